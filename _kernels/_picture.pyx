"""Pictures for people: intensity through a table to 8-bit BGR."""
from libc.stdint cimport uint8_t


def tone_bgr(const float[:, ::1] plane not None, float scale,
             const uint8_t[::1] table not None, uint8_t[:, :, ::1] out not None):
    """Write table[round(plane * scale)] to the three channels of out.

    The product is clamped to 0..65535, NaN counts as 0; table holds 65536 values.
    """
    cdef Py_ssize_t height = plane.shape[0], width = plane.shape[1], row, col
    cdef float value, top = 65535, half = 0.5
    cdef uint8_t grey
    if table.shape[0] != 65536:
        raise ValueError("tone_bgr: table must hold 65536 values")
    if out.shape[0] != height or out.shape[1] != width or out.shape[2] != 3:
        raise ValueError("tone_bgr: out must be (height, width, 3)")
    with nogil:
        for row in range(height):
            for col in range(width):
                value = plane[row, col] * scale
                if not value > 0:
                    value = 0
                elif value > top:
                    value = top
                grey = table[<Py_ssize_t> (value + half)]
                out[row, col, 0] = grey
                out[row, col, 1] = grey
                out[row, col, 2] = grey
