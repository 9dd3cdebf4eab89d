"""Interpolation and extrapolation of log intensity between events.  Inline only.

A stamp is an event's time times two, plus its polarity.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint32_t

from _kernels._lamp cimport lamp_t, ripple
from _kernels._math cimport exp_f
from _kernels._model cimport stored_t, track_t, tuning_t

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
    #define PER_S2 1e12                 /* per us^2, in s^-2 */
    #define REST_VARIANCE (1 / 3.0)     /* thresholds^2: anywhere in the dead band */
    /* Lower bounds of a gap (us): events of a pixel are closer together only in bursts,
       whose stamps do not tell how fast the light changes. */
    #define GAP_LEAST_US 100.0
    #define AHEAD_LEAST_US 200.0
    /* Between two events of opposite sign the light follows a parabola.  It turns so
       many thresholds beyond the first event: by default, and at most. */
    #define TURN_HALF 0.5
    #define TURN_MOST 1.0
    /* Variances of the part (thresholds^2) and of its slope (thresholds^2 per gap^2),
       from lab/studies/kalman_interpolation.py.  SAME: between two events of one sign;
       TURNED: between opposite signs, the event before giving the slope; UNSURE: the
       same without such an event; QUIET: no event has followed yet. */
    #define SAME_VARIANCE 0.0005
    #define SAME_RATE_VARIANCE 0.0008
    #define TURNED_VARIANCE 0.003
    #define TURNED_RATE_VARIANCE 0.02
    #define UNSURE_VARIANCE 0.05
    #define UNSURE_RATE_VARIANCE 1.0
    #define QUIET_VARIANCE 0.08
    #define QUIET_RATE_VARIANCE 0.3
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
    const double PER_S2
    const double REST_VARIANCE
    const double GAP_LEAST_US
    const double AHEAD_LEAST_US
    const double TURN_HALF
    const double TURN_MOST
    const double SAME_VARIANCE
    const double SAME_RATE_VARIANCE
    const double TURNED_VARIANCE
    const double TURNED_RATE_VARIANCE
    const double UNSURE_VARIANCE
    const double UNSURE_RATE_VARIANCE
    const double QUIET_VARIANCE
    const double QUIET_RATE_VARIANCE
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
    # Columns of AHEAD; the last three are those of light that moves.
    PART = 0
    RATE = 1
    VAR = 2
    RATE_VAR = 3
    MOVES = 4
    SPREAD = 5
    MIDDLE = 6
    COMMON = 7

cdef extern from "_sampled_part.h" nogil:
    ctypedef struct ahead_t:
        float part
        float rate
        float rate_var
        float moving
        float spread
        float middle
        float common
    ctypedef struct sampled_t:
        float part
        float rate
        float var
        float rate_var
    sampled_t part_of_sample(ahead_t, float, float, float, float, float, float)

cdef struct walk_t:
    # A position in a pixel's events: the last two events passed, the index of the next
    # one, and counts of the events passed.
    int64_t t_prev
    int p_prev
    int64_t t
    int p
    int32_t next
    double n_on             # including the change lost in refractory periods
    double n_off

cdef struct loss_t:
    # Change of the light lost in the refractory period between two events, split into
    # thresholds of the first event, in its direction, and of the second.
    double before
    double after

cdef struct curve_t:
    # The part crossed between two events: a s + b s^2 thresholds after a share s of the
    # gap; variances of it and of its slope per gap; last rate of fall as in part_t.
    double a
    double b
    double var
    double rate_var
    double fall

cdef struct part_t:
    # Part of a threshold crossed since the last event: fraction * theta[p], downwards
    # if p is 0; its rate per second; variances of both, theta^2.  fall: last rate of
    # fall in thresholds per second, 0 if the intensity rose.  ripple: log intensity
    # that the lamp adds, and its rate per second.
    int p
    double fraction
    double rate
    double var
    double rate_var
    double fall
    double ripple
    double ripple_rate


cdef inline bint never(int64_t t) noexcept nogil:
    """Tell that a time stands for no event; differences stay far from 2**63."""
    return t <= LONG_AGO


cdef inline bint at_rest(int64_t last, int64_t t) noexcept nogil:
    """Tell whether a pixel is at rest at t if it had no event since `last`."""
    return never(last) or t - last >= REST_US


cdef inline double p_rest(double gap, double still_us) noexcept nogil:
    """Probability that a pixel without an event for a gap is at rest."""
    gap /= still_us
    gap *= gap
    gap *= gap
    return gap / (1.0 + gap)


cdef inline double stamps_apart(const tuning_t* tuning) noexcept nogil:
    """Return the standard deviation of the difference of two events' stamps, us."""
    return sqrt(2.0) * tuning.jitter_us


