"""Regression of each pixel's events on the angle of a turning analyser.

The light behind it is I = S0/2 (1 + q1 cos 2a + q2 sin 2a).  Between two successive
events of a pixel ln I changes by the threshold of the second: a row that is linear in
q, as no level is needed (docs/theory/turning.md, in the same symbols).  A pixel's cell
holds the sums of its normal equations: those of q, which fade, and those of q with
both thresholds, which stay.
"""
from libc.stdint cimport int64_t, uint8_t

from _kernels._math cimport exp_f, log_f
from _kernels._types cimport event_t

cdef extern from "<math.h>" nogil:
    float sqrtf(float)
    double floor(double)

cdef extern from "_scenes.h" nogil:
    void sincos_d "scene_sincos"(double, double*, double*)

cdef extern from "_prefetch.h" nogil:
    const Py_ssize_t AHEAD "PDAVIS_AHEAD"
    void prefetch_all "PDAVIS_PREFETCH_ALL"(const void*, size_t)

cdef extern from *:
    """
    #define TWO_PI 6.283185307179586
    #define PI 3.1415927f
    #define HALF_PI 1.5707964f
    #define SIN3 -1.6666667e-1f     /* Taylor's, to 4e-6 at half pi */
    #define SIN5 8.3333333e-3f
    #define SIN7 -1.9841270e-4f
    #define SIN9 2.7557319e-6f
    #define COS2 -0.5f
    #define COS4 4.1666667e-2f
    #define COS6 -1.3888889e-3f
    #define COS8 2.4801587e-5f
    #define COS10 -2.7557319e-7f
    #define HALF 0.5f           /* a literal is a double to Cython */
    #define QUARTER 0.25f
    #define LEAST_DET 1e-20f
    #define DARKEST 0.02f       /* of 1 + q: least intensity in a weight, relative */
    #define FEW 0.8f            /* most that an event fades those before it: where fewer
                                   than some five come in a window, it is longer */
    #define GUESS 0.0256f       /* weight of a row of the middle of a gap: its level is
                                   known to 0.25 thresholds, an event's to 0.04 */
    #define ROW_FLOOR 0.02f     /* least error of an event's row, thresholds */
    #define MOST_ROWS 1024.0f   /* rows of the lasting sums, which then stay */
    #define RATIO 2             /* of the time constants of `rest` and of q */
    #define OUTLIER 0.25f       /* residual that halves a row's weight, thresholds */
    #define LEAST_LEARNT 8.0f   /* rows of a pixel whose thresholds are learned */
    #define STILL 0.08f         /* most error of a row where only the analyser turns */
    #define STRONG 0.3f         /* degree at which the curve's shape tells thresholds */
    #define LONGEST_STEP 0.2f   /* of ln threshold at once */
    #define WIDE 0.5f           /* of q where nothing is known of it */
    #define SILENT 0.35f        /* spread of q after a period without events,
                                   thresholds: a swing, 2 q, of up to one */
    #define PRIOR_ROWS 1.0f     /* rows that say that the error is ROW_FLOOR */
    #define ATANH3 0.33333333f  /* of atanh(x) / x; the last one for all that follow */
    #define ATANH5 0.2f
    #define ATANH7 0.35f
    #define MOST_ANGLE 0.9068997f       /* of a random angle: pi / sqrt(12) */
    #define LEAST_ROWS 1.0f     /* of a usable pixel; its most errors of DoLP, AoP: */
    #define UNKNOWN 0.1f
    #define UNSURE 0.2f
    """
    const double TWO_PI
    const float PI, HALF_PI, SIN3, SIN5, SIN7, SIN9, COS2, COS4, COS6, COS8, COS10
    const int RATIO
    const float FEW, HALF, QUARTER, LEAST_DET, DARKEST, GUESS, ROW_FLOOR, MOST_ROWS
    const float LONGEST_STEP, WIDE, OUTLIER, STRONG, STILL, LEAST_LEARNT
    const float ATANH3, ATANH5, ATANH7, SILENT, PRIOR_ROWS, MOST_ANGLE, LEAST_ROWS
    const float UNKNOWN, UNSURE

