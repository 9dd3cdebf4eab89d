"""What the events of a pixel say at a frame and around a time.  Inline only."""
from libc.stdint cimport int8_t, int64_t
from libc.string cimport memset

from _kernels._increments cimport (
    LAGS, MOST_SAMPLES, NEVER, around_t, camera_t, course_of, course_t, drift_of,
    goes_on, lead_of, look, look_t, node_t, pixel_t, silence_of,
    silence_t, silent_variance, stored_t)
from _kernels._lamp cimport lamp_flickers, lamp_t, ripple
from _kernels._math cimport exp_f, log_f

cdef struct frame_t:
    # A frame, as `Waiting.arrays` gives it.
    node_t* nodes
    const float* log            # ln DN/ms
    const float* variance       # of the sample, 0: not usable
    const float* said           # what others said since the frame before
    const float* gains          # about which nodes are linear
    const int64_t* begin        # of the exposure by column, as end and middle
    const int64_t* end
    const int64_t* middle
    double* around              # by `increments_node`; NULL: nothing is weighed
    Py_ssize_t size             # pixels
    int samples
    double lost                 # s that count besides since the frame before


cdef inline int frame_of(tuple arrays, Py_ssize_t h, Py_ssize_t w,
                         frame_t* f) except -1:
    cdef node_t[:, ::1] nodes
    cdef const float[:, :, ::1] sample, gains
    cdef const int64_t[:, ::1] times
    cdef double[:, :, ::1] around
    nodes, sample, gains, times, f.samples, around, f.lost = arrays
    if (nodes.shape[0] != h or nodes.shape[1] != w or sample.shape[0] != 3
            or sample.shape[1] != h or sample.shape[2] != w or gains.shape[0] != h
            or gains.shape[1] != w or gains.shape[2] != 2 or times.shape[0] != 3
            or times.shape[1] != w or around is not None and (
                around.shape[0] != 3 or around.shape[1] != h or around.shape[2] != w)):
        raise ValueError("all images must have one shape")
    if f.samples < 1 or f.samples > MOST_SAMPLES:
        raise ValueError("samples must be 1 to 9")
    f.nodes, f.gains, f.size = &nodes[0, 0], &gains[0, 0, 0], h * w
    f.log, f.variance, f.said = (
        &sample[0, 0, 0], &sample[1, 0, 0], &sample[2, 0, 0])
    f.begin, f.end, f.middle = &times[0, 0], &times[1, 0], &times[2, 0]
    f.around = NULL if around is None else &around[0, 0, 0]
    return 0


cdef inline int64_t open_since(int64_t t, const pixel_t* p) noexcept nogil:
    """The event of the silence that is open at a node, NEVER: none."""
    return p.quiet_t if t == 0 else t


cdef inline double seen_ripple(const lamp_t* lamp, double hz,
                               look_t* at) noexcept nogil:
    """Ripple of the lamp behind the low-pass at the last event, which it helped to
    trigger; sets its change until the next one."""
    cdef double rate, last = ripple(lamp, hz, <double>at.last, &rate)
    at.around.flickers = lamp_flickers(lamp, <double>at.last, <double>at.last)
    if at.around.gap > 0.0:
        at.around.drift = last - ripple(lamp, hz, <double>at.next, &rate)
    return last


cdef inline double corner_of(double log, const camera_t* c) noexcept nogil:
    """Increase of the corner frequency by the light, Hz."""
    cdef double light
    if c.hz_per_light <= 0.0:
        return 0.0
    light = exp_f(<float>log) - c.black
    return c.hz_per_light * (light if light > 0.0 else 0.0)


