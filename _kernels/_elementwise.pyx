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
