"""The event pixel: threshold crossings of low-pass filtered log light; noise events.

Between two nodes the light is the cubic with the given values and slopes, and its log
is the cubic v(x).  x in 0..1 is the interval's time in units of the filter's time
constants, of which the interval has phi.  The low-pass L' = phi (v - L) then has the
exact solution L = a exp(-phi x) + P(x) with a cubic P; for small phi a power series
replaces it.  Crossings are roots of L, not differences of samples.  The model and its
sources are in docs/theory/pixels.md.
"""
from libc.math cimport fabs
from libc.stdint cimport int64_t, uint8_t, uint16_t, uint64_t

from _kernels._double cimport draw64, exp64, log64, uniform64
from _kernels._types cimport event_t

cdef extern from *:
    """
    #define NEVER 1e300
    #define SERIES 0.5
    #define FAINT 1e-9
    """
    const double NEVER      # us
    const double SERIES     # below this phi the power series is used
    const double FAINT      # lower bound of light, DN/ms: log 0 is undefined

cdef enum:
    TERMS = 14              # of the series: 0.5^14 / 14! = 7e-16


cdef struct config_t:
    double h                # interval, us
    double t0               # time of the first node, us
    int unfiltered
    double cutoff           # 1/us
    double cutoff_slope     # 1/us per DN/ms of light
    double refractory       # us
    double bright_factor    # rate of noise events in bright light over that in the dark
    double bright_light     # DN/ms
    double burst_chance
    double burst_width      # us
    double noise            # candidates of noise events per us
    double dark             # DN/ms
    double leak_slope       # leak events per us and DN/ms of light
    double e, w0, w1, w2, w3  # weights of the filter's end value, constant cutoff


cdef struct pixel_t_:
    double level            # filtered log light at the node
    double ref              # log light at the comparator's last reset
    double release          # end of the refractory period, us
    double noise_t          # next candidate of a noise event, us
    uint64_t counter        # number of candidates drawn
    uint64_t key
    double on, off          # thresholds
    double leak             # ln units per us
    double light            # light at the node
    double v                # its log


cdef struct cell_t:
    # light i0 + i1 s + i2 s^2 + i3 s^3 over the interval, s = 0..1
    double i0, i1, i2, i3
    double v0, m0, b, e     # its log as a cubic in x
    double phi, cutoff, slope, drift
    int unfiltered, series, ready, terms
    double level            # at s = 0
    double a, p0, p1, p2, p3
    double term[TERMS]


cdef inline double light_at(cell_t *c, double s) noexcept nogil:
    cdef double i = c.i0 + s * (c.i1 + s * (c.i2 + s * c.i3))
    return i if i > FAINT else FAINT


cdef inline double filter_time(cell_t *c, double s) noexcept nogil:
    """Return x at time s: integral of the cutoff up to s, divided by the whole one."""
    if c.slope == 0:
        return s
    return s * (c.cutoff + c.slope * (c.i0 + s * (c.i1 / 2 + s * (
        c.i2 / 3 + s * c.i3 / 4)))) / c.phi


cdef inline void prepare(cell_t *c) noexcept nogil:
    """Coefficients of the filtered log light within the interval."""
    cdef int n
    cdef double v
    c.ready = 1
    if c.unfiltered:
        return
    if c.series:
        c.term[0] = c.level
        for n in range(TERMS - 1):
            v = c.v0 if n == 0 else c.m0 if n == 1 else c.b if n == 2 else (
                c.e if n == 3 else 0.0)
            c.term[n + 1] = c.phi * (v - c.term[n]) / (n + 1)
            if n > 3 and fabs(c.term[n + 1]) < 1e-17:
                break
        c.terms = n + 1
        return
    c.p3 = c.e
    c.p2 = c.b - 3 * c.p3 / c.phi
    c.p1 = c.m0 - 2 * c.p2 / c.phi
    c.p0 = c.v0 - c.p1 / c.phi
    c.a = c.level - c.p0


