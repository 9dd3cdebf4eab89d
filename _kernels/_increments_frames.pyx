"""Frames of the filter of log intensity (_increments.pyx)."""
from libc.math cimport NAN, fabs
from libc.stdint cimport int64_t
from libc.stdlib cimport free, malloc

from _kernels._increments cimport (
    CLAIM, GATE, HOT_MEMORY, LEARN_EVENTS, LESS, MORE, MOST_SAMPLES, PRIOR_ODDS,
    SHOWN, anchor_t, camera_of, camera_t, mean_at, node_t, pixel_t,
    stored_t)
from _kernels._increments_frames cimport around_of, lags_of, lags_t, node_of
from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._model cimport wave_t


def increments_node(const pixel_t[:, ::1] pixels not None,
                    const stored_t[::1] store not None,
                    const int64_t[:, ::1] exposure not None, int samples, int64_t known,
                    const float[:, :, ::1] gains not None,
                    const double[::1] camera not None, const wave_t[::1] waves not None,
                    bint again, node_t[:, ::1] nodes not None, bands not None):
    """Evaluate rows first <= y < last of a frame; exposure is (begin, end) by column.

    gains are those about which it is linear.  again: only where a silence was open.
    """
    cdef Py_ssize_t y, x, first, last
    cdef const camera_t* c = camera_of(camera)
    cdef lamp_t lamp = lamp_of(waves)
    first, last = bands
    if samples < 1 or samples > MOST_SAMPLES:
        raise ValueError("increments_node: samples must be 1 to 9")
    if (nodes.shape[0] != pixels.shape[0] or nodes.shape[1] != pixels.shape[1]
            or exposure.shape[0] != 2 or exposure.shape[1] != pixels.shape[1]
            or gains.shape[0] != pixels.shape[0] or gains.shape[1] != pixels.shape[1]
            or gains.shape[2] != 2):
        raise ValueError("increments_node: all images must have one shape")
    with nogil:
        for y in range(first, last):
            for x in range(pixels.shape[1]):
                if not again or nodes[y, x].open_t != 0:
                    node_of(&pixels[y, x], &store[0], exposure[0, x], exposure[1, x],
                            samples, known, &gains[y, x, 0], c, &lamp, &nodes[y, x])


cdef struct between_t:
    # From one frame to another: change of y, of its parts, thresholds passed, noise.
    double change
    double[2] part
    double passed
    double noise


cdef inline between_t between(const node_t* a, const node_t* b, double seconds,
                              const camera_t* c) noexcept nogil:
    """Changes from node a to the later node b, and their noise.  (8)"""
    cdef between_t out
    cdef double theta2 = 0.25 * (c.theta[0] + c.theta[1]) * (c.theta[0] + c.theta[1])
    cdef double opened
    out.part[0] = b.light[0] - a.light[0]
    out.part[1] = b.light[1] - a.light[1]
    out.change = b.mean - a.mean + b.around
    out.passed = fabs(out.part[0]) / c.theta[0] + fabs(out.part[1]) / c.theta[1]
    opened = b.open_variance
    if b.open_t != 0 and b.open_t == a.open_t:
        opened = max(opened - a.open_variance, 0.0)
    out.noise = (c.alpha * fabs(seconds) + c.gamma * out.passed
                 + 0.5 * c.beta * min(out.passed, 1.0) + theta2 * opened)
    return out


def increments_pass(const node_t[:, ::1] old not None,
                    const node_t[:, ::1] new not None,
                    const double[::1] seconds not None,
                    const double[::1] camera not None,
                    anchor_t[:, ::1] anchors not None, float[:, ::1] middles not None,
                    bands not None):
    """Let the filter pass a frame: predict from node old to node new, and update.  (12)

    seconds is the time between them by column.  middles receives ln(I + black) in the
    mean over the exposure, NaN without a sample.
    """
    cdef Py_ssize_t y, x, first, last
    cdef const camera_t* c = camera_of(camera)
    first, last = bands
    if (old.shape[0] != new.shape[0] or old.shape[1] != new.shape[1]
            or anchors.shape[0] != new.shape[0] or anchors.shape[1] != new.shape[1]
            or middles.shape[0] != new.shape[0] or middles.shape[1] != new.shape[1]
            or seconds.shape[0] != new.shape[1]):
        raise ValueError("increments_pass: all images must have one shape")
    with nogil:
        for y in range(first, last):
            for x in range(new.shape[1]):
                middles[y, x] = pass_one(
                    &old[y, x], &new[y, x], seconds[x], c, &anchors[y, x])


