"""Gains of the four pixels of a macropixel from events alone.

For all light n . I = 0, n the left null vector of the four responses.  With I_i =
a_i exp(E_i), E_i the sum of events, that is linear in the unknown gains a: the smallest
eigenvector of the moments of n_i exp(E_i), relative errors being equal: see
docs/theory/events.md.
"""
from libc.math cimport fabs, sqrt

from _kernels._math cimport exp_f, log_f
from _kernels._tracks cimport track_t

# What a pixel remembers of its counts: weight, means relative to now of all events and
# of ON events, their squares and product about the means.
cdef enum:
    WEIGHT = 0
    MEAN_ALL = 1
    MEAN_ON = 2
    VAR_ALL = 3
    COV_ON = 4
    VAR_ON = 5
    BALANCE = 6

# Moments of a macropixel: ten products, the weight, samples since the last solution.
cdef enum:
    SUM = 10
    SINCE = 11
    MOMENTS = 12


cdef inline void remember(double* m, double n_on, double n_off,
                          double per_event) noexcept nogil:
    """Add a point of the curve of ON events against all events."""
    cdef double n = n_on + n_off, keep = exp_f(<float>(-n * per_event)), w, all_, on
    m[MEAN_ALL] -= n
    m[MEAN_ON] -= n_on
    m[WEIGHT] *= keep
    m[VAR_ALL] *= keep
    m[COV_ON] *= keep
    m[VAR_ON] *= keep
    w = m[WEIGHT] + n
    all_ = -m[MEAN_ALL]
    on = -m[MEAN_ON]
    m[VAR_ALL] += n * m[WEIGHT] / w * all_ * all_
    m[COV_ON] += n * m[WEIGHT] / w * all_ * on
    m[VAR_ON] += n * m[WEIGHT] / w * on * on
    m[MEAN_ALL] += all_ * n / w
    m[MEAN_ON] += on * n / w
    m[WEIGHT] = w


cdef inline void rebalance(const double* m, const double* prior, double sigma,
                           double* s) noexcept nogil:
    """Set thresholds (sum as in prior) so that the sum of events has no trend.

    sigma is that of ln(on / off) before.  A pixel that is far from the prior is taken
    for what it is as soon as its events show it.
    """
    cdef double total = prior[0] + prior[1], travel = 0.25 * total * m[WEIGHT]
    cdef double before, part, swing, error, ratio, believed
    if m[VAR_ALL] <= 0.0:
        return
    # A line through N periods is wrong by up to 3 / (2 N)^2.  1 / (2 N) is the swing
    # of the sum of events by their number: of all of it, or of what the line leaves
    # once light of a range of e^4 must have turned round.
    part = m[COV_ON] / m[VAR_ALL]
    swing = prior[1] / total
    swing = 4.0 * (m[VAR_ON] / m[VAR_ALL] - 2.0 * swing * part + swing * swing)
    if swing >= 1.0:
        return
    error = 4.0 * (m[VAR_ON] / m[VAR_ALL] - part * part)
    error = error if error > 4.0 / (travel * travel) else 4.0 / (travel * travel)
    error = 3.0 * (error if error < swing else swing)
    part = part if part > 0.05 else 0.05
    part = part if part < 0.95 else 0.95
    before = log_f(<float>(prior[0] / prior[1]))
    ratio = log_f(<float>((1.0 - part) / part)) - before
    believed = ratio * ratio - error * error
    believed = believed if believed > sigma * sigma else sigma * sigma
    ratio = exp_f(<float>(before + ratio * believed / (believed + error * error)))
    s[1] = total * ratio / (1.0 + ratio)
    s[2] = total - s[1]


cdef inline void add_moments(double* m, const double* value,
                             double keep) noexcept nogil:
    cdef double norm = 0.0
    cdef int i, j, k = 0
    for i in range(4):
        norm += value[i] * value[i]
    norm = 1.0 / norm
    for i in range(4):
        for j in range(i, 4):
            m[k] = m[k] * keep + value[i] * value[j] * norm
            k += 1
    m[SUM] = m[SUM] * keep + 1.0
    m[SINCE] += 1.0


