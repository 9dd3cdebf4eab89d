"""The measurement update of a pixel's state, and its constants.  Inline only.

The many candidates of self-calibration share the constants.
"""
from _kernels._math cimport exp_f
from _kernels._model cimport state_t, tuning_t

cdef extern from *:
    """
    #define GAUSS 0.5773502691896258    /* nodes of two-point quadrature: 1 / sqrt 3 */
    #define FIRST_VARIANCE 100.0        /* ln^2, before the first sample: not known */
    #define REST_MOST 3.0               /* ln: 20 times; light has changed, not noise */
    #define JUMP_SIGMAS 4.0             /* innovations beyond: the base has jumped */
    #define THETA_LEAST 0.3             /* thresholds stay within these multiples */
    #define THETA_MOST 3.0              /* of what they started from */
    """
    const double GAUSS
    const double FIRST_VARIANCE
    const double REST_MOST
    const double JUMP_SIGMAS
    const double THETA_LEAST
    const double THETA_MOST

cdef enum:
    # A part of a lamp's period that two points are enough for.
    FINE_US = 1500
    # One or two events since the last sample are as likely noise, which would teach
    # that thresholds are 0.
    LEARN_EVENTS = 3

cdef struct taken_t:
    # What a measurement did: variance of its innovation, the innovation squared over
    # it, at most JUMP_SIGMAS^2, and the variance that a jump of the base was given.
    double v
    double ratio
    double jump


cdef inline void propagate(state_t* s, double n_on, double n_off) noexcept nogil:
    """Transition past so many events: base += theta_on n_on - theta_off n_off."""
    s.base += s.theta_on * n_on - s.theta_off * n_off
    s.var_base += (n_on * n_on * s.var_on + n_off * n_off * s.var_off
                   + 2.0 * (n_on * s.cov_base_on - n_off * s.cov_base_off
                            - n_on * n_off * s.cov_on_off))
    s.cov_base_on += n_on * s.var_on - n_off * s.cov_on_off
    s.cov_base_off += n_on * s.cov_on_off - n_off * s.var_off


cdef inline double noise_at(double per_dn, const tuning_t* tuning) noexcept nogil:
    """Variance of a sample (ln^2) in light of 1 / per_dn DN."""
    return (tuning.shot_share * per_dn * (
        tuning.read_variance * per_dn + tuning.shot_variance)
        + tuning.frame_sigma * tuning.frame_sigma)


cdef inline double linear(const state_t* s, double h_on, double h_off, double motion,
                          const tuning_t* tuning, double* innovation,
                          double* per_dn) noexcept nogil:
    """Linearize where state and sample together see the light; return R there.

    Noise is added to DN, not to their logarithm: by the sample alone, one that noise
    has made brighter would count for more, and a darker one would be too far off.  So
    innovation and per_dn become those of an iterated Kalman filter, but at a jump.
    """
    cdef double spread = s.var_base + (
        2.0 * (h_on * s.cov_base_on + h_off * s.cov_base_off + h_on * h_off
               * s.cov_on_off) + h_on * h_on * s.var_on + h_off * h_off * s.var_off)
    cdef double noise = motion + noise_at(per_dn[0], tuning), there, rest, factor, e
    rest = innovation[0] * noise / (spread + noise)
    if rest < -REST_MOST or rest > REST_MOST:
        return noise
    factor = exp_f(<float>rest)
    there = motion + noise_at(per_dn[0] * factor, tuning)
    e = innovation[0] - rest + factor - 1.0
    if e * e > JUMP_SIGMAS * JUMP_SIGMAS * (spread + there):
        return noise
    innovation[0] = e
    per_dn[0] *= factor
    return there


cdef inline taken_t update(state_t* s, double h_on, double h_off, double noise,
                           double innovation, bint learn,
                           double per_dn) noexcept nogil:
    """Kalman update with measured = base + h_on theta_on + h_off theta_off + noise.

    Without learn, thresholds stay what they are (Schmidt-Kalman update).  per_dn is
    what one DN more in all frames adds to this sample's log.
    """
    cdef double g0 = s.var_base + h_on * s.cov_base_on + h_off * s.cov_base_off
    cdef double g1 = s.cov_base_on + h_on * s.var_on + h_off * s.cov_on_off
    cdef double g2 = s.cov_base_off + h_on * s.cov_on_off + h_off * s.var_off
    cdef double v = g0 + h_on * g1 + h_off * g2 + noise, k0, k1, k2
    cdef taken_t taken
    taken.v = v
    taken.ratio = innovation * innovation / v
    taken.jump = 0.0
    if taken.ratio > JUMP_SIGMAS * JUMP_SIGMAS:
        # Lost events or a wrong sample: the base may have jumped, thresholds not.
        taken.ratio = JUMP_SIGMAS * JUMP_SIGMAS
        taken.jump = innovation * innovation
        s.var_base += taken.jump
        g0 += taken.jump
        v += taken.jump
    k0 = g0 / v
    k1 = g1 / v
    k2 = g2 / v
    s.base += k0 * innovation
    s.pull += k0 * (per_dn - s.pull)
    s.var_base -= k0 * g0
    s.cov_base_on -= k0 * g1
    s.cov_base_off -= k0 * g2
    if not learn:
        return taken
    s.theta_on += k1 * innovation
    s.theta_off += k2 * innovation
    s.var_on -= k1 * g1
    s.cov_on_off -= k1 * g2
    s.var_off -= k2 * g2
    return taken


cdef inline double limited(double theta, double prior) noexcept nogil:
    if theta < THETA_LEAST * prior:
        return THETA_LEAST * prior
    return THETA_MOST * prior if theta > THETA_MOST * prior else theta
