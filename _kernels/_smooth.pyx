"""Log intensity from the frames before and after it, thresholds taken as known.

Two filters per pixel, one forward and one backward in time, meet at t: the same as a
Rauch-Tung-Striebel smoother (Fraser & Potter 1969).  Only the offset of log intensity
is filtered; base + theta_on n_on - theta_off n_off is known up to it.
"""
from libc.stdint cimport int32_t, int64_t, uint8_t

from _kernels._estimate cimport (
    LEAST_VARIANCE, part_at, part_variance, theta_squared, walk_to)
from _kernels._hot cimport is_hot
from _kernels._lag cimport corner, lead, lead_variance
from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._model cimport (
    check_given, node_t, state_t, stored_t, track_t, tuning_t, wave_t)
from _kernels._tracks cimport TINY, at_rest, drift, part_t, walk_t

cdef packed struct past_t:
    # What the samples before say of the base; var < 0: there was none.
    double base
    double var
    int64_t t
    double n_on             # all events up to t, with what was lost
    double n_off

cdef packed struct gap_t:
    # What the samples on both sides of t say; var < 0: there is none.
    past_t before
    past_t after            # relative to the base after it
    double drift            # variance between them


cdef inline double measured(const node_t* node, double on, double off) noexcept nogil:
    return node.level - node.h_on * on - node.h_off * off


cdef inline void advance(past_t* past, const node_t* node, int64_t t, double on,
                         double off) noexcept nogil:
    """Take in the next sample."""
    cdef double z = measured(node, on, off), k
    if past.var < 0:
        past.base = z
        past.var = node.noise
    else:
        past.base += on * (node.n_on - past.n_on) - off * (node.n_off - past.n_off)
        past.var += node.drift
        k = past.var / (past.var + node.noise)
        past.base += k * (z - past.base)
        past.var *= 1.0 - k
    past.t = t
    past.n_on = node.n_on
    past.n_off = node.n_off


cdef inline double retreat(past_t* after, const node_t* node, int64_t t,
                           double gap, double on, double off) noexcept nogil:
    """Take in the sample before, gap being the drift since; return that before it."""
    cdef double z = measured(node, on, off), k
    if after.var < 0:
        after.base = z
        after.var = node.noise
    else:
        after.base -= on * (after.n_on - node.n_on) - off * (after.n_off - node.n_off)
        after.var += gap
        k = after.var / (after.var + node.noise)
        after.base += k * (z - after.base)
        after.var *= 1.0 - k
    after.t = t
    after.n_on = node.n_on
    after.n_off = node.n_off
    return node.drift


