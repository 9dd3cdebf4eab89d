"""Interpolation and extrapolation of log intensity between events.  Inline only.

A stamp is an event's time times two, plus its polarity.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint32_t

from _kernels._lamp cimport lamp_t, ripple
from _kernels._model cimport stored_t, track_t

cdef enum:
    # The lamp's waves are not kept for longer than this before the time read.
    STALE_US = 10000000
    # A pixel without an event for this long is taken to be at rest.
    REST_US = 1000000

cdef extern from *:
    """
    #define LONG_AGO -4611686018427387904   /* -2^62: stands for no event */
    #define GAP_MOST 4294967294     /* 2^32 - 2: so long ago that it says nothing */
    #define TINY 1e-30                  /* keeps 0 / 0 from being NaN */
    /* Lower bounds of a gap (us): events of a pixel are closer together only in bursts,
       whose stamps do not tell how fast the light changes. */
    #define GAP_LEAST_US 100.0
    #define AHEAD_LEAST_US 200.0
    /* Between two events of opposite sign the light follows a parabola.  It turns so
       many thresholds beyond the first event: by default, and at most. */
    #define TURN_HALF 0.5
    #define TURN_MOST 1.0
    /* Under a flickering lamp, in thresholds: lower bound of the change of the light
       alone in a gap; change below which the lamp caused the event, so that the light
       need not have turned; bounds of the remaining distance that the light alone has
       to go to the next event. */
    #define LIGHT_LEAST 0.1
    #define LIGHT_TURNED 0.5
    #define ROOM_LEAST 0.3
    #define ROOM_MOST 2.0
    """
    const int64_t LONG_AGO
    const int64_t GAP_MOST
    const double TINY
    const double GAP_LEAST_US
    const double AHEAD_LEAST_US
    const double TURN_HALF
    const double TURN_MOST
    const double LIGHT_LEAST
    const double LIGHT_TURNED
    const double ROOM_LEAST
    const double ROOM_MOST

cdef extern from "_extrapolation.h":
    const float AHEAD[][8]    # AHEAD_PITCH
    enum:
        AHEAD_PITCH
    const int AHEAD_NODES
    const int AHEAD_KNEE
    const double AHEAD_FINE
    const double AHEAD_COARSE

cdef enum:
    # Columns of AHEAD.
    PART = 0
    RATE = 1

cdef struct walk_t:
    # A position in a pixel's events: the last two events passed, the index of the next
    # one, and counts of the events passed.
    int64_t t_prev
    int p_prev
    int64_t t
    int p
    int32_t next
    double n_on
    double n_off

cdef struct part_t:
    # Part of a threshold crossed since the last event: fraction * theta[p], downwards
    # if p is 0; its rate per second.  ripple: log intensity that the lamp adds, and its
    # rate per second.
    int p
    double fraction
    double rate
    double ripple
    double ripple_rate


cdef inline bint never(int64_t t) noexcept nogil:
    """Tell that a time stands for no event; differences stay far from 2**63."""
    return t <= LONG_AGO


cdef inline bint at_rest(int64_t last, int64_t t) noexcept nogil:
    """Tell whether a pixel is at rest at t if it had no event since `last`."""
    return never(last) or t - last >= REST_US


cdef inline void step(walk_t* walk, const stored_t* store) noexcept nogil:
    """Pass the next event, and count it."""
    cdef const stored_t* event = &store[walk.next]
    walk.t_prev = walk.t
    walk.p_prev = walk.p
    walk.t = event.t
    walk.p = event.p
    walk.next = event.next
    if walk.p:
        walk.n_on += 1.0
    else:
        walk.n_off += 1.0


cdef inline int64_t before(const track_t* track) noexcept nogil:
    """Return the time of the last event but one, unless over 35 minutes before it."""
    if track.gap >= GAP_MOST:
        return LONG_AGO
    return (track.last >> 1) - (track.gap >> 1)


cdef inline uint32_t gap_since(int64_t stamp, int64_t t) noexcept nogil:
    """Return the gap from an event, given by its stamp, to t, as a track stores it."""
    cdef int64_t gap = t - (stamp >> 1)
    gap = 2 * gap if gap < (GAP_MOST >> 1) else GAP_MOST
    return <uint32_t>(gap + (stamp & 1))


cdef inline void start(walk_t* walk, const track_t* track) noexcept nogil:
    """Begin after the two events that a track remembers."""
    walk.t = track.last >> 1
    walk.p = track.last & 1
    walk.t_prev = before(track)
    walk.p_prev = track.gap & 1
    walk.next = track.first
    walk.n_on = 0.0
    walk.n_off = 0.0


cdef inline part_t nothing(int p) noexcept nogil:
    """Return the part where nothing is known: 0."""
    cdef part_t part
    part.p = p
    part.fraction = 0.0
    part.rate = 0.0
    part.ripple = 0.0
    part.ripple_rate = 0.0
    return part


cdef inline void turn_at(double room, double whole, double* a,
                         double* b) noexcept nogil:
    """Set a, b so that a s + b s^2 runs from 0 to `whole` (s = 1) and turns at -room.
    """
    cdef double most = room + whole, x
    room = sqrt(room)
    x = room + (sqrt(most) if most > 0.0 else 0.0)
    a[0] = -2.0 * room * x
    b[0] = x * x


cdef inline void bend(const walk_t* walk, bint same, double last, double next,
                      double gap, double* a, double* b) noexcept nogil:
    """Set a, b: a s + b s^2 thresholds are crossed after a share s of the gap.

    same: both events have one sign; last and next: thresholds that they stand for.
    """
    cdef double q
    a[0] = 1.0
    b[0] = 0.0
    if same:
        return
    if never(walk.t_prev) or walk.p_prev != walk.p:
        turn_at(TURN_HALF, 1.0, a, b)
        return
    q = <double>(walk.t - walk.t_prev)
    q = q if q > GAP_LEAST_US else GAP_LEAST_US
    q /= gap
    last /= next + TINY
    b[0] = (last + q) / (q * (1.0 + q))
    a[0] = 1.0 - b[0]
    if a[0] > 0.0 or b[0] < 0.0:
        a[0] = 0.0
        b[0] = 1.0
    elif a[0] * a[0] > 4.0 * b[0] * TURN_MOST:
        turn_at(TURN_MOST, 1.0, a, b)


cdef inline part_t between(const walk_t* walk, int64_t t1, int p1, double on,
                           double off, const lamp_t* lamp, double hz,
                           double t) noexcept nogil:
    """Part crossed at t, between walk and its next event, of polarity p1 at t1.

    Linear if both events have one sign.  Otherwise a parabola through both events and
    the one before, if that has the sign of the last; on and off are the thresholds.
    The parabola turns after the last event and at most a threshold beyond it; without
    such an event before, it turns half a threshold beyond.  Under a flickering lamp all
    this holds for the light minus the ripple, which is filtered by a pixel of corner
    frequency hz.
    """
    cdef part_t part = nothing(p1)
    cdef double gap = <double>(t1 - walk.t), s, a, b
    cdef double last = off if p1 else on, next = on if p1 else off
    cdef double here = 0.0, now, change = 0.0, _
    cdef bint same = walk.p == p1
    cdef bint flickers = lamp.blocks > 0 and t1 - walk.t < STALE_US
    if never(walk.t):
        return part
    if gap < GAP_LEAST_US:
        gap = GAP_LEAST_US
    s = (t - <double>walk.t) / gap
    if flickers:
        last = on if walk.p else -off
        next = on if p1 else -off
        here = ripple(lamp, hz, <double>walk.t, &_)
        change = ripple(lamp, hz, <double>t1, &_) - here
        next -= change
        if walk.t - walk.t_prev < STALE_US:
            last -= here - ripple(lamp, hz, <double>walk.t_prev, &_)
        same = last * next >= 0.0
        last = last if last > 0.0 else -last
        next = next if next > 0.0 else -next
    bend(walk, same, last, next, gap, &a, &b)
    part.fraction = s * (a + s * b)
    part.rate = (a + 2.0 * s * b) * 1e6 / gap
    if flickers:
        now = ripple(lamp, hz, t, &part.ripple_rate)
        part.ripple = now - here - part.fraction * change
        part.ripple_rate -= part.rate * change
    return part


cdef inline int node_of(double u, double* part) noexcept nogil:
    """Return the last node of AHEAD at or before u; set part to the fraction beyond it.
    """
    cdef int node
    cdef double w
    if u < AHEAD_KNEE * AHEAD_FINE:
        w = u / AHEAD_FINE
        node = <int>w
        part[0] = w - node
        return node
    w = u / AHEAD_COARSE - AHEAD_KNEE * AHEAD_FINE / AHEAD_COARSE
    w = w if w < AHEAD_NODES - 1 - AHEAD_KNEE else AHEAD_NODES - 1 - AHEAD_KNEE
    node = <int>w
    part[0] = w - node
    return node + AHEAD_KNEE


cdef inline double column(const float* low, int c, double w) noexcept nogil:
    """Return column c of AHEAD a fraction w beyond the row `low`."""
    return low[c] + w * (low[AHEAD_PITCH + c] - low[c])


cdef inline part_t quiet(const walk_t* walk, double known, const lamp_t* lamp,
                         double hz, double t) noexcept nogil:
    """Part crossed at t if no event follows up to the time known, which is > t.

    A parabola that rises to half a threshold and returns to 0 at the time known: within
    0.1 threshold of the mean over pixels whose light turns or slows down.
    """
    cdef part_t part = nothing(walk.p)
    cdef double gap = known - <double>walk.t, s
    if never(walk.t):
        return part
    s = (t - <double>walk.t) / gap
    part.fraction = 2.0 * s * (1.0 - s)
    part.rate = (2.0 - 4.0 * s) * 1e6 / gap
    add_ripple(&part, lamp, hz, walk.t, t)
    return part


cdef inline void add_ripple(part_t* part, const lamp_t* lamp, double hz, int64_t t0,
                            double t) noexcept nogil:
    """Set the ripple of a part: the lamp's wave at t relative to the event at t0."""
    cdef double _
    if lamp.blocks > 0 and t - <double>t0 < STALE_US:
        part.ripple = (ripple(lamp, hz, t, &part.ripple_rate)
                       - ripple(lamp, hz, <double>t0, &_))


