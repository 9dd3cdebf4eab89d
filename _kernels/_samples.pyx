"""Frames as samples of log intensity."""
from libc.stdint cimport uint8_t

cdef extern from "_samples.h" nogil:
    void log_row(const float*, const unsigned char*, const float*, Py_ssize_t, float*,
                 unsigned char*)


def log_frame(const float[:, ::1] dn not None, const uint8_t[:, ::1] usable not None,
              const float[::1] log_exposure not None, float[:, ::1] out not None,
              uint8_t[:, ::1] valid not None):
    """Write ln(max(dn, 1)) - log_exposure[column], and usable where dn >= 1."""
    cdef Py_ssize_t h = out.shape[0], w = out.shape[1], y
    if (dn.shape[0] != h or usable.shape[0] != h or valid.shape[0] != h
            or dn.shape[1] != w or usable.shape[1] != w or valid.shape[1] != w
            or log_exposure.shape[0] != w):
        raise ValueError("log_frame: all arrays must have one shape")
    if w == 0:
        return
    with nogil:
        for y in range(h):
            log_row(&dn[y, 0], &usable[y, 0], &log_exposure[0], w, &out[y, 0],
                    &valid[y, 0])
