"""What the events of a pixel say at a frame and around a time.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._increments cimport (
    LAGS, MOST_SAMPLES, NEVER, camera_t, drift_of, goes_on, lead_of, look, look_t,
    node_t, open_variance, part_of, pixel_t, stored_t, weight)
from _kernels._lamp cimport lamp_flickers, lamp_t, ripple
from _kernels._math cimport exp_f, log_f

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


cdef inline void node_of(const pixel_t* p, const stored_t* store, int64_t begin,
                         int64_t end, int samples, int64_t known, const float* gain,
                         const camera_t* c, const lamp_t* lamp,
                         node_t* node) noexcept nogil:
    """Evaluate the changes so far in a frame's exposure, as known at `known`.  (6)

    It is linear in the pixel's gains about those given.
    """
    cdef look_t at
    cdef double[2] part, rate
    cdef double[MOST_SAMPLES] y, off, on, slope, u, lit
    cdef double top = -1e300, total, level, share, hz = 0.0
    cdef int64_t t, middle = begin + (end - begin) // 2
    cdef bint flickers = lamp_flickers(lamp, <double>begin, <double>end)
    cdef int i, turn
    node.open_t = 0
    node.open_variance = 0.0
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
        hz = c.hz + (corner_of(node.log, c) if node.variance > 0.0 else 0.0)
    for i in range(samples):
        t = begin + <int64_t>((end - begin) * (i + 0.5) / samples)
        look(p, store, t, max(known, t), c, &at)
        y[i] = lit[i] = 0.0
        part[0] = part[1] = rate[0] = rate[1] = slope[i] = 0.0
        if lamp.blocks > 0:
            lit[i] = ripple(lamp, 0.0, <double>t, &slope[i])
            y[i] = -seen_ripple(lamp, hz, &at)
            y[i] += drift_of(&at.around, c, &slope[i])
        if at.around.sign:
            part_of(&at.around, c, part, rate)
        off[i] = at.light[0] + c.theta[0] * part[0]
        on[i] = at.light[1] + c.theta[1] * part[1]
        y[i] += (1.0 + gain[0]) * off[i] + (1.0 + gain[1]) * on[i]
        slope[i] += ((1.0 + gain[0]) * c.theta[0] * rate[0]
                     + (1.0 + gain[1]) * c.theta[1] * rate[1])
        u[i] = 0.0
        top = max(top, y[i] + lit[i])
        if t <= middle and at.next == NEVER and at.around.sign:
            node.open_variance = <float>open_variance(&at.around, c)
    level = y[samples // 2]
    for turn in range(3 if c.hz > 0.0 or c.hz_per_light > 0.0 else 1):
        total = 0.0
        for i in range(samples):
            if turn > 0 and node.variance > 0.0:
                share = exp_f(<float>(node.log - level + y[i])) - c.black
                u[i] = lead_of(slope[i], max(share, 1e-3), c)
            total += exp_f(<float>(y[i] + u[i] + lit[i] - top))
        level = top + log_f(<float>(total / samples))
    node.light[0] = node.light[1] = 0.0
    for i in range(samples):
        share = exp_f(<float>(y[i] + u[i] + lit[i] - top)) / total
        node.light[0] += share * off[i]
        node.light[1] += share * on[i]
    node.mean = level - gain[0] * node.light[0] - gain[1] * node.light[1]


cdef struct lags_t:
    # Lags that are known, and the sums of weight * lag and weight * lag^2 of the three
    # places (own, cell, near), OFF and ON.
    int n
    int[5] index
    double[3][2] first, second
    int64_t oldest, newest  # us: the longest lags back, and ahead


cdef inline lags_t lags_of(const camera_t* c, int64_t ahead) noexcept nogil:
    cdef lags_t out
    cdef int i, j
    cdef double lag
    out.n = 0
    out.oldest = out.newest = 0
    for j in range(2):
        for i in range(3):
            out.first[i][j] = out.second[i][j] = 0.0
    for i in range(LAGS):
        lag = c.lag[i]
        if lag == 0.0 or 1e6 * lag > <double>ahead:
            continue
        out.index[out.n] = i
        out.n += 1
        out.oldest = max(out.oldest, <int64_t>(-1e6 * lag))
        out.newest = max(out.newest, <int64_t>(1e6 * lag))
        for j in range(2):
            out.first[0][j] += lag * c.own[i][j]
            out.first[1][j] += lag * c.cell[i][j]
            out.first[2][j] += lag * c.near[i][j]
            out.second[0][j] += lag * lag * c.own[i][j]
            out.second[1][j] += lag * lag * c.cell[i][j]
            out.second[2][j] += lag * lag * c.near[i][j]
    return out


cdef inline int64_t around_of(const pixel_t* p, const stored_t* store, int64_t t,
                              int64_t known, const lags_t* lags, const camera_t* c,
                              double* out) noexcept nogil:
    """Weigh a pixel's counts at other times, and now: for itself, its macropixel and
    its neighbours.

    Returns the event of the silence that is open at the longest lag ahead, 0: none.
    """
    cdef look_t now, then
    cdef double[2] part, rate, other
    cdef double bend, d, length, since
    cdef int i, j, k, on
    out[0] = out[1] = out[2] = 0.0
    if p.at.run == 0 and p.next < 0:
        return 0
    look(p, store, t, known, c, &now)
    part[0] = part[1] = 0.0
    if now.around.sign:
        part_of(&now.around, c, part, rate)
    for j in range(2):
        part[j] += now.count[j]
        out[0] += c.own_now[j] * part[j]
        out[1] += c.cell_now[j] * part[j]
        out[2] += c.near_now[j] * part[j]
    if now.last < t - lags.oldest and now.next > known:
        # All lags lie in a silence, in which the part is a parabola: its rates at both
        # ends give it.
        if now.around.sign and goes_on(
                max(now.around.silent, now.around.before), c) > 0.0:
            on = now.around.sign > 0
            length = now.around.silent
            since = now.around.since
            now.around.since = 0.0
            part_of(&now.around, c, other, rate)
            d = rate[on]
            now.around.since = length
            part_of(&now.around, c, other, rate)
            bend = 0.5 * (rate[on] - d) / max(length, 1e-6)
            d += 2.0 * bend * since
            for k in range(3):
                out[k] += d * lags.first[k][on] + bend * lags.second[k][on]
        return now.last if now.last != -NEVER else 0
    for k in range(lags.n):
        i = lags.index[k]
        look(p, store, t + <int64_t>(1e6 * c.lag[i]), known, c, &then)
        other[0] = other[1] = 0.0
        if then.around.sign:
            part_of(&then.around, c, other, rate)
        for j in range(2):
            d = then.count[j] + other[j] - part[j]
            out[0] += c.own[i][j] * d
            out[1] += c.cell[i][j] * d
            out[2] += c.near[i][j] * d
    if lags.newest > 0 and now.next <= known:
        look(p, store, t + lags.newest, known, c, &now)
    return now.last if now.last != -NEVER and now.next > known else 0