cdef inline double filtered(cell_t *c, double x) noexcept nogil:
    cdef int n
    cdef double y
    if c.series:
        y = c.term[c.terms]
        for n in range(c.terms - 1, -1, -1):
            y = y * x + c.term[n]
        return y
    return c.a * exp64(-c.phi * x) + c.p0 + x * (c.p1 + x * (c.p2 + x * c.p3))


cdef inline double value(cell_t *c, double s, double *slope,
                         double *bend) noexcept nogil:
    """The comparator's input at s, and its first and second derivative."""
    cdef double i, x, y, v, rise, rate
    if not c.ready:
        prepare(c)
    if c.unfiltered:
        i = 1 / light_at(c, s)
        rise = (c.i1 + s * (2 * c.i2 + s * 3 * c.i3)) * i
        slope[0] = rise + c.drift
        bend[0] = (2 * c.i2 + s * 6 * c.i3) * i - rise * rise
        return log64(light_at(c, s)) + c.drift * s
    x = filter_time(c, s)
    y = filtered(c, x)
    v = c.v0 + x * (c.m0 + x * (c.b + x * c.e))
    rise = c.m0 + x * (2 * c.b + x * 3 * c.e)
    if c.slope == 0:
        slope[0] = c.phi * (v - y)
        bend[0] = c.phi * (rise - slope[0])
    else:
        rate = c.cutoff + c.slope * light_at(c, s)
        slope[0] = rate * (v - y)
        bend[0] = c.slope * (c.i1 + s * (2 * c.i2 + s * 3 * c.i3)) * (v - y) + (
            rate * (rise * rate / c.phi - slope[0]))
    slope[0] += c.drift
    return y + c.drift * s


cdef inline double end_level(cell_t *c, config_t *cfg, double v1) noexcept nogil:
    """Filtered log light at the end of the interval."""
    if c.unfiltered:
        return v1
    if c.slope == 0:
        return cfg.e * c.level + cfg.w0 * c.v0 + cfg.w1 * c.m0 + (
            cfg.w2 * c.b + cfg.w3 * c.e)
    prepare(c)
    return filtered(c, 1.0)


cdef inline void begin(cell_t *c, config_t *cfg, pixel_t_ *p, double light1, double v1,
                       double d0, double d1, double m0, double m1) noexcept nogil:
    """Set up the interval from the node's light to light1.

    d0 and d1 are the slopes of light, m0 and m1 those of its log.
    """
    cdef double dv, rise = light1 - p.light
    c.i0 = p.light
    c.i1 = d0
    c.i2 = 3 * rise - 2 * d0 - d1
    c.i3 = d0 + d1 - 2 * rise
    c.drift = p.leak * cfg.h
    if cfg.leak_slope > 0:  # at the interval's mean light
        c.drift += cfg.leak_slope * p.on * cfg.h * (
            c.i0 + c.i1 / 2 + c.i2 / 3 + c.i3 / 4)
    c.level = p.level
    c.unfiltered = cfg.unfiltered
    c.ready = 0
    c.v0 = p.v
    if c.unfiltered:
        return
    c.cutoff = cfg.cutoff * cfg.h
    c.slope = cfg.cutoff_slope * cfg.h
    if c.slope == 0:
        c.phi = c.cutoff
        c.m0 = m0
    else:
        c.phi = c.cutoff + c.slope * (c.i0 + c.i1 / 2 + c.i2 / 3 + c.i3 / 4)
        if c.phi < 1e-12:
            c.phi = 1e-12
        c.m0 = m0 * c.phi / (c.cutoff + c.slope * p.light)
        m1 = m1 * c.phi / (c.cutoff + c.slope * light1)
    c.series = c.phi < SERIES
    dv = v1 - c.v0
    c.b = 3 * dv - 2 * c.m0 - m1
    c.e = c.m0 + m1 - 2 * dv