def smooth_past(const node_t[:, ::1] nodes not None, const int64_t[::1] times not None,
                const state_t[:, ::1] states not None, past_t[:, ::1] past not None):
    """Take a frame into the past: nodes as kalman_frame left them, times by column."""
    cdef Py_ssize_t h = past.shape[0], w = past.shape[1], y, x
    if (nodes.shape[0] != h or nodes.shape[1] != w or times.shape[0] != w
            or states.shape[0] != h or states.shape[1] != w):
        raise ValueError("smooth_past: all images must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                if nodes[y, x].noise > 0:
                    advance(&past[y, x], &nodes[y, x], times[x],
                            states[y, x].theta_on, states[y, x].theta_off)


def smooth_gap(const node_t[:, :, ::1] nodes not None,
               const int64_t[:, ::1] times not None,
               const int32_t[::1] order not None,
               const int32_t[::1] passed not None,
               const state_t[:, ::1] states not None,
               const past_t[:, ::1] past not None, gap_t[:, ::1] out not None):
    """What frames before and after a time say of each pixel's base.

    nodes and times are by slot; order holds the slots in the order of time, passed how
    many of them lie before the time, by column.
    """
    cdef Py_ssize_t h = past.shape[0], w = past.shape[1], n = order.shape[0]
    cdef Py_ssize_t slots = nodes.shape[0], y, x, i
    if (nodes.shape[1] != h or nodes.shape[2] != w or times.shape[0] != slots
            or times.shape[1] != w or passed.shape[0] != w or states.shape[0] != h
            or states.shape[1] != w or out.shape[0] != h or out.shape[1] != w):
        raise ValueError("smooth_gap: all images must have one shape")
    for i in range(n):
        if order[i] < 0 or order[i] >= slots:
            raise ValueError("smooth_gap: order must hold slots of nodes")
    for i in range(w):
        if passed[i] < 0 or passed[i] > n:
            raise ValueError("smooth_gap: passed must lie in 0..len(order)")
    with nogil:
        for y in range(h):
            for x in range(w):
                meet(nodes, times, order, passed[x], y, x, states[y, x].theta_on,
                     states[y, x].theta_off, &past[y, x], &out[y, x])


cdef inline void meet(const node_t[:, :, ::1] nodes, const int64_t[:, ::1] times,
                      const int32_t[::1] order, Py_ssize_t passed, Py_ssize_t y,
                      Py_ssize_t x, double on, double off, const past_t* past,
                      gap_t* out) noexcept nogil:
    cdef Py_ssize_t i = 0, slot
    out.before = past[0]
    while i < passed:
        slot = order[i]
        if nodes[slot, y, x].noise > 0:
            advance(&out.before, &nodes[slot, y, x], times[slot, x], on, off)
        i += 1
    out.after.var = -1.0
    out.drift = 0.0
    i = order.shape[0] - 1
    while i >= passed:
        slot = order[i]
        if nodes[slot, y, x].noise > 0:
            out.drift = retreat(&out.after, &nodes[slot, y, x], times[slot, x],
                                out.drift, on, off)
        i -= 1


def smooth_read(int64_t t, int64_t known, chain not None, model not None,
                const gap_t[:, ::1] gaps not None,
                const state_t[:, ::1] states not None, shown not None):
    """Log intensity and its variance at t from the events up to known > t.

    chain, model and shown are as in kalman_read; the chain's tracks count all events
    up to some time before t.  The variance is 0 where there is no frame on either
    side; the log intensity then counts from 0.
    """
    cdef const stored_t[::1] store
    cdef const track_t[:, ::1] tracks
    cdef const tuning_t[::1] tuning
    cdef const wave_t[::1] waves
    cdef float[:, ::1] out, variance
    cdef uint8_t[:, ::1] valid
    cdef Py_ssize_t h = gaps.shape[0], w = gaps.shape[1], y, x
    cdef lamp_t lamp
    check_given((*chain, *model, *shown))
    store, tracks = chain
    tuning, waves = model
    out, variance, valid = shown
    if (tracks.shape[0] != h or tracks.shape[1] != w or states.shape[0] != h
            or states.shape[1] != w or out.shape[0] != h or out.shape[1] != w
            or variance.shape[0] != h or variance.shape[1] != w
            or valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("smooth_read: all images must have one shape")
    if tuning.shape[0] != 1 or store.shape[0] == 0:
        raise ValueError("smooth_read: tuning or store has a wrong length")
    lamp = lamp_of(waves)
    with nogil:
        for y in range(h):
            for x in range(w):
                read_smoothed(t, known, &store[0], &tuning[0], &lamp, &tracks[y, x],
                              &gaps[y, x], &states[y, x], &out[y, x], &variance[y, x],
                              &valid[y, x])


cdef void read_hot(int64_t t, const tuning_t* tuning, const gap_t* gap,
                   const state_t* s, float* out, float* variance,
                   unsigned char* valid) noexcept nogil:
    """Log intensity of a pixel whose events have no weight, by the samples alone.

    What light moves by from one sample to the next is shared by time.
    """
    cdef double a = gap.before.var, b = gap.after.var, share, u = tuning.offset_dn
    u *= s.pull
    variance[0] = 0.0
    valid[0] = 0
    if a < 0 and b < 0:
        out[0] = 0.0
        return
    valid[0] = max(a, b) <= tuning.valid_variance
    if a < 0 or b < 0:
        out[0] = <float>(gap.before.base if b < 0 else gap.after.base)
        variance[0] = <float>(max(a, b) + s.moves + u * u)
        return
    share = <double>(t - gap.before.t) / <double>max(gap.after.t - gap.before.t, 1)
    a += share * s.moves
    b += (1.0 - share) * s.moves
    share = a / (a + b + TINY)
    out[0] = <float>(gap.before.base + share * (gap.after.base - gap.before.base))
    variance[0] = <float>((1.0 - share) * a + u * u)


cdef void read_smoothed(int64_t t, int64_t known, const stored_t* store,
                        const tuning_t* tuning, const lamp_t* lamp,
                        const track_t* track, const gap_t* gap, const state_t* s,
                        float* out, float* variance,
                        unsigned char* valid) noexcept nogil:
    cdef walk_t walk
    cdef part_t part
    cdef double on = s.theta_on, off = s.theta_off, theta2 = theta_squared(s)
    cdef double m_on = 0.0, m_off = 0.0, theta, level = 0.0, v, u, spread
    cdef double a = 0.0, b = 0.0, left, whole, share, hz = 0.0
    cdef bint resting
    if is_hot(s):
        read_hot(t, tuning, gap, s, out, variance, valid)
        return
    walk_to(&walk, t, store, track, tuning.refractory_us)
    # Thresholds crossed since the sample before, and until the one after.
    if gap.before.var >= 0:
        m_on = walk.n_on - gap.before.n_on
        m_off = walk.n_off - gap.before.n_off
        level = gap.before.base + on * m_on - off * m_off
        v = theta2 * drift(t - gap.before.t, m_on + m_off, tuning)
        a = gap.before.var + v
        if gap.after.var >= 0:
            # A jump between two samples may lie anywhere between them.
            whole = theta2 * drift(
                gap.after.t - gap.before.t, gap.after.n_on - gap.before.n_on
                + gap.after.n_off - gap.before.n_off, tuning)
            share = v / whole if whole > 0 else 0.5
            a = gap.before.var + share * gap.drift
            left = (1.0 - share) * gap.drift
    elif gap.after.var >= 0:
        left = theta2 * drift(
            gap.after.t - t, gap.after.n_on - walk.n_on + gap.after.n_off
            - walk.n_off, tuning)
    if gap.after.var >= 0:
        b = gap.after.var + left
        u = gap.after.base - (on * (gap.after.n_on - walk.n_on)
                              - off * (gap.after.n_off - walk.n_off))
        share = a / (a + b + TINY) if gap.before.var >= 0 else 1.0
        m_on = (1.0 - share) * m_on - share * (gap.after.n_on - walk.n_on)
        m_off = (1.0 - share) * m_off - share * (gap.after.n_off - walk.n_off)
        level += share * (u - level)
        v = (1.0 - share) * a if gap.before.var >= 0 else b
    elif gap.before.var >= 0:
        v = a
    else:
        level = on * walk.n_on - off * walk.n_off
        v = -1.0
    # What is crossed of the next threshold, and the lag of the photoreceptor.
    if lamp.blocks > 0:
        hz = corner(tuning, level)
    part = part_at(&walk, store, known, on, off, lamp, hz,
                   tuning, NULL, <double>t)
    resting = lamp.blocks == 0 and at_rest(walk.t, t) and (
        walk.next < 0 or store[walk.next].t > known)
    spread = theta2 * part.var
    if resting and gap.before.var >= 0:
        spread = part_variance(s, gap.before.t, walk.t)
    if (walk.next >= 0 and store[walk.next].t <= known) or (
            gap.before.var >= 0 and walk.t > gap.before.t):
        spread += theta2 * tuning.motion_variance
    theta = on if part.p else -off
    level += theta * part.fraction + part.ripple
    # What does not change is shown without a lag.
    u = 0.0 if resting else lead(
        theta * part.rate + part.ripple_rate, level, tuning)
    out[0] = <float>(level + u)
    if v < 0:
        variance[0] = 0.0
        valid[0] = 0
        return
    if part.p:
        m_on += part.fraction
    else:
        m_off += part.fraction
    v += (spread + m_on * m_on * s.var_on + m_off * m_off * s.var_off
          - 2.0 * m_on * m_off * s.cov_on_off)
    v = v if v > LEAST_VARIANCE else LEAST_VARIANCE
    valid[0] = v <= tuning.valid_variance
    a = tuning.offset_dn * s.pull
    v += a * a
    if not resting:
        v += lead_variance(
            u, theta2 * part.rate_var, off * part.fall, level, tuning)
    variance[0] = <float>v
