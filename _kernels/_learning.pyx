"""Regressors of the learning: what the events of a sample of pixels say at given times.

A pixel's events are contiguous in memory.  The observation model is _increments.h.
"""
from libc.stdint cimport int8_t, int32_t, int64_t

from _kernels._increments cimport (
    CLASSES, CONTEXTS, FIRST_RATIO, LEAST_GAP, LEAST_SILENCE, MOST_SAMPLES, RATIOS,
    around_t, camera_of, camera_t, class_of, context_of, course_of, goes_on, lead_of,
    part_of, ratio_node, weight_of)
from _kernels._math cimport exp_f, log_f

cdef enum:
    COUNTS = 2 + 2 * CLASSES    # M-, M+, then counts by class, OFF first
    MOST_LAGS = 8               # of one call: an array on the stack
    PLACES = 8                  # a pixel, the others of its macropixel, four neighbours

cdef packed struct past_t:
    int64_t t
    float[10] total             # signed counts by class of the gap before, OFF first
    float before                # s since the event before
    float weight                # thresholds that it stands for
    int8_t sign, context, run, spare
    float spare2


cdef void check_starts(const int64_t[::1] start, Py_ssize_t n) except *:
    cdef Py_ssize_t i
    if start.shape[0] < 1 or start[0] != 0 or start[start.shape[0] - 1] != n:
        raise ValueError("start must be the indices of the pixels' events")
    for i in range(start.shape[0] - 1):
        if start[i] > start[i + 1]:
            raise ValueError("start must be the indices of the pixels' events")


def learning_past(past_t[::1] events not None, const int64_t[::1] start not None,
                  const int64_t[::1] first not None, const double[::1] camera not None):
    """Fill in what follows from the events before; t and sign are given.

    start are the indices of the pixels' first events, and the number of all; first is
    the time from which a pixel is watched, us.
    """
    cdef Py_ssize_t i, k, c, n = start.shape[0] - 1
    cdef const camera_t* camera_ = camera_of(camera)
    cdef past_t* e
    cdef double before, before2, x
    cdef bint same
    check_starts(start, events.shape[0])
    if first.shape[0] != n:
        raise ValueError("learning_past: first must have one time per pixel")
    with nogil:
        for i in range(n):
            before = 0.0
            for k in range(start[i], start[i + 1]):
                e = &events[k]
                before2 = before
                same = k > start[i] and events[k - 1].sign == e.sign
                before = 1e-6 * <double>(
                    e.t - (events[k - 1].t if k > start[i] else first[i]))
                for c in range(2 * CLASSES):
                    e.total[c] = events[k - 1].total[c] if k > start[i] else 0.0
                e.run = min(events[k - 1].run + 1, 3) if same else 1
                e.context = context_of(e.run, before, before2)
                e.before = <float>before
                e.weight = <float>weight_of(
                    before, before2, same, events[k - 1].run if k > start[i] else 0,
                    camera_)
                c = class_of(before, &x) + (CLASSES if e.sign > 0 else 0)
                e.total[c] += e.sign * e.weight * <float>(1.0 - x)
                e.total[c + 1] += e.sign * e.weight * <float>x


cdef inline int64_t last_at(const past_t* events, int64_t low, int64_t high,
                            int64_t t) noexcept nogil:
    """Index of the last of events[low:high] at or before t, or low - 1."""
    cdef int64_t middle
    while low < high:
        middle = (low + high) >> 1
        if events[middle].t <= t:
            low = middle + 1
        else:
            high = middle
    return low - 1


cdef inline void fill(const past_t* events, int64_t k, int64_t stop, int64_t t,
                      int64_t known, around_t* out) noexcept nogil:
    """Describe the events around t; k is the last one."""
    out.sign = events[k].sign
    out.drift = 0.0
    out.flickers = 0
    out.context = events[k].context
    out.before = events[k].before
    out.since = 1e-6 * <double>(t - events[k].t)
    out.silent = 1e-6 * <double>(known - events[k].t)
    out.gap = 0.0
    if k + 1 < stop and events[k + 1].t <= known:
        out.gap = 1e-6 * <double>max(events[k + 1].t - events[k].t, 1)
        out.next_sign = events[k + 1].sign
        out.next_weight = events[k + 1].weight