cdef inline float pass_one(const node_t* old, const node_t* new, double seconds,
                           const camera_t* c, anchor_t* a) noexcept nogil:
    cdef between_t step
    cdef double r, e, s, k0, k1, k2, d0, d1, p0, claim, shown
    cdef bint hot = a.hot > PRIOR_ODDS, jump
    if a.sampled == 0.0:
        if new.variance > 0.0:
            a.log = new.log
            a.p[0] = new.variance
            if new.light[0] != 0.0 or new.light[1] != 0.0:
                a.p[0] += 0.25 * c.beta
            a.p[1] = a.p[2] = a.p[4] = 0.0
            a.p[3] = a.p[5] = c.spread2
            a.sampled = 1.0
            return a.log
        return NAN
    step = between(old, new, seconds, c)
    if new.variance > 0.0:
        # Do frames contradict what the events of this pixel claim?
        claim = step.part[0] + step.part[1]
        shown = (new.log - a.log) * (1.0 if claim > 0.0 else -1.0)
        claim = fabs(claim)
        shown = SHOWN * claim - shown
        if (claim > CLAIM * (fabs(step.part[0]) + fabs(step.part[1])) and claim > 0.0
                and shown > 0.0 and shown * shown > GATE * (new.variance + a.p[0])):
            a.hot = min(a.hot + MORE, 2.0 * PRIOR_ODDS)
        elif claim > 0.0:
            a.hot = max(a.hot - LESS, 0.0)
        e = new.log - a.log
        a.motion += (e * e - a.motion) / HOT_MEMORY
    if hot:
        a.p[0] += a.motion
    else:
        d0, d1 = step.part[0], step.part[1]
        a.log += step.change + d0 * a.gain[0] + d1 * a.gain[1]
        a.p[0] += (2.0 * (d0 * a.p[1] + d1 * a.p[2] + d0 * d1 * a.p[4])
                   + d0 * d0 * a.p[3] + d1 * d1 * a.p[5] + step.noise)
        a.p[1] += d0 * a.p[3] + d1 * a.p[4]
        a.p[2] += d0 * a.p[4] + d1 * a.p[5]
    if new.variance <= 0.0:
        return NAN
    r = new.variance + (0.0 if hot else 0.25 * c.beta * min(step.passed, 1.0))
    e = new.log - a.log
    jump = e * e > GATE * (a.p[0] + r)
    if jump:
        a.p[0] += e * e
    s = 1.0 / (a.p[0] + r)
    k0 = a.p[0] * s
    k1 = a.p[1] * s
    k2 = a.p[2] * s
    if hot or jump or step.passed < LEARN_EVENTS:
        k1 = k2 = 0.0           # gains are learned from several events on
    p0 = a.p[0]
    a.log += k0 * e
    a.gain[0] += k1 * e
    a.gain[1] += k2 * e
    # Joseph's form, as k1 and k2 may not be the best ones.
    a.p[3] += k1 * (k1 / s - 2.0 * a.p[1])
    a.p[4] += k1 * k2 / s - k1 * a.p[2] - k2 * a.p[1]
    a.p[5] += k2 * (k2 / s - 2.0 * a.p[2])
    a.p[1] += k0 * k1 / s - k0 * a.p[1] - k1 * p0
    a.p[2] += k0 * k2 / s - k0 * a.p[2] - k2 * p0
    a.p[0] = k0 * r
    return a.log


