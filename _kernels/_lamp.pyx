"""Lamp on the mains: what flickers alike in all pixels, from events alone.

Between the first and the last of three events of a pixel the light changes evenly, but
for the lamp: where the middle one falls tells its wave, whatever the pixel sees.
"""
from libc.stdint cimport int64_t

from _kernels._lamp cimport BLOCK_US, cos_turns
from _kernels._tracks cimport never
from _kernels._types cimport event_t

cdef enum:
    # Of three events; where they are closer, the lamp does not show.
    CLOSEST_US = 200
    FURTHEST_US = 40000
    SPANS = 3
    RATES = 4
    # Frequencies beside the mains', in both directions, so many a hertz.
    STEPS = 6
    PER_HZ = 10
    SUMS = 7
    WHOLE_US = 200000
    # Of every 2^15th macropixel there is at most one on any sensor.
    SHIFT_MOST = 15

cdef extern from *:
    """
    #define MAINS_50 100e-6     /* turns per us of a lamp: twice the mains' */
    #define MAINS_60 120e-6     /* the same for mains of 60 Hz */
    #define BELOW 0.75          /* of these frequencies there is no lamp: what a wave of
                                   it explains is motion */
    #define PREFER 0.002        /* what a frequency at the end of the range costs, so
                                   that equal fits give the mains' */
    """
    const double MAINS_50
    const double MAINS_60
    const double BELOW
    const double PREFER

cdef struct normal_t:
    # Normal equations of (cosine, sine): matrix, right side; sum of squares, number.
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
    """Add the events of t < until to the sums; return the index of the first left.

    sensor is (h, w, shift), thresholds (on, off) in log intensity.  Of the macropixels
    of the sensor, h x w, every 2**shift-th of every 2**shift-th row
    counts.  stamps holds their pixels' last two events (2 t + p).  sums is (span,
    frequency, place in the macropixel, `normal_t`), phase 0 at t = 0: of 100 and 120
    Hz, then three quarters of them; even_us the time over which the light changes
    evenly, by span; hz the pixels' corner frequencies, 0: they pass on all there is.
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
    cdef int i
    if never(a) or c - a < CLOSEST_US or c - a > FURTHEST_US:
        return
    gap = <double>(c - a)
    s = <double>(b - a) / gap
    e = (1.0 - s) * (on if second & 1 else -off) - s * (on if third & 1 else -off)
    for i in range(SPANS):
        span = gap / even_us[i]
        weight[i] = 1.0 / (1.0 + span * span * span * span)
    for i in range(RATES):
        add_equation(turns_of(i), modulo(a, WHOLE_US), b - a, c - a, s, e, hz,
                     weight, sums + i * 4 * SUMS)


cdef inline double turns_of(Py_ssize_t which) noexcept nogil:
    """Return a frequency, turns per microsecond; WHOLE_US holds all a whole number."""
    cdef double turns = MAINS_50 if which % 2 == 0 else MAINS_60
    return turns if which < 2 else BELOW * turns


cdef inline int64_t modulo(int64_t t, int64_t period) noexcept nogil:
    """Return t in [0, period), whatever the division of negative numbers does."""
    return (t % period + period) % period


cdef inline void add_equation(double turns, int64_t a, int64_t b, int64_t c, double s,
                              double e, double hz, const double* weight,
                              double* sums) noexcept nogil:
    cdef normal_t* to
    cdef double x = turns * <double>a, y = turns * <double>(a + b)
    cdef double z = turns * <double>(a + c)
    cdef double h = cos_turns(y) - (1.0 - s) * cos_turns(x) - s * cos_turns(z)
    cdef double g = (cos_turns(y - 0.25) - (1.0 - s) * cos_turns(x - 0.25)
                     - s * cos_turns(z - 0.25))
    cdef double lag, share
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
    """Solve the equations; return the part of the sum of squares that is explained."""
    cdef double cc = m.cc + 1e-6, ss = m.ss + 1e-6
    cdef double det = cc * ss - m.cs * m.cs
    c[0] = (ss * m.c - m.cs * m.s) / det
    s[0] = (cc * m.s - m.cs * m.c) / det
    return c[0] * m.c + s[0] * m.s


cdef inline void turned(const normal_t* m, double turns, normal_t* to) noexcept nogil:
    """Add equations whose phase is so many turns further on."""
    cdef double u = cos_turns(turns), v = cos_turns(turns - 0.25)
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
    """Fit one wave, hz beside its mains, to all blocks; return what it explains.

    apart is what a wave for each of the four places would explain beyond that, left
    what neither does.
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
    """Fit a wave to the sums of the last blocks, the oldest first, for that from t on.

    out receives turns per us, cosine and sine amplitude, phase 0 at t; then what the
    wave explains, what one for each place would beyond that, what is left, the number,
    and what one for each place of three quarters of the frequency would explain.
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
                # A single block tells nothing of the frequency: then it is the mains'.
                hz = (step - STEPS) / <double>STEPS
                tried[step] *= 1.0 - PREFER * hz * hz
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
            # From phase 0 at 0 to phase 0 at t.
            u = turns_of(which) * <double>modulo(t, WHOLE_US)
            out[0] = turns_of(which) + 1e-6 * hz
            v = cos_turns(u - 0.25)
            u = cos_turns(u)
            out[1] = wave[0] * u + wave[1] * v
            out[2] = wave[1] * u - wave[0] * v
            out[3] = here
            out[4] = apart
            out[5] = left
            out[6] = n
            out[7] = common(sums, which + 2, BELOW * hz, wave, &apart, &left, &n)
            out[7] += apart
