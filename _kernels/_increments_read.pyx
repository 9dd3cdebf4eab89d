"""Images of the filter of log intensity (_increments.pyx)."""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t, uint8_t, uint32_t
from libc.string cimport memset

from _kernels._increments cimport (
    AFTER, BEFORE, BENDS, CHANGED, DOUBTFUL, ENDED, FLICKERS, GROWS, HOT, KNOT, LEVEL,
    NEVER, PER_TURN, PRIOR_ODDS, RESTS, SHARE, SLOPE, SMOOTH_FROM, VARIANCE, anchor_t,
    around_t, at_rest, camera_of, camera_t, course_of, course_t, drift_of, lead_of,
    mean_at, node_t, pixel_t, rest_planes, rest_row, show_row, shown_t, silence_of,
    silence_t, silent_variance, stored_t, weight)
from _kernels._increments_frames cimport (
    around_of, corner_of, frame_of, frame_t, lags_of, lags_t, node_of, open_since, say,
    silence_in, weigh_counts)
from _kernels._lamp cimport lamp_flickers, lamp_of, lamp_t, ripple
from _kernels._math cimport exp_f
from _kernels._model cimport wave_t

cdef extern from "_prefetch.h" nogil:
    void prefetch "PDAVIS_PREFETCH"(const void*)
    void prefetch_all "PDAVIS_PREFETCH_ALL"(const void*, size_t)

cdef enum:
    HOP = 8                     # pixels of the list between prefetches

cdef inline void show_one(const pixel_t* p, const stored_t* store, const node_t* node,
                          const anchor_t* a, const node_t* later, float said,
                          double b, double v, bint alone, const double* cov,
                          const camera_t* c,
                          const lamp_t* lamp, shown_t* s) noexcept nogil:
    cdef const stored_t* e = &p.at
    cdef double[2] since, until
    cdef double s00, s01, s11, passed = 0.0, after = 0.0, each, y, rate
    cdef bint hot = a.hot > PRIOR_ODDS
    s.state = HOT if hot else 0
    s.last = e.t if e.run > 0 else -NEVER
    s.sign = e.sign if e.run > 0 else 0
    s.context = e.context
    s.before = e.before
    s.next = NEVER
    if p.next >= 0:
        s.next = store[p.next].t
        s.next_sign = store[p.next].sign
        s.next_weight = <float>weight(&store[p.next], c)
    s.corner = <float>corner_of(a.log if a.sampled > 0.0 else b, c)
    y = e.light[0] + e.light[1]
    s.drift = 0.0
    if lamp.blocks > 0:
        each = ripple(lamp, c.hz + s.corner, <double>s.last, &rate)
        y -= each
        if lamp_flickers(lamp, <double>s.last, <double>s.last):
            s.state |= FLICKERS
        if p.next >= 0:
            s.drift = <float>(each - ripple(
                lamp, c.hz + s.corner, <double>s.next, &rate))
    s.theta[0] = 0.0 if hot else <float>((1.0 + a.gain[0]) * c.theta[0])
    s.theta[1] = 0.0 if hot else <float>((1.0 + a.gain[1]) * c.theta[1])
    s.extra = s.common = s.ahead = s.behind = 0.0
    s.p_ahead = s.p_behind = -1.0
    s.opened = node.open_variance if node.open_t == s.last else 0.0
    # Relative error of the thresholds, of this pixel and of all.
    s00 = a.p[3] + cov[0]
    s01 = a.p[4] + cov[1]
    s11 = a.p[5] + cov[2]
    since[0], since[1] = e.light[0] - node.light[0], e.light[1] - node.light[1]
    until[0], until[1] = later.light[0] - e.light[0], later.light[1] - e.light[1]
    if not hot and a.sampled > 0.0:
        passed = fabs(since[0]) / c.theta[0] + fabs(since[1]) / c.theta[1]
    if not hot and v > 0.0:
        after = fabs(until[0]) / c.theta[0] + fabs(until[1]) / c.theta[1]
    if a.sampled > 0.0:
        s.state |= BEFORE
        s.ahead = a.log
        s.p_ahead = a.p[0]
        if hot:
            s.p_ahead += a.motion
        else:
            s.ahead += <float>(
                y - node.mean + since[0] * a.gain[0] + since[1] * a.gain[1])
            s.p_ahead += <float>(
                2.0 * (since[0] * a.p[1] + since[1] * a.p[2]
                       + since[0] * since[1] * s01)
                + since[0] * since[0] * s00 + since[1] * since[1] * s11
                + c.gamma * passed)
            s.p_ahead = max(s.p_ahead, 0.0)     # a negative one would be of no sample
        s.extra = <float>(0.25 * c.beta * min(passed, 1.0))
    if v > 0.0:
        s.state |= AFTER
        s.behind = <float>b - said
        s.p_behind = <float>v
        if hot:
            s.p_behind += a.motion
        else:
            if alone:
                s.p_behind += <float>(0.25 * c.beta * min(passed + after, 1.0))
            s.behind -= <float>(
                later.mean - y + until[0] * a.gain[0] + until[1] * a.gain[1])
            s.p_behind += <float>(until[0] * until[0] * s00
                                  + 2.0 * until[0] * until[1] * s01
                                  + until[1] * until[1] * s11 + c.gamma * after)
            s.common = -<float>(until[0] * (a.p[1] + since[0] * s00 + since[1] * s01)
                                + until[1] * (a.p[2] + since[0] * s01 + since[1] * s11))
    s.back = <float>fabs(since[b < a.log] + until[b < a.log])
    s.passed = <float>(fabs(since[0] + until[0]) + fabs(since[1] + until[1]))
    each = passed + after
    each = 0.5 * c.beta * min(each, 1.0) / each if each > 0.0 else 0.0
    s.p_ahead += <float>(each * passed)
    s.p_behind += <float>(each * after)


