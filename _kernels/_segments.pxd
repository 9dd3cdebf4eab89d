"""Segments of exposures between events, evaluated many at a time.  Inline only.

The lamp is steady, and a pixel's next event is known, or its light moves and no event
follows; _exposure.pxd evaluates others one by one.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t

from _kernels._lag cimport PER_TURN     # with the constants that _segments.h shares
from _kernels._model cimport state_t, stored_t, tuning_t
from _kernels._tracks cimport (
    GAP_LEAST_US, bend, curve_t, loss_t, lost, never, sensitive_us, walk_t)
from _kernels._update cimport GAUSS

cdef extern from "_segments.h" nogil:
    enum:
        SEGMENTS
        NODES
        PIXELS
    ctypedef struct segments_t:
        double still_us
        double hz
        double hz_per_intensity
        double refractory_us
        Py_ssize_t n
        int32_t row[SEGMENTS]
        double middle[SEGMENTS]
        double node[SEGMENTS]
        double half[SEGMENTS]
        double last[SEGMENTS]
        double gap[SEGMENTS]
        double a[SEGMENTS]
        double b[SEGMENTS]
        double without[SEGMENTS]
        double on[SEGMENTS]
        double sensitive_us[SEGMENTS]
        double n_on[SEGMENTS]
        double n_off[SEGMENTS]
        double theta_on[SEGMENTS]
        double theta_off[SEGMENTS]
        double level[SEGMENTS]
        double whole[NODES][SEGMENTS]
        double by_on[NODES][SEGMENTS]
        double by_off[NODES][SEGMENTS]
    ctypedef struct sums_t:
        double whole[2 * PIXELS]
        double on[2 * PIXELS]
        double off[2 * PIXELS]
        double span[PIXELS]
        int32_t slot[PIXELS]
        Py_ssize_t n
    void integrate_segments(segments_t*)
    void de_blur(sums_t*)


cdef inline void begin_segments(segments_t* segments, sums_t* sums,
                                const tuning_t* tuning) noexcept nogil:
    sums.n = 0
    segments.n = 0
    segments.still_us = tuning.still_us
    segments.hz = tuning.bandwidth_hz
    segments.hz_per_intensity = tuning.bandwidth_hz_per_intensity
    segments.refractory_us = tuning.refractory_us


cdef inline Py_ssize_t middle_row(Py_ssize_t row) noexcept nogil:
    """Row for the part at the middle of an exposure in which events came."""
    return row + PIXELS


cdef inline Py_ssize_t begin_sums(sums_t* sums, Py_ssize_t slot,
                                  double span) noexcept nogil:
    """Begin the sums of another pixel, which is the group's `slot`; return their row.
    """
    cdef Py_ssize_t row = sums.n
    sums.n += 1
    sums.slot[row] = <int32_t>slot
    sums.span[row] = span
    sums.whole[row] = 0.0
    sums.on[row] = 0.0
    sums.off[row] = 0.0
    sums.whole[middle_row(row)] = 0.0
    sums.on[middle_row(row)] = 0.0
    sums.off[middle_row(row)] = 0.0
    return row


cdef inline void add_segments(segments_t* segments, sums_t* sums) noexcept nogil:
    """Add the integrals over all segments, in their order, to the sums of their pixels.
    """
    cdef Py_ssize_t i, k, row
    integrate_segments(segments)
    for i in range(segments.n):
        row = segments.row[i]
        for k in range(NODES):
            sums.whole[row] += segments.whole[k][i]
            sums.on[row] += segments.by_on[k][i]
            sums.off[row] += segments.by_off[k][i]
    segments.n = 0


cdef inline void add_segment(segments_t* segments, sums_t* sums, Py_ssize_t row,
                             const walk_t* walk, const stored_t* store, int64_t known,
                             double begin, double end, const state_t* s, double level,
                             const tuning_t* tuning) noexcept nogil:
    """Append what adds to a row of sums from begin to end, between walk and its next.

    If begin is end, that is log intensity, relative to level, and the counts at it.
    """
    cdef double half = 0.5 * (end - begin), gap, without, whole
    cdef double last, next, sensitive = INFINITY
    cdef curve_t curve
    cdef loss_t loss
    cdef int64_t t1
    cdef int p = walk.p
    cdef bint same
    cdef Py_ssize_t i
    curve.a = 0.0
    curve.b = 0.0
    if walk.next >= 0 and store[walk.next].t <= known:
        # As in `between`, for a steady lamp.
        t1 = store[walk.next].t
        p = store[walk.next].p
        without = <double>(t1 - walk.t)
        gap = without if without > GAP_LEAST_US else GAP_LEAST_US
        if not never(walk.t):
            loss = lost(walk.t_prev, walk.t, t1, tuning.refractory_us)
            same = walk.p == p
            last = s.theta_off if p else s.theta_on
            next = s.theta_on if p else s.theta_off
            whole = 1.0 + (
                loss.after + (loss.before if same else -loss.before * last / next))
            curve = bend(walk, p, same, last, next, whole, loss.before, gap,
                         tuning.refractory_us)
    else:
        # As in `quiet`: 2 s (1 - s).
        gap = <double>known - <double>walk.t
        without = max(<double>(walk.t - walk.t_prev), gap)
        curve.a = 2.0
        curve.b = -2.0
        if tuning.refractory_us > 0.0 and not never(walk.t_prev):
            sensitive = sensitive_us(walk.t_prev, walk.t, tuning.refractory_us)
    if segments.n == SEGMENTS:
        add_segments(segments, sums)
    i = segments.n
    segments.n += 1
    segments.row[i] = <int32_t>row
    segments.middle[i] = 0.5 * (begin + end)
    segments.node[i] = half * GAUSS
    segments.half[i] = half
    segments.last[i] = <double>walk.t
    segments.gap[i] = gap
    segments.a[i] = curve.a
    segments.b[i] = curve.b
    segments.without[i] = without
    segments.on[i] = p
    segments.sensitive_us[i] = sensitive
    segments.n_on[i] = walk.n_on
    segments.n_off[i] = walk.n_off
    segments.theta_on[i] = s.theta_on
    segments.theta_off[i] = s.theta_off
    segments.level[i] = level
