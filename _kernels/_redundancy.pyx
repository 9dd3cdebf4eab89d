"""Gains of the four pixels of a macropixel from events alone.

For any light n . I = 0, where n is the left null vector of the four responses.  With
I_i = a_i exp(E_i), where E_i is the sum of events, this is linear in the unknown gains
a.  For equal relative errors the solution is the eigenvector of the smallest eigenvalue
of the moments of n_i exp(E_i).  See docs/theory/events.md.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int64_t, uint8_t

from _kernels._estimate cimport read_level, reading_t, walk_to
from _kernels._lamp cimport lamp_of, lamp_t
from _kernels._listing cimport CHANGED
from _kernels._math cimport exp_f, log_f
from _kernels._model cimport (
    check_given, state_t, stored_t, track_t, tuning_t, wave_t)

cdef packed struct policy_t:
    double keep             # decay factor of the moments, per comparison
    double ratio_sigma      # prior sigma of ln(theta_on / theta_off)
    double forget           # decay rate of the balance, per event
    double loss             # fraction of a macropixel's level lost per comparison
    double pull             # ridge weight to equal mean squares, relative variance
    double least            # number of comparisons needed for the first solution

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
    /* A line fitted to N periods has an error of up to 3 / (2 N)^2 (see rebalance). */
    #define LINE_ERROR 3.0
    /* A pixel whose ratio is farther from the prior than this many such errors is an
       outlier: two sigma of the errors that light with fast and slow motion causes in
       its first period (studies/redundancy_far.py). */
    #define FAR_ERRORS 1.7
    #define PART_LEAST 0.05         /* bounds the fraction of ON, and of OFF, events */
    #define GAIN_LEAST 0.02         /* least gain of a unit vector that counts as > 0 */
    #define ROUNDED 1e-14           /* an off-diagonal element below this is 0 */
    #define DEAD 1e-12              /* a pixel below this share of moments is dark */
    #define SWEEPS 6                /* Jacobi sweeps, after which 4x4 has converged */
    #define RATIO_LEAST 1e-6        /* lower bound of an eigenvalue, by rounding */
    """
    const double LINE_ERROR
    const double FAR_ERRORS
    const double PART_LEAST
    const double GAIN_LEAST
    const double ROUNDED
    const double DEAD
    const int SWEEPS
    const double RATIO_LEAST


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


cdef inline void rebalance(const balance_t* m, double sigma, state_t* s) noexcept nogil:
    """Set the thresholds so that the sum of events has no trend.

    Their sum is that of the prior, and sigma is the prior's of ln(on / off).  For a
    pixel farther from the prior than the line's error explains, the prior is widened.
    """
    cdef double total = s.prior_on + s.prior_off, travel = 0.25 * total * m.weight
    cdef double before, part, swing, error, ratio, believed
    if m.var_all <= 0.0:
        return
    # A line fitted to N periods has an error of up to 3 / (2 N)^2.  1 / (2 N) is
    # estimated as the swing of the sum of events over their number: the total swing,
    # or that about the line once light with a range of e^4 must have turned round.
    part = m.cov_on / m.var_all
    swing = s.prior_off / total
    swing = 4.0 * (m.var_on / m.var_all - 2.0 * swing * part + swing * swing)
    if swing >= 1.0:
        return
    error = 4.0 * (m.var_on / m.var_all - part * part)
    error = error if error > 4.0 / (travel * travel) else 4.0 / (travel * travel)
    error = LINE_ERROR * (error if error < swing else swing)
    part = part if part > PART_LEAST else PART_LEAST
    part = part if part < 1.0 - PART_LEAST else 1.0 - PART_LEAST
    before = log_f(<float>(s.prior_on / s.prior_off))
    ratio = log_f(<float>((1.0 - part) / part)) - before
    believed = FAR_ERRORS * error
    believed = ratio * ratio - believed * believed
    believed = believed if believed > sigma * sigma else sigma * sigma
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


