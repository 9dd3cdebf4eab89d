"""Functions of each pixel, with the same bits on every CPU."""
from _kernels._types cimport pixel_t
from _kernels._weighted cimport mismatch_row, reconcile_row

cdef extern from "_curves.h" nogil:
    void exp_row(const float*, Py_ssize_t, float*)


def exp(const float[:, ::1] x not None, float[:, ::1] out not None):
    """Write e^x to out, same shape; x is clamped to +-87."""
    cdef Py_ssize_t height = x.shape[0], width = x.shape[1], row
    if out.shape[0] != height or out.shape[1] != width:
        raise ValueError("exp: x and out must have the same shape")
    if width == 0:
        return
    with nogil:
        for row in range(height):
            exp_row(&x[row, 0], width, &out[row, 0])


def mismatch(const float[:, :, ::1] quad not None, float gain, float angle,
             float contrast, float offset, float[:, :, ::1] variance not None):
    """Add to variance (of ln I) that of the mismatch of the pixels' responses.

    quad and variance are (4, row, column).  gain is the standard deviation of a
    pixel's relative sensitivity, angle that of its polarizer's angle in radians,
    contrast that of (ER - 1) / (ER + 1), offset that of its intensity.
    """
    cdef Py_ssize_t height = quad.shape[1], width = quad.shape[2], row
    cdef float quarter = 0.25
    if (quad.shape[0] != 4 or variance.shape[0] != 4 or variance.shape[1] != height
            or variance.shape[2] != width):
        raise ValueError("mismatch: quad and variance must be (4, h, w)")
    if width == 0:
        return
    angle *= angle
    contrast *= contrast * quarter
    gain *= gain
    offset *= offset
    with nogil:
        for row in range(height):
            mismatch_row(
                &quad[0, row, 0], &quad[1, row, 0], &quad[2, row, 0], &quad[3, row, 0],
                gain, angle, contrast, offset, width, &variance[0, row, 0],
                &variance[1, row, 0], &variance[2, row, 0], &variance[3, row, 0])


def reconcile(float[:, :, ::1] quad not None, const float[:, :, ::1] variance not None,
              const float[:, :, ::1] null not None):
    """Project quad, in place, onto the intensities that Stokes parameters can produce.

    These satisfy null . quad = 0.  quad and variance (of ln I) are (4, row, column);
    null is (4, row, column) or (4, 1, 1).  The projection is weighted by the inverse
    variances of the intensities, I^2 variance: a later least-squares solution is then
    the weighted one, whatever its own weights.
    """
    cdef Py_ssize_t height = quad.shape[1], width = quad.shape[2]
    cdef Py_ssize_t row, at
    cdef bint one = null.shape[1] == 1 and null.shape[2] == 1
    if (quad.shape[0] != 4 or variance.shape[0] != 4 or null.shape[0] != 4
            or variance.shape[1] != height or variance.shape[2] != width):
        raise ValueError("reconcile: quad and variance must be (4, h, w)")
    if not one and (null.shape[1] != height or null.shape[2] != width):
        raise ValueError("reconcile: null must be (4, h, w) or (4, 1, 1)")
    if width == 0:
        return
    with nogil:
        for row in range(height):
            at = 0 if one else row
            reconcile_row(
                &quad[0, row, 0], &quad[1, row, 0], &quad[2, row, 0], &quad[3, row, 0],
                &variance[0, row, 0], &variance[1, row, 0], &variance[2, row, 0],
                &variance[3, row, 0], &null[0, at, 0], &null[1, at, 0],
                &null[2, at, 0], &null[3, at, 0], one, width)


cdef enum:
    CHUNK = 1024


cdef inline void add_image(float* i, float* j, float* k, float* l,
                           const pixel_t* image, float a, float b, float c, float d,
                           Py_ssize_t n) noexcept nogil:
    cdef Py_ssize_t x
    cdef float value
    for x in range(n):
        value = <float>image[x]
        i[x] += a * value
        j[x] += b * value
        k[x] += c * value
        l[x] += d * value


cdef inline void add_square(float* rest, const pixel_t* image, const float* a,
                            const float* q, Py_ssize_t stride, Py_ssize_t n
                            ) noexcept nogil:
    cdef Py_ssize_t x
    cdef float r, a0 = a[0], a1 = a[1], a2 = a[2], a3 = a[3]
    for x in range(n):
        r = <float>image[x] - (a0 * q[x] + a1 * q[stride + x] + a2 * q[2 * stride + x]
                               + a3 * q[3 * stride + x])
        rest[x] += r * r


def least_squares(const pixel_t[:, ::1] images not None,
                  const float[:, ::1] solution not None,
                  const float[:, ::1] response not None,
                  float[:, ::1] out not None, float[::1] rest not None):
    """Write solution (4, n) times images (n, p) to out (4, p).

    rest (p) gets the sum of squares of images less response (n, 4) times out.
    """
    cdef Py_ssize_t n = images.shape[0], p = images.shape[1], begin, m, j, k, x
    cdef float zero = 0
    if (solution.shape[0] != 4 or solution.shape[1] != n or response.shape[0] != n
            or response.shape[1] != 4 or out.shape[0] != 4 or out.shape[1] != p
            or rest.shape[0] != p):
        raise ValueError("least_squares: images must be (n, p), solution (4, n), "
                         "response (n, 4), out (4, p), rest p floats")
    with nogil:
        for k in range((p + CHUNK - 1) // CHUNK):
            begin = k * CHUNK
            m = p - begin if p - begin < CHUNK else CHUNK
            for x in range(begin, begin + m):
                out[0, x] = out[1, x] = out[2, x] = out[3, x] = rest[x] = zero
            for j in range(n):
                add_image(&out[0, begin], &out[1, begin], &out[2, begin],
                          &out[3, begin], &images[j, begin], solution[0, j],
                          solution[1, j], solution[2, j], solution[3, j], m)
            for j in range(n):
                add_square(&rest[begin], &images[j, begin], &response[j, 0],
                           &out[0, begin], p, m)
