"""Demosaicing kernels."""
from _kernels._rows cimport (
    bilinear_row, check_places, plane_of_place, row_stride, scratch_row)
from _kernels._types cimport pixel_t


def superpixel(const pixel_t[:, ::1] mosaic not None,
               const Py_ssize_t[::1] places not None,
               float[:, :, ::1] out not None):
    """Copy each 2x2 cell of mosaic (2h, 2w) into out (4, h, w), channel by channel.

    places[c] is the place of channel c in the cell: 0 top left, 1 top right,
    2 bottom left, 3 bottom right.
    """
    cdef Py_ssize_t h = out.shape[1], w = out.shape[2]
    cdef Py_ssize_t c, y, x, dy, dx
    if out.shape[0] != 4 or mosaic.shape[0] != 2 * h or mosaic.shape[1] != 2 * w:
        raise ValueError("superpixel: mosaic must be (2h, 2w) and out (4, h, w)")
    check_places(places)
    with nogil:
        for c in range(4):
            dy = places[c] >> 1
            dx = places[c] & 1
            for y in range(h):
                for x in range(w):
                    out[c, y, x] = <float>mosaic[2 * y + dy, 2 * x + dx]


def bilinear(const pixel_t[:, ::1] mosaic not None,
             const Py_ssize_t[::1] places not None,
             float[::1] scratch not None,
             float[:, :, ::1] out not None):
    """Interpolate each channel of mosaic (h, w), sides >= 2, into out (4, h, w).

    scratch is 2 * (w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], y
    cdef Py_ssize_t plane[4]
    cdef float* to[4]
    cdef float* own
    cdef float* other
    if h < 2 or w < 2 or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w:
        raise ValueError("bilinear: mosaic must be (h, w), out (4, h, w), sides >= 2")
    if scratch.shape[0] < 2 * row_stride(w) + 32:
        raise ValueError("bilinear: scratch must be 2 * (w + 32) + 32 floats")
    check_places(places)
    plane_of_place(places, plane)
    own = scratch_row(&scratch[0], 0, w)
    other = scratch_row(&scratch[0], 1, w)
    with nogil:
        for y in range(h):
            to[0] = &out[plane[0], y, 0]
            to[1] = &out[plane[1], y, 0]
            to[2] = &out[plane[2], y, 0]
            to[3] = &out[plane[3], y, 0]
            bilinear_row(&mosaic[0, 0], y, h, w, own, other, to)


def binned(const pixel_t[:, ::1] mosaic not None,
           const Py_ssize_t[::1] places not None,
           float[::1] scratch not None,
           float[:, :, ::1] out not None):
    """Mean of bilinear's four pixels of each cell of mosaic (2h, 2w), out (4, h, w).

    scratch is 10 * (2 w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = out.shape[1], w = out.shape[2], y, x, k
    cdef Py_ssize_t plane[4]
    cdef float* upper[4]
    cdef float* lower[4]
    cdef float* to
    cdef float* own
    cdef float* other
    cdef float quarter = 0.25
    if (out.shape[0] != 4 or h < 1 or w < 1 or mosaic.shape[0] != 2 * h
            or mosaic.shape[1] != 2 * w):
        raise ValueError("binned: mosaic must be (2h, 2w) and out (4, h, w), not empty")
    if scratch.shape[0] < 10 * row_stride(2 * w) + 32:
        raise ValueError("binned: scratch must be 10 * (2 w + 32) + 32 floats")
    check_places(places)
    plane_of_place(places, plane)
    own = scratch_row(&scratch[0], 0, 2 * w)
    other = scratch_row(&scratch[0], 1, 2 * w)
    for k in range(4):
        upper[k] = scratch_row(&scratch[0], 2 + k, 2 * w)
        lower[k] = scratch_row(&scratch[0], 6 + k, 2 * w)
    with nogil:
        for y in range(h):
            bilinear_row(&mosaic[0, 0], 2 * y, 2 * h, 2 * w, own, other, upper)
            bilinear_row(&mosaic[0, 0], 2 * y + 1, 2 * h, 2 * w, own, other, lower)
            for k in range(4):
                to = &out[plane[k], y, 0]
                for x in range(w):
                    to[x] = quarter * ((upper[k][2 * x] + upper[k][2 * x + 1])
                                       + (lower[k][2 * x] + lower[k][2 * x + 1]))