cdef struct frames_t:
    # The frames before and after a read, and the epoch of the planes.
    frame_t before, later
    frame_t ended               # later, with its nodes where silences have ended
    const anchor_t* anchors
    const float* back           # NULL: no frame after
    const double* middle        # of both by column
    const lamp_t* lamp
    Py_ssize_t w, size
    int64_t epoch, ahead
    bint alone                  # the frame after has none after it
    double[3] theta_cov         # of the thresholds' relative errors
    bint fresh                  # the frames, or their estimates, are others


cdef inline int frames_of(tuple frames, Py_ssize_t h, Py_ssize_t w,
                          frames_t* f) except -1:
    """Unpack the frames of `increments_move`."""
    cdef const anchor_t[:, ::1] anchors
    cdef const float[:, :, ::1] back
    cdef const double[:, ::1] middles
    cdef node_t[:, ::1] ended
    before, later, ended, middles, f.alone, anchors, back, f.epoch = frames
    f.w, f.size = w, h * w
    frame_of(before, h, w, &f.before)
    f.back = NULL
    if (anchors.shape[0] != h or anchors.shape[1] != w or middles.shape[0] != 2
            or middles.shape[1] != w or ended.shape[0] != h or ended.shape[1] != w):
        raise ValueError("all images must have one shape")
    if later is not None:
        frame_of(later, h, w, &f.later)
        if back.shape[0] != 2 or back.shape[1] != h or back.shape[2] != w:
            raise ValueError("all images must have one shape")
        f.back = &back[0, 0, 0]
        f.ended = f.later
        f.ended.nodes = &ended[0, 0]
    f.anchors, f.middle = &anchors[0, 0], &middles[0, 0]
    return 0