def redundancy_sample(int64_t t, int64_t known, chain not None,
                      const stored_t[::1] events not None, model not None,
                      const policy_t[::1] policy not None, cells not None,
                      uint8_t[:, ::1] listed not None):
    """Add the intensities at t to the moments; move the counts to the states.

    chain is (store, tracks that chain the events after those counted), model (tuning,
    waves), cells (states, balance, moments).  events are those counted since the last
    comparison: only their macropixels change.  Pixels whose states change are flagged
    in listed (see _listing.pxd).
    """
    cdef const stored_t[::1] store
    cdef track_t[:, ::1] tracks
    cdef const tuning_t[::1] tuning
    cdef const wave_t[::1] waves
    cdef state_t[:, ::1] states
    cdef balance_t[:, ::1] balance
    cdef moments_t[:, ::1] moments
    cdef Py_ssize_t h, w, i
    cdef lamp_t lamp
    check_given((*chain, *model, *cells))
    store, tracks = chain
    tuning, waves = model
    states, balance, moments = cells
    h = tracks.shape[0]
    w = tracks.shape[1]
    if (states.shape[0] != h or states.shape[1] != w or balance.shape[0] != h
            or balance.shape[1] != w or moments.shape[0] != h // 2
            or moments.shape[1] != w // 2 or listed.shape[0] != h
            or listed.shape[1] != w):
        raise ValueError("redundancy_sample: all images must have one shape")
    if tuning.shape[0] != 1 or policy.shape[0] != 1 or store.shape[0] == 0:
        raise ValueError("redundancy_sample: an array has a wrong length")
    lamp = lamp_of(waves)
    with nogil:
        for i in range(events.shape[0]):
            if events[i].y < h // 2 * 2 and events[i].x < w // 2 * 2:
                sample_cell(t, known, &store[0], events[i].y // 2 * 2,
                            events[i].x // 2 * 2, &tuning[0], &policy[0], &lamp, tracks,
                            states, balance, moments, listed)