def increments_back(list nodes not None, const double[:, ::1] seconds not None,
                    const double[::1] camera not None,
                    const anchor_t[:, ::1] anchors not None,
                    float[:, :, ::1] back not None, bands not None):
    """Carry the estimate from the last of later frames back to the first of them.

    nodes are theirs, seconds (frame, column) the time from each to the next.  back is
    (log, variance) of ln(I + black) at the first; a variance < 0 is of no estimate.
    """
    cdef Py_ssize_t i, y, x, first, last, n = len(nodes)
    cdef Py_ssize_t h = anchors.shape[0], w = anchors.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef const node_t[:, ::1] one
    cdef const node_t** frames
    first, last = bands
    if (back.shape[0] != 2 or back.shape[1] != h or back.shape[2] != w
            or seconds.shape[0] != n or seconds.shape[1] != w):
        raise ValueError("increments_back: all images must have one shape")
    frames = <const node_t**>malloc(max(n, 1) * sizeof(node_t*))
    if frames == NULL:
        raise MemoryError
    try:
        for i in range(n):
            one = nodes[i]
            if one.shape[0] != h or one.shape[1] != w:
                raise ValueError("increments_back: all images must have one shape")
            frames[i] = &one[0, 0]
        with nogil:
            for y in range(first, last):
                for x in range(w):
                    back_one(frames, n, y * w + x, &seconds[0, x], w, c, &anchors[y, x],
                             &back[0, y, x], &back[1, y, x])
    finally:
        free(frames)


cdef inline void back_one(const node_t** frames, Py_ssize_t n, Py_ssize_t at,
                          const double* seconds, Py_ssize_t w, const camera_t* c,
                          const anchor_t* a, float* log,
                          float* variance) noexcept nogil:
    cdef between_t step
    cdef bint hot = a.hot > PRIOR_ODDS
    cdef double b = 0.0, v = -1.0, e, r
    cdef const node_t* node
    cdef Py_ssize_t i
    for i in range(n - 1, -1, -1):
        node = frames[i] + at
        if v > 0.0 and hot:
            v += a.motion
        elif v > 0.0:
            # from this node to the one after
            b -= step.change + step.part[0] * a.gain[0] + step.part[1] * a.gain[1]
            v += step.noise
        if i > 0:
            step = between(frames[i - 1] + at, node, seconds[(i - 1) * w], c)
        if node.variance > 0.0:
            e = node.log - b
            r = node.variance
            if not hot and i > 0:
                r += 0.25 * c.beta * min(step.passed, 1.0)
            if v <= 0.0 or e * e > GATE * (v + r):
                b, v = node.log, r
            else:
                b += v / (v + r) * e
                v = v * r / (v + r)
    log[0], variance[0] = <float>b, <float>v


def increments_around(const pixel_t[:, ::1] pixels not None,
                      const stored_t[::1] store not None, const int64_t[::1] times
                      not None, int64_t known, int64_t ahead,
                      const double[::1] camera not None, bint again,
                      node_t[:, ::1] nodes not None, double[:, :, ::1] planes not None,
                      bands not None):
    """Weigh the counts at other times, and now, of each pixel at a frame.

    times is its middle by column; lags up to ahead (us) count.  planes receives what
    counts for the pixel itself, for its macropixel and for its neighbours.  again: only
    where a silence was open.
    """
    cdef Py_ssize_t y, x, first, last, h = pixels.shape[0], w = pixels.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef lags_t lags = lags_of(c, ahead)
    cdef double[3] out
    cdef int k
    first, last = bands
    if (planes.shape[0] != 3 or planes.shape[1] != h or planes.shape[2] != w
            or times.shape[0] != w or nodes.shape[0] != h or nodes.shape[1] != w):
        raise ValueError("increments_around: all images must have one shape")
    with nogil:
        for y in range(first, last):
            for x in range(w):
                if again and nodes[y, x].around_t == 0:
                    continue
                nodes[y, x].around_t = around_of(
                    &pixels[y, x], &store[0], times[x], known, &lags, c, out)
                for k in range(3):
                    planes[k, y, x] = out[k]