cdef inline double line_of(double t, double j, const shown_t* shown, Py_ssize_t at,
                           Py_ssize_t x, const frames_t* f, double* log,
                           double* variance) noexcept nogil:
    """The straight line between the frames around t, and its share in the estimate j,
    whose variance becomes that of both.  (14)"""
    cdef const anchor_t* a = f.anchors + at
    cdef double seconds = 1e-6 * (f.middle[f.w + x] - f.middle[x])
    cdef double s = 1e-6 * (t - f.middle[x]) / seconds, moved = f.back[at] - a.log
    cdef double own, both, bend, back, spare, far, share
    log[0] = a.log + s * moved
    s = min(max(s, 0.0), 1.0)
    own = variance[0] - (1.0 - s) * (1.0 - s) * a.p[0] - s * s * f.back[f.size + at]
    if own <= 0.0:
        return 0.0
    bend = (moved / seconds - a.slope) / seconds
    bend = max(bend * bend, <double>a.bend2)
    back = a.back + (shown.back - a.back) / a.sampled
    spare = a.spare + (shown.passed - fabs(moved) - a.spare) / a.sampled
    spare = max(spare, back)
    seconds *= seconds
    both = own + bend * seconds * seconds * s * (1.0 - s) + spare * spare
    far = (j - log[0]) * (j - log[0]) / (DOUBTFUL * both)
    share = own / both
    share *= share / (1.0 + far * far)
    variance[0] += share * (share * both - 2.0 * own)
    return share


cdef inline void estimate(const shown_t* s, int64_t t, int64_t known, bint open_,
                          Py_ssize_t at, Py_ssize_t x, const frames_t* f,
                          const camera_t* c, double* log, double* variance,
                          silence_t* silence, double* share) noexcept nogil:
    """ln(I + black) at t without what other times and pixels say, its variance, the
    silence that is open at t, and the share of what others say."""
    cdef around_t a
    cdef double[2] rise, bend
    cdef int k
    cdef double j = 0.0, v = s.extra, u, slope = 0.0, light, theta2
    if s.sign and not s.state & HOT:
        a.sign = s.sign
        a.next_sign = s.next_sign
        a.next_weight = s.next_weight
        a.before = s.before
        a.context = s.context
        a.since = 1e-6 * <double>(t - s.last)
        a.silent = 1e-6 * <double>(known - s.last)
        a.gap = 0.0
        if s.next <= known and not open_:
            a.gap = 1e-6 * <double>max(s.next - s.last, 1)
        a.drift = s.drift
        a.flickers = s.state & FLICKERS
        j = drift_of(&a, c, &slope)
        if a.gap > 0.0:
            course_of(&a, c, rise, bend)
        else:
            silence[0] = silence_of(&a, c)
            theta2 = 0.25 * (c.theta[0] + c.theta[1]) * (c.theta[0] + c.theta[1])
            v += theta2 * max(silent_variance(silence, a.since) - s.opened, 0.0)
            rise[0] = rise[1] = bend[0] = bend[1] = 0.0
            if not a.flickers:
                rise[a.sign > 0], bend[a.sign > 0] = silence.rise, silence.bend
        for k in range(2):
            j += s.theta[k] * a.since * (rise[k] + a.since * bend[k])
            slope += s.theta[k] * (rise[k] + 2.0 * a.since * bend[k])
    at_rest(<double>t, s.ahead, s.p_ahead, s.behind, s.p_behind, s.common, v,
            f.middle[x], f.middle[f.w + x], c.alpha, &u, variance)
    if not s.state & (BEFORE | AFTER):
        log[0] = 0.0
        return
    j += u
    if slope != 0.0 and (c.hz > 0.0 or c.hz_per_light > 0.0):
        u = slope * PER_TURN / (c.hz + s.corner)
        if u > 0.02 or u < -0.02:
            light = exp_f(<float>j) - c.black
            u = lead_of(slope, light if light > 1e-3 else 1e-3, c)
        else:
            u *= 1.0 - u * s.corner / (c.hz + s.corner)
        j += u
    log[0] = j
    share[0] = 1.0
    if (s.state & (BEFORE | AFTER | HOT) == BEFORE | AFTER
            and f.anchors[at].sampled > 1.0):
        u = line_of(<double>t, j, s, at, x, f, &light, variance)
        share[0] = 1.0 - u
        log[0] = j + u * (light - j)