cdef void sample_cell(int64_t t, int64_t known, const stored_t* store, Py_ssize_t y0,
                      Py_ssize_t x0, const tuning_t* tuning, const policy_t* policy,
                      const lamp_t* lamp, track_t[:, ::1] tracks,
                      state_t[:, ::1] states, balance_t[:, ::1] balance,
                      moments_t[:, ::1] moments,
                      uint8_t[:, ::1] listed) noexcept nogil:
    """Sample one macropixel, unless its counts are 0: then it has been done."""
    cdef reading_t r
    cdef double value[4]
    cdef float log[4]
    cdef double level = 0.0, loss, n_on, n_off
    cdef bint quiet = True
    cdef Py_ssize_t y, x
    cdef track_t* track
    cdef state_t* s
    cdef int i
    for i in range(4):
        track = &tracks[y0 + i // 2, x0 + i % 2]
        if track.n_on != 0 or track.n_off != 0:
            quiet = False
    if quiet:
        return
    for i in range(4):
        y = y0 + i // 2
        x = x0 + i % 2
        walk_to(&r.walk, t, store, &tracks[y, x], tuning.refractory_us)
        read_level(&r, t, known, store, tuning, lamp, &states[y, x])
        log[i] = <float>(r.level + r.lag)
        level += 0.25 * log[i]
    loss = level * policy.loss
    for i in range(4):
        y = y0 + i // 2
        x = x0 + i % 2
        value[i] = balance[y, x].null * exp_f(<float>(log[i] - level))
        track = &tracks[y, x]
        s = &states[y, x]
        n_on = track.n_on
        n_off = track.n_off
        s.base += s.theta_on * n_on - s.theta_off * n_off - loss
        track.n_on = 0
        track.n_off = 0
        listed[y, x] |= CHANGED
        if n_on + n_off > 0.0:
            remember(&balance[y, x], n_on, n_off, policy.forget)
            rebalance(&balance[y, x], policy.ratio_sigma, s)
    add_moments(&moments[y0 // 2, x0 // 2], value, policy.keep)


cdef inline void rotate(double* a, double* v, int p, int q) noexcept nogil:
    """Apply a Jacobi rotation to the symmetric matrix a (4x4) and to eigenvectors v."""
    cdef double theta, t, c, s, x, y
    cdef int k
    if fabs(a[4 * p + q]) < ROUNDED:
        return
    theta = 0.5 * (a[5 * q] - a[5 * p]) / a[4 * p + q]
    t = 1.0 / (fabs(theta) + sqrt(theta * theta + 1.0))
    t = t if theta >= 0.0 else -t
    c = 1.0 / sqrt(t * t + 1.0)
    s = t * c
    for k in range(4):
        x = a[4 * k + p]
        y = a[4 * k + q]
        a[4 * k + p] = c * x - s * y
        a[4 * k + q] = s * x + c * y
    for k in range(4):
        x = a[4 * p + k]
        y = a[4 * q + k]
        a[4 * p + k] = c * x - s * y
        a[4 * q + k] = s * x + c * y
        x = v[4 * k + p]
        y = v[4 * k + q]
        v[4 * k + p] = c * x - s * y
        v[4 * k + q] = s * x + c * y


cdef inline double smallest(const moments_t* m, double pull, double* gain,
                            double* least) noexcept nogil:
    """Set the gains; return the ratio of the two smallest eigenvalues, 1 if none fits.

    least is set to the smallest eigenvalue, a relative variance, if there are gains.
    """
    cdef double a[16]
    cdef double v[16]
    cdef double scale[4]
    cdef double low, other, sign = 0.0
    cdef int i, j, k = 0, at = 0
    for i in range(4):
        k = (4 * i) - (i * (i - 1)) // 2
        if m.product[k] <= DEAD * m.weight:
            return 1.0
        scale[i] = 1.0 / sqrt(m.product[k])
    k = 0
    for i in range(4):
        for j in range(i, 4):
            a[4 * i + j] = m.product[k] * scale[i] * scale[j] - 0.25 * pull
            a[4 * j + i] = a[4 * i + j]
            k += 1
        a[5 * i] += pull
        for j in range(4):
            v[4 * i + j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        for i in range(3):
            for j in range(i + 1, 4):
                rotate(a, v, i, j)
    for i in range(1, 4):
        if a[5 * i] < a[5 * at]:
            at = i
    low = a[5 * at]
    other = a[5 * (0 if at else 1)]
    for i in range(4):
        if i != at and a[5 * i] < other:
            other = a[5 * i]
        sign += v[4 * i + at]
    for i in range(4):
        gain[i] = v[4 * i + at] if sign > 0.0 else -v[4 * i + at]
        if gain[i] < GAIN_LEAST:
            return 1.0
        gain[i] *= scale[i]
    least[0] = low if low > RATIO_LEAST else RATIO_LEAST
    other -= pull              # without the ridge
    return least[0] / other if other > least[0] else 1.0


def redundancy_solve(const policy_t[::1] policy not None,
                     moments_t[:, ::1] moments not None,
                     state_t[:, ::1] states not None, uint8_t[:, ::1] listed not None):
    """Shift each base so that the gains of its macropixel become 1; set its ratio.

    Macropixels without a new comparison, or with too few in total, are left unchanged.
    Pixels whose bases change are flagged in listed (see _listing.pxd).
    """
    cdef Py_ssize_t rows = moments.shape[0], columns = moments.shape[1], r, c
    cdef double gain[4]
    cdef double mean, rest
    cdef int i, j, k
    cdef moments_t* m
    if (states.shape[0] // 2 != rows or states.shape[1] // 2 != columns
            or listed.shape[0] != states.shape[0]
            or listed.shape[1] != states.shape[1]):
        raise ValueError("redundancy_solve: all images must have one shape")
    if policy.shape[0] != 1:
        raise ValueError("redundancy_solve: policy must be one record")
    with nogil:
        for r in range(rows):
            for c in range(columns):
                m = &moments[r, c]
                if m.since == 0.0 or m.weight < policy[0].least:
                    continue
                m.since = 0.0
                rest = 1.0
                m.ratio = <float>smallest(m, policy[0].pull, gain, &rest)
                m.smallest = <float>rest
                if rest >= 1.0:
                    continue
                mean = 0.0
                for i in range(4):
                    gain[i] = log_f(<float>gain[i])
                    mean += 0.25 * gain[i]
                for i in range(4):
                    gain[i] -= mean
                    states[2 * r + i // 2, 2 * c + i % 2].base += gain[i]
                    listed[2 * r + i // 2, 2 * c + i % 2] |= CHANGED
                    gain[i] = exp_f(<float>gain[i])
                k = 0
                for i in range(4):
                    for j in range(i, 4):
                        m.product[k] *= gain[i] * gain[j]
                        k += 1


def redundancy_shown(const moments_t[:, ::1] moments not None,
                     float[:, ::1] ratio not None, float[:, ::1] smallest not None):
    """Write each macropixel's ratio and smallest eigenvalue to its pixels; else 1."""
    cdef Py_ssize_t h = ratio.shape[0], w = ratio.shape[1], y, x
    cdef float one, rest
    if (moments.shape[0] != h // 2 or moments.shape[1] != w // 2
            or smallest.shape[0] != h or smallest.shape[1] != w):
        raise ValueError("redundancy_shown: all images must have one shape")
    with nogil:
        for y in range(h // 2):
            for x in range(w // 2):
                one = moments[y, x].ratio
                rest = moments[y, x].smallest
                ratio[2 * y, 2 * x] = one
                ratio[2 * y, 2 * x + 1] = one
                ratio[2 * y + 1, 2 * x] = one
                ratio[2 * y + 1, 2 * x + 1] = one
                smallest[2 * y, 2 * x] = rest
                smallest[2 * y, 2 * x + 1] = rest
                smallest[2 * y + 1, 2 * x] = rest
                smallest[2 * y + 1, 2 * x + 1] = rest
        for y in range(h):
            for x in range(0 if y >= h // 2 * 2 else w // 2 * 2, w):
                ratio[y, x] = 1.0
                smallest[y, x] = 1.0


def saturated_fill(cells not None, seen not None, const float[:, ::1] bound not None,
                   float prior, float excess, float valid_variance, shown not None):
    """Weigh an estimate of frames and what events tell of the same macropixels.

    cells is (pixels, missing, columns): by place in the cell and macropixel its index
    on the sensor and whether it is not known; and the first column of the macropixel
    in the planes that events tell, seen (log intensity, variance, enough, quality),
    two rows high.  bound holds the last samples; prior is the variance where the mean
    squares of the four are taken equal, excess what that of the events is multiplied
    by; shown is (log intensity, variance, valid).
    """
    cdef const Py_ssize_t[:, ::1] pixels
    cdef const uint8_t[:, ::1] missing
    cdef const Py_ssize_t[::1] columns
    cdef const float[:, ::1] seen_log, seen_variance, quality
    cdef const uint8_t[:, ::1] enough
    cdef float[:, ::1] log, variance
    cdef uint8_t[:, ::1] valid
    cdef Py_ssize_t n, width, size, i, k, at, x
    cdef double apart, level, total, offset, weight, told
    cdef bint known
    check_given((*cells, *seen, *shown))
    pixels, missing, columns = cells
    seen_log, seen_variance, enough, quality = seen
    log, variance, valid = shown
    n = columns.shape[0]
    width = seen_log.shape[1]
    size = log.shape[0] * log.shape[1]
    if (pixels.shape[0] != 4 or pixels.shape[1] != n or missing.shape[0] != 4
            or missing.shape[1] != n):
        raise ValueError("saturated_fill: pixels and missing must be (4, n)")
    if (seen_log.shape[0] != 2 or seen_variance.shape[0] != 2 or enough.shape[0] != 2
            or quality.shape[0] != 2 or seen_variance.shape[1] != width
            or enough.shape[1] != width or quality.shape[1] != width):
        raise ValueError("saturated_fill: seen must be planes of one shape, two rows")
    if (bound.shape[0] != log.shape[0] or bound.shape[1] != log.shape[1]
            or variance.shape[0] != log.shape[0] or variance.shape[1] != log.shape[1]
            or valid.shape[0] != log.shape[0] or valid.shape[1] != log.shape[1]):
        raise ValueError("saturated_fill: all images must have one shape")
    for i in range(n):
        if columns[i] < 0 or columns[i] + 2 > width:
            raise ValueError("saturated_fill: columns must lie in seen")
        for k in range(4):
            if pixels[k, i] < 0 or pixels[k, i] >= size:
                raise ValueError("saturated_fill: pixels must lie in the image")
    with nogil:
        for i in range(n):
            # The offset of a macropixel: from pixels that are known, else the bound.
            apart = level = total = 0.0
            for k in range(4):
                at = pixels[k, i]
                x = columns[i] + k % 2
                level += 0.25 * (&bound[0, 0])[at]
                if not missing[k, i]:
                    weight = 1.0 / ((&variance[0, 0])[at] + excess * (
                        seen_variance[k // 2, x] + prior * quality[k // 2, x]))
                    total += weight
                    apart += weight * ((&log[0, 0])[at] - seen_log[k // 2, x])
            offset = apart / total if total > 0.0 else level
            for k in range(4):
                at = pixels[k, i]
                x = columns[i] + k % 2
                known = not missing[k, i]
                if not enough[k // 2, x]:
                    continue
                told = excess * (seen_variance[k // 2, x] + prior * quality[k // 2, x])
                if total > 0.0:
                    told += 1.0 / total     # of the offset
                weight = (&variance[0, 0])[at] / ((&variance[0, 0])[at] + told) if (
                    known) else 1.0
                (&log[0, 0])[at] += <float>(weight * (
                    seen_log[k // 2, x] + offset - (&log[0, 0])[at]))
                (&variance[0, 0])[at] = <float>(
                    (1.0 - weight) * (&variance[0, 0])[at] if known else told)
                (&valid[0, 0])[at] = (&variance[0, 0])[at] <= valid_variance
