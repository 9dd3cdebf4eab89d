"""Pictures for people: values through a table of colours to 8-bit BGR."""
from libc.math cimport floor, sqrt
from libc.stdint cimport uint8_t

ctypedef fused plane_t:
    float
    double


cdef int check(Py_ssize_t size, const uint8_t[::1] valid,
               const uint8_t[:, ::1] table, const uint8_t[::1] invalid,
               uint8_t[:, ::1] out) except -1:
    if valid.shape[0] != 0 and valid.shape[0] != size:
        raise ValueError("picture: valid must be empty or as long as plane")
    if table.shape[0] == 0 or table.shape[1] != 3:
        raise ValueError("picture: table must be (n, 3), n > 0")
    if invalid.shape[0] != 3:
        raise ValueError("picture: invalid must hold 3 values")
    if out.shape[0] != size or out.shape[1] != 3:
        raise ValueError("picture: out must be (size, 3)")
    return 0


cdef inline void put(uint8_t* out, const uint8_t* colour) noexcept nogil:
    out[0] = colour[0]
    out[1] = colour[1]
    out[2] = colour[2]


def hue_bgr(const plane_t[::1] plane not None, const uint8_t[::1] valid not None,
            double scale, const uint8_t[:, ::1] table not None,
            const uint8_t[::1] invalid not None, uint8_t[:, ::1] out not None):
    """Write table[round(plane * scale) modulo its length] to out.

    Where the value is not finite, or valid (if not empty) is 0, write invalid.
    """
    cdef Py_ssize_t size = plane.shape[0], i
    cdef double n = table.shape[0], value
    cdef bint masked = valid.shape[0] > 0
    check(size, valid, table, invalid, out)
    with nogil:
        for i in range(size):
            value = plane[i] * scale
            if masked and not valid[i] or value - value != 0:
                put(&out[i, 0], &invalid[0])
                continue
            value += 0.5
            if not 0 <= value < n:
                value -= n * floor(value / n)
                if not 0 <= value < n:   # rounding, or too large for a turn to count
                    value = 0
            put(&out[i, 0], &table[<Py_ssize_t> value, 0])


def ramp_bgr(const plane_t[::1] plane not None, const uint8_t[::1] valid not None,
             double scale, const uint8_t[:, ::1] table not None,
             const uint8_t[::1] invalid not None, uint8_t[:, ::1] out not None):
    """Write table[round(plane * scale)], clamped to its ends, to out.

    Where the value is NaN, or valid (if not empty) is 0, write invalid.
    """
    cdef Py_ssize_t size = plane.shape[0], i
    cdef double top = table.shape[0] - 1, value
    cdef bint masked = valid.shape[0] > 0
    check(size, valid, table, invalid, out)
    with nogil:
        for i in range(size):
            value = plane[i] * scale
            if masked and not valid[i] or value != value:
                put(&out[i, 0], &invalid[0])
                continue
            value = 0 if value < 0 else top if value > top else value
            put(&out[i, 0], &table[<Py_ssize_t> (value + 0.5), 0])


def tone_bgr(const plane_t[::1] plane not None, const uint8_t[::1] valid not None,
             double scale, const uint8_t[:, ::1] table not None,
             const uint8_t[::1] invalid not None, uint8_t[:, ::1] out not None):
    """As ramp_bgr, but of sqrt(plane * scale): fine steps where the light is dim."""
    cdef Py_ssize_t size = plane.shape[0], i
    cdef double top = table.shape[0] - 1, value
    cdef bint masked = valid.shape[0] > 0
    check(size, valid, table, invalid, out)
    with nogil:
        for i in range(size):
            value = plane[i] * scale
            if masked and not valid[i] or value != value:
                put(&out[i, 0], &invalid[0])
                continue
            value = sqrt(value) if value > 0 else 0
            if value > top:
                value = top
            put(&out[i, 0], &table[<Py_ssize_t> (value + 0.5), 0])