cdef inline double root(cell_t *c, double target, double sa, double sb, double ya,
                        double yb, double tolerance) noexcept nogil:
    """Return where value() reaches target between sa and sb, where it is monotonic.

    ya and yb are its values at sa and sb.  Chebyshev's method (Newton's with the second
    derivative) starts from the root of the chord and falls back to bisection, until the
    estimated error is below the tolerance.
    """
    cdef double s, y, slope, bend, step, turn
    cdef int rising = ya < target, direct = c.unfiltered and c.drift == 0, _n
    s = sa + (target - ya) / (yb - ya) * (sb - sa) if yb != ya else sb
    if not (sa <= s <= sb):
        s = 0.5 * (sa + sb)
    if direct:  # light itself instead of its log
        target = exp64(target)
    for _n in range(60):
        if direct:
            y = c.i0 + s * (c.i1 + s * (c.i2 + s * c.i3))
            slope = c.i1 + s * (2 * c.i2 + s * 3 * c.i3)
            bend = 2 * c.i2 + s * 6 * c.i3
        else:
            y = value(c, s, &slope, &bend)
        if (y < target) == rising:
            sa = s
        else:
            sb = s
        if slope != 0:
            slope = 1 / slope
            step = (target - y) * slope
            turn = 0.5 * step * bend * slope
            if fabs(turn) > 0.25:
                turn = 0
            y = s + step - step * turn
            # Error left by Chebyshev's method, and by the third derivative.
            if sa <= y <= sb and fabs(step) * (
                    2 * turn * turn + step * step) < tolerance:
                return y
            s = y
        else:
            s = sa - 1
        if not (sa <= s <= sb):
            s = 0.5 * (sa + sb)
            if sb - sa < tolerance:
                return s
    return s


cdef inline double turning(cell_t *c, double sa, double sb) noexcept nogil:
    """Return where the slope of value() changes sign, or 2 (Illinois method)."""
    cdef double fa, fb, f, s, y, bend
    cdef int _n, side = 0
    y = value(c, sa, &fa, &bend)
    y = value(c, sb, &fb, &bend)
    if (fa < 0) == (fb < 0):
        return 2
    s = sa
    for _n in range(80):
        s = (fa * sb - fb * sa) / (fa - fb)
        y = value(c, s, &f, &bend)
        if fabs(f) < 1e-13 or sb - sa < 1e-9:
            break
        if (f < 0) == (fb < 0):
            sb = s
            fb = f
            if side == -1:
                fa *= 0.5
            side = -1
        else:
            sa = s
            fa = f
            if side == 1:
                fb *= 0.5
            side = 1
    return s


cdef struct sink_t:
    event_t *events
    Py_ssize_t n, capacity
    uint16_t x, y
    int full


cdef inline void emit(sink_t *out, double t, int polarity) noexcept nogil:
    if out.n >= out.capacity:
        out.full = 1
        return
    out.events[out.n].t = <int64_t>(t + 0.5)  # t >= 0
    out.events[out.n].x = out.x
    out.events[out.n].y = out.y
    out.events[out.n].p = <uint8_t>polarity
    out.n += 1


cdef inline void next_noise(pixel_t_ *p, config_t *cfg) noexcept nogil:
    """Advance to the next candidate of the pixel's Poisson process."""
    if cfg.noise <= 0:
        p.noise_t = NEVER
        return
    p.noise_t -= log64(uniform64(draw64(p.key, 2 * p.counter))) / cfg.noise
    p.counter += 1


cdef inline int noise_polarity(pixel_t_ *p, config_t *cfg, cell_t *c,
                               double s) noexcept nogil:
    """Polarity of the current candidate, or -1 if it is rejected because of the light.

    Thinning a Poisson process makes its rate depend on the light.
    """
    cdef uint64_t bits = draw64(p.key, 2 * p.counter - 1)
    cdef double rate = light_at(c, s) / cfg.bright_light
    rate = 1 - (1 - cfg.bright_factor) * (rate if rate < 1 else 1.0)
    return <int>(bits & 1) if uniform64(bits) < rate else -1


