"""Log intensity from the frames before and after it, thresholds taken as known.

Two filters per pixel, one forward and one backward in time, meet at t: the same as a
Rauch-Tung-Striebel smoother (Fraser & Potter 1969).  Only the offset of log intensity
is filtered; base + theta_on n_on - theta_off n_off is known up to it.
"""
from libc.stdint cimport int32_t, int64_t

from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._tracks cimport (
    between, corner, drift, lead, lead_variance, node_t, part_t, quiet, start, step,
    track_t, walk_t)
from _kernels._types cimport event_t

cdef packed struct past_t:
    # What the samples before say of the base; var < 0: there was none.
    double base
    double var
    int64_t t
    int32_t n_on            # all events up to t
    int32_t n_off

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
                const double[:, :, ::1] state not None, past_t[:, ::1] past not None):
    """Take a frame into the past: nodes as kalman_frame left them, times by column."""
    cdef Py_ssize_t h = past.shape[0], w = past.shape[1], y, x
    if (nodes.shape[0] != h or nodes.shape[1] != w or times.shape[0] != w
            or state.shape[0] != h or state.shape[1] != w or state.shape[2] != 9):
        raise ValueError("smooth_past: all images must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                if nodes[y, x].noise > 0:
                    advance(&past[y, x], &nodes[y, x], times[x], state[y, x, 1],
                            state[y, x, 2])


def smooth_gap(const node_t[:, :, ::1] nodes not None,
               const int64_t[:, ::1] times not None,
               const int32_t[::1] order not None,
               const int32_t[::1] passed not None,
               const double[:, :, ::1] state not None,
               const past_t[:, ::1] past not None, gap_t[:, ::1] out not None):
    """What frames before and after a time say of each pixel's base.

    nodes and times are by slot; order holds the slots in the order of time, passed how
    many of them lie before the time, by column.
    """
    cdef Py_ssize_t h = past.shape[0], w = past.shape[1], n = order.shape[0]
    cdef Py_ssize_t slots = nodes.shape[0], y, x, i
    if (nodes.shape[1] != h or nodes.shape[2] != w or times.shape[0] != slots
            or times.shape[1] != w or passed.shape[0] != w or state.shape[0] != h
            or state.shape[1] != w or state.shape[2] != 9 or out.shape[0] != h
            or out.shape[1] != w):
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
                meet(nodes, times, order, passed[x], y, x, state[y, x, 1],
                     state[y, x, 2], &past[y, x], &out[y, x])


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


def smooth_read(int64_t t, int64_t known, const event_t[::1] store not None,
                const int32_t[::1] link not None,
                const int32_t[:, ::1] first not None,
                const double[::1] tuning not None,
                const double[:, ::1] waves not None, int64_t lit_us,
                const track_t[:, ::1] tracks not None,
                const gap_t[:, ::1] gaps not None,
                const double[:, :, ::1] state not None, double most,
                float[:, ::1] out not None, float[:, ::1] variance not None,
                unsigned char[:, ::1] valid not None):
    """Log intensity and its variance at t from the events up to known > t.

    tracks counts all events up to some time before t, first and link chain those
    after it.  variance is -1 where there is no frame on either side; out then counts
    from 0.  valid is 1 where it is at most `most`, not counting that of the lag.
    waves (turns per us, cosine, sine, 1 if of the light) are the lamp's, a row per
    block from lit_us on.
    """
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], n = store.shape[0]
    cdef Py_ssize_t y, x
    cdef lamp_t lamp
    if (gaps.shape[0] != h or gaps.shape[1] != w or state.shape[0] != h
            or state.shape[1] != w or out.shape[0] != h or out.shape[1] != w
            or variance.shape[0] != h or variance.shape[1] != w
            or valid.shape[0] != h or valid.shape[1] != w
            or first.shape[0] != h or first.shape[1] != w):
        raise ValueError("smooth_read: all images must have one shape")
    if (state.shape[2] != 9 or tuning.shape[0] != 5 or waves.shape[1] != 4
            or link.shape[0] != n or n == 0):
        raise ValueError(
            "smooth_read: state, tuning, waves, store or link has a wrong length")
    lamp = lamp_of(waves, lit_us)
    with nogil:
        for y in range(h):
            for x in range(w):
                read_pixel(t, known, &store[0], &link[0], first[y, x], &tuning[0],
                           &lamp, &tracks[y, x], &gaps[y, x], &state[y, x, 0], most,
                           &out[y, x], &variance[y, x], &valid[y, x])


cdef void read_pixel(int64_t t, int64_t known, const event_t* store,
                     const int32_t* link, int32_t first, const double* tuning,
                     const lamp_t* lamp, const track_t* track, const gap_t* gap,
                     const double* s, double most, float* out, float* variance,
                     unsigned char* valid) noexcept nogil:
    cdef walk_t walk
    cdef part_t part
    cdef double m_on = 0.0, m_off = 0.0, theta, theta2, level = 0.0, v, u
    cdef double a = 0.0, b = 0.0, left, whole, share, hz = 0.0
    start(&walk, track.prev, track.last, first)
    walk.n_on = track.n_on
    walk.n_off = track.n_off
    while walk.next >= 0 and store[walk.next].t <= t:
        step(&walk, store, link)
    theta2 = 0.25 * (s[1] + s[2]) * (s[1] + s[2])
    # Thresholds crossed since the sample before, and until the one after.
    if gap.before.var >= 0:
        m_on = walk.n_on - gap.before.n_on
        m_off = walk.n_off - gap.before.n_off
        level = gap.before.base + s[1] * m_on - s[2] * m_off
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
        u = gap.after.base - (s[1] * (gap.after.n_on - walk.n_on)
                              - s[2] * (gap.after.n_off - walk.n_off))
        share = a / (a + b + 1e-30) if gap.before.var >= 0 else 1.0
        m_on = (1.0 - share) * m_on - share * (gap.after.n_on - walk.n_on)
        m_off = (1.0 - share) * m_off - share * (gap.after.n_off - walk.n_off)
        level += share * (u - level)
        v = (1.0 - share) * a if gap.before.var >= 0 else b
    elif gap.before.var >= 0:
        v = a
    else:
        level = s[1] * walk.n_on - s[2] * walk.n_off
        v = -1.0
    # What is crossed of the next threshold, and the lag of the photoreceptor.
    if lamp.blocks > 0:
        hz = corner(tuning[2], tuning[3], level)
    if walk.next >= 0 and store[walk.next].t <= known:
        part = between(&walk, store[walk.next].t, store[walk.next].p, s[1], s[2],
                       lamp, hz, <double>t)
    else:
        part = quiet(walk.t, walk.p, <double>known, lamp, hz, <double>t)
    theta = s[1] if part.p else -s[2]
    level += theta * part.fraction + part.ripple
    u = lead(theta * part.rate + part.ripple_rate, level, tuning[2], tuning[3])
    out[0] = <float>(level + u)
    if v < 0:
        variance[0] = -1.0
        valid[0] = 0
        return
    if part.p:
        m_on += part.fraction
    else:
        m_off += part.fraction
    v += (theta2 * part.var + m_on * m_on * s[6] + m_off * m_off * s[8]
          - 2.0 * m_on * m_off * s[7])
    v = v if v > 1e-8 else 1e-8
    u = lead_variance(u, theta2 * part.rate_var, s[2] * part.fall, level,
                      tuning)
    variance[0] = <float>(v + u)
    valid[0] = v <= most
