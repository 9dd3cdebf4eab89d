"""Gains of the four pixels of a macropixel from events alone.

For any light n . I = 0, where n is the left null vector of the four responses.  With
I_i = a_i exp(E_i), where E_i is the sum of events, this is linear in the unknown gains
a.  For equal relative errors the solution is the eigenvector of the smallest eigenvalue
of the moments of n_i exp(E_i).  See docs/theory/events.md.
"""
from libc.stdint cimport int32_t, int64_t, uint8_t, uint16_t, uint32_t
from libc.string cimport memset

from _kernels._increments cimport (
    DOUBTFUL, NEVER, camera_of, camera_t, drift_of, lead_of, look, look_t, part_of,
    pixel_t, stored_t)
from _kernels._increments_frames cimport corner_of
from _kernels._lamp cimport lamp_flickers, lamp_of, lamp_t, ripple
from _kernels._math cimport exp_f, log_f
from _kernels._model cimport check_given, wave_t
from _kernels._types cimport event_t

cdef extern from "_prefetch.h" nogil:
    void prefetch_all "PDAVIS_PREFETCH_ALL"(const void*, Py_ssize_t)

cdef packed struct policy_t:
    double keep             # decay factor of the moments, per comparison
    double ratio_sigma      # prior sigma of ln(theta_on / theta_off)
    double forget           # decay rate of the balance, per event
    double loss             # fraction of a macropixel's level lost per comparison
    double pull             # ridge weight to equal mean squares, relative variance
    double least            # number of comparisons needed for the first solution
    double line_error       # error of a line through N periods, in 1 / (2 N)^2
    double far_errors       # such errors beyond which a pixel is an outlier
    double part_least       # bounds the fraction of ON, and of OFF, events

cdef packed struct state_t:
    double base             # ln intensity at the last comparison, up to an offset
    double theta_off
    double theta_on
    double prior_off        # thresholds as stated
    double prior_on
    double count_off        # events up to the last comparison, as the store counts
    double count_on

cdef packed struct balance_t:
    # Running regression of a pixel's ON events on all its events: weight, means
    # relative to the present counts, and central second moments.  null: coefficient of
    # the pixel in the sum of the macropixel's intensities that is 0 for any light.
    double weight
    double mean_all
    double mean_on
    double var_all
    double cov_on
    double var_on
    double null

cdef packed struct moments_t:
    double product[10]      # moments of weighted intensities, upper triangle by rows
    double weight
    double since            # number of comparisons since the last solution
    float ratio             # ratio of the two smallest eigenvalues, 1: no solution
    float smallest          # smallest eigenvalue, a relative variance

cdef extern from *:
    """
    /* Events ahead of which a macropixel's records, 20 cache lines, are prefetched. */
    #define CELLS_AHEAD 6
    """
    const Py_ssize_t CELLS_AHEAD

cdef extern from "_redundancy.h" nogil:
    const double CHANNEL_SHARE
    enum:
        CELLS
        PRODUCTS
    ctypedef struct cells_t:
        double product[PRODUCTS][CELLS]
        double weight[CELLS]
        double shift[4][CELLS]
        double ratio[CELLS]
        double smallest[CELLS]
    void solve_cells(cells_t*, double)


cdef inline void remember(balance_t* m, double n_on, double n_off,
                          double per_event) noexcept nogil:
    """Add a point to the regression of ON events on all events."""
    cdef double n = n_on + n_off, keep = exp_f(<float>(-n * per_event)), w, all_, on
    m.mean_all -= n
    m.mean_on -= n_on
    m.weight *= keep
    m.var_all *= keep
    m.cov_on *= keep
    m.var_on *= keep
    w = m.weight + n
    all_ = -m.mean_all
    on = -m.mean_on
    m.var_all += n * m.weight / w * all_ * all_
    m.cov_on += n * m.weight / w * all_ * on
    m.var_on += n * m.weight / w * on * on
    m.mean_all += all_ * n / w
    m.mean_on += on * n / w
    m.weight = w