cdef struct cell_t:      # 128 bytes without gaps
    double t            # of the last event, us; -inf before the first
    float c, s          # cos 2a, sin 2a then
    float s1, s2        # fading sums of rows times their errors before they were added
    float on, off       # exp of half the thresholds
    float sign          # of the last event
    float rest          # ln of what changed and is no modulation; it fades
    float a11, a12, a22, b1, b2, yy, n                      # fading sums
    float l11, l12, l22, m1, m2, zz                         # lasting sums
    float n1, g1, h1, y1                                    # of ON rows
    float n0, g0, h0, y0                                    # of OFF rows
    float scale                                             # error of ln threshold


cdef inline float seen(float q1, float q2, float c, float s) noexcept nogil:
    """Return the intensity in units of S0/2, at least DARKEST."""
    cdef float light = 1 + q1 * c + q2 * s
    return light if light > DARKEST else DARKEST


cdef inline float solve(float a11, float a12, float a22, float b1, float b2,
                        float* q1, float* q2) noexcept nogil:
    """Solve for q, at most fully polarized; return 1 / determinant."""
    cdef float det = a11 * a22 - a12 * a12, length
    det = 1 / (det if det > LEAST_DET else LEAST_DET)
    q1[0] = (a22 * b1 - a12 * b2) * det
    q2[0] = (a11 * b2 - a12 * b1) * det
    length = q1[0] * q1[0] + q2[0] * q2[0]
    if length > 1:
        length = 1 / sqrtf(length)
        q1[0] *= length
        q2[0] *= length
    return det


cdef inline void half_turn(double angle, float* cosine, float* sine) noexcept nogil:
    """Cosine and sine of an angle in float32, to 4e-6."""
    cdef double k = floor(angle * (1 / TWO_PI) + 0.5)
    cdef float x = <float>(angle - k * TWO_PI), z, flip = 1
    if x > HALF_PI:
        x = PI - x
        flip = -1
    elif x < -HALF_PI:
        x = -PI - x
        flip = -1
    z = x * x
    sine[0] = x * (1 + z * (SIN3 + z * (SIN5 + z * (SIN7 + z * SIN9))))
    cosine[0] = flip * (
        1 + z * (COS2 + z * (COS4 + z * (COS6 + z * (COS8 + z * COS10)))))


cdef inline void fade(cell_t* cell, float by) noexcept nogil:
    cell.a11 *= by
    cell.a12 *= by
    cell.a22 *= by
    cell.b1 *= by
    cell.b2 *= by
    cell.yy *= by
    cell.n *= by
    cell.s1 *= by
    cell.s2 *= by


cdef inline void add(cell_t* cell, float g, float h, float y, float weight,
                     float rows) noexcept nogil:
    cdef float wg = weight * g, wh = weight * h
    cell.a11 += wg * g
    cell.a12 += wg * h
    cell.a22 += wh * h
    cell.b1 += wg * y
    cell.b2 += wh * y
    cell.yy += weight * y * y
    cell.n += rows


cdef inline void keep(cell_t* cell, float g, float h, float y, float rest,
                      bint up) noexcept nogil:
    """Add a row to the lasting sums, with less weight if an event was noise."""
    cdef float weight = 1 / (1 + rest * rest)
    cdef float wg = weight * g, wh = weight * h, wy = weight * y
    cell.l11 += wg * g
    cell.l12 += wg * h
    cell.l22 += wh * h
    cell.m1 += wg * y
    cell.m2 += wh * y
    cell.zz += wy * y
    if up:
        cell.n1 += weight
        cell.g1 += wg
        cell.h1 += wh
        cell.y1 += wy
    else:
        cell.n0 += weight
        cell.g0 += wg
        cell.h0 += wh
        cell.y0 += wy