cdef inline void node_of(const pixel_t* p, const stored_t* store, const frame_t* f,
                         Py_ssize_t place, Py_ssize_t x, int64_t known,
                         const camera_t* c, const lamp_t* lamp) noexcept nogil:
    """Evaluate the changes so far in a frame's exposure, as known at `known`.  (6)

    It is linear in the pixel's gains about the frame's.
    """
    cdef look_t at
    cdef double[2] part, rate, rise, bend
    cdef double[MOST_SAMPLES] y, off, on, slope, u, lit
    cdef double top = -1e300, total, level = 0.0, share, seen = 0.0, hz = 0.0
    cdef node_t* node = f.nodes + place
    cdef const float* gain = f.gains + 2 * place
    cdef double log = f.log[place]
    cdef int samples = f.samples
    cdef int64_t t, begin = f.begin[x], end = f.end[x]
    cdef int64_t middle = begin + (end - begin) // 2
    cdef bint flickers = lamp_flickers(lamp, <double>begin, <double>end)
    cdef bint in_one_gap, leads = False, usable = f.variance[place] > 0.0
    cdef silence_t open_
    cdef int i, j, turn
    node.open_t = NEVER
    node.open_variance = node.middle = 0.0
    look(p, store, end, max(known, end), c, &at)
    if at.last != -NEVER and at.next == NEVER:
        node.open_t = at.last
    if not flickers and at.last <= begin and at.next == NEVER and (
            at.around.sign == 0 or goes_on(at.around.silent, c) <= 0.0):
        node.light[0], node.light[1] = at.light[0], at.light[1]
        node.mean = at.light[0] + at.light[1]
        if lamp.blocks > 0:
            node.mean -= seen_ripple(lamp, c.hz, &at)
        return
    if lamp.blocks > 0:
        hz = c.hz + (corner_of(log, c) if usable else 0.0)
    in_one_gap = at.last <= begin and known >= end
    for i in range(samples):
        t = begin + <int64_t>((end - begin) * (i + 0.5) / samples)
        if i == 0 or t >= at.next or known < end:
            if i > 0 or not in_one_gap:
                look(p, store, t, max(known, t), c, &at)
            seen = seen_ripple(lamp, hz, &at) if lamp.blocks > 0 else 0.0
            rise[0] = rise[1] = bend[0] = bend[1] = 0.0
            if at.around.sign:
                course_of(&at.around, c, rise, bend)
        at.around.since = 1e-6 * <double>(t - at.last)
        lit[i] = ripple(lamp, 0.0, <double>t, &slope[i]) if lamp.blocks > 0 else 0.0
        y[i] = drift_of(&at.around, c, &slope[i]) - seen
        for j in range(2):
            part[j] = at.around.since * (rise[j] + at.around.since * bend[j])
            rate[j] = rise[j] + 2.0 * at.around.since * bend[j]
        off[i] = at.light[0] + c.theta[0] * part[0]
        on[i] = at.light[1] + c.theta[1] * part[1]
        y[i] += (1.0 + gain[0]) * off[i] + (1.0 + gain[1]) * on[i]
        slope[i] += ((1.0 + gain[0]) * c.theta[0] * rate[0]
                     + (1.0 + gain[1]) * c.theta[1] * rate[1])
        leads |= slope[i] != 0.0
        u[i] = 0.0
        top = max(top, y[i] + lit[i])
        if i == samples // 2:
            level = y[i]
        if t <= middle and at.next == NEVER and at.around.sign:
            open_ = silence_of(&at.around, c)
            node.open_variance = <float>silent_variance(&open_, at.around.since)
    for turn in range(3 if leads and usable else 1):
        total = 0.0
        for i in range(samples):
            if turn > 0 and slope[i] != 0.0:
                share = exp_f(<float>(log - level + y[i])) - c.black
                u[i] = lead_of(slope[i], share, c)
            total += exp_f(<float>(y[i] + u[i] + lit[i] - top))
        level = top + log_f(<float>(total / samples))
    i = samples // 2
    node.middle = <float>(y[i] + u[i] + lit[i] - level)
    node.light[0] = node.light[1] = 0.0
    for i in range(samples):
        share = exp_f(<float>(y[i] + u[i] + lit[i] - top)) / total
        node.light[0] += share * off[i]
        node.light[1] += share * on[i]
    node.mean = level - gain[0] * node.light[0] - gain[1] * node.light[1]


cdef struct lags_t:
    # The times whose counts have a weight: now, then the lags that are known.
    int n
    int64_t[6] lag          # us
    double[6][3][2] weight  # for the pixel, its macropixel, its neighbours; OFF, ON
    double[3][2][3] moment  # of all these weights: sums of weight lag^0, 1 and 2
    int64_t oldest          # us: the longest lag back


cdef inline lags_t lags_of(const camera_t* c, int64_t ahead) noexcept nogil:
    cdef lags_t out
    cdef double lag
    cdef int i, j, k
    out.n = 1
    out.lag[0] = out.oldest = 0
    for j in range(2):
        out.weight[0][0][j] = c.own_now[j]
        out.weight[0][1][j] = c.cell_now[j]
        out.weight[0][2][j] = c.near_now[j]
        for k in range(3):
            out.moment[k][j][0] = out.weight[0][k][j]
            out.moment[k][j][1] = out.moment[k][j][2] = 0.0
    for i in range(LAGS):
        if c.lag[i] == 0.0 or 1e6 * c.lag[i] > <double>ahead:
            continue
        out.lag[out.n] = <int64_t>(1e6 * c.lag[i])
        out.oldest = max(out.oldest, -out.lag[out.n])
        lag = 1e-6 * <double>out.lag[out.n]
        for j in range(2):
            out.weight[out.n][0][j] = c.own[i][j]
            out.weight[out.n][1][j] = c.cell[i][j]
            out.weight[out.n][2][j] = c.near[i][j]
            for k in range(3):      # counts less those now
                out.weight[0][k][j] -= out.weight[out.n][k][j]
                out.moment[k][j][1] += out.weight[out.n][k][j] * lag
                out.moment[k][j][2] += out.weight[out.n][k][j] * lag * lag
        out.n += 1
    return out


