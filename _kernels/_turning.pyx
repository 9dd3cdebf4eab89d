"""Regression of each pixel's events on the angle of a turning analyser.

The light behind it is I = S0/2 (1 + q1 cos 2a + q2 sin 2a).  Between two successive
events of a pixel ln I changes by the threshold of the second: a row that is linear in
q, as no level is needed (docs/theory/turning.md, in the same symbols).  A pixel's cell
holds the sums of its normal equations: those of q, which fade, and those of q with
both thresholds, which stay.
"""
from libc.stdint cimport int64_t, uint8_t

from _kernels._math cimport exp_f
from _kernels._types cimport event_t

cdef extern from "<math.h>" nogil:
    float sqrtf(float)
    double floor(double)

cdef extern from "_scenes.h" nogil:
    void sincos_d "scene_sincos"(double, double*, double*)

cdef extern from "_prefetch.h" nogil:
    const Py_ssize_t AHEAD "PDAVIS_AHEAD"
    void prefetch_all "PDAVIS_PREFETCH_ALL"(const void*, size_t)

cdef extern from "_turning.h" nogil:
    const float LEAST_DET, ROW_FLOOR, WIDE
    ctypedef struct cell_t "turning_cell_t":
        double t
        float s1, s2, on, off, sign, rest, a11, a12, a22, b1, b2, yy, n, scale
        float c, s, l11, l12, l22, m1, m2, zz, n1, g1, h1, y1, n0, g0, h0, y0
    ctypedef struct reading_t "turning_read_t":
        double t
        float half_us, decay, late, common
    float solve "turning_solve"(float, float, float, float, float, float*, float*)
    void turning_row(const reading_t*, const cell_t*, const float*, Py_ssize_t, float*,
                     float*, float*, float*, float*, float*, float*, unsigned char*)

cdef extern from *:
    """
    #define TWO_PI 6.283185307179586
    #define QUARTER 0.25f       /* a literal is a double to Cython */
    #define DARKEST 0.02f       /* of 1 + q: least intensity in a weight, relative */
    #define FEW 0.8f            /* most that an event fades those before it: where fewer
                                   than some five come in a window, it is longer */
    #define GUESS 0.0256f       /* weight of a row of the middle of a gap: its level is
                                   known to 0.25 thresholds, an event's to 0.04 */
    #define MOST_ROWS 1024.0f   /* rows of the lasting sums, which then stay */
    #define RATIO 2             /* of the time constants of `rest` and of q */
    #define OUTLIER 0.25f       /* residual that halves a row's weight, thresholds */
    """
    const double TWO_PI
    const int RATIO
    const float FEW, QUARTER, DARKEST, GUESS, MOST_ROWS, OUTLIER


cdef inline float seen(float q1, float q2, float c, float s) noexcept nogil:
    """Return the intensity in units of S0/2, at least DARKEST."""
    cdef float light = 1 + q1 * c + q2 * s
    return light if light > DARKEST else DARKEST


cdef inline void circle(double angle, float* cosine, float* sine) noexcept nogil:
    cdef double c, s
    sincos_d(angle - TWO_PI * floor(angle * (1 / TWO_PI)), &s, &c)
    cosine[0] = <float>c
    sine[0] = <float>s


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
    circle(0.5 * rate * (t - cell.t), &cm, &sm)
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
    cdef double rate = 0
    cdef float c = 1, s = 0
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
                circle(segments[k, 1] + rate * (t - segments[k, 0]), &c, &s)
            cell = &cells[y, x]
            if cell.sign != 0:
                take(cell, t, c, s, events[i].p == 1, rate, per_tau, share)
            cell.t = t
            cell.c = c
            cell.s = s
            cell.sign = 1 if events[i].p == 1 else -1
        else:
            i = n
    return i


def turning_images(const cell_t[:, ::1] cells not None, double t, float tau,
                   float half_us, float late, float common,
                   const float[:, ::1] level not None, float[:, :, ::1] quad not None,
                   float[:, :, ::1] sigmas not None, uint8_t[:, ::1] valid not None):
    """Write what cells tell at the time t: quad (4, h, w), sigmas (3, h, w), valid.

    sigmas are those of AoP, DoLP and q across its direction.  half_us is half a turn,
    late the part of the drift of q that is its error, common the relative error that
    all thresholds have in common, level (h, w) what ln S0 is relative to.
    """
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1], y
    cdef reading_t now
    now.t = t
    now.half_us = half_us
    now.decay = -1 / (RATIO * tau)
    now.late = late
    now.common = common
    if (quad.shape[0] != 4 or sigmas.shape[0] != 3 or quad.shape[1] != h
            or sigmas.shape[1] != h or valid.shape[0] != h or level.shape[0] != h
            or quad.shape[2] != w or sigmas.shape[2] != w or valid.shape[1] != w
            or level.shape[1] != w):
        raise ValueError("turning_images: planes must be those of cells")
    if w == 0:
        return
    with nogil:
        for y in range(h):
            turning_row(
                &now, &cells[y, 0], &level[y, 0], w, &quad[0, y, 0], &quad[1, y, 0],
                &quad[2, y, 0], &quad[3, y, 0], &sigmas[0, y, 0], &sigmas[1, y, 0],
                &sigmas[2, y, 0], &valid[y, 0])
