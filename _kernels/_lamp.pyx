"""Flicker of a mains lamp, a ripple common to all pixels, from events alone.

Of three successive events of a pixel, the middle one lies on a straight line between
the others if the light changes linearly.  Its deviation is a linear function of the
cosine and sine amplitudes of the ripple, whatever that change is, so that least squares
gives them (docs/theory/lamp.md).
"""
from libc.stdint cimport int64_t

from _kernels._lamp cimport BLOCK_US, QUARTER_TURN, cos_turns
from _kernels._types cimport event_t

cdef enum:
    # Bounds of the time from the first to the last of three events.  In a shorter time
    # the ripple hardly changes, in a longer one the light does not change linearly.
    SPAN_LEAST_US = 200
    SPAN_MOST_US = 40000
    # Time constants of the weight of three events: the length of even_us.
    SPANS = 3
    # Frequencies: 100 and 120 Hz, and three quarters of both.
    RATES = 4
    # Grid of frequency offsets: STEPS on either side of the nominal one, PER_HZ per Hz.
    STEPS = 6
    PER_HZ = 10
    # Events of an equation.
    TIMES = 3
    # Number of doubles in normal_t.
    SUMS = 7
    # A common multiple of the periods of all RATES frequencies, us.
    COMMON_PERIOD_US = 200000
    # On any sensor there is at most one macropixel in 2^15.
    SHIFT_MOST = 15

cdef extern from "_lamp.h" nogil:
    void cos_each(const double*, Py_ssize_t, double*)

cdef extern from *:
    """
    #define MAINS_50 100e-6     /* a lamp's periods per us: twice the mains frequency */
    #define MAINS_60 120e-6     /* the same for mains of 60 Hz */
    /* No lamp flickers at this fraction of these frequencies, so what a wave of that
       frequency explains is due to motion. */
    #define BELOW 0.75
    /* Penalty of a frequency at the end of the grid, relative to what its wave
       explains, so that equally good fits give the nominal frequency. */
    #define NOMINAL_PREFERENCE 0.002
    /* Ridge of the normal equations, so that they can be solved without data. */
    #define RIDGE 1e-6
    """
    const double MAINS_50
    const double MAINS_60
    const double BELOW
    const double NOMINAL_PREFERENCE
    const double RIDGE

cdef struct normal_t:
    # Normal equations of (cosine, sine): three elements of the matrix, two of the right
    # side; sum of squares of the left sides e; sum of weights.
    double cc
    double cs
    double ss
    double c
    double s
    double ee
    double n


def lamp_push(const event_t[::1] events not None, int64_t until, sensor not None,
              thresholds not None, const double[::1] even_us not None,
              const float[:, ::1] hz not None, int64_t[:, :, ::1] stamps not None,
              double[:, :, :, ::1] sums not None):
    """Add the events with t < until to sums; return the index of the first one left.

    sensor is (h, w, shift): the sensor's size in pixels, of whose macropixels every
    2**shift-th in every 2**shift-th row is used.  thresholds are (on, off) in log
    intensity.  stamps holds the last two events (2 t + p) of the pixels used, hz their
    corner frequencies (0: no low-pass).  even_us has the time constants of the weight,
    us: the times over which the light is taken to change linearly.  sums has the axes
    time constant, frequency (100 and 120 Hz, then three quarters of both), place in the
    macropixel, and the doubles of `normal_t`; phase 0 is at t = 0.
    """
    cdef Py_ssize_t n = events.shape[0], i = 0, y, x, row, column, h, w
    cdef int shift, mask
    cdef double on, off
    cdef int64_t* last
    h, w, shift = sensor
    on, off = thresholds
    if shift < 0 or shift > SHIFT_MOST:
        raise ValueError("lamp_push: shift must lie in 0..15")
    mask = (1 << shift) - 1
    if (((((h + 1) >> 1) + mask) >> shift) * 2 > stamps.shape[0]
            or ((((w + 1) >> 1) + mask) >> shift) * 2 > stamps.shape[1]
            or stamps.shape[2] != 2 or hz.shape[0] != stamps.shape[0]
            or hz.shape[1] != stamps.shape[1]):
        raise ValueError("lamp_push: stamps, hz must have room for the macropixels")
    if (even_us.shape[0] != SPANS or sums.shape[0] != SPANS or sums.shape[1] != RATES
            or sums.shape[2] != 4 or sums.shape[3] != SUMS):
        raise ValueError("lamp_push: sums must be (3, 4, 4, 7), even_us (3,)")
    with nogil:
        while i < n and events[i].t < until:
            y = events[i].y
            x = events[i].x
            if not ((y >> 1 | x >> 1) & mask) and y < h and x < w:
                row = (y >> 1 + shift) * 2 + (y & 1)
                column = (x >> 1 + shift) * 2 + (x & 1)
                last = &stamps[row, column, 0]
                add_triple(last[0], last[1], 2 * events[i].t + events[i].p, on, off,
                           hz[row, column], &even_us[0],
                           &sums[0, 0, 2 * (y & 1) + (x & 1), 0])
                last[0] = last[1]
                last[1] = 2 * events[i].t + events[i].p
            i += 1
    return i


