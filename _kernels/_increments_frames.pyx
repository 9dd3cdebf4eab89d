"""Frames of the filter of log intensity (_increments.pyx)."""
from libc.math cimport NAN, fabs
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport calloc, free, malloc
from libc.string cimport memset

from _kernels._increments cimport (
    CLAIM, GATE, HOT_MEMORY, LESS, MORE, NEVER, PRIOR_ODDS, QUIET, SHOWN,
    anchor_t, back_row, camera_of, camera_t, mean_at, node_t, pass_row, pixel_t,
    stored_t)
from _kernels._increments_frames cimport (
    around_of, frame_of, frame_t, lags_of, lags_t, node_of, open_since)
from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._model cimport wave_t


def increments_node(const pixel_t[:, ::1] pixels not None,
                    const stored_t[::1] store not None, tuple frame not None,
                    int64_t known, int64_t ahead, const double[::1] camera not None,
                    const wave_t[::1] waves not None, again not None,
                    const int32_t[::1] listed not None, bands not None):
    """Evaluate a frame at the entries first <= i < last of a list of pixels.

    `around` of the frame receives what the counts at other times, and now, weigh at its
    middle, for the pixel itself, its macropixel and its neighbours; lags up to `ahead`
    (us) count.  again: only where a silence was open, of either.
    """
    cdef Py_ssize_t i, at, first, last, h = pixels.shape[0], w = pixels.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef lamp_t lamp = lamp_of(waves)
    cdef lags_t lags = lags_of(c, ahead)
    cdef const pixel_t* p
    cdef node_t* node
    cdef frame_t f
    cdef bint nodes_again, around_again
    frame_of(frame, h, w, &f)
    nodes_again, around_again = again
    first, last = bands
    with nogil:
        for i in range(first, min(last, listed.shape[0])):
            at = listed[i]
            if not 0 <= at < h * w:
                continue
            p = &pixels[0, 0] + at
            node = f.nodes + at
            if not nodes_again or open_since(node.open_t, p) != NEVER:
                node_of(p, &store[0], &f, at, at % w, known, c, &lamp)
            if f.around != NULL and (
                    not around_again or open_since(node.around_t, p) != NEVER):
                around_of(p, &store[0], &f, at, at % w, known, &lags, c)


cdef struct between_t:
    # From one frame to another: change of y, of its parts, thresholds passed, noise.
    double change
    double[2] part
    double passed
    double noise


cdef inline between_t between(const node_t* a, const node_t* b, double said,
                              double seconds, const camera_t* c) noexcept nogil:
    """Changes from node a to the later node b, and their noise.  (8)"""
    cdef between_t out
    cdef double theta2 = 0.25 * (c.theta[0] + c.theta[1]) * (c.theta[0] + c.theta[1])
    cdef double opened
    out.part[0] = b.light[0] - a.light[0]
    out.part[1] = b.light[1] - a.light[1]
    out.change = b.mean - a.mean + said
    out.passed = fabs(out.part[0]) / c.theta[0] + fabs(out.part[1]) / c.theta[1]
    opened = b.open_variance
    if b.open_t == a.open_t:
        opened = max(opened - a.open_variance, 0.0)
    out.noise = (c.alpha * fabs(seconds) + c.gamma * out.passed
                 + 0.5 * c.beta * min(out.passed, 1.0) + theta2 * opened)
    return out


def increments_pass(tuple old not None, tuple new not None,
                    const int64_t[:, ::1] due not None,
                    const double[::1] camera not None,
                    anchor_t[:, ::1] anchors not None, float[:, ::1] middles not None,
                    bands not None):
    """Let the filter pass a frame: predict from the one before, and update.  (12)

    middles receives ln(I + black) in the middle of the exposure, NaN without a sample.
    """
    cdef Py_ssize_t y, x, at, first, last, h = anchors.shape[0], w = anchors.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef frame_t a, b
    cdef node_t none
    cdef anchor_t* one
    cdef float* row
    cdef double* seconds
    cdef double* noise
    cdef bint quiet
    first, last = bands
    frame_of(old, h, w, &a)
    frame_of(new, h, w, &b)
    if (middles.shape[0] != h or middles.shape[1] != w or due.shape[0] != h
            or due.shape[1] != w):
        raise ValueError("increments_pass: all images must have one shape")
    memset(&none, 0, sizeof(node_t))
    seconds = <double*>malloc(w * (2 * sizeof(double) + 5 * sizeof(float)))
    if seconds == NULL:
        raise MemoryError
    noise, row = seconds + w, <float*>(seconds + 2 * w)
    with nogil:
        for x in range(w):
            seconds[x] = 1e-6 * <double>(b.middle[x] - a.middle[x]) + b.lost
            noise[x] = c.alpha * fabs(seconds[x])
        for y in range(first, last):
            for x in range(w):
                one = &anchors[y, x]
                row[x], row[w + x], row[2 * w + x] = one.log, one.p[0], one.p[1]
                row[3 * w + x], row[4 * w + x] = one.p[2], one.motion
            at = y * w
            pass_row(b.log + at, b.variance + at, b.said + at, noise, w, row, row + w,
                     row + 2 * w, row + 3 * w, row + 4 * w)
            for x in range(w):
                at = y * w + x
                one = &anchors[y, x]
                quiet = due[y, x] == QUIET
                if quiet and one.sampled > 0.0:
                    one.log, one.p[0], one.p[1] = row[x], row[w + x], row[2 * w + x]
                    one.p[2], one.motion = row[3 * w + x], row[4 * w + x]
                    middles[y, x] = one.log if b.variance[at] > 0.0 else NAN
                else:
                    middles[y, x] = pass_one(
                        &none if quiet else a.nodes + at,
                        &none if quiet else b.nodes + at, b.log[at], b.variance[at],
                        b.said[at], seconds[x], c, one)
    free(seconds)