def increments_rest_planes(tuple frames not None, const double[::1] camera not None,
                           float[:, :, ::1] planes not None, bands not None):
    """Write the planes of rows as of quiet pixels.  frames is as in `increments_move`.
    """
    cdef Py_ssize_t y, x, at, first, last, h = planes.shape[1], w = planes.shape[2]
    cdef const camera_t* c = camera_of(camera)
    cdef const anchor_t* a
    cdef frames_t f
    first, last = bands
    frames_of(frames, h, w, &f)
    if planes.shape[0] != 6:
        raise ValueError("increments_rest_planes: all images must have one shape")
    with nogil:
        for y in range(first, last):
            for x in range(w):
                at = y * w + x
                a = f.anchors + at
                planes[LEVEL, y, x] = a.log
                planes[VARIANCE, y, x] = a.p[0] if a.sampled > 0.0 else -1.0
                planes[SLOPE, y, x], planes[GROWS, y, x] = 0.0, -1.0
                planes[SHARE, y, x] = 1.0
                if f.back != NULL:
                    planes[SLOPE, y, x] = f.back[at] - f.later.said[at]
                    planes[GROWS, y, x] = f.back[f.size + at]
            rest_row(f.middle, f.middle + w, <double>f.epoch, c.alpha, w,
                     &planes[LEVEL, y, 0], &planes[SLOPE, y, 0],
                     &planes[VARIANCE, y, 0], &planes[GROWS, y, 0],
                     &planes[BENDS, y, 0])


def increments_move(pixel_t[:, ::1] pixels not None, const stored_t[::1] store not None,
                    tuple frames not None, times not None,
                    const wave_t[::1] waves not None,
                    const double[::1] camera not None,
                    const int32_t[::1] listed not None, int64_t[:, ::1] due not None,
                    shown_t[:, ::1] shown not None, course_t[:, ::1] courses,
                    float[:, :, ::1] planes not None,
                    float[:, :, ::1] around, bands not None):
    """Bring the planes of the listed pixels up to date for a read.

    frames is (frame before, frame after or None, its nodes once silences in it have
    ended, middles, whether that is the last, anchors, back, epoch), times (t, known,
    whether all frames are new).  Of the list, the entries first <= i < last are
    processed, and of these, pixels that are due at t; due becomes when they are next.
    around receives what the counts of each weigh, less that at the frame before, by way
    of courses; None: nothing is weighed.

    Between events, and farther than all lags from them, a pixel's value is interpolated
    between times since the event that grow by `KNOT`: an image does not depend on which
    others are asked for.
    """
    cdef const camera_t* c = camera_of(camera)
    cdef frames_t f
    cdef lamp_t lamp = lamp_of(waves)
    cdef lags_t lags
    cdef Py_ssize_t first, last, i, k, at, h = pixels.shape[0], w = pixels.shape[1]
    cdef int64_t t, known
    cdef int64_t* until = &due[0, 0]
    cdef float* plane = &planes[0, 0, 0]
    first, last = bands
    t, known, f.fresh = times
    frames_of(frames, h, w, &f)
    f.lamp = &lamp
    if (shown.shape[0] != h or shown.shape[1] != w or due.shape[0] != h
            or due.shape[1] != w or planes.shape[0] != 6 or planes.shape[1] != h
            or planes.shape[2] != w or around is not None and (
                f.before.around == NULL or courses is None or courses.shape[0] != h
                or courses.shape[1] != w or around.shape[0] != 3
                or around.shape[1] != h or around.shape[2] != w)):
        raise ValueError("increments_move: all images must have one shape")
    if first < 0 or last > listed.shape[0]:
        raise ValueError("increments_move: the list is shorter")
    f.ahead = known - t
    f.theta_cov[0] = c.theta_cov[0] / (c.theta[0] * c.theta[0])
    f.theta_cov[1] = c.theta_cov[1] / (c.theta[0] * c.theta[1])
    f.theta_cov[2] = c.theta_cov[2] / (c.theta[1] * c.theta[1])
    with nogil:
        lags = lags_of(c, f.ahead)
        for i in range(first, last):
            at = listed[i + HOP] if i + HOP < last else -1
            if 0 <= at < f.size and (f.fresh or t >= until[at]):
                prefetch_all(&shown[0, 0] + at, sizeof(shown_t))
                for k in range(6):
                    prefetch(plane + k * f.size + at)
                if around is not None:
                    prefetch_all(&courses[0, 0] + at, sizeof(course_t))
                    for k in range(3):
                        prefetch(&around[k, 0, 0] + at)
                        prefetch(f.before.around + k * f.size + at)
            at = listed[i]
            if 0 <= at < f.size and (f.fresh or t >= until[at]):
                until[at] = move_one(
                    &pixels[0, 0] + at, &store[0], at, until[at] == CHANGED, t, known,
                    &f, &lags, c, &shown[0, 0] + at,
                    &courses[0, 0] + at if around is not None else NULL, plane,
                    &around[0, 0, 0] if around is not None else NULL)