cdef inline double least_gap(const tuning_t* tuning) noexcept nogil:
    """Return the least gap (us) that tells how fast light changes after it."""
    return max(AHEAD_LEAST_US, stamps_apart(tuning))


cdef inline double sensitive_us(int64_t t0, int64_t t1,
                                double refractory) noexcept nogil:
    """Return how long a pixel was sensitive between two events, us."""
    cdef double gap = <double>(t1 - t0) - refractory
    return gap if gap > GAP_LEAST_US else GAP_LEAST_US


cdef inline loss_t lost(int64_t before, int64_t t, int64_t next,
                        double refractory) noexcept nogil:
    """Return the change of light lost while the pixel was held in reset after t.

    The mean slopes before and after the reset are known; between the middles of these
    two intervals the slope is taken as linear in time (docs/theory/kalman.md).
    """
    cdef loss_t loss
    cdef double first, second, whole
    loss.before = 0.0
    loss.after = 0.0
    if refractory <= 0.0 or never(t):
        return loss
    second = sensitive_us(t, next, refractory)
    if never(before):
        loss.after = refractory / second
        return loss
    first = sensitive_us(before, t, refractory)
    whole = first + 2.0 * refractory + second
    loss.before = refractory * (refractory + second) / (first * whole)
    loss.after = refractory * (first + refractory) / (second * whole)
    return loss


cdef inline void count(double n, int p, double* n_on, double* n_off) noexcept nogil:
    """Add to the count of a polarity."""
    if p:
        n_on[0] += n
    else:
        n_off[0] += n


cdef inline void pass_to(walk_t* walk, int64_t t, int p,
                         double refractory) noexcept nogil:
    """Pass the next event, which is at t, and count it."""
    cdef loss_t loss
    if refractory > 0.0:
        loss = lost(walk.t_prev, walk.t, t, refractory)
        count(loss.before, walk.p, &walk.n_on, &walk.n_off)
        count(loss.after, p, &walk.n_on, &walk.n_off)
    walk.t_prev = walk.t
    walk.p_prev = walk.p
    walk.t = t
    walk.p = p
    count(1.0, p, &walk.n_on, &walk.n_off)


cdef inline void step(walk_t* walk, const stored_t* store,
                      double refractory) noexcept nogil:
    pass_to(walk, store[walk.next].t, store[walk.next].p, refractory)
    walk.next = store[walk.next].next


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
    """Return the part where nothing is known: 0 with the variance of rest."""
    cdef part_t part
    part.p = p
    part.fraction = 0.0
    part.rate = 0.0
    part.var = REST_VARIANCE
    part.rate_var = 0.0
    part.fall = 0.0
    part.ripple = 0.0
    part.ripple_rate = 0.0
    return part


cdef inline double drift(int64_t dt, double n, const tuning_t* tuning) noexcept nogil:
    """Process noise (theta^2) of dt microseconds and n events."""
    return tuning.leak_per_s * 1e-6 * <double>dt + tuning.noise_per_event * n


cdef inline void turn_at(double room, double whole, double* a,
                         double* b) noexcept nogil:
    """Set a, b so that a s + b s^2 runs from 0 to `whole` (s = 1) and turns at -room.
    """
    cdef double most = room + whole, x
    room = sqrt(room)
    x = room + (sqrt(most) if most > 0.0 else 0.0)
    a[0] = -2.0 * room * x
    b[0] = x * x


cdef inline curve_t bend(const walk_t* walk, int p1, bint same, double last,
                         double next, double whole, double beyond, double gap,
                         double refractory) noexcept nogil:
    """Curve from walk to its next event, of polarity p1, after a gap (see `between`).

    same: both events have one sign; last and next: thresholds that they stand for;
    whole: thresholds from one event to the next; beyond: what is lost in the reset.
    """
    cdef curve_t curve
    cdef double q
    curve.a = whole
    curve.b = 0.0
    curve.fall = 0.0
    if same:
        curve.var = SAME_VARIANCE
        curve.rate_var = SAME_RATE_VARIANCE
        curve.fall = 0.0 if p1 else 1e6 / gap
    elif never(walk.t_prev) or walk.p_prev != walk.p:
        curve.var = UNSURE_VARIANCE
        curve.rate_var = UNSURE_RATE_VARIANCE
        turn_at(TURN_HALF + beyond, whole, &curve.a, &curve.b)
    else:
        curve.var = TURNED_VARIANCE
        curve.rate_var = TURNED_RATE_VARIANCE
        q = <double>(walk.t - walk.t_prev)
        q = q if q > GAP_LEAST_US else GAP_LEAST_US
        # The slope before the last event, extrapolated over the gap before it.
        last *= q / sensitive_us(walk.t_prev, walk.t, refractory) / (next + TINY)
        curve.fall = 1e6 / q if p1 else 0.0
        q /= gap
        beyond += TURN_MOST
        curve.b = (last + q * whole) / (q * (1.0 + q))
        curve.a = whole - curve.b
        if curve.a > 0.0 or curve.b < 0.0:
            curve.a = whole
            curve.b = 0.0
            if whole > 0.0:
                curve.a = 0.0
                curve.b = whole
        elif curve.a * curve.a > 4.0 * curve.b * beyond:
            turn_at(beyond, whole, &curve.a, &curve.b)
    return curve


