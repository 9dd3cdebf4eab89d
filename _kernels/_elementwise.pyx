"""Functions of each element, the same bits on every CPU."""
from _kernels._math cimport exp_f


def exp(const float[:, ::1] x not None, float[:, ::1] out not None):
    """Write e^x to out, same shape; x is clamped to +-87."""
    cdef Py_ssize_t height = x.shape[0], width = x.shape[1]
    cdef Py_ssize_t row, col
    if out.shape[0] != height or out.shape[1] != width:
        raise ValueError("exp: x and out must have the same shape")
    with nogil:
        for row in range(height):
            for col in range(width):
                out[row, col] = exp_f(x[row, col])


def mismatch(const float[:, :, ::1] quad not None, float gain, float angle,
             float contrast, float[:, :, ::1] variance not None):
    """Add to variance (of ln I) what pixels differ by from their nominal response.

    quad and variance are (4, row, column).  gain is the standard deviation of a
    pixel's relative sensitivity, angle that of its polarizer's angle in radians,
    contrast that of (ER - 1) / (ER + 1).
    """
    cdef Py_ssize_t height = quad.shape[1], width = quad.shape[2], row, col, k
    cdef float side, across, least, v, most = 1.0, tiny = 1e-30, quarter = 0.25
    cdef float part = 1e-4
    if (quad.shape[0] != 4 or variance.shape[0] != 4 or variance.shape[1] != height
            or variance.shape[2] != width):
        raise ValueError("mismatch: quad and variance must be (4, h, w)")
    angle *= angle
    contrast *= contrast * quarter
    gain *= gain
    with nogil:
        for row in range(height):
            for col in range(width):
                least = tiny
                for k in range(4):
                    least += quad[k, row, col]
                least *= least * part
                for k in range(4):
                    side = quad[(k + 1) & 3, row, col] - quad[(k + 3) & 3, row, col]
                    across = quad[k, row, col] - quad[(k + 2) & 3, row, col]
                    v = quad[k, row, col] * quad[k, row, col]
                    v = v if v > least else least
                    v = (angle * side * side + contrast * across * across) / v
                    variance[k, row, col] += gain + (v if v < most else most)


def reconcile(float[:, :, ::1] quad not None, const float[:, :, ::1] variance not None,
              const float[:, :, ::1] null not None):
    """Move quad, in place, onto the intensities that Stokes parameters can give.

    null . quad = 0 there.  quad and variance (of ln I) are (4, row, column); null is
    (4, row, column) or (4, 1, 1).  Each channel takes its share by the variance of its
    intensity, (I^2 variance); a later least-squares solution is then the one weighted
    so, whatever its own weights.
    """
    cdef Py_ssize_t height = quad.shape[1], width = quad.shape[2]
    cdef Py_ssize_t row, col, k, ny, nx
    cdef bint one = null.shape[1] == 1 and null.shape[2] == 1
    cdef float gap, total, tiny = 1e-30
    cdef float share[4]
    if (quad.shape[0] != 4 or variance.shape[0] != 4 or null.shape[0] != 4
            or variance.shape[1] != height or variance.shape[2] != width):
        raise ValueError("reconcile: quad and variance must be (4, h, w)")
    if not one and (null.shape[1] != height or null.shape[2] != width):
        raise ValueError("reconcile: null must be (4, h, w) or (4, 1, 1)")
    with nogil:
        for row in range(height):
            for col in range(width):
                ny = 0 if one else row
                nx = 0 if one else col
                gap = 0
                total = tiny
                for k in range(4):
                    share[k] = (quad[k, row, col] * quad[k, row, col]
                                * variance[k, row, col] * null[k, ny, nx])
                    gap += null[k, ny, nx] * quad[k, row, col]
                    total += null[k, ny, nx] * share[k]
                for k in range(4):
                    quad[k, row, col] -= share[k] * (gap / total)
