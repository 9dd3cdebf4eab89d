"""Smoothed log intensity from the frames before and after a time.

Two filters per pixel, one forward and one backward in time, are combined at t, which
equals a Rauch-Tung-Striebel smoother (Fraser & Potter 1969).  Thresholds are taken as
known, so only the offset of log intensity is filtered.
"""
from libc.stdint cimport int32_t, int64_t, uint8_t

from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._model cimport (
    check_given, node_t, state_t, stored_t, track_t, tuning_t, wave_t)
from _kernels._smoothed cimport gap_t, past_t, read_smoothed

cdef extern from "_prefetch.h" nogil:
    void prefetch "PDAVIS_PREFETCH"(const void*)

cdef extern from "_smooth.h" nogil:
    enum:
        SIDE
    ctypedef struct nodes_t:
        double level[SIDE]
        double h_on[SIDE]
        double h_off[SIDE]
        double noise[SIDE]
        double drift[SIDE]
        double n_on[SIDE]
        double n_off[SIDE]
        int64_t t[SIDE]
    ctypedef struct side_t:
        double base[SIDE]
        double var[SIDE]
        double n_on[SIDE]
        double n_off[SIDE]
        int64_t t[SIDE]
        double drift[SIDE]
    ctypedef struct pair_t:
        double on[SIDE]
        double off[SIDE]
    void advance_side(side_t*, const nodes_t*, const pair_t*, Py_ssize_t)
    void retreat_side(side_t*, const nodes_t*, const pair_t*, Py_ssize_t)

cdef struct meeting_t:
    # What `smooth_gap` is given; n is the number of frames.
    Py_ssize_t w, size, n
    const node_t* nodes
    const int64_t* times
    const int32_t* order
    const int32_t* passed
    const state_t* states
    const past_t* past
    gap_t* out
    gap_t* following

cdef inline double measured(const node_t* node, double on, double off) noexcept nogil:
    return node.level - node.h_on * on - node.h_off * off


cdef inline void advance(past_t* past, const node_t* node, int64_t t, double on,
                         double off) noexcept nogil:
    """Update the forward filter with the next sample."""
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


