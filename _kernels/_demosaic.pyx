"""Demosaicing kernels."""
from libc.stdint cimport uint8_t

from _kernels._rows cimport (
    bilinear_row, check_places, plane_of_place, polarization_row, row_stride,
    scratch_row)
from _kernels._types cimport pixel_t
from _kernels._weighted cimport (
    BORDER_SLOPE, check_weighted, variance_row, weighted_row, weighted_t)


def bilinear(const pixel_t[:, ::1] mosaic not None,
             const Py_ssize_t[::1] places not None, bint uncertain,
             float[::1] scratch not None,
             float[:, :, ::1] out not None):
    """Interpolate each channel of mosaic (h, w), sides >= 2, into out (4, h, w).

    At borders it is extrapolated linearly, or if its samples are uncertain with
    BORDER_SLOPE of the slope.  scratch is 2 * (w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], y
    cdef float slope = BORDER_SLOPE if uncertain else 1.0
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
            bilinear_row(&mosaic[0, 0], y, h, w, slope, own, other, to)


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
            bilinear_row(&mosaic[0, 0], 2 * y, 2 * h, 2 * w, 1.0, own, other, upper)
            bilinear_row(&mosaic[0, 0], 2 * y + 1, 2 * h, 2 * w, 1.0, own, other,
                         lower)
            for k in range(4):
                to = &out[plane[k], y, 0]
                for x in range(w):
                    to[x] = quarter * ((upper[k][2 * x] + upper[k][2 * x + 1])
                                       + (lower[k][2 * x] + lower[k][2 * x + 1]))


def bilinear_variance(const float[:, ::1] variance not None,
                      const Py_ssize_t[::1] places not None,
                      float[::1] scratch not None, float[:, :, ::1] out not None):
    """Interpolate the variances of each channel's samples (h, w) into out (4, h, w).

    As `bilinear`, but mirrored at the borders.  scratch is 2 * (w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = variance.shape[0], w = variance.shape[1], y, c
    cdef Py_ssize_t plane[4]
    cdef float* to[4]
    cdef float* own
    cdef float* other
    if h < 2 or w < 2 or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w:
        raise ValueError(
            "bilinear_variance: variance must be (h, w), out (4, h, w), sides >= 2")
    if scratch.shape[0] < 2 * row_stride(w) + 32:
        raise ValueError("bilinear_variance: scratch must be 2 * (w + 32) + 32 floats")
    check_places(places)
    plane_of_place(places, plane)
    own = scratch_row(&scratch[0], 0, w)
    other = scratch_row(&scratch[0], 1, w)
    with nogil:
        for y in range(h):
            for c in range(4):
                to[c] = &out[plane[c], y, 0]
            variance_row(&variance[0, 0], y, h, w, own, other, to)


def bilinear_weighted(const float[:, ::1] mosaic not None,
                      const float[:, ::1] variance not None,
                      const Py_ssize_t[::1] places not None,
                      const float[::1] spread not None,
                      const float[:, :, ::1] null not None, rows not None,
                      float[::1] scratch not None, float[:, :, ::1] quad not None,
                      float[:, :, ::1] out not None, float gain,
                      float[:, ::1] aop not None, float[:, ::1] dolp not None):
    """Interpolate mosaic into quad, its variance (of ln I) into out; reconcile them.

    The same bits as `bilinear` of uncertain samples, `bilinear_variance`, `mismatch`
    with the four numbers of spread and `reconcile` with null, but row by row, so that
    intermediate results stay in the cache.  Only rows (first, last) are written;
    scratch is 2 * (w + 32) + 32 floats.  Unless aop and dolp have shape (0, 0), they
    receive what `s0_aop_dolp` gives with gain.
    """
    cdef weighted_t image
    cdef bint polarizes = aop.shape[0] > 0
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], first, last, y, c
    cdef float* q[4]
    cdef float* v[4]
    check_weighted(&image, mosaic, variance, places, spread, null, scratch, 2)
    if (quad.shape[0] != 4 or quad.shape[1] != h or quad.shape[2] != w
            or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w):
        raise ValueError("bilinear_weighted: quad and out must be (4, h, w)")
    if dolp.shape[0] != aop.shape[0] or dolp.shape[1] != aop.shape[1] or polarizes and (
            aop.shape[0] != h or aop.shape[1] != w):
        raise ValueError("bilinear_weighted: aop and dolp must be (h, w) or (0, 0)")
    first, last = rows
    if first < 0 or last > h:
        raise ValueError("bilinear_weighted: rows must lie in the mosaic")
    with nogil:
        for y in range(first, last):
            for c in range(4):
                q[c], v[c] = &quad[c, y, 0], &out[c, y, 0]
            weighted_row(&image, y, q, v)
            if polarizes:
                polarization_row(q[0], q[1], q[2], q[3], gain, w, image.own, &aop[y, 0],
                                 &dolp[y, 0])


cdef inline void keep_row(uint8_t* to, const uint8_t* of, Py_ssize_t n) noexcept nogil:
    cdef Py_ssize_t x
    for x in range(n):
        to[x] &= of[x]


def reached(const uint8_t[:, ::1] valid not None, rows not None,
            uint8_t[::1] scratch not None, uint8_t[:, ::1] out not None):
    """Write to rows (first, last) of out where all samples that `bilinear` uses are 1.

    These are the 3x3 around a pixel, and at a border those that it extrapolates from.
    scratch is w bytes; sides are at least 2.
    """
    cdef Py_ssize_t h = valid.shape[0], w = valid.shape[1], first, last, y, x
    first, last = rows
    if h < 2 or w < 2 or out.shape[0] != h or out.shape[1] != w or scratch.shape[0] < w:
        raise ValueError(
            "reached: valid and out must be (h, w), sides >= 2, scratch w bytes")
    if first < 0 or last > h:
        raise ValueError("reached: rows must lie in the image")
    with nogil:
        for y in range(first, last):
            for x in range(w):
                scratch[x] = valid[y, x]
            keep_row(&scratch[0], &valid[y - 1 if y else 1, 0], w)
            keep_row(&scratch[0], &valid[y + 1 if y + 1 < h else y - 1, 0], w)
            if h > 3 and y == 0:
                keep_row(&scratch[0], &valid[3, 0], w)
            if h > 3 and y == h - 1:
                keep_row(&scratch[0], &valid[h - 4, 0], w)
            for x in range(1, w - 1):
                out[y, x] = scratch[x - 1] & scratch[x] & scratch[x + 1]
            out[y, 0] = scratch[0] & scratch[1]
            out[y, w - 1] = scratch[w - 2] & scratch[w - 1]
            if w > 3:
                out[y, 0] &= scratch[3]
                out[y, w - 1] &= scratch[w - 4]
