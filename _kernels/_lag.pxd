"""Lag of the photoreceptor, a low-pass whose corner frequency may depend on the light.

The output y of a pixel follows y' = 2 pi (hz + hz_per_intensity I) (ln I - y), where I
is the intensity.  The lag is u = ln I - y (docs/theory/events.md).  Inline only.
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
    """
    const double PER_TURN
    const double LAG_LEAST
    const double LAG_MOST
    const double LINEAR_LAG_MOST
    const double LINEAR
    const double CONVERGED
    const double DERIVATIVE_LEAST
    const int NEWTON_STEPS


cdef inline double corner(const tuning_t* tuning, double level) noexcept nogil:
    """Corner frequency of a pixel whose output is level, Hz."""
    if tuning.bandwidth_hz_per_intensity <= 0.0:
        return tuning.bandwidth_hz
    return tuning.bandwidth_hz + tuning.bandwidth_hz_per_intensity * exp_f(
        <float>level)


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