def increments_close(const pixel_t[:, ::1] pixels not None,
                     const stored_t[::1] store not None,
                     const int64_t[:, ::1] exposure not None,
                     const int64_t[::1] middle not None, int samples, int64_t ahead,
                     int64_t oldest, const float[:, :, ::1] gains not None,
                     const double[::1] camera not None,
                     const wave_t[::1] waves not None, node_t[:, ::1] nodes not None,
                     double[:, :, ::1] planes):
    """Evaluate a frame where silences have ended, before its events are dropped.

    A silence since an event after oldest (us) that goes on counts as ended.
    """
    cdef Py_ssize_t y, x, h = pixels.shape[0], w = pixels.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef lamp_t lamp = lamp_of(waves)
    cdef lags_t lags = lags_of(c, ahead)
    cdef const pixel_t* p
    cdef node_t* n
    cdef double[3] out
    cdef int k
    if (nodes.shape[0] != h or nodes.shape[1] != w or exposure.shape[0] != 2
            or exposure.shape[1] != w or middle.shape[0] != w or samples < 1
            or gains.shape[0] != h or gains.shape[1] != w or gains.shape[2] != 2
            or samples > MOST_SAMPLES or planes is not None and (
                planes.shape[0] != 3 or planes.shape[1] != h or planes.shape[2] != w)):
        raise ValueError("increments_close: all images must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                p = &pixels[y, x]
                n = &nodes[y, x]
                if n.around_t != 0 and planes is not None and p.at.t > n.around_t:
                    n.around_t = around_of(
                        p, &store[0], middle[x], p.at.t, &lags, c, out)
                    for k in range(3):
                        planes[k, y, x] = out[k]
                if n.open_t != 0 and p.at.t > n.open_t:
                    node_of(p, &store[0], exposure[0, x], exposure[1, x], samples,
                            p.at.t, &gains[y, x, 0], c, &lamp, n)
                if n.open_t > oldest:
                    n.open_t = 0
                if n.around_t > oldest:
                    n.around_t = 0


def increments_differ(const double[:, :, ::1] new not None,
                      const double[:, :, ::1] old not None,
                      const anchor_t[:, ::1] anchors not None,
                      float[:, :, ::1] out not None, bands not None):
    """Subtract what `increments_around` wrote at two frames; 0 where events say none.
    """
    cdef Py_ssize_t y, x, k, first, last, h = anchors.shape[0], w = anchors.shape[1]
    first, last = bands
    if (new.shape[0] != 3 or new.shape[1] != h or new.shape[2] != w
            or old.shape[0] != 3 or old.shape[1] != h or old.shape[2] != w
            or out.shape[0] != 3 or out.shape[1] != h or out.shape[2] != w):
        raise ValueError("increments_differ: all images must have one shape")
    with nogil:
        for k in range(3):
            for y in range(first, last):
                for x in range(w):
                    out[k, y, x] = (0.0 if anchors[y, x].hot > PRIOR_ODDS else
                                    <float>(new[k, y, x] - old[k, y, x]))


def increments_mean(const float[:, :, ::1] planes not None, float[:, ::1] row not None,
                    node_t[:, ::1] nodes not None, bands not None):
    """Let nodes have the pixel's plane plus the means of `mean_at`; row is scratch."""
    cdef Py_ssize_t h = nodes.shape[0], w = nodes.shape[1], y, x, first, last
    first, last = bands
    if (planes.shape[0] != 3 or planes.shape[1] != h or planes.shape[2] != w
            or row.shape[0] != h or row.shape[1] != w):
        raise ValueError("increments_mean: all images must have one shape")
    with nogil:
        for y in range(first, last):
            mean_at(&planes[0, 0, 0], y, h, w, &row[y, 0])
            for x in range(w):
                nodes[y, x].around = row[y, x]