cdef inline void take(cell_t* cell, double t, float c, float s, bint up, double rate,
                      float per_tau, float share) noexcept nogil:
    """Add the rows of an event that has a predecessor."""
    cdef float dt = <float>(t - cell.t), slow = exp_f(dt * per_tau)
    cdef float fast = slow * slow       # to the power RATIO
    cdef float sign = 1 if up else -1
    cdef float root = cell.on if up else cell.off, inverse = 1 / root
    cdef float ridge, q1, q2, here, before, g, h, y, cm, sm, rest, step, e
    fade(cell, fast if fast > FEW else FEW)
    ridge = root - inverse      # about the threshold
    y = sign * ridge
    ridge *= ROW_FLOOR / WIDE
    ridge *= ridge
    solve(cell.a11 + ridge, cell.a12, cell.a22 + ridge, cell.b1, cell.b2, &q1, &q2)
    here = seen(q1, q2, c, s)
    before = seen(q1, q2, cell.c, cell.s)
    # The middle of the gap: half the step, none where the polarity reversed.
    half_turn(0.5 * rate * (t - cell.t), &cm, &sm)
    g = cell.c * cm - cell.s * sm
    h = cell.s * cm + cell.c * sm
    e = 1 / (before * seen(q1, q2, g, h))
    if sign == cell.sign:
        rest = QUARTER * y     # of ln I to each side of it
        add(cell, g - cell.c - rest * (g + cell.c), h - cell.s - rest * (h + cell.s),
            2 * rest, e * GUESS * share, 0)
    else:
        add(cell, g - cell.c, h - cell.s, 0, e * GUESS * share, 0)
    # The event itself, as exp(-ln step / 2) I - exp(ln step / 2) I before.
    e = 1 / sqrtf(here * before)
    if not up:
        root, inverse = inverse, root
    g = (c * inverse - cell.c * root) * e
    h = (s * inverse - cell.s * root) * e
    rest = y
    step = y if up else -y
    y *= e
    add(cell, g, h, y, 1, 1)
    e = y - g * q1 - h * q2
    cell.s1 += g * e
    cell.s2 += h * e
    cell.rest = cell.rest * slow + max(min(e, 2 * step), -2 * step)
    if cell.n1 + cell.n0 < MOST_ROWS:
        keep(cell, g, h, y, e / (OUTLIER * rest), up)


def turning_events(const event_t[::1] events not None, int64_t last,
                   cell_t[:, ::1] cells not None,
                   const double[:, ::1] segments not None,
                   float tau, float share):
    """Add events to the cells; return how many were taken.

    segments are rows (time, 2 a, its rate per us), of which the last that does not
    begin after an event holds, and the first before it.  Stops at the first event
    outside cells, or before its predecessor (the first: before last).
    """
    cdef Py_ssize_t n = events.shape[0], h = cells.shape[0], w = cells.shape[1]
    cdef Py_ssize_t i, y, x, k = 0, m = segments.shape[0]
    cdef int64_t t, at = 0
    cdef double phase, rate = 0, sine = 0, cosine = 1
    cdef float per_tau = -1 / (RATIO * tau)
    cdef cell_t* cell
    if m < 1 or segments.shape[1] != 3:
        raise ValueError("turning_events: segments must be (m, 3), m at least 1")
    with nogil:
        for i in range(n):
            t = events[i].t
            y = events[i].y
            x = events[i].x
            if y >= h or x >= w or events[i].p > 1 or t < last:
                break
            last = t
            if (i + AHEAD < n and events[i + AHEAD].y < h
                    and events[i + AHEAD].x < w):
                prefetch_all(&cells[events[i + AHEAD].y, events[i + AHEAD].x], 128)
            if i == 0 or t != at:
                at = t
                while k + 1 < m and segments[k + 1, 0] <= t:
                    k += 1
                rate = segments[k, 2]
                phase = segments[k, 1] + rate * (t - segments[k, 0])
                phase -= TWO_PI * floor(phase / TWO_PI)
                sincos_d(phase, &sine, &cosine)
            cell = &cells[y, x]
            if cell.sign != 0:
                take(cell, t, <float>cosine, <float>sine, events[i].p == 1, rate,
                     per_tau, share)
            cell.t = t
            cell.c = <float>cosine
            cell.s = <float>sine
            cell.sign = 1 if events[i].p == 1 else -1
        else:
            i = n
    return i