cdef inline void interval(pixel_t_ *p, config_t *cfg, cell_t *c, double t0, double last,
                          double *burst_t, int burst_p, sink_t *out) noexcept nogil:
    """Events of one pixel in [t0, t0 + h); `last` is the filtered log at its end."""
    cdef double s = 0, stop, ga = c.level, gb = 0, slope_a, slope_b, at, up, down
    cdef double extreme = 2, bend
    cdef double reach, t1 = t0 + cfg.h, tolerance = 0.001 / cfg.h
    cdef int polarity, checked = 0, forced
    if p.release > t0:
        if p.release >= t1:
            while p.noise_t < t1:
                next_noise(p, cfg)
            if burst_t[0] < t1:
                burst_t[0] = NEVER
            return
        s = (p.release - t0) / cfg.h
        ga = p.ref = value(c, s, &slope_a, &bend)
    while not out.full:
        # The next time at which an event is forced, or the end.
        forced = 0
        stop = 1
        at = burst_t[0] if burst_t[0] < p.noise_t else p.noise_t
        if at < t1:
            stop = (at - t0) / cfg.h
            forced = 1
            if stop < s:  # in the refractory period no event is made
                if burst_t[0] == at:
                    burst_t[0] = NEVER
                else:
                    next_noise(p, cfg)
                continue
        # The first crossing before that.
        up = p.ref + p.on
        down = p.ref - p.off
        at = -1
        if ga >= up or ga <= down:
            at = s
            polarity = ga >= up
        else:
            gb = last + c.drift if stop == 1 else value(c, stop, &slope_b, &bend)
            if not checked:
                # The values at both ends do not show crossings around a turning point.
                checked = 1
                if c.unfiltered:
                    slope_a = c.i1 / c.i0 + c.drift
                    slope_b = (c.i1 + 2 * c.i2 + 3 * c.i3) / light_at(c, 1) + c.drift
                else:
                    slope_a = c.drift + (c.v0 - c.level) * (
                        c.phi if c.slope == 0 else c.cutoff + c.slope * c.i0)
                    slope_b = c.drift + (c.v0 + c.m0 + c.b + c.e - last) * (
                        c.phi if c.slope == 0
                        else c.cutoff + c.slope * light_at(c, 1))
                if slope_a * slope_b < 0:
                    # Four times the height of a parabola above its higher end.
                    reach = fabs(slope_a)
                    if fabs(slope_b) < reach:
                        reach = fabs(slope_b)
                    reach *= 2 * reach / (fabs(slope_a) + fabs(slope_b))
                    if (reach > 1e-15 and (
                            (slope_a > 0
                             and (c.level if c.level > last + c.drift
                                  else last + c.drift) + reach >= up)
                            or (slope_a < 0
                                and (c.level if c.level < last + c.drift
                                     else last + c.drift) - reach <= down)
                            or s > 0 or stop < 1 or gb >= up or gb <= down)):
                        extreme = turning(c, 0, 1)
            if s < extreme < stop:
                reach = value(c, extreme, &slope_a, &bend)
                if reach >= up or reach <= down:
                    polarity = reach >= up
                    at = root(c, up if polarity else down, s, extreme, ga, reach,
                              tolerance)
                elif gb >= up or gb <= down:
                    polarity = gb >= up
                    at = root(c, up if polarity else down, extreme, stop, reach, gb,
                              tolerance)
            elif gb >= up or gb <= down:
                polarity = gb >= up
                at = root(c, up if polarity else down, s, stop, ga, gb, tolerance)
        if at < 0:
            if not forced:
                break
            at = stop
            if burst_t[0] <= p.noise_t:
                polarity = burst_p
                burst_t[0] = NEVER
            else:
                polarity = noise_polarity(p, cfg, c, at)
                next_noise(p, cfg)
                if polarity < 0:
                    s = at
                    ga = gb
                    continue
            ga = gb
        elif at > s:
            ga = up if polarity else down
        emit(out, t0 + at * cfg.h, polarity)
        p.ref += p.on if polarity else -p.off
        s = at
        if cfg.refractory > 0:
            p.release = t0 + at * cfg.h + cfg.refractory
            if p.release >= t1:
                while p.noise_t < t1:
                    next_noise(p, cfg)
                if burst_t[0] < t1:
                    burst_t[0] = NEVER
                return
            s = (p.release - t0) / cfg.h
            ga = p.ref = value(c, s, &slope_a, &bend)


