"""Hot pixels: events of a pixel that its frames contradict.  Inline only.

A hot pixel makes events at a high rate whatever the light does.  Between two samples
the events claim that log intensity has moved; a frame that shows nearly none of it
contradicts them.  The odds of a pixel's being hot follow by Bayes' rule with stated
probabilities; from even odds on its events have no weight.
"""
from _kernels._model cimport state_t

cdef extern from *:
    """
    /* Events make a claim if they sum up to this share of the path that they describe,
       which the light's own rises and falls between two samples seldom do, and a frame
       contradicts it if less than this part of it shows: thresholds may be stated three
       times too large.  By so many sigmas of the two samples. */
    #define CLAIM_SHARE 0.5
    #define SHOWN_SHARE 0.25
    #define CLAIM_SIGMAS 4.0
    /* ln of the prior odds against a hot pixel, 1000 to 1, and as far beyond even odds
       as they may get: what has ended is found out.  What a frame adds to them if it
       contradicts, ln(.9 / .01), and if not, ln(.99 / .1): probabilities of that for
       hot pixels and for others.  Engineering choices. */
    #define HOT_PRIOR 6.91
    #define HOT_MORE 4.5
    #define HOT_LESS 2.29
    /* By what log intensity moves from one sample to the next (ln^2, a factor of e)
       until so many samples of a hot pixel have said it. */
    #define HOT_MOTION 1.0
    #define HOT_SAMPLES 8.0
    """
    const double CLAIM_SHARE
    const double SHOWN_SHARE
    const double CLAIM_SIGMAS
    const double HOT_PRIOR
    const double HOT_MORE
    const double HOT_LESS
    const double HOT_MOTION
    const double HOT_SAMPLES


cdef inline bint is_hot(const state_t* s) noexcept nogil:
    """Tell whether it is likelier than not that a pixel is hot."""
    return s.hot > HOT_PRIOR


cdef inline bint contradicted(double claim, double path, double shown,
                              double variance) noexcept nogil:
    """Tell whether frames contradict what events say of log intensity.

    claim is the sum of the events between two samples, path that of their magnitudes,
    shown the change from one sample to the next and variance that of both samples.
    """
    if claim < 0.0:
        claim = -claim
        shown = -shown
    shown = SHOWN_SHARE * claim - shown
    return (claim > CLAIM_SHARE * path and shown > 0.0
            and shown * shown > CLAIM_SIGMAS * CLAIM_SIGMAS * variance)


cdef inline void weigh_odds(state_t* s, bint against) noexcept nogil:
    """Move the odds of a pixel's being hot by one sample."""
    cdef bint before = is_hot(s)
    s.hot += HOT_MORE if against else -HOT_LESS
    s.hot = 0.0 if s.hot < 0.0 else min(s.hot, 2.0 * HOT_PRIOR)
    if is_hot(s) and not before:
        s.moves = HOT_MOTION