cdef inline float square(float x) noexcept nogil:
    return x * x


cdef inline float clipped(float x) noexcept nogil:
    return min(max(x, -LONGEST_STEP), LONGEST_STEP)


cdef inline void moved(float theta, float by, float n, float* g, float* h, float* y,
                       cell_t* cell) noexcept nogil:
    """Change the lasting sums to those of a threshold that is larger by exp(by).

    theta is negative for OFF, as the step of ln I.
    """
    cdef float add = theta * by
    cell.m1 += add * g[0]
    cell.m2 += add * h[0]
    cell.zz += 2 * add * y[0] + add * add * n
    y[0] += add * n


def turning_learn(cell_t[:, ::1] cells not None, float on, float off, float spread,
                  uint8_t[:, ::1] told not None):
    """Estimate each pixel's thresholds from its lasting sums, given on, off, spread.

    spread is the error of ln on and ln off for a single pixel.  told becomes 1 where
    the light did not change but for the modulation, 2 where that is also strong enough
    to tell the thresholds' mean, else 0.
    """
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1], y, x
    cdef cell_t* cell
    cdef bint strong
    cdef float d1, d0, mean, rest, q1, q2, variance, ridge, k1, k0, lam1, lam0, p1, p0
    cdef float e1, e0, n, det, u1, u0, a11, a12, a22, f11, f12, f22, i11, i12, i22
    if told.shape[0] != h or told.shape[1] != w:
        raise ValueError("turning_learn: told must have the cells' shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                cell = &cells[y, x]
                n = cell.n1 + cell.n0
                told[y, x] = 0
                if n < LEAST_LEARNT:
                    continue
                u1 = 2 * log_f(cell.on)
                u0 = -2 * log_f(cell.off)
                e1 = log_f(u1 / on)
                e0 = log_f(-u0 / off)
                ridge = ROW_FLOOR * HALF * (u1 - u0)
                ridge = ridge * ridge / (WIDE * WIDE)
                solve(cell.l11 + ridge, cell.l12, cell.l22 + ridge, cell.m1, cell.m2,
                      &q1, &q2)
                variance = (cell.zz - 2 * (q1 * cell.m1 + q2 * cell.m2)
                            + q1 * q1 * cell.l11 + 2 * q1 * q2 * cell.l12
                            + q2 * q2 * cell.l22) / n
                variance = max(variance, ridge * WIDE * WIDE)
                lam1 = variance / (spread * spread)
                lam0 = lam1
                ridge = variance / (WIDE * WIDE)
                p1 = u1 * u1 * cell.n1 + lam1
                p0 = u0 * u0 * cell.n0 + lam0
                k1 = u1 * u1 / p1
                k0 = u0 * u0 / p0
                a11 = (cell.l11 + ridge - k1 * cell.g1 * cell.g1
                       - k0 * cell.g0 * cell.g0)
                a12 = cell.l12 - k1 * cell.g1 * cell.h1 - k0 * cell.g0 * cell.h0
                a22 = (cell.l22 + ridge - k1 * cell.h1 * cell.h1
                       - k0 * cell.h0 * cell.h0)
                solve(a11, a12, a22,
                      cell.m1 - k1 * cell.y1 * cell.g1 - k0 * cell.y0 * cell.g0
                      - u1 * lam1 * e1 * cell.g1 / p1 - u0 * lam0 * e0 * cell.g0 / p0,
                      cell.m2 - k1 * cell.y1 * cell.h1 - k0 * cell.y0 * cell.h0
                      - u1 * lam1 * e1 * cell.h1 / p1 - u0 * lam0 * e0 * cell.h0 / p0,
                      &q1, &q2)
                d1 = clipped(-(u1 * (cell.y1 - q1 * cell.g1 - q2 * cell.h1)
                               + lam1 * e1) / p1)
                d0 = clipped(-(u0 * (cell.y0 - q1 * cell.g0 - q2 * cell.h0)
                               + lam0 * e0) / p0)
                rest = (cell.zz - 2 * (q1 * cell.m1 + q2 * cell.m2)
                        + q1 * q1 * cell.l11 + 2 * q1 * q2 * cell.l12
                        + q2 * q2 * cell.l22 + u1 * u1 * d1 * d1 * cell.n1
                        + 2 * u1 * d1 * (cell.y1 - q1 * cell.g1 - q2 * cell.h1)
                        + u0 * u0 * d0 * d0 * cell.n0
                        + 2 * u0 * d0 * (cell.y0 - q1 * cell.g0 - q2 * cell.h0))
                # Information on both thresholds when q is unknown, inverted for the
                # variance of their mean.
                det = ((cell.l11 + ridge) * (cell.l22 + ridge)
                       - cell.l12 * cell.l12)
                det = det if det > LEAST_DET else LEAST_DET
                i11 = (cell.l22 + ridge) / det
                i12 = -cell.l12 / det
                i22 = (cell.l11 + ridge) / det
                f11 = p1 - u1 * u1 * (cell.g1 * cell.g1 * i11 + cell.h1 * cell.h1 * i22
                                      + 2 * cell.g1 * cell.h1 * i12)
                f22 = p0 - u0 * u0 * (cell.g0 * cell.g0 * i11 + cell.h0 * cell.h0 * i22
                                      + 2 * cell.g0 * cell.h0 * i12)
                f12 = -u1 * u0 * (cell.g1 * cell.g0 * i11 + cell.h1 * cell.h0 * i22
                                  + (cell.g1 * cell.h0 + cell.h1 * cell.g0) * i12)
                det = f11 * f22 - f12 * f12
                cell.scale = spread
                if det > LEAST_DET:
                    cell.scale = min(spread, sqrtf(max(
                        QUARTER * variance * (f11 + f22 - 2 * f12) / det, 0)))
                strong = (q1 * q1 + q2 * q2 >= STRONG * STRONG
                          and cell.scale < HALF * spread)
                if rest > n * STILL * STILL * u1 * -u0:
                    d1 = clipped(-e1)       # the light changed otherwise
                    d0 = clipped(-e0)
                elif strong:
                    told[y, x] = 2
                else:
                    told[y, x] = 1
                    # Weak light tells their ratio only; their mean is that of all.
                    mean = HALF * (d1 + d0 + e1 + e0)
                    d1 -= mean
                    d0 -= mean
                if told[y, x] != 2:
                    cell.scale = spread
                e1, e0 = d1, d0
                moved(u1, e1, cell.n1, &cell.g1, &cell.h1, &cell.y1, cell)
                moved(u0, e0, cell.n0, &cell.g0, &cell.h0, &cell.y0, cell)
                cell.on = exp_f(HALF * u1 * exp_f(e1))
                cell.off = exp_f(-HALF * u0 * exp_f(e0))


cdef inline void blank(float[:, :, ::1] quad, float[:, :, ::1] sigma,
                       uint8_t[:, ::1] valid, Py_ssize_t y, Py_ssize_t x,
                       float s0) noexcept nogil:
    """Write what is known of a pixel without events: nothing of its polarization."""
    quad[0, y, x] = quad[1, y, x] = quad[2, y, x] = quad[3, y, x] = HALF * s0
    sigma[0, y, x] = MOST_ANGLE
    sigma[1, y, x] = sigma[2, y, x] = WIDE
    valid[y, x] = 0


def turning_read(const cell_t[:, ::1] cells not None, double t, float tau,
                 float span, float common, float lag,
                 const float[:, ::1] dc not None,
                 float[:, :, ::1] quad not None, float[:, :, ::1] sigma not None,
                 uint8_t[:, ::1] valid not None):
    """Write I0, I45, I90, I135 at t, and errors of AoP, DoLP and q across it.

    dc is ln S0 without what the events changed, span the time without events, us,
    after which a pixel's swing is below a threshold, common the error of ln of all
    thresholds, lag the part of the drift of q, over the rows' mean age, that is late.
    """
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1], y, x
    cdef const cell_t* cell
    cdef float gone, theta, floor2, ridge, a11, a22, q1, q2, det, n, ratio, variance
    cdef float d1, d2, v11, v12, v22, degree, cosine, sine, across, along, s0, age, slow
    if (quad.shape[0] != 4 or quad.shape[1] != h or quad.shape[2] != w
            or sigma.shape[0] != 3 or sigma.shape[1] != h or sigma.shape[2] != w
            or dc.shape[0] != h or dc.shape[1] != w
            or valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("turning_read: arrays must have the cells' shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                cell = &cells[y, x]
                if cell.sign == 0:
                    blank(quad, sigma, valid, y, x, exp_f(dc[y, x]))
                    continue
                theta = HALF * (cell.on - 1 / cell.on + cell.off - 1 / cell.off)
                floor2 = ROW_FLOOR * theta * ROW_FLOOR * theta
                age = <float>(t - cell.t)
                age = age if age > 0 else 0
                slow = exp_f(-age / (RATIO * tau))
                gone = slow * slow
                n = cell.n * gone
                ratio = n / (2 * n - 1) if n > 1 else 1
                a11 = cell.a11 * gone
                a22 = cell.a22 * gone
                v12 = cell.a12 * gone
                v11 = cell.b1 * gone
                v22 = cell.b2 * gone
                ridge = floor2 / (WIDE * WIDE)
                if age > span:
                    # No event in a whole period: a swing below one threshold.
                    ridge += floor2 / (SILENT * SILENT * theta * theta)
                solve(a11 + ridge, v12, a22 + ridge, v11, v22, &q1, &q2)
                variance = (cell.yy * gone - 2 * (q1 * v11 + q2 * v22) + q1 * q1 * a11
                            + 2 * q1 * q2 * v12 + q2 * q2 * a22)
                variance = ((max(variance, 0) + PRIOR_ROWS * floor2)
                            / (max(n - 2 * ratio, 0) + PRIOR_ROWS))
                ridge *= variance / floor2
                a11 += ridge
                a22 += ridge
                det = solve(a11, v12, a22, v11, v22, &q1, &q2)
                # What q lacked, on average, when its rows came.
                d1 = (a22 * cell.s1 - v12 * cell.s2) * gone * det
                d2 = (a11 * cell.s2 - v12 * cell.s1) * gone * det
                variance *= ratio * det
                v11 = variance * a22
                v22 = variance * a11
                v12 *= -variance
                degree = sqrtf(q1 * q1 + q2 * q2)
                cosine = q1 / degree if degree > 0 else 1
                sine = q2 / degree if degree > 0 else 0
                along = (v11 * cosine * cosine + v22 * sine * sine
                         + 2 * v12 * cosine * sine)
                across = (v11 * sine * sine + v22 * cosine * cosine
                          - 2 * v12 * cosine * sine)
                along += max(lag * lag * square(d1 * cosine + d2 * sine) - along, 0)
                across += max(lag * lag * square(d2 * cosine - d1 * sine) - across, 0)
                # A common factor of the thresholds multiplies atanh of the degree.
                s0 = min(degree * degree, 1)
                s0 = degree * (1 - s0) * (1 + s0 * (ATANH3 + s0 * (ATANH5
                                                                   + s0 * ATANH7)))
                s0 *= sqrtf(cell.scale * cell.scale + common * common)
                along = max(along, 0)
                valid[y, x] = n > LEAST_ROWS and along < UNKNOWN * UNKNOWN
                along = sqrtf(along + s0 * s0)
                across = sqrtf(max(across, 0))
                sigma[1, y, x] = along
                sigma[2, y, x] = across
                sigma[0, y, x] = MOST_ANGLE
                if degree > 0:
                    sigma[0, y, x] = min(HALF * across / degree, MOST_ANGLE)
                s0 = exp_f(dc[y, x] + cell.rest * slow)
                quad[0, y, x] = HALF * s0 * (1 + q1)
                quad[1, y, x] = HALF * s0 * (1 + q2)
                quad[2, y, x] = HALF * s0 * (1 - q1)
                quad[3, y, x] = HALF * s0 * (1 - q2)
                valid[y, x] = valid[y, x] and sigma[0, y, x] < UNSURE
