"""Stokes parameters, angle and degree of linear polarization."""
from _kernels._rows cimport aop_row, dolp_row, mix_row, polarization_row, stokes_row


def stokes(const float[:, ::1] quad not None, float gain,
           float[:, ::1] out not None):
    """S0, S1, S2 of quad (4, n) into out (3, n); S1 and S2 are multiplied by gain."""
    cdef Py_ssize_t n = quad.shape[1]
    if quad.shape[0] != 4 or out.shape[0] != 3 or out.shape[1] != n:
        raise ValueError("stokes: quad must be (4, n) and out (3, n)")
    if n == 0:
        return
    with nogil:
        stokes_row(&quad[0, 0], &quad[1, 0], &quad[2, 0], &quad[3, 0], gain, n,
                   &out[0, 0], &out[1, 0], &out[2, 0])


def mix(const float[:, ::1] quad not None, const float[:, ::1] solution not None,
        float[:, ::1] out not None):
    """Multiply quad (4, n) by a 3x4 matrix: out[i] = sum(solution[4 i + k] * quad[k]).

    solution is (12, n), a matrix per sample, or (12, 1), one for all.
    """
    cdef Py_ssize_t n = quad.shape[1], step = 0 if solution.shape[1] == 1 else 1, i
    if quad.shape[0] != 4 or out.shape[0] != 3 or out.shape[1] != n:
        raise ValueError("mix: quad must be (4, n) and out (3, n)")
    if solution.shape[0] != 12 or (step and solution.shape[1] != n):
        raise ValueError("mix: solution must be (12, n) or (12, 1)")
    if n == 0:
        return
    with nogil:
        for i in range(3):
            mix_row(&quad[0, 0], &quad[1, 0], &quad[2, 0], &quad[3, 0],
                    &solution[4 * i, 0], &solution[4 * i + 1, 0],
                    &solution[4 * i + 2, 0], &solution[4 * i + 3, 0], step, n,
                    &out[i, 0])


def aop(const float[::1] s1 not None, const float[::1] s2 not None,
        float[::1] out not None):
    """Half the angle of (s1, s2), in [0, pi)."""
    cdef Py_ssize_t n = out.shape[0]
    if s1.shape[0] != n or s2.shape[0] != n:
        raise ValueError("aop: s1, s2 and out must be equally long")
    if n == 0:
        return
    with nogil:
        aop_row(&s1[0], &s2[0], n, &out[0])


def dolp(const float[::1] s0 not None, const float[::1] s1 not None,
         const float[::1] s2 not None, float[::1] out not None):
    """The length of (s1, s2) over s0; 0 where s0 is not positive."""
    cdef Py_ssize_t n = out.shape[0]
    if s0.shape[0] != n or s1.shape[0] != n or s2.shape[0] != n:
        raise ValueError("dolp: s0, s1, s2 and out must be equally long")
    if n == 0:
        return
    with nogil:
        dolp_row(&s0[0], &s1[0], &s2[0], n, &out[0])


def s0_aop_dolp(const float[:, ::1] quad not None, float gain, float[::1] s0 not None,
                float[::1] aop not None, float[::1] dolp not None):
    """S0, angle and degree of quad (4, n) in one pass; gain as in `stokes`."""
    cdef Py_ssize_t n = quad.shape[1]
    if (quad.shape[0] != 4 or s0.shape[0] != n or aop.shape[0] != n
            or dolp.shape[0] != n):
        raise ValueError("s0_aop_dolp: quad must be (4, n), s0, aop and dolp (n,)")
    if n:
        with nogil:
            polarization_row(&quad[0, 0], &quad[1, 0], &quad[2, 0], &quad[3, 0], gain,
                             n, &s0[0], &aop[0], &dolp[0])
