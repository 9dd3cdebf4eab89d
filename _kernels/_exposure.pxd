"""Light over a frame's exposure by a pixel's events.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._estimate cimport part_at
from _kernels._lag cimport corner, lead
from _kernels._lamp cimport lamp_flickers, lamp_t
from _kernels._math cimport exp_f
from _kernels._model cimport state_t, stored_t, tuning_t
from _kernels._segments cimport add_segment, segments_t, sums_t
from _kernels._tracks cimport part_t, step, walk_t
from _kernels._update cimport FINE_US, GAUSS

cdef struct sum_t:
    # Integrals over the exposure of exp(y), exp(y) n_on and exp(y) n_off, where y is
    # log intensity relative to a level.
    double whole
    double on
    double off


cdef inline double log_at(const walk_t* walk, const stored_t* store, int64_t known,
                          double t, const state_t* s, double level,
                          const tuning_t* tuning, const lamp_t* lamp, double* n_on,
                          double* n_off) noexcept nogil:
    """Log intensity at t relative to level, between walk and its next event.

    Sets n_on and n_off to the counts, including the part crossed since the last event.
    """
    cdef double y, theta, p, hz = 0.0
    cdef part_t part
    if lamp.blocks > 0:
        hz = corner(tuning, level + s.theta_on * walk.n_on - s.theta_off * walk.n_off)
    part = part_at(walk, store, known, s.theta_on, s.theta_off, lamp, hz,
                   tuning, s, t)
    n_on[0] = walk.n_on
    n_off[0] = walk.n_off
    # Not by branches, which depend on events and are hard to predict.
    p = part.p
    n_on[0] += p * part.fraction
    n_off[0] += (1.0 - p) * part.fraction
    theta = p * s.theta_on - (1.0 - p) * s.theta_off
    y = s.theta_on * n_on[0] - s.theta_off * n_off[0] + part.ripple
    return y + lead(theta * part.rate + part.ripple_rate, level + y, tuning)


cdef inline void add_step(sum_t* total, const walk_t* walk, const stored_t* store,
                          int64_t known, double begin, double end, const state_t* s,
                          double level, const tuning_t* tuning,
                          const lamp_t* lamp) noexcept nogil:
    """Integrate from begin to end, between walk and its next event (2-point Gauss)."""
    cdef double middle = 0.5 * (begin + end), half = 0.5 * (end - begin)
    cdef double node = half * GAUSS, y, n_on, n_off
    cdef int k
    for k in range(2):
        y = log_at(walk, store, known, middle + node if k else middle - node, s, level,
                   tuning, lamp, &n_on, &n_off)
        y = half * exp_f(<float>y)
        total.whole += y
        total.on += y * n_on
        total.off += y * n_off


cdef inline void integrate(sum_t* total, walk_t* walk, const stored_t* store,
                           int64_t begin, int64_t end, int64_t known, const state_t* s,
                           double level, const tuning_t* tuning,
                           const lamp_t* lamp) noexcept nogil:
    """Integrate from begin to end, event by event; in short steps if a lamp flickers.
    """
    cdef double now = <double>begin, until
    cdef bint flickers = lamp_flickers(lamp, now, <double>end)
    while True:
        until = <double>end
        if walk.next >= 0 and store[walk.next].t < end:
            until = <double>store[walk.next].t
        while flickers and until > now + FINE_US:
            add_step(total, walk, store, known, now, now + FINE_US, s, level, tuning,
                     lamp)
            now += FINE_US
        if until > now:
            add_step(total, walk, store, known, now, until, s, level, tuning, lamp)
            now = until
        if walk.next < 0 or store[walk.next].t >= end:
            break
        step(walk, store, tuning.refractory_us)


cdef inline void divide(segments_t* segments, sums_t* sums, Py_ssize_t row,
                        walk_t* walk, const stored_t* store, int64_t begin, int64_t end,
                        int64_t known, const state_t* s, double level,
                        const tuning_t* tuning) noexcept nogil:
    """Append segments from begin to end, event by event; the lamp is steady."""
    cdef int64_t until
    while True:
        until = end
        if walk.next >= 0 and store[walk.next].t < end:
            until = store[walk.next].t
        if until > begin:
            add_segment(segments, sums, row, walk, store, known, <double>begin,
                        <double>until, s, level, tuning)
            begin = until
        if until == end:
            break
        step(walk, store, tuning.refractory_us)