cdef inline part_t still(const walk_t* walk, const lamp_t* lamp, double hz,
                         double t) noexcept nogil:
    """Part of a pixel at rest: unknown, apart from the lamp's ripple."""
    cdef part_t part = nothing(walk.p)
    if not never(walk.t):
        add_ripple(&part, lamp, hz, walk.t, t)
    return part


cdef inline part_t ahead(const walk_t* walk, double on, double off,
                         const lamp_t* lamp, double hz, double t) noexcept nogil:
    """Part crossed at t, extrapolated from the last two events.

    Returns posterior means of the part and of its slope, given that no event has
    followed.  They are tabulated by the time since the last event over the
    last gap.  lab/studies/kalman_extrapolation.py states the prior, an ensemble of
    lights that turn and may stop, and makes the table.  Long silence means rest.  Under
    a flickering lamp this holds for the light minus the ripple.
    """
    cdef part_t part = nothing(walk.p)
    cdef double gap = <double>(walk.t - walk.t_prev), u, change
    cdef double since = t - <double>walk.t, room = 1.0, w, _
    cdef int node
    cdef const float* low
    cdef bint same = walk.p_prev == walk.p
    if never(walk.t_prev):
        return part
    if lamp.blocks > 0 and t - <double>walk.t_prev < STALE_US:
        # Time in which the light alone crosses a threshold, and its direction.
        change = (ripple(lamp, hz, <double>walk.t, &_)
                  - ripple(lamp, hz, <double>walk.t_prev, &_))
        if change != 0.0:
            change = (on if walk.p else -off) - change
            part.p = change > 0.0
            change = change / on if change > 0.0 else -change / off
            # A change below half a threshold does not count as a turn.
            same = walk.p_prev == part.p or change < LIGHT_TURNED
            gap /= change if change > LIGHT_LEAST else LIGHT_LEAST
        # Part of a threshold that the light alone may cross before an event.
        room = ripple(lamp, hz, t, &_) - ripple(lamp, hz, <double>walk.t, &_)
        room = 1.0 - room / on if part.p else 1.0 + room / off
        room = room if room > ROOM_LEAST else ROOM_LEAST
        room = room if room < ROOM_MOST else ROOM_MOST
    gap = max(gap, AHEAD_LEAST_US)
    u = since / (gap * room)
    node = node_of(u, &w)
    if node == AHEAD_NODES - 1:
        add_ripple(&part, lamp, hz, walk.t, t)
        return part
    low = AHEAD[node if same else AHEAD_NODES + node]
    part.fraction = column(low, PART, w)
    part.rate = column(low, RATE, w)
    part.fraction *= room
    part.rate *= 1e6 / gap
    add_ripple(&part, lamp, hz, walk.t, t)
    return part
