"""Images of the filter of log intensity (_increments.pyx)."""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t, uint8_t, uint32_t
from libc.string cimport memset

from _kernels._increments cimport (
    AFTER, BEFORE, BENDS, CHANGED, FLICKERS, GROWS, HOT, KNOT, LEVEL, NEVER, PRIOR_ODDS,
    RESTS, SLOPE, SMOOTH_FROM, VARIANCE, anchor_t, around_t, at_rest, camera_of,
    camera_t, course_of, course_t, drift_of, lead_of, mean_at, node_t, pixel_t,
    rest_planes, rest_row, show_row, shown_t, silence_of, silence_t, silent_variance,
    stored_t, weight)
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
    OPEN_BEFORE = 16            # flags of shown_t.state: all of the exposure before, or
    OPEN_AFTER = 32             # after, lies in the silence since the last event

cdef inline void show_one(const pixel_t* p, const stored_t* store, const node_t* node,
                          const anchor_t* a, const node_t* later, float said,
                          double b, double v, const double* cov, const camera_t* c,
                          const int64_t* begins, const lamp_t* lamp,
                          shown_t* s) noexcept nogil:
    cdef const stored_t* e = &p.at
    cdef double each, y, rate
    cdef bint hot = a.hot > PRIOR_ODDS
    cdef int k
    s.state = HOT if hot else 0
    s.last = e.t if e.run > 0 else -NEVER
    if e.run > 0 and not hot:
        if open_since(node.open_t, p) == e.t <= begins[0]:
            s.state |= OPEN_BEFORE
        if open_since(later.open_t, p) == e.t <= begins[1]:
            s.state |= OPEN_AFTER
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
    s.ahead = s.behind = 0.0
    s.p_behind = -1.0
    s.opened = node.open_variance if node.open_t == s.last else 0.0
    s.p[0], s.p[1], s.p[2] = a.p[0], a.p[1], a.p[2]
    s.gains[0], s.gains[1] = a.p[3] + <float>cov[0], a.p[4] + <float>cov[1]
    s.gains[2] = a.p[5] + <float>cov[2]
    for k in range(2):
        s.since[k] = 0.0 if hot else <float>(e.light[k] - node.light[k])
        s.until[k] = 0.0 if hot else <float>(later.light[k] - e.light[k])
    if a.sampled > 0.0:
        s.state |= BEFORE
        s.ahead = a.log
        if hot:
            s.p[0] += a.motion
        else:
            s.ahead += <float>(
                y - node.mean + s.since[0] * a.gain[0] + s.since[1] * a.gain[1])
    if v > 0.0:
        s.state |= AFTER
        s.behind = <float>b - said
        s.p_behind = <float>v
        if hot:
            s.p_behind += a.motion
        else:
            s.behind -= <float>(
                later.mean - y + s.until[0] * a.gain[0] + s.until[1] * a.gain[1])


