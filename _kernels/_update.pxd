"""Constants of the measurement update, for the filter and its many candidates."""

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