def redundancy_sample(const float[:, ::1] log not None,
                      const float[:, ::1] null not None,
                      const double[:, :, ::1] prior not None,
                      const double[::1] tuning not None,
                      track_t[:, ::1] tracks not None,
                      double[:, :, ::1] state not None,
                      double[:, :, ::1] balance not None,
                      double[:, :, ::1] moments not None):
    """Take the intensities of one time; fold the counts in tracks into the state.

    log is what the state and tracks show at that time.  state is (row, column, (base,
    on, off, ...)) as for `kalman_read`.  Macropixels without an event since the last
    time are left alone.  tuning: what is kept of the moments, sigma of ln(on / off),
    what is forgotten of the balance per event, and what the level loses.
    """
    cdef Py_ssize_t h = log.shape[0], w = log.shape[1], rows = h // 2, columns = w // 2
    cdef Py_ssize_t r, c, y, x
    cdef int i
    cdef double value[4]
    cdef double level, loss, n_on, n_off
    cdef bint quiet
    cdef double* s
    if (null.shape[0] != h or null.shape[1] != w or prior.shape[0] != h
            or prior.shape[1] != w or tracks.shape[0] != h or tracks.shape[1] != w
            or state.shape[0] != h or state.shape[1] != w or balance.shape[0] != h
            or balance.shape[1] != w or moments.shape[0] != rows
            or moments.shape[1] != columns):
        raise ValueError("redundancy_sample: all images must have one shape")
    if (prior.shape[2] != 2 or state.shape[2] != 9 or balance.shape[2] != BALANCE
            or moments.shape[2] != MOMENTS or tuning.shape[0] != 4):
        raise ValueError("redundancy_sample: an array has a wrong length")
    with nogil:
        for r in range(rows):
            for c in range(columns):
                quiet = True
                level = 0.0
                for i in range(4):
                    y = 2 * r + i // 2
                    x = 2 * c + i % 2
                    level += 0.25 * log[y, x]
                    if tracks[y, x].n_on != 0 or tracks[y, x].n_off != 0:
                        quiet = False
                if quiet:
                    continue
                loss = level * tuning[3]
                for i in range(4):
                    y = 2 * r + i // 2
                    x = 2 * c + i % 2
                    value[i] = null[y, x] * exp_f(<float>(log[y, x] - level))
                    s = &state[y, x, 0]
                    n_on = tracks[y, x].n_on
                    n_off = tracks[y, x].n_off
                    s[0] += s[1] * n_on - s[2] * n_off - loss
                    tracks[y, x].n_on = 0
                    tracks[y, x].n_off = 0
                    if n_on + n_off > 0.0:
                        remember(&balance[y, x, 0], n_on, n_off, tuning[2])
                        rebalance(&balance[y, x, 0], &prior[y, x, 0], tuning[1], s)
                add_moments(&moments[r, c, 0], value, tuning[0])


cdef inline void rotate(double* a, double* v, int p, int q) noexcept nogil:
    """One Jacobi rotation of the symmetric 4x4 matrix a; v collects eigenvectors."""
    cdef double theta, t, c, s, x, y
    cdef int k
    if fabs(a[4 * p + q]) < 1e-14:
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


cdef inline double smallest(const double* m, double pull, double* gain,
                            double* least) noexcept nogil:
    """Gains from moments; the ratio of the two smallest eigenvalues, 1 if none fits.

    Sets least to the smallest, which is a relative variance; leaves it without gains.
    """
    cdef double a[16]
    cdef double v[16]
    cdef double scale[4]
    cdef double low, other, sign = 0.0
    cdef int i, j, k = 0, at = 0
    for i in range(4):
        k = (4 * i) - (i * (i - 1)) // 2
        if m[k] <= 1e-12 * m[SUM]:
            return 1.0
        scale[i] = 1.0 / sqrt(m[k])
    k = 0
    for i in range(4):
        for j in range(i, 4):
            a[4 * i + j] = m[k] * scale[i] * scale[j] - 0.25 * pull
            a[4 * j + i] = a[4 * i + j]
            k += 1
        a[5 * i] += pull
        for j in range(4):
            v[4 * i + j] = 1.0 if i == j else 0.0
    for _ in range(6):
        for i in range(3):
            for j in range(i + 1, 4):
                rotate(a, v, i, j)
    for i in range(1, 4):
        if a[5 * i] < a[5 * at]:
            at = i
    low = a[5 * at]
    other = 1e300
    for i in range(4):
        if i != at and a[5 * i] < other:
            other = a[5 * i]
        sign += v[4 * i + at]
    for i in range(4):
        gain[i] = v[4 * i + at] if sign > 0.0 else -v[4 * i + at]
        if gain[i] < 0.02:
            return 1.0
        gain[i] *= scale[i]
    least[0] = low if low > 1e-6 else 1e-6
    other -= pull              # what the moments themselves say
    return least[0] / other if other > least[0] else 1.0


def redundancy_solve(double pull, double least, double[:, :, ::1] moments not None,
                     double[:, :, ::1] state not None,
                     float[:, :, ::1] quality not None):
    """Move each base so that the gains of its macropixel become 1; set quality.

    quality is (row, column, (ratio, least)): the ratio of the two smallest eigenvalues,
    1 without solution, and the smallest.  Macropixels with fewer than `least` samples
    are left alone.  pull is what a direction
    other than that of equal mean squares costs.
    """
    cdef Py_ssize_t rows = moments.shape[0], columns = moments.shape[1]
    cdef Py_ssize_t r, c
    cdef double gain[4]
    cdef double mean, rest
    cdef int i, j, k
    cdef double* m
    if (state.shape[0] // 2 != rows or state.shape[1] // 2 != columns
            or quality.shape[0] != rows or quality.shape[1] != columns
            or quality.shape[2] != 2):
        raise ValueError("redundancy_solve: all images must have one shape")
    if moments.shape[2] != MOMENTS or state.shape[2] != 9:
        raise ValueError("redundancy_solve: an array has a wrong length")
    with nogil:
        for r in range(rows):
            for c in range(columns):
                m = &moments[r, c, 0]
                if m[SINCE] == 0.0 or m[SUM] < least:
                    continue
                m[SINCE] = 0.0
                rest = 1.0
                quality[r, c, 0] = <float>smallest(m, pull, gain, &rest)
                quality[r, c, 1] = <float>rest
                if rest >= 1.0:
                    continue
                mean = 0.0
                for i in range(4):
                    gain[i] = log_f(<float>gain[i])
                    mean += 0.25 * gain[i]
                for i in range(4):
                    gain[i] -= mean
                    state[2 * r + i // 2, 2 * c + i % 2, 0] += gain[i]
                    gain[i] = exp_f(<float>gain[i])
                k = 0
                for i in range(4):
                    for j in range(i, 4):
                        m[k] *= gain[i] * gain[j]
                        k += 1
