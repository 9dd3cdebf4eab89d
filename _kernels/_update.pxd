"""The transition of a pixel's state; constants of its update.  Inline only.

The many candidates of self-calibration share the constants.
"""
from _kernels._model cimport state_t

cdef extern from *:
    """
    #define GAUSS 0.5773502691896258    /* nodes of two-point quadrature: 1 / sqrt 3 */
    #define FIRST_VARIANCE 100.0        /* ln^2, before the first sample: not known */
    #define JUMP_SIGMAS 4.0             /* innovations beyond: the base has jumped */
    #define THETA_LEAST 0.3             /* thresholds stay within these multiples */
    #define THETA_MOST 3.0              /* of what they started from */
    """
    const double GAUSS
    const double FIRST_VARIANCE
    const double JUMP_SIGMAS
    const double THETA_LEAST
    const double THETA_MOST

cdef enum:
    # A part of a lamp's period that two points are enough for.
    FINE_US = 1500
    # One or two events since the last sample are as likely noise, which would teach
    # that thresholds are 0.
    LEARN_EVENTS = 3


cdef inline void propagate(state_t* s, double n_on, double n_off) noexcept nogil:
    """Transition past so many events: base += theta_on n_on - theta_off n_off."""
    s.base += s.theta_on * n_on - s.theta_off * n_off
    s.var_base += (n_on * n_on * s.var_on + n_off * n_off * s.var_off
                   + 2.0 * (n_on * s.cov_base_on - n_off * s.cov_base_off
                            - n_on * n_off * s.cov_on_off))
    s.cov_base_on += n_on * s.var_on - n_off * s.cov_on_off
    s.cov_base_off += n_on * s.cov_on_off - n_off * s.var_off