cdef inline node_t* later_of(const pixel_t* p, const stored_t* store, Py_ssize_t at,
                             Py_ssize_t x, int64_t known, const frames_t* f,
                             const camera_t* c, bint* ended) noexcept nogil:
    """The frame after; a silence that was open at its end may have ended by `known`."""
    cdef node_t* node = f.ended.nodes + at
    cdef int64_t since = open_since((f.later.nodes + at).open_t, p)
    cdef int32_t k = p.next
    if since == NEVER:
        return f.later.nodes + at
    while k >= 0 and store[k].t <= since:
        k = store[k].next
    ended[0] = k >= 0 and since < store[k].t <= known
    if not ended[0]:
        return f.later.nodes + at
    if node.around_t != <int64_t>f.middle[f.w + x]:
        node_of(p, store, &f.ended, at, x, store[k].t, c, f.lamp)
        node.around_t = <int64_t>f.middle[f.w + x]
    return node


cdef inline int64_t move_one(const pixel_t* p, const stored_t* store, Py_ssize_t at,
                             bint changed, int64_t t, int64_t known, const frames_t* f,
                             const lags_t* lags, const camera_t* c, shown_t* s,
                             course_t* course, float* plane,
                             float* around) noexcept nogil:
    """Write a pixel's planes; return up to when they hold it."""
    cdef Py_ssize_t size = f.size, x = <uint32_t>at % <uint32_t>f.w
    cdef node_t* node = f.before.nodes + at
    cdef int64_t t0 = t, t1 = t, until = 0
    cdef double[3] out
    cdef double j0, v0, j1, v1, since, knot, rate, share = 1.0, u
    cdef bint rests = False, smooth = False
    cdef silence_t silence, other
    cdef int k
    cdef bint ended = False
    cdef node_t* later = node
    if f.back != NULL:
        later = later_of(p, store, at, x, known, f, c, &ended)
    if changed or f.fresh or ended != (s.state & ENDED > 0):
        if p.at.run > 0 and p.at.t > open_since(node.open_t, p):
            # Its end is known now.
            node_of(p, store, &f.before, at, x, p.at.t, c, f.lamp)
        if (around != NULL and f.ahead == 0 and p.at.run > 0
                and p.at.t > open_since(node.around_t, p)):
            around_of(p, store, &f.before, at, x, p.at.t, lags, c)
        if f.back != NULL:
            show_one(p, store, node, f.anchors + at, later,
                     f.later.said[at], f.back[at], f.back[size + at], f.alone,
                     f.theta_cov, c, f.lamp, s)
        else:
            show_one(p, store, node, f.anchors + at, node, 0.0, 0.0, -1.0, False,
                     f.theta_cov, c, f.lamp, s)
        s.state |= ENDED if ended else 0
    silence.rise = silence.bend = 0.0
    knot = since = 1e-6 * <double>(t - s.last)
    if s.next > known:
        # By the knot, not by t: whatever was read before, the same segment is shown.
        rests = s.sign == 0 or stays(since / KNOT, s, f, c)
        if not rests and since > SMOOTH_FROM:
            knot = SMOOTH_FROM
            while knot * KNOT <= since:
                knot *= KNOT
        rests = (rests or stays(knot, s, f, c)) and (
            s.sign == 0 or t - s.last > lags.oldest)
        smooth = not rests and since > SMOOTH_FROM
    if rests:
        until = NEVER
        rest_planes(
            s.ahead, s.p_ahead, s.behind, s.p_behind, s.common, s.extra, f.middle[x],
            f.middle[f.w + x], <double>f.epoch, c.alpha, plane + LEVEL * size + at,
            plane + SLOPE * size + at, plane + VARIANCE * size + at,
            plane + GROWS * size + at, plane + BENDS * size + at)
    else:
        if smooth:
            t0 = s.last + <int64_t>(1e6 * knot)
            t1 = s.last + <int64_t>(1e6 * knot * KNOT)
            if f.back != NULL:          # the line (14) ends at both frames
                if f.middle[x] < t:
                    t0 = max(t0, <int64_t>f.middle[x])
                if f.middle[f.w + x] > t:
                    t1 = min(t1, <int64_t>f.middle[f.w + x])
            until = t1
        estimate(s, t0, t0 + f.ahead if smooth else known, smooth, at, x, f, c, &j0,
                 &v0, &silence, &share)
        plane[SLOPE * size + at] = plane[GROWS * size + at] = 0.0
        plane[BENDS * size + at] = 0.0
        if smooth:
            estimate(s, t1, t1 + f.ahead, smooth, at, x, f, c, &j1, &v1, &other, &u)
            since = 1e-6 * <double>(f.epoch - t0)
            rate = (j1 - j0) / (1e-6 * <double>(t1 - t0))
            plane[SLOPE * size + at] = <float>rate
            j0 += rate * since
            rate = (v1 - v0) / (1e-6 * <double>(t1 - t0))
            plane[GROWS * size + at] = <float>rate
            v0 += since * rate
        plane[LEVEL * size + at] = <float>j0
        plane[VARIANCE * size + at] = <float>v0
    plane[SHARE * size + at] = <float>share
    if s.next != NEVER:
        until = min(until, s.next - f.ahead)    # then it is known
    if around != NULL:
        if s.state & HOT:
            course.until = 0
            for k in range(3):
                around[k * size + at] = 0.0
        else:
            if changed or t >= course.until:
                weigh_counts(p, store, t, f.ahead, lags, c, course)
            if not smooth:
                t0 = t
            if s.next <= known:
                silence = silence_in(course, known, c)
            say(course, t0, silence.rise, silence.bend, out)
            for k in range(3):
                around[k * size + at] = <float>(
                    out[k] - f.before.around[k * size + at])
    return until