cdef inline void counts_at(const past_t* events, int64_t low, int64_t k, int64_t stop,
                           int64_t t, int64_t known, const camera_t* c, double* out,
                           double* rate) noexcept nogil:
    """M-, M+ and their rates; k is the last event at or before t."""
    cdef around_t around
    cdef int i
    cdef double[2] part
    out[0] = out[1] = rate[0] = rate[1] = 0.0
    if k < low:
        return
    fill(events, k, stop, t, known, &around)
    part_of(&around, c, part, rate)
    for i in range(CLASSES):
        out[0] += events[k].total[i]
        out[1] += events[k].total[CLASSES + i]
    out[0] += part[0]
    out[1] += part[1]


def learning_rows(const past_t[::1] events not None, const int64_t[::1] start not None,
                  const int32_t[::1] pixel not None,
                  const int64_t[:, :, ::1] exposure not None, int64_t ahead,
                  const double[:, ::1] log not None, int samples,
                  const double[::1] camera not None,
                  const double[:, ::1] gains not None,
                  double[:, ::1] out not None):
    """Average the features over two exposures, weighted by light.  (6)

    exposure (frame, begin and end, N) are times, us; images know events up to `ahead`
    beyond them, and the first also those of the second.  log (2, N) is ln(I + black) of
    the frames, gains (2, pixels) those of the pixels, OFF and ON.  out (15, N) receives
    the differences of both: M-, M+ and counts by class, each times 1 + gain, and h; and
    the change by OFF and by ON events, without gain.
    """
    cdef Py_ssize_t i, n = pixel.shape[0], pixels = start.shape[0] - 1
    cdef const camera_t* c = camera_of(camera)
    cdef const past_t* all_ = &events[0] if events.shape[0] else NULL
    cdef double[2][COUNTS + 1] f
    cdef double off, on
    cdef int64_t low, high
    cdef int j
    check_starts(start, events.shape[0])
    if (samples < 1 or samples > MOST_SAMPLES or exposure.shape[0] != 2
            or exposure.shape[1] != 2 or exposure.shape[2] != n or log.shape[0] != 2
            or log.shape[1] != n or out.shape[0] != COUNTS + 3 or out.shape[1] != n):
        raise ValueError("learning_rows: arrays must have one column per row")
    if gains.shape[0] != 2 or gains.shape[1] != pixels:
        raise ValueError("learning_rows: gains must have one column per pixel")
    for i in range(n):
        if pixel[i] < 0 or pixel[i] >= pixels:
            raise ValueError("learning_rows: no such pixel")
    with nogil:
        for i in range(n):
            low, high = start[pixel[i]], start[pixel[i] + 1]
            off, on = 1.0 + gains[0, pixel[i]], 1.0 + gains[1, pixel[i]]
            mean_of(all_, low, high, exposure[0, 0, i], exposure[0, 1, i],
                    exposure[1, 1, i] + ahead, ahead, log[0, i], samples, c, off, on,
                    f[0])
            mean_of(all_, low, high, exposure[1, 0, i], exposure[1, 1, i], 0, ahead,
                    log[1, i], samples, c, off, on, f[1])
            for j in range(COUNTS + 1):
                f[1][j] -= f[0][j]
            out[COUNTS, i] = f[1][COUNTS]
            out[COUNTS + 1, i] = c.theta[0] * f[1][0]
            out[COUNTS + 2, i] = c.theta[1] * f[1][1]
            out[0, i], out[1, i] = off * f[1][0], on * f[1][1]
            for j in range(CLASSES):
                out[COUNTS + 1, i] += c.by_class[0][j] * f[1][2 + j]
                out[COUNTS + 2, i] += c.by_class[1][j] * f[1][2 + CLASSES + j]
                out[2 + j, i] = off * f[1][2 + j]
                out[2 + CLASSES + j, i] = on * f[1][2 + CLASSES + j]


