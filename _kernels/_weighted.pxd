"""Bilinear interpolation weighted by variances, row by row."""
from _kernels._rows cimport (
    bilinear_row, bilinear_row_f32, check_places, plane_of_place, row_stride,
    scratch_row)

cdef extern from *:
    """
    /* Share of the slope with which an uncertain channel continues beyond a border:
       docs/theory/demosaicing.md derives it. */
    #define BORDER_SLOPE 0.5f
    """
    const float BORDER_SLOPE

cdef extern from "_channels.h" nogil:
    void mismatch_row(
        const float*, const float*, const float*, const float*, float, float, float,
        float, Py_ssize_t, float*, float*, float*, float*)
    void reconcile_row(
        float*, float*, float*, float*, const float*, const float*, const float*,
        const float*, const float*, const float*, const float*, const float*, bint,
        Py_ssize_t)


cdef struct weighted_t:
    Py_ssize_t h, w
    const float* mosaic         # (h, w)
    const float* variance       # (h, w), of ln I
    Py_ssize_t plane[4]         # the channel at each place of a cell
    float gain, angle, contrast, offset     # variances, the third divided by 4
    const float* null           # (4, h, w), or (4, 1, 1): `one`
    bint one
    float* own                  # two rows of scratch
    float* other


cdef inline int check_weighted(
        weighted_t* to, const float[:, ::1] mosaic, const float[:, ::1] variance,
        const Py_ssize_t[::1] places, const float[::1] spread,
        const float[:, :, ::1] null, float[::1] scratch, Py_ssize_t rows) except -1:
    """Write what is interpolated, and the first two rows of scratch, to a struct."""
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1]
    cdef float quarter = 0.25
    to.one = null.shape[1] == 1 and null.shape[2] == 1
    if (h < 2 or w < 2 or variance.shape[0] != h or variance.shape[1] != w
            or null.shape[0] != 4):
        raise ValueError("mosaic and variance must be (h, w), sides >= 2")
    if not to.one and (null.shape[1] != h or null.shape[2] != w):
        raise ValueError("null must be (4, h, w) or (4, 1, 1)")
    if spread.shape[0] != 4:
        raise ValueError("spread must be four numbers")
    if scratch.shape[0] < rows * row_stride(w) + 32:
        raise ValueError(f"scratch must be {rows} * (w + 32) + 32 floats")
    check_places(places)
    plane_of_place(places, to.plane)
    to.gain = spread[0] * spread[0]
    to.angle = spread[1] * spread[1]
    to.contrast = spread[2] * (spread[2] * quarter)
    to.offset = spread[3] * spread[3]
    to.h, to.w = h, w
    to.mosaic, to.variance, to.null = &mosaic[0, 0], &variance[0, 0], &null[0, 0, 0]
    to.own = scratch_row(&scratch[0], 0, w)
    to.other = scratch_row(&scratch[0], 1, w)
    return 0


cdef inline void variance_row(
        const float* variance, Py_ssize_t y, Py_ssize_t h, Py_ssize_t w, float* own,
        float* other, float** to) noexcept nogil:
    """As bilinear_row, but mirrored at the borders instead of extrapolated.

    Linear extrapolation of variances could be negative.
    """
    cdef Py_ssize_t up = y - 1 if y else 1, down = y + 1 if y + 1 < h else h - 2
    cdef Py_ssize_t p = 2 * (y & 1), q = 2 - p, c, column
    bilinear_row_f32(variance + y * w, variance + up * w, variance + down * w, 0,
                     1.0, w, own, other, to[p], to[p + 1], to[q], to[q + 1])
    for c in range(4):
        column = c & 1
        if column == 1:
            to[c][0] = to[c][1]
        if (w - 1) & 1 != column:
            to[c][w - 1] = to[c][w - 2]


cdef inline void weighted_row(
        const weighted_t* of, Py_ssize_t y, float** q, float** v) noexcept nogil:
    """Write row y of the four channels to q, and of their variances to v."""
    cdef Py_ssize_t h = of.h, w = of.w, c
    cdef Py_ssize_t step = 1 if of.one else h * w, at = 0 if of.one else y * w
    cdef float* to[4]
    for c in range(4):
        to[c] = q[of.plane[c]]
    bilinear_row(of.mosaic, y, h, w, BORDER_SLOPE, of.own, of.other, to)
    for c in range(4):
        to[c] = v[of.plane[c]]
    variance_row(of.variance, y, h, w, of.own, of.other, to)
    mismatch_row(q[0], q[1], q[2], q[3], of.gain, of.angle, of.contrast, of.offset, w,
                 v[0], v[1], v[2], v[3])
    reconcile_row(q[0], q[1], q[2], q[3], v[0], v[1], v[2], v[3], of.null + at,
                  of.null + step + at, of.null + 2 * step + at,
                  of.null + 3 * step + at, of.one, w)