cdef struct frames_t:
    # The frames before and after a read, and the epoch of the planes.
    frame_t before, later
    frame_t ended               # later, with nodes as of silences by now (`later_of`)
    const anchor_t* anchors
    const float* back           # NULL: no frame after
    const double* middle        # of both by column, then as noise grows
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
    if (anchors.shape[0] != h or anchors.shape[1] != w or middles.shape[0] != 4
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


cdef struct ends_t:
    # ln(I + black) at the last event, from the frames before and after, as known now;
    # variances without what grows with time (< 0: no frame), their covariance, and what
    # is added to that of both.
    double ahead, behind, p_ahead, p_behind, common, extra


cdef inline double passed_at(const frame_t* f, double middle, Py_ssize_t x,
                             int64_t last, double rise, double bend) noexcept nogil:
    """Part of a threshold passed since an event, in the mean over an exposure."""
    cdef double since = 1e-6 * (middle - <double>last)
    cdef double exposure = 1e-6 * <double>(f.end[x] - f.begin[x])
    return since * (rise + since * bend) + bend * exposure * exposure / 12.0


cdef inline ends_t ends_of(const shown_t* s, const frames_t* f, Py_ssize_t x,
                           const double* rise, const double* bend, double since,
                           const camera_t* c) noexcept nogil:
    """The estimates from both frames, and their errors `since` s after the last event.

    Of a silence that was open in an exposure more is known by now.  (8), (13)
    """
    cdef ends_t out
    cdef double[2] d, u         # ln, passed since the frame before, and until the next
    cdef double part, passed = 0.0, after = 0.0, each
    cdef int k
    out.ahead, out.behind = s.ahead, s.behind
    out.p_ahead = out.p_behind = -1.0
    out.common = out.extra = 0.0
    for k in range(2):
        d[k], u[k] = s.since[k], s.until[k]
        if s.state & OPEN_BEFORE:
            d[k] = -c.theta[k] * passed_at(
                &f.before, f.middle[x], x, s.last, rise[k], bend[k])
            out.ahead += s.theta[k] / c.theta[k] * (d[k] - s.since[k])
        if s.state & OPEN_AFTER:
            u[k] = c.theta[k] * passed_at(
                &f.later, f.middle[f.w + x], x, s.last, rise[k], bend[k])
            out.behind -= s.theta[k] / c.theta[k] * (u[k] - s.until[k])
        part = c.theta[k] * since * (rise[k] + since * bend[k])
        d[k] += part
        u[k] -= part
        passed += fabs(d[k]) / c.theta[k]
        after += fabs(u[k]) / c.theta[k]
    passed = passed if s.state & BEFORE else 0.0
    after = after if s.state & AFTER else 0.0
    each = passed + after
    each = c.gamma + (0.5 * c.beta * min(each, 1.0) / each if each > 0.0 else 0.0)
    if s.state & BEFORE:
        # A negative one would be of no frame.
        out.p_ahead = max(
            s.p[0] + 2.0 * (d[0] * s.p[1] + d[1] * s.p[2]) + d[0] * d[0] * s.gains[0]
            + 2.0 * d[0] * d[1] * s.gains[1] + d[1] * d[1] * s.gains[2],
            0.0) + each * passed
        out.extra = 0.25 * c.beta * min(passed, 1.0)
    if s.state & AFTER:
        out.p_behind = (
            s.p_behind + u[0] * u[0] * s.gains[0] + 2.0 * u[0] * u[1] * s.gains[1]
            + u[1] * u[1] * s.gains[2] + each * after)
        if f.alone:
            out.p_behind += 0.25 * c.beta * min(passed + after, 1.0)
        out.common = -(u[0] * (s.p[1] + d[0] * s.gains[0] + d[1] * s.gains[1])
                       + u[1] * (s.p[2] + d[0] * s.gains[1] + d[1] * s.gains[2]))
    return out


cdef inline void estimate(const shown_t* s, int64_t t, int64_t known, bint open_,
                          Py_ssize_t x, const frames_t* f, const camera_t* c,
                          double* log, double* variance,
                          silence_t* silence) noexcept nogil:
    """ln(I + black) at t without what other times and pixels say, its variance, and the
    silence that is open at t."""
    cdef around_t a
    cdef ends_t ends
    cdef double[2] rise = [0.0, 0.0], bend = [0.0, 0.0]
    cdef int k
    cdef double j = 0.0, now = 0.0, then = 0.0, next_ = 0.0, u, slope = 0.0
    a.since = 0.0
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
            u = 0.25 * (c.theta[0] + c.theta[1]) * (c.theta[0] + c.theta[1])
            now = u * silent_variance(silence, a.since)
            then = u * s.opened
            if s.state & OPEN_BEFORE:
                then = u * silent_variance(
                    silence, 1e-6 * (f.middle[x] - <double>s.last))
            if s.state & AFTER:
                next_ = u * silent_variance(
                    silence, 1e-6 * (f.middle[f.w + x] - <double>s.last))
            if not a.flickers:
                rise[a.sign > 0], bend[a.sign > 0] = silence.rise, silence.bend
        for k in range(2):
            j += s.theta[k] * a.since * (rise[k] + a.since * bend[k])
            slope += s.theta[k] * (rise[k] + 2.0 * a.since * bend[k])
    ends = ends_of(s, f, x, rise, bend, a.since, c)
    if s.state & BEFORE:
        ends.p_ahead += max(now - then, 0.0)
    if s.state & AFTER:
        ends.p_behind += max(next_ - now, 0.0)
    at_rest(<double>t, ends.ahead, ends.p_ahead, ends.behind, ends.p_behind,
            ends.common, ends.extra, f.middle[2 * f.w + x], f.middle[3 * f.w + x],
            c.alpha, &u, variance)
    if not s.state & (BEFORE | AFTER):
        log[0] = 0.0
        return
    j += u
    if slope != 0.0:
        j += lead_of(slope, exp_f(<float>j) - c.black, c)
    log[0] = j


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
    if planes.shape[0] != 5:
        raise ValueError("increments_rest_planes: all images must have one shape")
    with nogil:
        for y in range(first, last):
            for x in range(w):
                at = y * w + x
                a = f.anchors + at
                planes[LEVEL, y, x] = a.log
                planes[VARIANCE, y, x] = a.p[0] if a.sampled > 0.0 else -1.0
                planes[SLOPE, y, x], planes[GROWS, y, x] = 0.0, -1.0
                if f.back != NULL:
                    planes[SLOPE, y, x] = f.back[at] - f.later.said[at]
                    planes[GROWS, y, x] = f.back[f.size + at]
            rest_row(f.middle + 2 * w, f.middle + 3 * w, <double>f.epoch, c.alpha, w,
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
            or due.shape[1] != w or planes.shape[0] != 5 or planes.shape[1] != h
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
                for k in range(5):
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
                             const camera_t* c, bint* changed) noexcept nogil:
    """The frame after.  A silence since an event between t and its end, which was open
    there, is looked at again when it has ended, and as it grows by 1/16 to 1/8."""
    cdef node_t* node = f.ended.nodes + at
    cdef int64_t since = open_since((f.later.nodes + at).open_t, p)
    cdef int32_t k = p.next
    cdef int shift = 0
    if since == NEVER or since == p.at.t and p.at.t <= f.later.begin[x]:
        return f.later.nodes + at
    while k >= 0 and store[k].t <= since:
        k = store[k].next
    if k >= 0 and store[k].t <= known:
        known = store[k].t
    else:
        known = max(known - since, 0)
        while known >> shift >= 16:     # images do not depend on which others are read
            shift += 1
        known = since + (known >> shift << shift)
    if f.fresh or node.around_t != known:
        node_of(p, store, &f.ended, at, x, known, c, f.lamp)
        node.around_t = known
        changed[0] = True
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
    cdef double j0, v0, j1, v1, since, knot, rate
    cdef bint rests = False, smooth = False
    cdef silence_t silence, other
    cdef ends_t ends
    cdef double[2] still = [0.0, 0.0]
    cdef int64_t[2] begins = [f.before.begin[x], -NEVER]
    cdef int k
    cdef node_t* later = node
    if f.back != NULL:
        later = later_of(p, store, at, x, known, f, c, &changed)
    if changed or f.fresh:
        if p.at.run > 0 and p.at.t > open_since(node.open_t, p):
            # Its end is known now.
            node_of(p, store, &f.before, at, x, p.at.t, c, f.lamp)
        if (around != NULL and f.ahead == 0 and p.at.run > 0
                and p.at.t > open_since(node.around_t, p)):
            around_of(p, store, &f.before, at, x, p.at.t, lags, c)
        if f.back != NULL:
            begins[1] = f.later.begin[x]
            show_one(p, store, node, f.anchors + at, later, f.later.said[at],
                     f.back[at], f.back[size + at], f.theta_cov, c, begins, f.lamp, s)
        else:
            show_one(p, store, node, f.anchors + at, node, 0.0, 0.0, -1.0,
                     f.theta_cov, c, begins, f.lamp, s)
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
        ends = ends_of(s, f, x, still, still, 0.0, c)
        rest_planes(
            ends.ahead, ends.p_ahead, ends.behind, ends.p_behind, ends.common,
            ends.extra, f.middle[2 * f.w + x], f.middle[3 * f.w + x],
            <double>f.epoch, c.alpha, plane + LEVEL * size + at,
            plane + SLOPE * size + at, plane + VARIANCE * size + at,
            plane + GROWS * size + at, plane + BENDS * size + at)
    else:
        if smooth:
            t0 = s.last + <int64_t>(1e6 * knot)
            t1 = s.last + <int64_t>(1e6 * knot * KNOT)
            until = t1
        estimate(s, t0, t0 + f.ahead if smooth else known, smooth, x, f, c, &j0,
                 &v0, &silence)
        plane[SLOPE * size + at] = plane[GROWS * size + at] = 0.0
        plane[BENDS * size + at] = 0.0
        if smooth:
            estimate(s, t1, t1 + f.ahead, smooth, x, f, c, &j1, &v1, &other)
            since = 1e-6 * <double>(f.epoch - t0)
            rate = (j1 - j0) / (1e-6 * <double>(t1 - t0))
            plane[SLOPE * size + at] = <float>rate
            j0 += rate * since
            rate = (v1 - v0) / (1e-6 * <double>(t1 - t0))
            plane[GROWS * size + at] = <float>rate
            v0 += since * rate
        plane[LEVEL * size + at] = <float>j0
        plane[VARIANCE * size + at] = <float>v0
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
    if (planes.shape[0] != 5 or planes.shape[1] != log.shape[0]
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
                     &planes[VARIANCE, y, 0], &planes[GROWS, y, 0],
                     &planes[BENDS, y, 0], <float>seconds, <float>lit, <float>most,
                     log.shape[1], &log[y, 0], &variance[y, 0], &valid[y, 0])
