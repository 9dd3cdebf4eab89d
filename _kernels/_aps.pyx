"""Kernels of the active pixel sensor's frames."""
from libc.stdint cimport uint8_t, uint16_t


def cds(const uint16_t[:, ::1] reset not None, const uint16_t[:, ::1] signal not None,
        const float[:, ::1] dark, const float[:, ::1] gain,
        uint16_t least_reset, uint16_t least_signal,
        float[:, ::1] dn not None, uint8_t[:, ::1] valid not None):
    """(reset - signal - dark) * gain, and whether neither read was at its limit.

    dark and gain may be None.
    """
    cdef Py_ssize_t h = dn.shape[0], w = dn.shape[1], y, x
    cdef bint has_dark = dark is not None, has_gain = gain is not None
    if (reset.shape[0] != h or reset.shape[1] != w or signal.shape[0] != h
            or signal.shape[1] != w or valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("cds: reset, signal, dn and valid must have one shape")
    if has_dark and (dark.shape[0] != h or dark.shape[1] != w):
        raise ValueError("cds: dark must have the frame's shape")
    if has_gain and (gain.shape[0] != h or gain.shape[1] != w):
        raise ValueError("cds: gain must have the frame's shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                dn[y, x] = <float>(<int>reset[y, x] - <int>signal[y, x])
                valid[y, x] = ((reset[y, x] >= least_reset)
                               & (signal[y, x] >= least_signal))
            if has_dark:
                for x in range(w):
                    dn[y, x] -= dark[y, x]
            if has_gain:
                for x in range(w):
                    dn[y, x] *= gain[y, x]


def correct(const float[:, ::1] raw not None, const float[:, ::1] dark,
            const float[:, ::1] gain, float clip_dn,
            float[:, ::1] dn not None, uint8_t[:, ::1] valid not None):
    """(raw - dark) * gain; valid is cleared where raw is at or over clip_dn, or NaN.

    dark and gain may be None.
    """
    cdef Py_ssize_t h = dn.shape[0], w = dn.shape[1], y, x
    cdef bint has_dark = dark is not None, has_gain = gain is not None
    if (raw.shape[0] != h or raw.shape[1] != w or valid.shape[0] != h
            or valid.shape[1] != w):
        raise ValueError("correct: raw, dn and valid must have one shape")
    if has_dark and (dark.shape[0] != h or dark.shape[1] != w):
        raise ValueError("correct: dark must have the frame's shape")
    if has_gain and (gain.shape[0] != h or gain.shape[1] != w):
        raise ValueError("correct: gain must have the frame's shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                dn[y, x] = raw[y, x]
                valid[y, x] &= raw[y, x] < clip_dn
            if has_dark:
                for x in range(w):
                    dn[y, x] -= dark[y, x]
            if has_gain:
                for x in range(w):
                    dn[y, x] *= gain[y, x]
