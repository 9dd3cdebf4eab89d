"""Log intensity of a pixel at one time from its state and events.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._lag cimport PER_TURN, corner, lead
from _kernels._lamp cimport lamp_t
from _kernels._model cimport state_t, stored_t, track_t, tuning_t
from _kernels._tracks cimport (
    ahead, at_rest, between, never, part_t, quiet, start, step, still, walk_t)

cdef extern from *:
    """
    /* Time constants of a pixel over which the slope of its output is a mean;
       lab/studies/lag_slope.py. */
    #define SLOPE_SPAN 1.0
    """
    const double SLOPE_SPAN


cdef inline part_t part_at(const walk_t* walk, const stored_t* store, int64_t known,
                           double on, double off, const lamp_t* lamp, double hz,
                           double t) noexcept nogil:
    """Part crossed at t after walk's last event, up to its next event if known."""
    if walk.next >= 0 and store[walk.next].t <= known:
        return between(walk, store[walk.next].t, store[walk.next].p, on, off, lamp, hz,
                       t)
    if at_rest(walk.t, <int64_t>t):
        return still(walk, lamp, hz, t)
    if <double>known > t:
        return quiet(walk, <double>known, lamp, hz, t)
    return ahead(walk, on, off, lamp, hz, t)


cdef inline double output_slope(const walk_t* walk, const part_t* part,
                                const stored_t* store, int64_t known, double on,
                                double off, double level, const lamp_t* lamp,
                                const tuning_t* tuning, double t) noexcept nogil:
    """Slope of a pixel's output at t, 1/s, from which its lag is found.

    Between two known events it is the mean over a time constant around t, because time
    stamps of events jitter.  It begins at the last event but one at the earliest.
    Elsewhere it is the slope at t.
    """
    cdef walk_t later
    cdef part_t side
    cdef double half, begin, end, first = <double>walk.t, rise
    cdef double slope = (on if part.p else -off) * part.rate + part.ripple_rate
    if lamp.blocks > 0 or never(walk.t) or walk.next < 0 or (
            store[walk.next].t > known):
        return slope
    half = corner(tuning, level)
    if half <= 0.0:
        return slope
    half = 1e6 * PER_TURN * SLOPE_SPAN / (2.0 * half)
    if t - half >= first and t + half <= <double>store[walk.next].t:
        return slope        # the mean slope of a parabola is that in its middle
    if not never(walk.t_prev):
        first = <double>walk.t_prev
    begin = t - half if t - half > first else first
    end = t + half if t + half < <double>known else <double>known
    if end <= begin:
        return slope
    later = walk[0]
    while later.next >= 0 and <double>store[later.next].t <= end:
        step(&later, store)
    side = part_at(&later, store, known, on, off, lamp, 0.0, end)
    rise = on * (later.n_on - walk.n_on) - off * (later.n_off - walk.n_off) + (
        on if side.p else -off) * side.fraction
    if begin < <double>walk.t:
        rise += (on if walk.p else -off) * (<double>walk.t - begin) / (
            <double>walk.t - first)
    else:
        side = part_at(walk, store, known, on, off, lamp, 0.0, begin)
        rise -= (on if side.p else -off) * side.fraction
    return 1e6 * rise / (end - begin)


cdef inline double log_at(int64_t t, int64_t known, const stored_t* store,
                          const tuning_t* tuning, const lamp_t* lamp,
                          const track_t* track, const state_t* s) noexcept nogil:
    """Log intensity at t, using the events up to known >= t."""
    cdef walk_t walk
    cdef part_t part
    cdef double hz = 0.0, level
    start(&walk, track)
    walk.n_on = track.n_on
    walk.n_off = track.n_off
    while walk.next >= 0 and store[walk.next].t <= t:
        step(&walk, store)
    level = s.base + s.theta_on * walk.n_on - s.theta_off * walk.n_off
    if lamp.blocks > 0:
        hz = corner(tuning, level)
    part = part_at(&walk, store, known, s.theta_on, s.theta_off, lamp, hz, <double>t)
    level += (s.theta_on if part.p else -s.theta_off) * part.fraction + part.ripple
    return level + lead(output_slope(
        &walk, &part, store, known, s.theta_on, s.theta_off, level, lamp, tuning,
        <double>t), level, tuning)
