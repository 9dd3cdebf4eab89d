"""Lag of the photoreceptor, a low-pass whose corner frequency may depend on the light.

The output y of a pixel follows y' = 2 pi (hz + hz_per_intensity I) (ln I - y), where I
is the intensity.  The lag is u = ln I - y (docs/theory/kalman.md).  Inline only.
"""
from _kernels._math cimport exp_f
from _kernels._model cimport tuning_t

cdef extern from *:
    """
    #define PER_TURN 0.15915494309189535    /* 1 / (2 pi) */
    /* Bounds of the lag u, ln units.  The lower one is where y' stops determining u:
       for hz = 0, y' is proportional to u e^u, which has its minimum at u = -1 and is
       within 1.3 % of it at -0.85. */
    #define LAG_LEAST -0.85
    #define LAG_MOST 2.0
    #define LINEAR_LAG_MOST 3.0             /* bound of |u| if hz_per_intensity is 0 */
    /* Newton's method: up to |u| = LINEAR one step suffices; it has converged when a
       step is below CONVERGED; lower bound of the derivative, relative to its value
       for a corner frequency that does not change with u. */
    #define LINEAR 0.02
    #define CONVERGED 1e-4
    #define DERIVATIVE_LEAST 0.05
    #define NEWTON_STEPS 8
    /* Standard error (ln units) of a light that falls faster than a pixel can follow:
       LOST_SLOPE (r - LOST_FROM), where r is the rate of fall (1/s) divided by 2 pi
       times the corner frequency; lab/studies/kalman_interpolation.py. */
    #define LOST_FROM 0.24
    #define LOST_SLOPE 3.0
    #define LAG_VARIANCE_MOST 1.0           /* ln^2: nothing is known of the lag */
    """
    const double PER_TURN
    const double LAG_LEAST
    const double LAG_MOST
    const double LINEAR_LAG_MOST
    const double LINEAR
    const double CONVERGED
    const double DERIVATIVE_LEAST
    const int NEWTON_STEPS
    const double LOST_FROM
    const double LOST_SLOPE
    const double LAG_VARIANCE_MOST


cdef inline double corner(const tuning_t* tuning, double level) noexcept nogil:
    """Corner frequency of a pixel whose output is level, Hz."""
    if tuning.bandwidth_hz_per_intensity <= 0.0:
        return tuning.bandwidth_hz
    return tuning.bandwidth_hz + tuning.bandwidth_hz_per_intensity * exp_f(
        <float>level)


cdef inline double lead_variance(double u, double rate_var, double fall,
                                 double shown, const tuning_t* tuning) noexcept nogil:
    """Variance of the lag u that `lead` returns, ln^2.

    First-order propagation, through the equation that `lead` solves, of rate_var, the
    variance of the slope (1/s^2), and of the relative error of the corner frequency.
    If the corner frequency is proportional to the light, the output falls at most at
    1/e of 2 pi times the corner frequency, and how far the light falls beyond that
    cannot be seen.  fall is the output's rate of fall, 1/s.
    """
    cdef double hz = tuning.bandwidth_hz
    cdef double slope = tuning.bandwidth_hz_per_intensity, e = 0.0, d, v, lost = 0.0
    if hz <= 0.0 and slope <= 0.0:
        return 0.0
    if slope > 0.0:
        e = slope * exp_f(<float>shown)
        lost = fall * PER_TURN * e / ((hz + e) * (hz + e))
        lost = LOST_SLOPE * (lost - LOST_FROM) if lost > LOST_FROM else 0.0
        e = slope * exp_f(<float>(shown + u))
    d = hz + e * (1.0 + u)
    if d < DERIVATIVE_LEAST * (hz + e):
        d = DERIVATIVE_LEAST * (hz + e)
    v = tuning.bandwidth_sigma * u * (hz + e)
    v = (PER_TURN * PER_TURN * rate_var + v * v) / (d * d) + lost * lost
    return v if v < LAG_VARIANCE_MOST else LAG_VARIANCE_MOST


cdef inline double lead(double slope, double shown,
                        const tuning_t* tuning) noexcept nogil:
    """Return the lag u = ln I - y of a pixel: log intensity minus the pixel's output.

    Solves slope = 2 pi (hz + hz_per_level I) u for u, where slope is y' (1/s), shown is
    y and I = e^(y + u).  The result is clipped to LAG_LEAST and LAG_MOST, because y'
    does not determine an intensity far below the output.
    """
    cdef double hz = tuning.bandwidth_hz
    cdef double hz_per_level = tuning.bandwidth_hz_per_intensity, c, u, e, f, g, level
    cdef int _
    if slope == 0.0:
        return 0.0
    if hz_per_level <= 0.0:
        if hz <= 0.0:
            return 0.0
        u = slope * PER_TURN / hz
        return (LINEAR_LAG_MOST if u > LINEAR_LAG_MOST
                else -LINEAR_LAG_MOST if u < -LINEAR_LAG_MOST else u)
    c = slope * PER_TURN
    level = exp_f(<float>shown)
    f = hz + hz_per_level * level
    u = c / f
    if u < LINEAR and u > -LINEAR:
        return u * (1.0 - u * hz_per_level * level / f)
    u = 0.0
    for _ in range(NEWTON_STEPS):
        e = hz_per_level * level * exp_f(<float>u)
        g = u * (hz + e) - c
        f = hz + e * (1.0 + u)
        if f < DERIVATIVE_LEAST * (hz + e):
            f = DERIVATIVE_LEAST * (hz + e)
        g /= f
        u -= g
        u = LAG_MOST if u > LAG_MOST else LAG_LEAST if u < LAG_LEAST else u
        if g < CONVERGED and g > -CONVERGED:
            break
    return u