cdef inline float pass_one(const node_t* old, const node_t* new, float log,
                           float variance, float said, double seconds,
                           const camera_t* c, anchor_t* a) noexcept nogil:
    cdef between_t step
    cdef double r, e, s, k0, k1, k2, d0, d1, p0, claim, shown
    cdef bint hot = a.hot > PRIOR_ODDS, jump
    if a.sampled == 0.0:
        if variance > 0.0:
            a.sampled = 1.0
            a.log = log
            a.p[0] = variance
            if new.light[0] != 0.0 or new.light[1] != 0.0:
                a.p[0] += 0.25 * c.beta
            a.p[1] = a.p[2] = a.p[4] = 0.0
            a.p[3] = a.p[5] = c.spread2
            return a.log + new.middle
        return NAN
    step = between(old, new, said, seconds, c)
    if variance > 0.0:
        # Do frames contradict what the events of this pixel claim?
        claim = step.part[0] + step.part[1]
        shown = (log - a.log) * (1.0 if claim > 0.0 else -1.0)
        claim = fabs(claim)
        shown = SHOWN * claim - shown
        if (claim > CLAIM * (fabs(step.part[0]) + fabs(step.part[1])) and claim > 0.0
                and shown > 0.0 and shown * shown > GATE * (variance + a.p[0])):
            a.hot = min(a.hot + MORE, 2.0 * PRIOR_ODDS)
        elif claim > 0.0:
            a.hot = max(a.hot - LESS, 0.0)
        e = log - a.log
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
    if variance <= 0.0:
        return NAN
    r = variance + (0.0 if hot else 0.25 * c.beta * min(step.passed, 1.0))
    e = log - a.log
    jump = e * e > GATE * (a.p[0] + r)
    if jump:
        a.p[0] += e * e
    s = 1.0 / (a.p[0] + r)
    k0 = a.p[0] * s
    k1 = a.p[1] * s
    k2 = a.p[2] * s
    if hot or jump or step.passed == 0.0:
        k1 = k2 = 0.0           # what gains are of: no event
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
    return a.log if hot else a.log + new.middle


def increments_back(list frames not None, const int64_t[:, ::1] due not None,
                    const double[::1] camera not None,
                    const anchor_t[:, ::1] anchors not None,
                    float[:, :, ::1] back not None, bands not None):
    """Carry the estimate from the last of later frames back to the first of them.

    back is (log, variance) of ln(I + black) at the first; a variance < 0 is of no
    estimate.
    """
    cdef Py_ssize_t i, y, x, at, first, last, n = len(frames)
    cdef Py_ssize_t h = anchors.shape[0], w = anchors.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef frame_t* all_
    cdef double* noise
    cdef double* b
    cdef double* v
    first, last = bands
    if (back.shape[0] != 2 or back.shape[1] != h or back.shape[2] != w
            or due.shape[0] != h or due.shape[1] != w):
        raise ValueError("increments_back: all images must have one shape")
    all_ = <frame_t*>malloc((n + 1) * sizeof(frame_t))
    noise = <double*>calloc((n + 3) * w, sizeof(double))
    b, v = noise + (n + 1) * w, noise + (n + 2) * w
    try:
        if all_ == NULL or noise == NULL:
            raise MemoryError
        for i in range(n):
            frame_of(frames[i], h, w, all_ + i)
        with nogil:
            for i in range(1, n):
                for x in range(w):
                    noise[i * w + x] = c.alpha * fabs(all_[i].lost + 1e-6 * <double>(
                        all_[i].middle[x] - all_[i - 1].middle[x]))
            for y in range(first, last):
                at = y * w
                for x in range(w):
                    b[x], v[x] = 0.0, -1.0
                for i in range(n - 1, -1, -1):
                    back_row(all_[i].log + at, all_[i].variance + at,
                             all_[min(i + 1, n - 1)].said + at, noise + (i + 1) * w, w,
                             b, v)
                for x in range(w):
                    if due[y, x] != QUIET:
                        back_one(all_, n, at + x, x, c, &anchors[y, x], b + x, v + x)
                    back[0, y, x], back[1, y, x] = <float>b[x], <float>v[x]
    finally:
        free(all_)
        free(noise)


