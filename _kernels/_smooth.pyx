"""Log intensity from the frames before and after it, thresholds taken as known.

Two filters per pixel, one forward and one backward in time, meet at t: the same as a
Rauch-Tung-Striebel smoother (Fraser & Potter 1969).  Only the offset of log intensity
is filtered; base + theta_on n_on - theta_off n_off is known up to it.
"""
from libc.stdint cimport int32_t, int64_t, uint8_t

from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._model cimport (
    check_given, node_t, state_t, stored_t, track_t, tuning_t, wave_t)
from _kernels._smoothed cimport gap_t, past_t, read_smoothed

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