cdef inline int no_crossing(cell_t *c, pixel_t_ *p, double last) noexcept nogil:
    """Return 1 if there certainly is no crossing in the interval.

    That is so if the end lies between the thresholds and the slope has the same sign at
    both ends.
    """
    cdef double a, b
    last += c.drift
    if not p.ref - p.off < last < p.ref + p.on:
        return 0
    if c.unfiltered:
        return 0
    last -= c.drift
    a = (c.v0 - c.level) * (c.phi if c.slope == 0 else c.cutoff + c.slope * c.i0)
    b = (c.v0 + c.m0 + c.b + c.e - last) * (
        c.phi if c.slope == 0 else c.cutoff + c.slope * light_at(c, 1))
    return (a + c.drift) * (b + c.drift) > 0


cdef inline void filter_weights(config_t *cfg) noexcept nogil:
    """Weights of the filter's end value: w_n = phi int_0^1 exp(-phi (1 - x)) x^n dx."""
    cdef double phi = cfg.cutoff * cfg.h, term, total
    cdef double w[4]
    cdef int n, k
    cfg.e = exp64(-phi)
    for n in range(4):
        if phi < SERIES:
            term = phi / (n + 1)
            total = 0
            for k in range(TERMS + 2):
                total += term
                term *= -phi / (n + k + 2)
            w[n] = total
        elif n == 0:
            w[0] = 1 - cfg.e
        else:
            w[n] = 1 - n * w[n - 1] / phi
    cfg.w0 = w[0]
    cfg.w1 = w[1]
    cfg.w2 = w[2]
    cfg.w3 = w[3]


cdef inline void read_config(const double[::1] settings, config_t *cfg) noexcept:
    cfg.h = settings[0]
    cfg.t0 = settings[1]
    cfg.unfiltered = settings[2] != 0
    cfg.cutoff = settings[3]
    cfg.cutoff_slope = settings[4]
    cfg.refractory = settings[5]
    cfg.bright_factor = settings[6]
    cfg.bright_light = settings[7]
    cfg.burst_chance = settings[8]
    cfg.burst_width = settings[9]
    cfg.noise = settings[10]
    cfg.dark = settings[11]
    cfg.leak_slope = settings[12]
    filter_weights(cfg)


cdef inline double next_burst(pixel_t_ *p, config_t *cfg, const double[::1] edges,
                              Py_ssize_t *edge, uint64_t first, double after,
                              int *polarity) noexcept nogil:
    """Time of the next event that the edge of an exposure causes, from after on."""
    cdef uint64_t key = p.key ^ 0xd1b54a32d192ed03ULL, bits
    cdef double t
    while edge[0] < edges.shape[0]:
        bits = draw64(key, 2 * (first + <uint64_t>edge[0]))
        polarity[0] = <int>(bits & 1)
        t = edges[edge[0]] + cfg.burst_width * uniform64(
            draw64(key, 2 * (first + <uint64_t>edge[0]) + 1))
        edge[0] += 1
        if uniform64(bits) < cfg.burst_chance and t >= after:
            return t
    return NEVER
