"""Hot pixels: events of a pixel that its frames contradict.  Inline only.

A hot pixel produces events at a high rate, whatever the light does.  Between two
samples its events imply a change of log intensity; a frame that shows almost none of it
contradicts them.  The odds that a pixel is hot follow from Bayes' rule with stated
probabilities; above even odds its events are ignored.
"""
from _kernels._model cimport state_t

cdef extern from *:
    """
    /* CLAIM_SHARE: the events between two samples are tested if their sum is at least
       this share of the sum of their magnitudes; light that rises and falls seldom does
       that.  SHOWN_SHARE: a frame contradicts them if it shows less than this share of
       the sum (thresholds may be stated three times too large), by CLAIM_SIGMAS
       standard deviations of the two samples. */
    #define CLAIM_SHARE 0.5
    #define SHOWN_SHARE 0.25
    #define CLAIM_SIGMAS 4.0
    /* HOT_PRIOR: ln of the prior odds against a hot pixel, 1000 to 1; also the limit of
       the log odds for it, so that a pixel can recover.  HOT_MORE, HOT_LESS: change of
       the log odds by a frame that contradicts, ln(0.9 / 0.01), and by one that does
       not, ln(0.99 / 0.1), from the probabilities of that for hot pixels and for
       others.  Engineering choices. */
    #define HOT_PRIOR 6.91
    #define HOT_MORE 4.5
    #define HOT_LESS 2.29
    /* HOT_MOTION: initial mean square change of log intensity from one sample of a hot
       pixel to the next (ln^2, a factor of e).  HOT_SAMPLES: memory of its estimate. */
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
    """Tell whether a pixel is more likely hot than not."""
    return s.hot > HOT_PRIOR


cdef inline bint contradicted(double claim, double path, double shown,
                              double variance) noexcept nogil:
    """Tell whether frames contradict the change of log intensity implied by events.

    claim is the sum of the events between two samples, path the sum of their
    magnitudes, shown the change between the samples, variance the sum of theirs.
    """
    if claim < 0.0:
        claim = -claim
        shown = -shown
    shown = SHOWN_SHARE * claim - shown
    return (claim > CLAIM_SHARE * path and shown > 0.0
            and shown * shown > CLAIM_SIGMAS * CLAIM_SIGMAS * variance)


cdef inline void weigh_odds(state_t* s, bint against) noexcept nogil:
    """Update the odds that a pixel is hot by one sample."""
    cdef bint before = is_hot(s)
    s.hot += HOT_MORE if against else -HOT_LESS
    s.hot = 0.0 if s.hot < 0.0 else min(s.hot, 2.0 * HOT_PRIOR)
    if is_hot(s) and not before:
        s.moves = HOT_MOTION
