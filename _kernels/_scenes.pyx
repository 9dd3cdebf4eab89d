"""Light of scenes that are not uniform, at many times on all pixels."""

cdef extern from "_scenes.h" nogil:
    void waves_row(Py_ssize_t, Py_ssize_t, Py_ssize_t, const double*, const double*,
                   const double*, const double*, double*)
    void texture_row(Py_ssize_t, double, double, double, double, double, double,
                     double*, double*, double*)
    void fan_row(Py_ssize_t, double, const double*, const double*, const double*,
                 const double*, const double*, double*, double*)
    void analysed_row(Py_ssize_t, const double*, const double*, const double*,
                      const double*, const double*, const double*, double*)

cdef enum:
    SECTORS = 18            # of a wheel, from -12 on


def plane_waves(const double[:, ::1] down_c not None,
                const double[:, ::1] down_s not None,
                const double[:, ::1] cos not None, const double[:, ::1] sin not None,
                double[:, ::1] out not None):
    """Write to out (row, column) the sum over waves of down_c cos - down_s sin.

    down_c and down_s are (wave, row), cos and sin (wave, column); added in the order
    of the waves.
    """
    cdef Py_ssize_t waves = cos.shape[0], n = out.shape[1], rows = out.shape[0], row
    if (down_c.shape[0] != waves or down_s.shape[0] != waves or sin.shape[0] != waves
            or down_c.shape[1] != rows or down_s.shape[1] != rows or cos.shape[1] != n
            or sin.shape[1] != n):
        raise ValueError("plane_waves: shapes do not fit")
    if rows == 0 or n == 0:
        return
    if waves == 0:
        out[:, :] = 0.0
        return
    with nogil:
        for row in range(rows):
            waves_row(waves, n, rows, &down_c[0, row], &down_s[0, row], &cos[0, 0],
                      &sin[0, 0], &out[row, 0])


def texture_stokes(double[::1] first not None, double[::1] second not None,
                   double[::1] third not None, double s0, double contrast, double dolp,
                   double dolp_spread, double aop, double aop_spread):
    """Replace fields of ln intensity, DoLP and AoP by S0, S1 and S2.

    S0 is s0 exp(contrast first), DoLP dolp + dolp_spread sin(second), and AoP
    aop + aop_spread third, radians.  Fields lie in -1e5..1e5.
    """
    cdef Py_ssize_t n = first.shape[0]
    if second.shape[0] != n or third.shape[0] != n:
        raise ValueError("texture_stokes: shapes do not fit")
    if n == 0:
        return
    with nogil:
        texture_row(n, s0, contrast, dolp, dolp_spread, aop, aop_spread, &first[0],
                    &second[0], &third[0])


def fan_stokes(const double[::1] turns not None, const double[:, ::1] cosines not None,
               const double[:, ::1] sines not None, const double[::1] rest not None,
               const double[::1] steep not None, const double[::1] light not None,
               double[:, ::1] s1 not None, double[:, ::1] s2 not None):
    """Write S1 and S2 (time, place) of a wheel of six polarizers.

    turns: turn of the wheel in sectors, 0 to 6; cosines and sines (time, 18): of twice
    the polarizers' angles in sectors -12 to 5.  By place: rest, the azimuth in sectors,
    -3 to 3; steep, the width of a sector over that of an edge; light, S0 behind the
    wheel.
    """
    cdef Py_ssize_t times = turns.shape[0], n = rest.shape[0], k
    if (cosines.shape[0] != times or sines.shape[0] != times
            or cosines.shape[1] != SECTORS or sines.shape[1] != SECTORS
            or steep.shape[0] != n or light.shape[0] != n or s1.shape[0] != times
            or s2.shape[0] != times or s1.shape[1] != n or s2.shape[1] != n):
        raise ValueError("fan_stokes: shapes do not fit")
    for k in range(times):
        if not 0 <= turns[k] <= 6:
            raise ValueError("fan_stokes: turns must lie in 0..6")
    for k in range(n):
        if not -3.1 <= rest[k] <= 3.1:
            raise ValueError("fan_stokes: rest must lie in -3..3")
    if n == 0:
        return
    with nogil:
        for k in range(times):
            fan_row(n, turns[k], &cosines[k, 0], &sines[k, 0], &rest[0], &steep[0],
                    &light[0], &s1[k, 0], &s2[k, 0])


def analysed(const double[:, ::1] analyser not None, const double[:, ::1] s0 not None,
             const double[:, ::1] s1 not None, const double[:, ::1] s2 not None,
             double[:, ::1] out not None):
    """Write to out (time, pixel) the light on pixels from Stokes images (time, pixel).

    analyser is (3, pixel): the response to S0, S1, S2.  s0 (1, pixel) is constant.
    """
    cdef Py_ssize_t times = out.shape[0], n = out.shape[1], k
    cdef bint constant = s0.shape[0] == 1
    if (analyser.shape[0] != 3 or analyser.shape[1] != n or s0.shape[1] != n
            or (not constant and s0.shape[0] != times) or s1.shape[0] != times
            or s2.shape[0] != times or s1.shape[1] != n or s2.shape[1] != n):
        raise ValueError("analysed: shapes do not fit")
    if n == 0:
        return
    with nogil:
        for k in range(times):
            analysed_row(n, &analyser[0, 0], &analyser[1, 0], &analyser[2, 0],
                         &s0[0 if constant else k, 0], &s1[k, 0], &s2[k, 0],
                         &out[k, 0])