cdef inline void back_one(const frame_t* frames, Py_ssize_t n, Py_ssize_t at,
                          Py_ssize_t x, const camera_t* c, const anchor_t* a,
                          double* log, double* variance) noexcept nogil:
    cdef between_t step
    cdef bint hot = a.hot > PRIOR_ODDS
    cdef double b = 0.0, v = -1.0, e, r
    cdef const frame_t* f
    cdef const frame_t* old
    cdef Py_ssize_t i
    for i in range(n - 1, -1, -1):
        f = frames + i
        if v > 0.0 and hot:
            v += a.motion
        elif v > 0.0:
            # from this node to the one after
            b -= step.change + step.part[0] * a.gain[0] + step.part[1] * a.gain[1]
            v += step.noise
        if i > 0:
            old = f - 1
            step = between(old.nodes + at, f.nodes + at, f.said[at],
                           f.lost + 1e-6 * <double>(f.middle[x] - old.middle[x]), c)
        if f.variance[at] > 0.0:
            e = f.log[at] - b
            r = f.variance[at]
            if not hot and n > 1:
                r += 0.25 * c.beta * min(step.passed, 1.0)
            if v <= 0.0 or e * e > GATE * (v + r):
                b, v = f.log[at], r
            else:
                b += v / (v + r) * e
                v = v * r / (v + r)
    log[0], variance[0] = b, v


def increments_close(const pixel_t[:, ::1] pixels not None,
                     const stored_t[::1] store not None, tuple frame not None,
                     int64_t ahead, int64_t oldest, const double[::1] camera not None,
                     const wave_t[::1] waves not None,
                     const int32_t[::1] listed not None):
    """Evaluate a frame where silences have ended, before its events are dropped.

    A silence since an event after oldest (us) that goes on counts as ended.
    """
    cdef Py_ssize_t i, at, h = pixels.shape[0], w = pixels.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef lamp_t lamp = lamp_of(waves)
    cdef lags_t lags = lags_of(c, ahead)
    cdef const pixel_t* p
    cdef node_t* n
    cdef frame_t f
    frame_of(frame, h, w, &f)
    with nogil:
        for i in range(listed.shape[0]):
            at = listed[i]
            if not 0 <= at < h * w:
                continue
            p = &pixels[0, 0] + at
            n = f.nodes + at
            if f.around != NULL and p.at.t > open_since(n.around_t, p):
                around_of(p, &store[0], &f, at, at % w, p.at.t, &lags, c)
            if p.at.t > open_since(n.open_t, p):
                node_of(p, &store[0], &f, at, at % w, p.at.t, c, &lamp)
            if n.open_t > oldest:
                n.open_t = NEVER
            if n.around_t > oldest:
                n.around_t = NEVER


def increments_differ(const double[:, :, ::1] new not None,
                      const double[:, :, ::1] old not None,
                      const anchor_t[:, ::1] anchors not None,
                      const int32_t[::1] listed not None,
                      float[:, :, ::1] planes not None, float[:, ::1] out not None):
    """Let out have what events said between two frames, by `around` of both.

    Pixels that are not listed, and hot ones, say nothing: planes, which are scratch,
    are 0 there.
    """
    cdef Py_ssize_t i, at, k, y, h = anchors.shape[0], w = anchors.shape[1]
    if (new.shape[0] != 3 or new.shape[1] != h or new.shape[2] != w
            or old.shape[0] != 3 or old.shape[1] != h or old.shape[2] != w
            or planes.shape[0] != 3 or planes.shape[1] != h or planes.shape[2] != w
            or out.shape[0] != h or out.shape[1] != w):
        raise ValueError("increments_differ: all images must have one shape")
    with nogil:
        for i in range(listed.shape[0]):
            at = listed[i]
            if 0 <= at < h * w:
                for k in range(3):
                    (&planes[k, 0, 0])[at] = (
                        0.0 if (&anchors[0, 0])[at].hot > PRIOR_ODDS else
                        <float>((&new[k, 0, 0])[at] - (&old[k, 0, 0])[at]))
        for y in range(h):
            mean_at(&planes[0, 0, 0], y, h, w, &out[y, 0])