cdef inline void rebalance(const balance_t* m, const policy_t* policy,
                           state_t* s) noexcept nogil:
    """Set the thresholds so that the sum of events has no trend.

    Their sum is that of the prior.  For a pixel whose ratio is farther from the prior's
    than the line's error explains, the prior is widened.
    """
    cdef double total = s.prior_on + s.prior_off
    # Half of the events lead in one direction, by the mean threshold each.
    cdef double travel = 0.5 * m.weight * (0.5 * total)
    cdef double before, part, swing, error, ratio, believed
    cdef double least = policy.part_least, spread = policy.ratio_sigma
    # If a pixel's ratio is off by this spread, its sum of events grows by so many
    # thresholds per event.
    cdef double trend = 0.5 * spread
    if m.var_all <= 0.0:
        return
    # A line fitted to N periods has an error of line_error / (2 N)^2.  1 / (2 N) is
    # estimated as the swing of the sum of events over their number: the total swing,
    # less what the spread of the ratios adds to it, or that about the line once light
    # with a range of e^4 must have turned round.
    part = m.cov_on / m.var_all
    swing = s.prior_off / total
    swing = 4.0 * (m.var_on / m.var_all - 2.0 * swing * part + swing * swing)
    if swing >= 1.0:
        return
    error = 4.0 * (m.var_on / m.var_all - part * part)
    swing -= trend * trend
    swing = swing if swing > error else error
    error = error if error > 4.0 / (travel * travel) else 4.0 / (travel * travel)
    error = policy.line_error * (error if error < swing else swing)
    part = part if part > least else least
    part = part if part < 1.0 - least else 1.0 - least
    before = log_f(<float>(s.prior_on / s.prior_off))
    ratio = log_f(<float>((1.0 - part) / part)) - before
    believed = policy.far_errors * error
    believed = ratio * ratio - believed * believed
    believed = believed if believed > spread * spread else spread * spread
    ratio = exp_f(<float>(before + ratio * believed / (believed + error * error)))
    s.theta_on = total * ratio / (1.0 + ratio)
    s.theta_off = total - s.theta_on


cdef inline void add_moments(moments_t* m, const double* value,
                             double keep) noexcept nogil:
    cdef double norm = 0.0
    cdef int i, j, k = 0
    for i in range(4):
        norm += value[i] * value[i]
    norm = 1.0 / norm
    for i in range(4):
        for j in range(i, 4):
            m.product[k] = m.product[k] * keep + value[i] * value[j] * norm
            k += 1
    m.weight = m.weight * keep + 1.0
    m.since += 1.0


cdef inline double log_at(int64_t t, int64_t known, const stored_t* store,
                          const camera_t* c, const lamp_t* lamp, const pixel_t* p,
                          const state_t* s, double* passed) noexcept nogil:
    """Log intensity at t, using the events up to known >= t; `passed` receives the
    signed counts of OFF and ON events since the last comparison."""
    cdef look_t at
    cdef double[2] part, rate
    cdef double level, slope = 0.0, rise, hz, before
    look(p, store, t, known, c, &at)
    passed[0] = at.count[0] - s.count_off
    passed[1] = at.count[1] - s.count_on
    level = s.base + s.theta_off * passed[0] + s.theta_on * passed[1]
    if at.around.sign == 0:
        return level
    if lamp.blocks > 0:
        hz = c.hz + corner_of(level, c)
        before = ripple(lamp, hz, <double>at.last, &slope)
        at.around.flickers = lamp_flickers(lamp, <double>at.last, <double>at.last)
        if at.next != NEVER:
            at.around.drift = before - ripple(lamp, hz, <double>at.next, &slope)
        level += ripple(lamp, hz, <double>t, &slope) - before
    part_of(&at.around, c, part, rate)
    level += (s.theta_off * part[0] + s.theta_on * part[1]
              + drift_of(&at.around, c, &rise))
    slope += s.theta_off * rate[0] + s.theta_on * rate[1] + rise
    if slope == 0.0:
        return level
    return level + lead_of(slope, exp_f(<float>level), c)