cdef inline part_t between(const walk_t* walk, int64_t t1, int p1, double on,
                           double off, const lamp_t* lamp, double hz,
                           double refractory, double t) noexcept nogil:
    """Part crossed at t, between walk and its next event, of polarity p1 at t1.

    Linear if both events have one sign.  Otherwise a parabola through both events and
    the one before, if that has the sign of the last; on and off are the thresholds.
    The parabola turns after the last event and at most a threshold beyond it; without
    such an event before, it turns half a threshold beyond.  The variances are those of
    rotating polarizers and plates.  The change lost in a refractory period counts as
    part of the way.  Under a flickering lamp all this holds for the light minus the
    ripple, which is filtered by a pixel of corner frequency hz.
    """
    cdef part_t part = nothing(p1)
    cdef curve_t curve
    cdef double gap = <double>(t1 - walk.t), s, whole = 1.0
    cdef double last = off if p1 else on, next = on if p1 else off, ripples = 1.0
    cdef double here = 0.0, now, change = 0.0, _
    cdef loss_t loss = lost(walk.t_prev, walk.t, t1, refractory)
    cdef bint same = walk.p == p1
    cdef bint flickers = lamp.blocks > 0 and t1 - walk.t < STALE_US
    if never(walk.t):
        return part
    if gap < GAP_LEAST_US:
        gap = GAP_LEAST_US
    s = (t - <double>walk.t) / gap
    whole += loss.after + (loss.before if same else -loss.before * last / next)
    if flickers:
        # The part has the shape of the light minus the ripple; it is scaled at the end.
        ripples = whole
        whole = 1.0
        loss.before = 0.0
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
    curve = bend(walk, p1, same, last, next, whole, loss.before, gap, refractory)
    part.var = curve.var
    part.fall = curve.fall
    part.fraction = s * (curve.a + s * curve.b)
    part.rate = (curve.a + 2.0 * s * curve.b) * 1e6 / gap
    part.rate_var = curve.rate_var * (PER_S2 / (gap * gap))
    if flickers:
        now = ripple(lamp, hz, t, &part.ripple_rate)
        part.ripple = now - here - part.fraction * change
        part.ripple_rate -= part.rate * change
        part.fraction *= ripples
        part.rate *= ripples
    return part


cdef inline void add_in_reset(part_t* part, double since, double gap, double first,
                              double refractory) noexcept nogil:
    """Add the change of light while the pixel is held in reset after its last event.

    The light continues at `first` thresholds per gap (us); since: time since the event.
    """
    if since < refractory:
        part.fraction += first * since / gap
        part.rate += first * 1e6 / gap
    else:
        part.fraction += first * refractory / gap


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


cdef inline double moving(const walk_t* walk, double gap,
                          const tuning_t* tuning) noexcept nogil:
    """Probability that light still moves if no event follows the last one for `gap`.
    """
    cdef double refractory = tuning.refractory_us, w
    cdef double before = <double>(walk.t - walk.t_prev) - refractory
    cdef const float* low
    cdef int node
    if never(walk.t_prev):
        return 1.0
    before = max(before, least_gap(tuning))
    gap = gap - refractory if gap > refractory else 0.0
    node = node_of(gap / before, &w)
    if node == AHEAD_NODES - 1:
        return 0.0
    low = AHEAD[node if walk.p_prev == walk.p else AHEAD_NODES + node]
    return column(low, MOVES, w)