cdef inline void add_triple(int64_t first, int64_t second, int64_t third, double on,
                            double off, double hz, const double* even_us,
                            double* sums) noexcept nogil:
    cdef int64_t a = first >> 1, b = second >> 1, c = third >> 1
    cdef double s, e, gap, span
    cdef double weight[SPANS]
    cdef double[2 * TIMES][RATES] turns
    cdef double[2 * TIMES][RATES] wave
    cdef int64_t phase
    cdef int i, k
    if c - a < SPAN_LEAST_US or c - a > SPAN_MOST_US:
        return
    gap = <double>(c - a)
    s = <double>(b - a) / gap
    e = (1.0 - s) * (on if second & 1 else -off) - s * (on if third & 1 else -off)
    for i in range(SPANS):
        span = gap / even_us[i]
        weight[i] = 1.0 / (1.0 + span * span * span * span)
    # Phases of both waves at the three times, in turns.  Phase 0 may be at any common
    # multiple of the periods.
    phase = modulo(a, COMMON_PERIOD_US)
    for i in range(RATES):
        turns[0][i] = turns_of(i) * <double>phase
        turns[1][i] = turns_of(i) * <double>(phase + (b - a))
        turns[2][i] = turns_of(i) * <double>(phase + (c - a))
        for k in range(TIMES):
            turns[TIMES + k][i] = turns[k][i] - QUARTER_TURN
    cos_each(&turns[0][0], 2 * TIMES * RATES, &wave[0][0])
    for i in range(RATES):
        add_equation(
            turns_of(i), wave[1][i] - (1.0 - s) * wave[0][i] - s * wave[2][i],
            wave[4][i] - (1.0 - s) * wave[3][i] - s * wave[5][i], e, hz, weight,
            sums + i * 4 * SUMS)


cdef inline double turns_of(Py_ssize_t which) noexcept nogil:
    """Return a frequency in periods per us."""
    cdef double turns = MAINS_50 if which % 2 == 0 else MAINS_60
    return turns if which < 2 else BELOW * turns


cdef inline int64_t modulo(int64_t t, int64_t period) noexcept nogil:
    """Return t modulo period, in [0, period) for negative t as well."""
    return (t % period + period) % period


cdef inline void add_equation(double turns, double h, double g, double e, double hz,
                              const double* weight, double* sums) noexcept nogil:
    """Add the equation e = h (cosine) + g (sine), as a low-pass of hz passes them."""
    cdef normal_t* to
    cdef double x, lag, share
    cdef int i
    if hz > 0.0:
        lag = 1e6 * turns / hz
        share = 1.0 / (1.0 + lag * lag)
        x = share * (h + lag * g)
        g = share * (g - lag * h)
        h = x
    for i in range(SPANS):
        to = <normal_t*>(sums + i * (RATES * 4 * SUMS))
        to.cc += weight[i] * h * h
        to.cs += weight[i] * h * g
        to.ss += weight[i] * g * g
        to.c += weight[i] * h * e
        to.s += weight[i] * g * e
        to.ee += weight[i] * e * e
        to.n += weight[i]


cdef inline double explained(const normal_t* m, double* c, double* s) noexcept nogil:
    """Solve the normal equations; return the sum of squares that the wave explains."""
    cdef double cc = m.cc + RIDGE, ss = m.ss + RIDGE
    cdef double det = cc * ss - m.cs * m.cs
    c[0] = (ss * m.c - m.cs * m.s) / det
    s[0] = (cc * m.s - m.cs * m.c) / det
    return c[0] * m.c + s[0] * m.s


