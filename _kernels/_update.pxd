"""The transition of a pixel's state, and constants of its update.  Inline only.

The candidate filters of self-calibration use the same constants.
"""
from _kernels._model cimport state_t

cdef extern from *:
    """
    #define GAUSS 0.5773502691896258    /* nodes of two-point quadrature: 1 / sqrt 3 */
    #define FIRST_VARIANCE 100.0        /* ln^2, of the unknown initial base */
    #define JUMP_SIGMAS 4.0             /* a larger innovation is a jump of the base */
    #define THETA_LEAST 0.3             /* bounds of a threshold, as multiples */
    #define THETA_MOST 3.0              /* of its initial value */
    """
    const double GAUSS
    const double FIRST_VARIANCE
    const double JUMP_SIGMAS
    const double THETA_LEAST
    const double THETA_MOST

cdef enum:
    # Longest step (us) of two-point quadrature under a flickering lamp.
    FINE_US = 1500
    # Least number of events since the last sample from which thresholds are learned:
    # one or two are likely noise, which would pull the thresholds to 0.
    LEARN_EVENTS = 3


cdef inline void propagate(state_t* s, double n_on, double n_off) noexcept nogil:
    """Transition over n events: base += theta_on n_on - theta_off n_off."""
    s.base += s.theta_on * n_on - s.theta_off * n_off
    s.var_base += (n_on * n_on * s.var_on + n_off * n_off * s.var_off
                   + 2.0 * (n_on * s.cov_base_on - n_off * s.cov_base_off
                            - n_on * n_off * s.cov_on_off))
    s.cov_base_on += n_on * s.var_on - n_off * s.cov_on_off
    s.cov_base_off += n_on * s.cov_on_off - n_off * s.var_off