def redundancy_sample(int64_t t, int64_t known, recent not None, model not None,
                      const policy_t[::1] policy not None, cells not None):
    """Add the intensities at t to the moments; move the counts to the states.

    recent is (store, pixels, first, last): the events first <= i < last have been
    committed since the last comparison, so only their macropixels change.  model is
    (numbers of a `PixelModel`, waves), cells (states, balance, moments).
    """
    cdef const stored_t[::1] store
    cdef pixel_t[:, ::1] pixels
    cdef const double[::1] numbers
    cdef const wave_t[::1] waves
    cdef state_t[:, ::1] states
    cdef balance_t[:, ::1] balance
    cdef moments_t[:, ::1] moments
    cdef const camera_t* c
    cdef Py_ssize_t h, w, first, last, i, k
    cdef uint32_t at, y, x, width
    cdef lamp_t lamp
    check_given((*recent[:2], *model, *cells))
    store, pixels, first, last = recent
    numbers, waves = model
    states, balance, moments = cells
    h = pixels.shape[0]
    w = pixels.shape[1]
    width = <uint32_t>w
    if (states.shape[0] != h or states.shape[1] != w or balance.shape[0] != h
            or balance.shape[1] != w or moments.shape[0] != h // 2
            or moments.shape[1] != w // 2):
        raise ValueError("redundancy_sample: all images must have one shape")
    if policy.shape[0] != 1 or first < 0 or last > store.shape[0]:
        raise ValueError("redundancy_sample: an array has a wrong length")
    c = camera_of(numbers)
    lamp = lamp_of(waves)
    with nogil:
        for i in range(first, last):
            if i + CELLS_AHEAD < last:
                at = <uint32_t>store[i + CELLS_AHEAD].pixel
                y = at // width // 2 * 2
                x = at % width // 2 * 2
                if y + 1 < h and x + 1 < w:
                    prefetch_all(&moments[y // 2, x // 2], sizeof(moments_t))
                    for k in range(2):
                        prefetch_all(&pixels[y + k, x], 2 * sizeof(pixel_t))
                        prefetch_all(&states[y + k, x], 2 * sizeof(state_t))
                        prefetch_all(&balance[y + k, x], 2 * sizeof(balance_t))
            at = <uint32_t>store[i].pixel
            y = at // width // 2 * 2
            x = at % width // 2 * 2
            if y + 1 < h and x + 1 < w:
                sample_cell(t, known, &store[0], y, x, c, &policy[0], &lamp, pixels,
                            states, balance, moments)


cdef void sample_cell(int64_t t, int64_t known, const stored_t* store, Py_ssize_t y0,
                      Py_ssize_t x0, const camera_t* c, const policy_t* policy,
                      const lamp_t* lamp, const pixel_t[:, ::1] pixels,
                      state_t[:, ::1] states, balance_t[:, ::1] balance,
                      moments_t[:, ::1] moments) noexcept nogil:
    """Sample one macropixel, unless its counts are those of the last comparison."""
    cdef double value[4]
    cdef double[4][2] passed
    cdef float log[4]
    cdef double level = 0.0, loss
    cdef bint quiet = True
    cdef Py_ssize_t y, x
    cdef state_t* s
    cdef int i
    for i in range(4):
        y = y0 + i // 2
        x = x0 + i % 2
        s = &states[y, x]
        if (pixels[y, x].at.count[0] != s.count_off
                or pixels[y, x].at.count[1] != s.count_on):
            quiet = False
    if quiet:
        return
    for i in range(4):
        y = y0 + i // 2
        x = x0 + i % 2
        log[i] = <float>log_at(t, known, store, c, lamp, &pixels[y, x], &states[y, x],
                               passed[i])
        level += CHANNEL_SHARE * log[i]
    loss = level * policy.loss
    for i in range(4):
        y = y0 + i // 2
        x = x0 + i % 2
        value[i] = balance[y, x].null * exp_f(<float>(log[i] - level))
        s = &states[y, x]
        s.base += s.theta_off * passed[i][0] + s.theta_on * passed[i][1] - loss
        s.count_off += passed[i][0]
        s.count_on += passed[i][1]
        if passed[i][0] != 0.0 or passed[i][1] != 0.0:
            remember(&balance[y, x], passed[i][1], -passed[i][0], policy.forget)
            rebalance(&balance[y, x], policy, s)
    add_moments(&moments[y0 // 2, x0 // 2], value, policy.keep)


def redundancy_solve(const policy_t[::1] policy not None,
                     moments_t[:, ::1] moments not None,
                     state_t[:, ::1] states not None):
    """Shift each base so that the gains of its macropixel become 1; set its ratio.

    Macropixels without a new comparison, or with too few in total, are left unchanged.
    """
    cdef Py_ssize_t rows = moments.shape[0], columns = moments.shape[1], r, c, i
    cdef Py_ssize_t[CELLS] row, column
    cdef cells_t cells
    cdef Py_ssize_t n = 0
    cdef moments_t* m
    if states.shape[0] // 2 != rows or states.shape[1] // 2 != columns:
        raise ValueError("redundancy_solve: all images must have one shape")
    if policy.shape[0] != 1:
        raise ValueError("redundancy_solve: policy must be one record")
    memset(&cells, 0, sizeof(cells))    # all lanes are computed, also unused ones
    with nogil:
        for r in range(rows):
            for c in range(columns):
                m = &moments[r, c]
                if m.since == 0.0 or m.weight < policy[0].least:
                    continue
                m.since = 0.0
                row[n] = r
                column[n] = c
                for i in range(PRODUCTS):
                    cells.product[i][n] = m.product[i]
                cells.weight[n] = m.weight
                n += 1
                if n == CELLS:
                    solve_cells(&cells, policy[0].pull)
                    apply_gains(&cells, row, column, n, moments, states)
                    n = 0
        if n > 0:
            solve_cells(&cells, policy[0].pull)
            apply_gains(&cells, row, column, n, moments, states)


cdef inline void apply_gains(const cells_t* cells, const Py_ssize_t* row,
                             const Py_ssize_t* column, Py_ssize_t n,
                             moments_t[:, ::1] moments,
                             state_t[:, ::1] states) noexcept nogil:
    """Write what solve_cells found of the first n macropixels."""
    cdef Py_ssize_t k, y, x
    cdef int i
    cdef moments_t* m
    for k in range(n):
        m = &moments[row[k], column[k]]
        m.ratio = <float>cells.ratio[k]
        m.smallest = <float>cells.smallest[k]
        if cells.smallest[k] >= 1.0:
            continue
        for i in range(4):
            y = 2 * row[k] + i // 2
            x = 2 * column[k] + i % 2
            states[y, x].base += cells.shift[i][k]
        for i in range(PRODUCTS):
            m.product[i] = cells.product[i][k]


def redundancy_read(int64_t t, int64_t known, recent not None, model not None,
                    const state_t[:, ::1] states not None, rows not None,
                    const uint8_t[:, ::1] wanted not None, float[:, ::1] log not None):
    """Write log intensity at t to rows (first, last), using events up to known >= t.

    recent is (store, pixels), model (numbers of a `PixelModel`, waves).  Pixels that
    are not wanted stay as they are.
    """
    cdef const stored_t[::1] store
    cdef const pixel_t[:, ::1] pixels
    cdef const double[::1] numbers
    cdef const wave_t[::1] waves
    cdef const camera_t* c
    cdef double[2] passed
    cdef Py_ssize_t h = states.shape[0], w = states.shape[1], y, x, first, last
    cdef lamp_t lamp
    first, last = rows
    check_given((*recent, *model))
    store, pixels = recent
    numbers, waves = model
    if (pixels.shape[0] != h or pixels.shape[1] != w or log.shape[0] != h
            or log.shape[1] != w or wanted.shape[0] != h or wanted.shape[1] != w):
        raise ValueError("redundancy_read: all images must have one shape")
    if store.shape[0] == 0:
        raise ValueError("redundancy_read: store must hold records")
    if first < 0 or last > h:
        raise ValueError("redundancy_read: rows must lie in the image")
    c = camera_of(numbers)
    lamp = lamp_of(waves)
    with nogil:
        for y in range(first, last):
            for x in range(w):
                if wanted[y, x]:
                    log[y, x] = <float>log_at(t, known, &store[0], c, &lamp,
                                              &pixels[y, x], &states[y, x], passed)


def saturated_events(const event_t[::1] events not None,
                     const int32_t[:, ::1] cell_of not None, Py_ssize_t columns,
                     event_t[::1] out not None):
    """Write the events of some macropixels, moved to the sensor that they make up.

    cell_of holds the number of each macropixel, or a negative one; that sensor has
    `columns` macropixels in a row.  Returns the number of events written.
    """
    cdef Py_ssize_t i, n = 0, rows = cell_of.shape[0], width = cell_of.shape[1]
    cdef Py_ssize_t y, x, cell
    if columns < 1:
        raise ValueError("saturated_events: columns must be positive")
    if out.shape[0] < events.shape[0]:
        raise ValueError("saturated_events: out is too short")
    with nogil:
        for i in range(events.shape[0]):
            y = events[i].y
            x = events[i].x
            if y // 2 >= rows or x // 2 >= width:
                continue
            cell = cell_of[y // 2, x // 2]
            if cell < 0:
                continue
            out[n].t = events[i].t
            out[n].y = <uint16_t>(cell // columns * 2 + y % 2)
            out[n].x = <uint16_t>(cell % columns * 2 + x % 2)
            out[n].p = events[i].p
            n += 1
    return n


def saturated_fill(cells not None, seen not None, const float[:, ::1] bound not None,
                   float prior, float excess, double dim, float valid_variance,
                   shown not None):
    """Weigh an estimate of frames and what events tell of the same macropixels.

    cells is (pixels, missing): by place in the cell and macropixel its index on the
    sensor and whether it is not known.  seen (log intensity, variance, enough, quality)
    is what events tell, in planes of the sensor that the macropixels make up row by
    row.  bound holds the last samples, which stand for pixels that are not known; prior
    is the variance where the mean squares of the four are taken equal, excess what that
    of the events is multiplied by, and dim the samples up to which frames are right
    where both contradict each other; shown is (log intensity, variance, valid).
    """
    cdef const Py_ssize_t[:, ::1] pixels
    cdef const uint8_t[:, ::1] missing
    cdef const float[:, ::1] seen_log, seen_variance, quality
    cdef const uint8_t[:, ::1] enough
    cdef float[:, ::1] log, variance
    cdef uint8_t[:, ::1] valid
    cdef Py_ssize_t n, columns, size, i, k, at, y0, x0, y, x
    cdef double apart, level, total, offset, weight, told, off, square, far, top
    cdef int number
    cdef bint known
    check_given((*cells, *seen, *shown))
    pixels, missing = cells
    seen_log, seen_variance, enough, quality = seen
    log, variance, valid = shown
    n = pixels.shape[1]
    columns = seen_log.shape[1] // 2
    size = log.shape[0] * log.shape[1]
    if pixels.shape[0] != 4 or missing.shape[0] != 4 or missing.shape[1] != n:
        raise ValueError("saturated_fill: pixels and missing must be (4, n)")
    for plane in seen[1:]:
        if plane.shape[0] != seen_log.shape[0] or plane.shape[1] != seen_log.shape[1]:
            raise ValueError("saturated_fill: seen must be planes of one shape")
    if seen_log.shape[0] // 2 * columns < n:
        raise ValueError("saturated_fill: seen must hold all macropixels")
    if (bound.shape[0] != log.shape[0] or bound.shape[1] != log.shape[1]
            or variance.shape[0] != log.shape[0] or variance.shape[1] != log.shape[1]
            or valid.shape[0] != log.shape[0] or valid.shape[1] != log.shape[1]):
        raise ValueError("saturated_fill: all images must have one shape")
    for i in range(n):
        for k in range(4):
            if pixels[k, i] < 0 or pixels[k, i] >= size:
                raise ValueError("saturated_fill: pixels must lie in the image")
    with nogil:
        for i in range(n):
            # The offset of a macropixel: from pixels that are known, else the bound.
            apart = level = total = square = far = 0.0
            top, number = (&bound[0, 0])[pixels[0, i]], 0
            y0 = i // columns * 2
            x0 = i % columns * 2
            known = False
            for k in range(4):
                known |= enough[y0 + k // 2, x0 + k % 2]
                if missing[k, i]:
                    (&log[0, 0])[pixels[k, i]] = (&bound[0, 0])[pixels[k, i]]
            if not known:
                continue
            for k in range(4):
                at = pixels[k, i]
                y = y0 + k // 2
                x = x0 + k % 2
                level += CHANNEL_SHARE * (&bound[0, 0])[at]
                top = max(top, <double>(&bound[0, 0])[at])
                if not missing[k, i]:
                    weight = 1.0 / ((&variance[0, 0])[at] + excess * (
                        seen_variance[y, x] + prior * quality[y, x]))
                    off = (&log[0, 0])[at] - seen_log[y, x]
                    number += 1
                    total += weight
                    apart += weight * off
                    square += weight * off * off
            # If they tell less of it than `valid_variance` asks for, it is not used.
            # Those that are not valid, sampled once long ago, are as good as unknown
            # where events tell enough.
            if total * valid_variance < 1.0:
                total = 0.0
            offset = apart / total if total > 0.0 else level
            if total > 0.0 and number > 1 and top <= dim:
                far = (square - apart * offset) / (DOUBTFUL * (number - 1))
            for k in range(4):
                at = pixels[k, i]
                y = y0 + k // 2
                x = x0 + k % 2
                known = not missing[k, i]
                if known and total == 0.0:
                    if not enough[y, x] or (&variance[0, 0])[at] <= valid_variance:
                        continue
                    known = False
                    (&log[0, 0])[at] = (&bound[0, 0])[at]
                if not enough[y, x]:
                    continue
                told = (1.0 + far * far) * excess * (
                    seen_variance[y, x] + prior * quality[y, x])
                if total > 0.0:
                    told += 1.0 / total     # of the offset
                weight = (&variance[0, 0])[at] / ((&variance[0, 0])[at] + told) if (
                    known) else 1.0
                (&log[0, 0])[at] += <float>(weight * (
                    seen_log[y, x] + offset - (&log[0, 0])[at]))
                (&variance[0, 0])[at] = <float>(
                    (1.0 - weight) * (&variance[0, 0])[at] if known else told)
                (&valid[0, 0])[at] = (&variance[0, 0])[at] <= valid_variance