cdef inline bint stays(double since, const shown_t* s, const frames_t* f,
                       const camera_t* c) noexcept nogil:
    """Whether light is still at a time since the last event."""
    return max(since + 1e-6 * <double>f.ahead, <double>s.before) >= RESTS * c.rest


def increments_image(const float[:, :, ::1] planes not None,
                     const float[:, :, ::1] around,
                     times not None, const wave_t[::1] waves not None, double most,
                     out not None, bands not None):
    """Write ln light, its variance and validity, with the lamp's ripple.

    times is (t, epoch of the planes), around what `increments_move` writes, or None.
    """
    cdef Py_ssize_t y, first, last
    cdef float[:, ::1] log, variance
    cdef uint8_t[:, ::1] valid
    cdef lamp_t lamp = lamp_of(waves)
    cdef double seconds, lit, rate
    t, epoch = times
    seconds = 1e-6 * (t - epoch)
    lit = ripple(&lamp, 0.0, t, &rate)
    log, variance, valid = out
    first, last = bands
    if (planes.shape[0] != 6 or planes.shape[1] != log.shape[0]
            or planes.shape[2] != log.shape[1] or variance.shape[0] != log.shape[0]
            or variance.shape[1] != log.shape[1] or valid.shape[0] != log.shape[0]
            or valid.shape[1] != log.shape[1] or around is not None and (
                around.shape[0] != 3 or around.shape[1] != log.shape[0]
                or around.shape[2] != log.shape[1])):
        raise ValueError("increments_image: all images must have one shape")
    with nogil:
        for y in range(first, last):
            if around is not None:
                mean_at(&around[0, 0, 0], y, log.shape[0], log.shape[1], &log[y, 0])
            else:
                memset(&log[y, 0], 0, log.shape[1] * sizeof(float))
            show_row(&planes[LEVEL, y, 0], &planes[SLOPE, y, 0],
                     &planes[VARIANCE, y, 0],
                     &planes[GROWS, y, 0], &planes[BENDS, y, 0],
                     &planes[SHARE, y, 0], <float>seconds,
                     <float>lit, <float>most, log.shape[1], &log[y, 0], &variance[y, 0],
                     &valid[y, 0])
