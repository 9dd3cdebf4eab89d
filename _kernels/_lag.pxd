"""The lag of a pixel's photoreceptor: a low-pass whose corner follows the light.

A pixel shows y with y' = 2 pi (hz + hz_per_intensity I) (ln I - y), I the light.
Inline only.
"""
from _kernels._math cimport exp_f
from _kernels._model cimport tuning_t

cdef extern from *:
    """
    #define PER_TURN 0.15915494309189535    /* 1 / (2 pi) */
    /* ln I - y is solved for within these bounds (natural-log units).  Below, y' no
       longer tells I: for hz = 0, k I (ln I - y) is least at ln I = y - 1, and within
       1.3 % of that from -0.85 on. */
    #define FALL_MOST -0.85
    #define RISE_MOST 2.0
    #define STRAIGHT_MOST 3.0               /* the same for hz_per_intensity = 0 */
    /* Newton's method: one step will do below LINEAR; it has converged at CONVERGED;
       the derivative is at least STIFF of what it is without the lag. */
    #define LINEAR 0.02
    #define CONVERGED 1e-4
    #define STIFF 0.05
    #define NEWTON_STEPS 8
    /* Error (ln units) of a light that falls faster than a pixel can show, by how much
       it falls over the corner frequency; studies/kalman_interpolation.py. */
    #define LOST_FROM 0.24
    #define LOST_SLOPE 3.0
    #define LAG_VARIANCE_MOST 1.0           /* ln^2: nothing is known of the lag */
    """
    const double PER_TURN
    const double FALL_MOST
    const double RISE_MOST
    const double STRAIGHT_MOST
    const double LINEAR
    const double CONVERGED
    const double STIFF
    const int NEWTON_STEPS
    const double LOST_FROM
    const double LOST_SLOPE
    const double LAG_VARIANCE_MOST


cdef inline double corner(const tuning_t* tuning, double level) noexcept nogil:
    """Corner frequency of a pixel that shows level, Hz."""
    if tuning.bandwidth_hz_per_intensity <= 0.0:
        return tuning.bandwidth_hz
    return tuning.bandwidth_hz + tuning.bandwidth_hz_per_intensity * exp_f(
        <float>level)


cdef inline double lead_variance(double u, double rate_var, double fall,
                                 double shown, const tuning_t* tuning) noexcept nogil:
    """Variance of lead's result u.

    From that of the slope, per second squared, and the relative error of the corner
    frequency, by the derivatives of the equation that lead solves.  A pixel that is as
    fast as its light is bright shows no fall faster than 1/e of its corner frequency
    (times 2 pi), and what it falls to beyond is lost: fall is per second.
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
    if d < STIFF * (hz + e):
        d = STIFF * (hz + e)
    v = tuning.bandwidth_sigma * u * (hz + e)
    v = (PER_TURN * PER_TURN * rate_var + v * v) / (d * d) + lost * lost
    return v if v < LAG_VARIANCE_MOST else LAG_VARIANCE_MOST


cdef inline double lead(double slope, double shown,
                        const tuning_t* tuning) noexcept nogil:
    """Log intensity minus what a low-pass pixel shows of it.

    slope is that of the log intensity shown, per second.  The pixel follows
    y' = 2 pi (hz + hz_per_level I) (ln I - y): solved for ln I - y.  Where I is far
    below what is shown, its size is lost; FALL_MOST is the limit that can be told.
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
        return (STRAIGHT_MOST if u > STRAIGHT_MOST
                else -STRAIGHT_MOST if u < -STRAIGHT_MOST else u)
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
        if f < STIFF * (hz + e):
            f = STIFF * (hz + e)
        g /= f
        u -= g
        u = RISE_MOST if u > RISE_MOST else FALL_MOST if u < FALL_MOST else u
        if g < CONVERGED and g > -CONVERGED:
            break
    return u
