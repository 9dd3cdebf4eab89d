"""Regression of each pixel's events on the angle of a turning analyser.

The light behind it is I = S0/2 (1 + q1 cos 2a + q2 sin 2a).  Between two successive
events of a pixel ln I changes by the threshold of the second: a row that is linear in
q, as no level is needed (docs/theory/turning.md, in the same symbols).  A pixel's cell
holds the sums of its normal equations: those of q, which fade, and those of q with
both thresholds, which stay.
"""
from libc.stdint cimport int64_t, uint8_t
from libc.string cimport memset

from _kernels._types cimport event_t

cdef extern from "_turning.h" nogil:
    const Py_ssize_t AHEAD "PDAVIS_AHEAD"
    void prefetch "PDAVIS_PREFETCH"(const void*)
    const double TWO_PI
    const int EVENTS "PDAVIS_LANES", PLANES, RATIO
    ctypedef struct cell_t "turning_cell_t":
        double t
        float s1, s2, a11, a12, a22, b1, b2, yy, n, scale, on, off, sign, rest
    ctypedef struct lasting_t "turning_lasting_t":
        float c, s, l11, l12, l22, m1, m2, zz, n1, g1, h1, y1, n0, g0, h0, y0
    ctypedef float* lanes_t "float *"
    ctypedef struct rows_t "turning_rows_t":
        Py_ssize_t* at
        double* t
        double* rate
        lanes_t c, s, sign
    void circle "turning_circle"(double, float*, float*)
    void turning_rows(const rows_t*, int, float, float, cell_t*, lasting_t*)
    void turning_pixels(double, float, float, float, float, const cell_t*,
                        const unsigned char*, const float*, Py_ssize_t, float*,
                        unsigned char*)


def turning_events(const event_t[::1] events not None, int64_t last,
                   cell_t[:, ::1] cells not None, lasting_t[:, ::1] lasting not None,
                   uint8_t[:, ::1] seen not None,
                   const double[:, ::1] segments not None,
                   float tau, float share):
    """Add events to the cells and their lasting sums; return how many were taken.

    seen becomes not 0 where an event is: the number of its group, of events of as many
    pixels.  segments are rows (time, 2 a, its rate per us), of which the last that does
    not begin after an event holds, and the first before it.  Stops at the first event
    outside cells, or before its predecessor (the first: before last).
    """
    cdef Py_ssize_t n = events.shape[0], h = cells.shape[0], w = cells.shape[1]
    cdef Py_ssize_t i = 0, y, x, k = 0, m = segments.shape[0], at
    cdef int64_t t, now = 0
    cdef double rate = 0
    cdef float c = 1, s = 0, per_tau = -1 / (RATIO * tau)
    cdef int j, group = 0
    cdef rows_t rows
    if m < 1 or segments.shape[1] != 3:
        raise ValueError("turning_events: segments must be (m, 3), m at least 1")
    if (lasting.shape[0] != h or lasting.shape[1] != w or seen.shape[0] != h
            or seen.shape[1] != w):
        raise ValueError("turning_events: lasting and seen must be as many as cells")
    memset(&rows, 0, sizeof(rows))
    with nogil:
        while i < n:
            # Events of as many pixels: another one of the same pixel waits.
            group = group % 255 + 1
            j = 0
            while j < EVENTS and i + j < n:
                t = events[i + j].t
                y = events[i + j].y
                x = events[i + j].x
                if y >= h or x >= w or events[i + j].p > 1 or t < last:
                    n = i + j
                    break
                at = y * w + x
                if (&seen[0, 0])[at] == group:
                    break
                (&seen[0, 0])[at] = group
                rows.at[j] = at
                last = t
                if (i + j + AHEAD < n and events[i + j + AHEAD].y < h
                        and events[i + j + AHEAD].x < w):
                    at = events[i + j + AHEAD].y * w + events[i + j + AHEAD].x
                    prefetch(&cells[0, 0] + at)
                    prefetch(&lasting[0, 0] + at)
                if i + j == 0 or t != now:
                    now = t
                    while k + 1 < m and segments[k + 1, 0] <= t:
                        k += 1
                    rate = segments[k, 2]
                    circle((segments[k, 1] + rate * (t - segments[k, 0])) / TWO_PI,
                           &c, &s)
                rows.t[j] = t
                rows.rate[j] = rate * (0.5 / TWO_PI)
                rows.c[j] = c
                rows.s[j] = s
                rows.sign[j] = 2 * events[i + j].p - 1
                j += 1
            if j:
                turning_rows(&rows, j, per_tau, share, &cells[0, 0],
                             &lasting[0, 0])
            i += j
    return i


def turning_images(const cell_t[:, ::1] cells not None,
                   const uint8_t[:, ::1] seen not None, double t, float tau,
                   float half_us, float late, float common,
                   const float[:, ::1] level not None, float[:, :, ::1] planes not None,
                   uint8_t[:, ::1] valid not None):
    """Write what cells tell at the time t: planes (7, h, w), valid.

    The planes are I0 to I135, errors of AoP, DoLP and q across its direction.  seen are
    pixels that had an event, half_us is half a turn, late the part of the drift of q
    that is its error, common the relative error that all thresholds have in common,
    level (h, w) what ln S0 is relative to.
    """
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1]
    if (planes.shape[0] != PLANES or planes.shape[1] != h or planes.shape[2] != w
            or seen.shape[0] != h or seen.shape[1] != w or valid.shape[0] != h
            or valid.shape[1] != w or level.shape[0] != h or level.shape[1] != w):
        raise ValueError("turning_images: planes must be those of cells")
    if h * w == 0:
        return
    with nogil:
        turning_pixels(t, half_us, -1 / (RATIO * tau), late, common, &cells[0, 0],
                       &seen[0, 0], &level[0, 0], h * w, &planes[0, 0, 0], &valid[0, 0])