cdef inline void turned(const normal_t* m, double turns, normal_t* to) noexcept nogil:
    """Add normal equations to others whose phase 0 is that many turns earlier."""
    cdef double u = cos_turns(turns), v = cos_turns(turns - QUARTER_TURN)
    to.cc += u * u * m.cc - 2.0 * u * v * m.cs + v * v * m.ss
    to.ss += v * v * m.cc + 2.0 * u * v * m.cs + u * u * m.ss
    to.cs += u * v * (m.cc - m.ss) + (u * u - v * v) * m.cs
    to.c += u * m.c - v * m.s
    to.s += v * m.c + u * m.s
    to.ee += m.ee
    to.n += m.n


cdef double common(const double[:, :, :, ::1] sums, Py_ssize_t which, double hz,
                   double* wave, double* apart, double* left,
                   double* n) noexcept nogil:
    """Fit one wave, hz off the nominal frequency, to all blocks.

    Returns the sum of squares that it explains.  apart receives what separate waves for
    the four places of a macropixel would explain in addition, left the residual of
    those, n the sum of weights.
    """
    cdef Py_ssize_t blocks = sums.shape[0], k, place
    cdef normal_t whole, one
    cdef double c, s, single = 0.0, both
    whole = normal_t(0, 0, 0, 0, 0, 0, 0)
    for place in range(4):
        one = normal_t(0, 0, 0, 0, 0, 0, 0)
        for k in range(blocks):
            turned(<const normal_t*>&sums[k, which, place, 0],
                   hz * 1e-6 * BLOCK_US * (<double>(k - blocks) + 0.5), &one)
        single += explained(&one, &c, &s)
        turned(&one, 0.0, &whole)
    both = explained(&whole, &wave[0], &wave[1])
    apart[0] = single - both
    left[0] = whole.ee - single
    n[0] = whole.n
    return both


def lamp_wave(const double[:, :, :, ::1] sums not None, int64_t t,
              double[::1] out not None):
    """Fit a wave to the sums of the last blocks, the oldest first; t is their end.

    out receives the frequency (periods per us), the cosine and sine amplitudes with
    phase 0 at t, and sums of squares: that which the wave explains, that which separate
    waves for the four places would explain in addition, the residual, the sum of
    weights, and that which separate waves of three quarters of the frequency explain.
    """
    cdef Py_ssize_t which, step, at
    cdef double wave[2]
    cdef double best = -1.0, hz, here, u, v, apart, left, n
    cdef double tried[2 * STEPS + 1]
    if sums.shape[0] < 1 or sums.shape[1] != RATES or sums.shape[2] != 4 or (
            sums.shape[3] != SUMS):
        raise ValueError("lamp_wave: sums must be (blocks, 4, 4, 7)")
    if out.shape[0] != 8:
        raise ValueError("lamp_wave: out must have 8 numbers")
    with nogil:
        for which in range(2):
            at = 0
            for step in range(2 * STEPS + 1):
                tried[step] = common(sums, which, (step - STEPS) / <double>PER_HZ, wave,
                                     &apart, &left, &n)
                # With one block, all frequencies fit alike, and the nominal one wins.
                hz = (step - STEPS) / <double>STEPS
                tried[step] *= 1.0 - NOMINAL_PREFERENCE * hz * hz
                if tried[step] > tried[at]:
                    at = step
            hz = (at - STEPS) / <double>PER_HZ
            if 0 < at < 2 * STEPS:
                u = tried[at - 1] - 2.0 * tried[at] + tried[at + 1]
                if u < 0.0:
                    hz += (tried[at - 1] - tried[at + 1]) / u / (2.0 * PER_HZ)
            here = common(sums, which, hz, wave, &apart, &left, &n)
            if here <= best:
                continue
            best = here
            # Move phase 0 from time 0 to t.
            u = turns_of(which) * <double>modulo(t, COMMON_PERIOD_US)
            out[0] = turns_of(which) + 1e-6 * hz
            v = cos_turns(u - QUARTER_TURN)
            u = cos_turns(u)
            out[1] = wave[0] * u + wave[1] * v
            out[2] = wave[1] * u - wave[0] * v
            out[3] = here
            out[4] = apart
            out[5] = left
            out[6] = n
            out[7] = common(sums, which + 2, BELOW * hz, wave, &apart, &left, &n)
            out[7] += apart