cdef inline void mean_of(const past_t* events, int64_t low, int64_t high, int64_t begin,
                         int64_t end, int64_t known, int64_t ahead, double log,
                         int samples, const camera_t* c, double off, double on,
                         double* out) noexcept nogil:
    cdef double[MOST_SAMPLES][COUNTS] f
    cdef double[MOST_SAMPLES] y, slope, u
    cdef double[2] rise, bend, count
    cdef double top = -1e300, total, level, share, light, since = 0.0
    cdef int64_t t, k = low - 1, before
    cdef around_t around
    cdef bint leads = False
    cdef int i, j, turn
    around.gap = 0.0
    for i in range(samples):
        t = begin + <int64_t>((end - begin) * (i + 0.5) / samples)
        before = k
        if i == 0:
            k = last_at(events, low, high, t)
        while k + 1 < high and events[k + 1].t <= t:
            k += 1
        if i == 0 or k != before:
            count[0] = count[1] = rise[0] = rise[1] = bend[0] = bend[1] = 0.0
            for j in range(CLASSES if k >= low else 0):
                count[0] += events[k].total[j]
                count[1] += events[k].total[CLASSES + j]
        if k >= low:
            since = 1e-6 * <double>(t - events[k].t)
            # In a gap whose end is known, the course stays the same.
            if k != before or around.gap <= 0.0:
                fill(events, k, high, t, max(known, t + ahead), &around)
                course_of(&around, c, rise, bend)
        for j in range(2):
            f[i][j] = count[j] + since * (rise[j] + since * bend[j])
        y[i] = c.theta[0] * f[i][0] * off + c.theta[1] * f[i][1] * on
        for j in range(2 * CLASSES):
            f[i][2 + j] = events[k].total[j] if k >= low else 0.0
        for j in range(CLASSES):
            y[i] += (c.by_class[0][j] * f[i][2 + j] * off
                     + c.by_class[1][j] * f[i][2 + CLASSES + j] * on)
        slope[i] = (c.theta[0] * (rise[0] + 2.0 * since * bend[0]) * off
                    + c.theta[1] * (rise[1] + 2.0 * since * bend[1]) * on)
        leads |= slope[i] != 0.0
        u[i] = 0.0
        top = max(top, y[i])
    level = y[samples // 2]
    total = 1.0
    for turn in range(3 if leads else 1):
        total = 0.0
        for i in range(samples):
            if turn > 0 and slope[i] != 0.0:
                light = exp_f(<float>(log - level + y[i])) - c.black
                u[i] = lead_of(slope[i], light, c)
            total += exp_f(<float>(y[i] + u[i] - top))
        level = top + log_f(<float>(total / samples))
    for j in range(COUNTS):
        out[j] = 0.0
    out[COUNTS] = level
    for i in range(samples):
        share = exp_f(<float>(y[i] + u[i] - top)) / total
        for j in range(COUNTS):
            out[j] += share * f[i][j]


def learning_around(const past_t[::1] events not None,
                    const int64_t[::1] start not None,
                    const int32_t[:, ::1] places not None, const int64_t[::1] times
                    not None, const int64_t[::1] known not None,
                    const double[::1] lags not None, const double[::1] camera not None,
                    float[:, ::1] out not None):
    """Counts at other times and of other pixels, less those now and of the pixel.

    places (N, 8) is the pixel, the others of its macropixel, and its four neighbours,
    -1 if there is none.  out (N, 6 lags + 4) receives for each lag the pixel's,
    the macropixel's and the neighbours' mean count at the lag less that now (OFF, ON);
    then the macropixel's and the neighbours' mean now, less the pixel's.
    """
    cdef Py_ssize_t i, j, n = places.shape[0], m = lags.shape[0]
    cdef Py_ssize_t pixels = start.shape[0] - 1
    cdef const camera_t* c = camera_of(camera)
    cdef const past_t* all_ = &events[0] if events.shape[0] else NULL
    check_starts(start, events.shape[0])
    if (m > MOST_LAGS or places.shape[1] != PLACES or times.shape[0] != n
            or known.shape[0] != n or out.shape[0] != n or out.shape[1] != 6 * m + 4):
        raise ValueError("learning_around: arrays must have one row per pixel")
    for i in range(n):
        for j in range(PLACES):
            if places[i, j] < (0 if j == 0 else -1) or places[i, j] >= pixels:
                raise ValueError("learning_around: no such pixel")
    with nogil:
        for i in range(n):
            around_of(all_, &start[0], &places[i, 0], times[i], known[i], &lags[0],
                      <int>m, c, &out[i, 0])


cdef void around_of(const past_t* events, const int64_t* start, const int32_t* places,
                    int64_t t, int64_t known, const double* lags, int m,
                    const camera_t* c, float* out) noexcept nogil:
    cdef double[3][MOST_LAGS + 1][2] mean
    cdef double[2] now, then, rate
    cdef int[3] number
    cdef int64_t low, high, k, at, index
    cdef int i, j, part, s
    for part in range(3):
        number[part] = 0
        for i in range(m + 1):
            mean[part][i][0] = mean[part][i][1] = 0.0
    for j in range(PLACES):
        if places[j] < 0:
            continue
        low, high = start[places[j]], start[places[j] + 1]
        index = last_at(events, low, high, t)
        counts_at(events, low, index, high, t, known, c, now, rate)
        part = 0 if j == 0 else 1 if j < 4 else 2
        number[part] += 1
        for s in range(2):
            mean[part][m][s] += now[s]
        for i in range(m):
            at = t + <int64_t>(1e6 * lags[i])
            if at > known:
                continue
            k = index
            while k >= low and events[k].t > at:
                k -= 1
            while k + 1 < high and events[k + 1].t <= at:
                k += 1
            counts_at(events, low, k, high, at, known, c, then, rate)
            for s in range(2):
                mean[part][i][s] += then[s] - now[s]
    for i in range(m + 1):
        for s in range(2):
            mean[1][i][s] = (mean[0][i][s] + mean[1][i][s]) / (1 + number[1])
            mean[2][i][s] = (mean[2][i][s] / number[2] if number[2] > 0
                             else mean[0][i][s])
    for i in range(m):
        for part in range(3):
            for s in range(2):
                out[6 * i + 2 * part + s] = <float>mean[part][i][s]
    for part in range(2):
        for s in range(2):
            out[6 * m + 2 * part + s] = <float>(mean[part + 1][m][s] - mean[0][m][s])


def learning_silences(const past_t[::1] events not None, const int64_t[::1] start
                      not None, const int32_t[::1] pixels not None,
                      const int64_t[::1] times not None, int64_t ahead,
                      const double[::1] camera not None, double[:, ::1] rows not None,
                      double[::1] target not None):
    """Rows of the regression of (2c): silences that are open at t + ahead, whose end is
    known later.  Returns their number.

    rows (M, 40) receives the factors of E and of B by context and node, and target the
    part that had passed.  Each of the pixels is looked at at all times.
    """
    cdef Py_ssize_t i, j, n = 0, most = target.shape[0], number = start.shape[0] - 1
    cdef const camera_t* c = camera_of(camera)
    cdef const past_t* e = &events[0] if events.shape[0] else NULL
    cdef around_t around
    cdef double[2] part, rate
    cdef double s, z, basis, ratio, share
    cdef int64_t k, first, stop
    cdef int half, at, node
    check_starts(start, events.shape[0])
    if rows.shape[0] != most or rows.shape[1] != 2 * CONTEXTS * RATIOS:
        raise ValueError("learning_silences: rows must have one per target")
    for i in range(pixels.shape[0]):
        if pixels[i] < 0 or pixels[i] >= number:
            raise ValueError("learning_silences: no such pixel")
    with nogil:
        for i in range(pixels.shape[0]):
            first, stop = start[pixels[i]], start[pixels[i] + 1]
            for j in range(times.shape[0]):
                if n >= most:
                    break
                k = last_at(e, first, stop, times[j])
                if k <= first or k + 1 >= stop or e[k + 1].t <= times[j] + ahead:
                    continue
                fill(e, k, stop, times[j], e[k + 1].t, &around)
                part_of(&around, c, part, rate)
                around.silent = max(1e-6 * <double>(times[j] + ahead - e[k].t),
                                    LEAST_SILENCE)
                ratio = around.silent / max(around.before, LEAST_GAP)
                z = goes_on(max(around.silent, around.before), c)
                if z <= 0.0:
                    continue
                node = ratio_node(ratio, &share)
                s = around.since / around.silent
                for at in range(2 * CONTEXTS * RATIOS):
                    rows[n, at] = 0.0
                for half in range(2):
                    basis = z * (4.0 * s * (1.0 - s) if half else s)
                    at = (half * CONTEXTS + around.context) * RATIOS + node
                    if ratio < FIRST_RATIO and half == 0:
                        rows[n, at] = basis * ratio / FIRST_RATIO
                    else:
                        rows[n, at] = basis * (1.0 - share)
                        rows[n, at + 1] = basis * share
                target[n] = e[k].sign * (part[0] + part[1])
                n += 1
    return n