def smooth_past(const node_t[:, ::1] nodes not None, const int64_t[::1] times not None,
                const state_t[:, ::1] states not None,
                past_t[:, ::1] past not None):
    """Merge a frame into the past: nodes as kalman_frame wrote them, times by column.
    """
    cdef Py_ssize_t h = past.shape[0], w = past.shape[1], y, x
    if (nodes.shape[0] != h or nodes.shape[1] != w or times.shape[0] != w
            or states.shape[0] != h or states.shape[1] != w):
        raise ValueError("smooth_past: all images must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                if nodes[y, x].noise > 0:
                    advance(&past[y, x], &nodes[y, x], times[x], states[y, x].theta_on,
                            states[y, x].theta_off)


def smooth_gap(const node_t[:, :, ::1] nodes not None,
               const int64_t[:, ::1] times not None,
               const int32_t[::1] order not None,
               const int32_t[::1] passed not None,
               const state_t[:, ::1] states not None,
               const past_t[:, ::1] past not None, rows not None,
               gap_t[:, ::1] out not None, gap_t[:, ::1] following not None):
    """Estimate each pixel's base from the frames before, and from those after, a time.

    nodes and times are indexed by slot; order lists the slots in order of time, and
    passed says by column how many of them lie before the time.  following receives the
    same for the next interval, with one more frame passed, if there is one.  Rows
    (first, last) are written.
    """
    cdef Py_ssize_t h = past.shape[0], w = past.shape[1], n = order.shape[0]
    cdef Py_ssize_t slots = nodes.shape[0], i, first, last
    cdef meeting_t of
    first, last = rows
    if (nodes.shape[1] != h or nodes.shape[2] != w or times.shape[0] != slots
            or times.shape[1] != w or passed.shape[0] != w or states.shape[0] != h
            or states.shape[1] != w or out.shape[0] != h or out.shape[1] != w
            or following.shape[0] != h or following.shape[1] != w):
        raise ValueError("smooth_gap: all images must have one shape")
    for i in range(n):
        if order[i] < 0 or order[i] >= slots:
            raise ValueError("smooth_gap: order must hold slots of nodes")
    for i in range(w):
        if passed[i] < 0 or passed[i] > n:
            raise ValueError("smooth_gap: passed must lie in 0..len(order)")
    if first < 0 or last > h:
        raise ValueError("smooth_gap: rows must lie in the image")
    if w == 0 or first >= last:
        return
    of.w, of.size, of.n = w, h * w, n
    of.nodes, of.times, of.passed = &nodes[0, 0, 0], &times[0, 0], &passed[0]
    of.order = NULL
    if n > 0:
        of.order = &order[0]
    of.states, of.past = &states[0, 0], &past[0, 0]
    of.out, of.following = &out[0, 0], &following[0, 0]
    with nogil:
        meet_rows(&of, first, last)


cdef void meet_rows(const meeting_t* of, Py_ssize_t first,
                    Py_ssize_t last) noexcept nogil:
    cdef Py_ssize_t y, x, width
    for y in range(first, last):
        x = 0
        while x < of.w:
            width = 1
            while (width < SIDE and x + width < of.w
                   and of.passed[x + width] == of.passed[x]):
                width += 1
            meet(of, y, x, width)
            x += width


cdef inline void lay_out(const node_t* of, const int64_t* times, Py_ssize_t n,
                         const node_t* following, nodes_t* out) noexcept nogil:
    """Gather the samples of n pixels by quantity; prefetch those that come next."""
    cdef Py_ssize_t i
    for i in range(n):
        if following != NULL:
            prefetch(&following[i])
        out.level[i] = of[i].level
        out.h_on[i] = of[i].h_on
        out.h_off[i] = of[i].h_off
        out.noise[i] = of[i].noise
        out.drift[i] = of[i].drift
        out.n_on[i] = of[i].n_on
        out.n_off[i] = of[i].n_off
        out.t[i] = times[i]


cdef inline void write_side(const side_t* side, Py_ssize_t i,
                            past_t* out) noexcept nogil:
    out.base = side.base[i]
    out.var = side.var[i]
    out.t = side.t[i]
    out.n_on = side.n_on[i]
    out.n_off = side.n_off[i]


cdef void meet(const meeting_t* of, Py_ssize_t y, Py_ssize_t x,
               Py_ssize_t width) noexcept nogil:
    """Do `smooth_gap` for `width` pixels from x on with equal numbers passed."""
    cdef Py_ssize_t at = y * of.w + x, n = of.n, passed = of.passed[x]
    cdef const node_t* nodes = of.nodes + at
    cdef const int64_t* times = of.times + x
    cdef const state_t* states = of.states + at
    cdef const past_t* past = of.past + at
    cdef gap_t* out = of.out + at
    cdef gap_t* following = of.following + at
    cdef pair_t theta
    cdef nodes_t samples
    cdef side_t side
    cdef const node_t* ahead
    cdef Py_ssize_t i, k
    for i in range(width):
        theta.on[i] = states[i].theta_on
        theta.off[i] = states[i].theta_off
        side.base[i] = past[i].base
        side.var[i] = past[i].var
        side.t[i] = past[i].t
        side.n_on[i] = past[i].n_on
        side.n_off[i] = past[i].n_off
        side.drift[i] = 0.0
    for k in range(min(passed + 1, n)):
        if k == passed:
            for i in range(width):
                write_side(&side, i, &out[i].before)
        lay_out(nodes + of.order[k] * of.size, times + of.order[k] * of.w, width, NULL,
                &samples)
        advance_side(&side, &samples, &theta, width)
    for i in range(width):
        write_side(&side, i, &following[i].before)
        if passed >= n:
            write_side(&side, i, &out[i].before)
        side.base[i] = 0.0
        side.var[i] = -1.0
        side.t[i] = 0
        side.n_on[i] = 0.0
        side.n_off[i] = 0.0
        side.drift[i] = 0.0
    k = n
    while k >= passed:
        if k <= passed + 1:     # frames k and later have been used so far
            for i in range(width):
                if k == passed:
                    write_side(&side, i, &out[i].after)
                    out[i].drift = side.drift[i]
                else:
                    write_side(&side, i, &following[i].after)
                    following[i].drift = side.drift[i]
        k -= 1
        if k >= passed:
            ahead = NULL
            if k > passed:
                ahead = nodes + of.order[k - 1] * of.size
            lay_out(nodes + of.order[k] * of.size, times + of.order[k] * of.w, width,
                    ahead, &samples)
            retreat_side(&side, &samples, &theta, width)


def smooth_read(int64_t t, int64_t known, chain not None, model not None,
                const gap_t[:, ::1] gaps not None,
                const state_t[:, ::1] states not None, shown not None):
    """Write log intensity and its variance at t, using the events up to known > t.

    chain, model and shown are as in kalman_read; the chain's tracks count all events
    up to some time before t.  Where there is no frame on either side, the variance is 0
    and log intensity is relative to 0.
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