cdef inline part_t quiet(const walk_t* walk, double known, const lamp_t* lamp,
                         double hz, double refractory, double t) noexcept nogil:
    """Part crossed at t if no event follows up to the time known, which is > t.

    A parabola that rises to half a threshold and returns to 0 at the time known: within
    0.1 threshold of the mean over pixels whose light turns or slows down.
    """
    cdef part_t part = nothing(walk.p)
    cdef double gap = known - <double>walk.t, s
    if never(walk.t):
        return part
    part.var = QUIET_VARIANCE
    part.rate_var = QUIET_RATE_VARIANCE * PER_S2 / (gap * gap)
    s = (t - <double>walk.t) / gap
    part.fraction = 2.0 * s * (1.0 - s)
    part.rate = (2.0 - 4.0 * s) * 1e6 / gap
    if refractory > 0.0 and not never(walk.t_prev):
        add_in_reset(&part, t - <double>walk.t, sensitive_us(
            walk.t_prev, walk.t, refractory), 1.0, refractory)
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
                         const lamp_t* lamp, double hz, const tuning_t* tuning,
                         double t) noexcept nogil:
    """Part crossed at t, extrapolated from the last two events.

    Returns posterior means and variances of the part and of its slope, given that no
    event has followed.  They are tabulated by the time since the last event over the
    last gap.  lab/studies/kalman_extrapolation.py states the prior, an ensemble of
    lights that turn and may stop, and makes the table.  Long silence means rest.  Under
    a flickering lamp this holds for the light minus the ripple.
    """
    cdef part_t part = nothing(walk.p)
    cdef double refractory = tuning.refractory_us
    cdef double gap = <double>(walk.t - walk.t_prev) - refractory, u, change
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
    gap = max(gap, least_gap(tuning))
    u = (since - refractory if since > refractory else 0.0) / (gap * room)
    node = node_of(u, &w)
    if node == AHEAD_NODES - 1:
        add_ripple(&part, lamp, hz, walk.t, t)
        return part
    low = AHEAD[node if same else AHEAD_NODES + node]
    part.fraction = column(low, PART, w)
    part.rate = column(low, RATE, w)
    part.var = column(low, VAR, w)
    part.rate_var = column(low, RATE_VAR, w)
    if same:
        part.fall = 0.0 if part.p else 1e6 / gap
    part.fraction *= room
    part.rate *= 1e6 / gap
    part.rate_var *= PER_S2 / (gap * gap)
    if refractory > 0.0:
        if since < refractory:
            part.fraction = 0.0
            part.rate = 0.0
        add_in_reset(&part, since, gap, AHEAD[0 if same else AHEAD_NODES][1],
                     refractory)
    add_ripple(&part, lamp, hz, walk.t, t)
    return part


cdef inline part_t ahead_of_sample(const walk_t* walk, double rest, double held,
                                   double noise, int64_t sampled,
                                   const tuning_t* tuning, double t) noexcept nogil:
    """Part crossed at t as `ahead` finds it and a sample has measured it.

    rest is the probability of rest; held the part that the sample at `sampled`, after
    the last event, has measured, with the variance noise.  The lamp is steady.
    """
    cdef part_t part = nothing(walk.p)
    cdef double refractory = tuning.refractory_us, since = t - <double>walk.t
    cdef double gap = max(<double>(walk.t - walk.t_prev) - refractory,
                          least_gap(tuning))
    cdef double active = since - refractory if since > refractory else 0.0
    cdef double reset = since if since < refractory else refractory
    cdef double after = active - (t - <double>sampled), w
    cdef bint same = walk.p_prev == walk.p
    cdef const float* low
    cdef ahead_t row
    cdef sampled_t found
    cdef int node = node_of(active / gap, &w)
    if never(walk.t_prev) or node == AHEAD_NODES - 1:
        part.fraction = held
        part.var = 0.0
        return part
    low = AHEAD[node if same else AHEAD_NODES + node]
    row.part = <float>column(low, PART, w)
    row.rate = <float>column(low, RATE, w)
    row.rate_var = <float>column(low, RATE_VAR, w)
    row.moving = <float>column(low, MOVES, w)
    row.spread = <float>column(low, SPREAD, w)
    row.middle = <float>column(low, MIDDLE, w)
    row.common = <float>column(low, COMMON, w)
    found = part_of_sample(
        row, <float>(active / gap), <float>(after / active if after > 0.0 else 0.0),
        <float>rest, <float>held, <float>noise,
        <float>(AHEAD[0 if same else AHEAD_NODES][1] * reset / gap))
    part.fraction = found.part
    part.var = found.var
    part.rate = found.rate * 1e6 / gap
    part.rate_var = found.rate_var * PER_S2 / (gap * gap)
    if same:
        part.fall = 0.0 if part.p else 1e6 / gap
    return part