cdef inline void weigh_silence(const look_t* now, int64_t ahead, const lags_t* lags,
                               course_t* out) noexcept nogil:
    """Weigh counts if all times lie in the silence that is open."""
    cdef int i, k, on = now.around.sign > 0
    for k in range(3):
        out.level[k] = (lags.moment[k][0][0] * now.count[0]
                        + lags.moment[k][1][0] * now.count[1])
        for i in range(3):
            out.open[k][i] = <float>lags.moment[k][on][i]
    out.sign, out.last = <int8_t>now.around.sign, now.last
    if now.around.sign:
        out.context, out.before = <int8_t>now.around.context, <float>now.around.before
    if now.unknown != NEVER:
        out.until = now.unknown - ahead


cdef inline void weigh_counts(const pixel_t* p, const stored_t* store, int64_t t,
                              int64_t ahead, const lags_t* lags, const camera_t* c,
                              course_t* out) noexcept nogil:
    """Weigh a pixel's counts at other times, and now, for times around t.

    Events up to t + ahead (us) are known.  It depends on the events between which these
    times lie, not on t itself.
    """
    cdef look_t[6] looks
    cdef const look_t* at
    cdef double[2] rise, bend
    cdef double w, x, lag
    cdef int i, j, k
    memset(out, 0, sizeof(course_t))
    out.until, out.origin = NEVER, -NEVER
    if p.at.run == 0 and p.next < 0:
        return
    look(p, store, t, t + ahead, c, &looks[0])
    if looks[0].next == NEVER and looks[0].last <= t - lags.oldest:
        weigh_silence(&looks[0], ahead, lags, out)
        return
    out.origin = looks[0].last
    for i in range(1, lags.n):
        look(p, store, t + lags.lag[i], t + ahead, c, &looks[i])
        out.origin = max(out.origin, looks[i].last - lags.lag[i])
    for i in range(lags.n):
        at = &looks[i]
        for k in range(3):
            for j in range(2):
                out.level[k] += lags.weight[i][k][j] * at.count[j]
        if at.next != NEVER:
            out.until = min(out.until, at.next - lags.lag[i])
        elif at.unknown != NEVER:
            out.until = min(out.until, at.unknown - ahead)
        if at.around.sign == 0:
            continue
        if at.next != NEVER:
            course_of(&at.around, c, rise, bend)
            x = 1e-6 * <double>(out.origin + lags.lag[i] - at.last)
            for k in range(3):
                for j in range(2):
                    w = lags.weight[i][k][j]
                    out.level[k] += w * x * (rise[j] + x * bend[j])
                    out.rise[k] += <float>(w * (rise[j] + 2.0 * x * bend[j]))
                    out.bend[k] += <float>(w * bend[j])
        else:
            out.last, out.sign = at.last, <int8_t>at.around.sign
            out.context = <int8_t>at.around.context
            out.before = <float>at.around.before
            lag = 1e-6 * <double>lags.lag[i]
            for k in range(3):
                w = lags.weight[i][k][at.around.sign > 0]
                out.open[k][0] += <float>w
                out.open[k][1] += <float>(w * lag)
                out.open[k][2] += <float>(w * lag * lag)


cdef inline silence_t silence_in(const course_t* s, int64_t known,
                                 const camera_t* c) noexcept nogil:
    """The open silence, by the events up to `known`."""
    cdef around_t a
    a.sign, a.context, a.before = s.sign, s.context, s.before
    a.silent = 1e-6 * <double>(known - s.last)
    return silence_of(&a, c)


cdef inline void say(const course_t* s, int64_t t, double r, double b,
                     double* out) noexcept nogil:
    """What the counts say at t, for the pixel, its macropixel and its neighbours.

    r and b are rise and bend of the open silence.
    """
    cdef double x = 1e-6 * <double>(t - s.origin)
    cdef int k
    for k in range(3):
        out[k] = s.level[k] + x * (s.rise[k] + x * s.bend[k])
    if s.sign == 0 or (r == 0.0 and b == 0.0):
        return
    x = 1e-6 * <double>(t - s.last)
    for k in range(3):
        out[k] += (s.open[k][0] * x * (r + x * b)
                   + s.open[k][1] * (r + 2.0 * x * b) + s.open[k][2] * b)


cdef inline void around_of(const pixel_t* p, const stored_t* store, const frame_t* f,
                           Py_ssize_t place, Py_ssize_t x, int64_t known,
                           const lags_t* lags, const camera_t* c) noexcept nogil:
    """Weigh a pixel's counts at other times, and now, of the events up to `known`."""
    cdef course_t course
    cdef silence_t open_
    cdef double[3] out
    weigh_counts(p, store, f.middle[x], known - f.middle[x], lags, c, &course)
    open_ = silence_in(&course, known, c)
    say(&course, f.middle[x], open_.rise, open_.bend, out)
    f.around[place], f.around[f.size + place] = out[0], out[1]
    f.around[2 * f.size + place] = out[2]
    f.nodes[place].around_t = course.last if course.sign else NEVER
