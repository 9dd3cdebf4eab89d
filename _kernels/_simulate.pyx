"""Event pixels over intervals of light; the mathematics is in _pixel.pxd."""
from libc.stdint cimport int32_t, uint16_t, uint64_t
from libc.string cimport memcpy

from _kernels._double cimport exp64, log64
from _kernels._pixel cimport (
    FAINT,
    NEVER,
    SERIES,
    begin,
    cell_t,
    config_t,
    end_level,
    interval,
    next_burst,
    next_noise,
    pixel_t_,
    quiet,
    read_config,
    sink_t,
)
from _kernels._types cimport event_t


def pixel_events(const double[:, ::1] light not None,
                 const double[:, ::1] slope not None,
                 const double[:, ::1] analyser,
                 const double[:, ::1] pixels not None,
                 const uint64_t[::1] keys not None,
                 const double[::1] edges not None,
                 uint64_t first_edge,
                 const double[::1] settings not None,
                 const uint16_t[:, ::1] places not None,
                 double[:, ::1] state not None,
                 uint64_t[::1] counters not None,
                 Py_ssize_t start, Py_ssize_t stop, event_t[::1] out not None):
    """Events of pixels start..stop over K intervals, in pixel order.

    light, slope: (K + 1, N) of each pixel; with analyser (N, 3), (K + 1, 3) Stokes
    components that all pixels share.  slope is per interval; without rows, light is
    linear between nodes.  pixels (N, 3): on, off, leak; places (N, 2): x, y; state
    (N, 6): level, reference, release, next noise, light and its log at the node.
    Returns (pixels done up to, events written): it stops before a pixel whose events
    do not fit.
    """
    cdef Py_ssize_t n = pixels.shape[0], k = light.shape[0] - 1, i, j, m, edge
    cdef Py_ssize_t saved
    cdef config_t cfg
    cdef cell_t c
    cdef pixel_t_ p
    cdef sink_t sink
    cdef double d0, d1, light1, v1, last, burst_t, t0, top = 0, bottom = 0
    cdef int burst_p = 0, shared = analyser is not None
    cdef int known, direct, still
    cdef Py_ssize_t before
    cdef int linear = slope.shape[0] == 0
    m = 3 if shared else n
    if (k < 0 or light.shape[1] != m
            or (not linear and (slope.shape[0] != k + 1 or slope.shape[1] != m))
            or pixels.shape[1] != 3 or keys.shape[0] != n or places.shape[0] != n
            or places.shape[1] != 2 or state.shape[0] != n or state.shape[1] != 6
            or counters.shape[0] != n or settings.shape[0] != 12
            or not 0 <= start <= stop <= n):
        raise ValueError("pixel_events: shapes do not fit")
    if shared and (analyser.shape[0] != n or analyser.shape[1] != 3):
        raise ValueError("pixel_events: analyser must be (n, 3)")
    if not settings[0] > 0:
        raise ValueError("pixel_events: the interval must be positive")
    read_config(settings, &cfg)
    sink.events = &out[0] if out.shape[0] else NULL
    sink.capacity = out.shape[0]
    sink.n = 0
    sink.full = 0
    with nogil:
        for i in range(start, stop):
            saved = sink.n
            p.level = state[i, 0]
            p.ref = state[i, 1]
            p.release = state[i, 2]
            p.noise_t = state[i, 3]
            p.counter = counters[i]
            p.key = keys[i]
            p.on = pixels[i, 0]
            p.off = pixels[i, 1]
            p.leak = pixels[i, 2]
            sink.x = places[i, 0]
            sink.y = places[i, 1]
            p.light = state[i, 4]
            p.v = state[i, 5]
            d0 = 0
            if p.counter == 0:
                next_noise(&p, &cfg)
            edge = 0
            known = 1
            # Without filter and leak, light itself is compared, and seldom its log.
            direct = cfg.unfiltered and p.leak == 0
            burst_t = next_burst(&p, &cfg, edges, &edge, first_edge, cfg.t0, &burst_p)
            for j in range(k + 1):
                if shared:
                    light1 = cfg.dark + analyser[i, 0] * light[j, 0] + (
                        analyser[i, 1] * light[j, 1] + analyser[i, 2] * light[j, 2])
                    if not linear:
                        d1 = analyser[i, 0] * slope[j, 0] + (
                            analyser[i, 1] * slope[j, 1] + analyser[i, 2] * slope[j, 2])
                else:
                    light1 = cfg.dark + light[j, i]
                    if not linear:
                        d1 = slope[j, i]
                if light1 < FAINT:
                    light1 = FAINT
                    d1 = 0
                if linear:
                    d0 = d1 = light1 - p.light
                if j == 0:
                    if light1 != p.light:
                        p.light = light1
                        p.v = log64(light1)
                    d0 = d1
                    if direct:
                        p.level = p.v
                        top = exp64(p.ref + p.on)
                        bottom = exp64(p.ref - p.off)
                    continue
                t0 = cfg.t0 + (j - 1) * cfg.h
                still = p.noise_t >= t0 + cfg.h and burst_t >= t0 + cfg.h and (
                    p.release <= t0)
                if direct and still and bottom < light1 < top and d0 * d1 > 0:
                    p.light = light1
                    d0 = d1
                    known = 0
                    continue
                v1 = log64(light1)
                if not known:
                    p.level = p.v = log64(p.light)
                    known = 1
                begin(&c, &cfg, &p, light1, v1, d0, d1)
                last = end_level(&c, &cfg, v1)
                if not (still and quiet(&c, &p, last)):
                    before = sink.n
                    interval(&p, &cfg, &c, t0, last, &burst_t, burst_p, &sink)
                    if direct and before != sink.n:
                        top = exp64(p.ref + p.on)
                        bottom = exp64(p.ref - p.off)
                    while burst_t == NEVER and edge < edges.shape[0]:
                        burst_t = next_burst(&p, &cfg, edges, &edge, first_edge,
                                             t0 + cfg.h, &burst_p)
                p.level = last
                p.ref -= c.drift
                p.light = light1
                p.v = v1
                d0 = d1
            if sink.full:
                sink.n = saved
                break
            state[i, 0] = p.level
            state[i, 1] = p.ref
            state[i, 2] = p.release
            state[i, 3] = p.noise_t
            state[i, 4] = p.light
            state[i, 5] = p.v if known else log64(p.light)
            counters[i] = p.counter
        else:
            i = stop
    return i, sink.n


cdef inline float log32(float x) noexcept nogil:
    """Natural log of a positive, normal x, to 2e-7; the compiler vectorises it.

    The mantissa is taken to sqrt(1/2)..sqrt(2); then Cephes' polynomial (logf.c).
    """
    cdef int32_t bits, k
    cdef float m, z, y, e
    memcpy(&bits, &x, 4)
    k = (bits - 0x3f3504f3) >> 23
    bits -= k * (1 << 23)  # a shift of what is negative is not defined
    memcpy(&m, &bits, 4)
    m -= <float>1.0
    z = m * m
    y = <float>7.0376836292e-2
    y = y * m + <float>-1.1514610310e-1
    y = y * m + <float>1.1676998740e-1
    y = y * m + <float>-1.2420140846e-1
    y = y * m + <float>1.4249322787e-1
    y = y * m + <float>-1.6668057665e-1
    y = y * m + <float>2.0000714765e-1
    y = y * m + <float>-2.4999993993e-1
    y = y * m + <float>3.3333331174e-1
    y = y * m * z
    e = <float>k
    y += e * <float>-2.12194440e-4
    y -= <float>0.5 * z
    return m + y + e * <float>0.693359375


cdef void weigh(const float *quad, Py_ssize_t plane, const float *weights,
                Py_ssize_t area, float dark, Py_ssize_t n, float *light,
                float *v) noexcept nogil:
    """Light and log light of n pixels behind their analysers."""
    cdef Py_ssize_t i
    cdef float s, faint = <float>FAINT
    for i in range(n):
        s = dark + weights[i] * quad[i] + weights[area + i] * quad[plane + i]
        s += weights[2 * area + i] * quad[2 * plane + i]
        s += weights[3 * area + i] * quad[3 * plane + i]
        s = s if s > faint else faint
        light[i] = s
        v[i] = log32(s)


def video_events(const float[:, :, ::1] quad not None,
                 const float[:, ::1] weights not None,
                 const double[:, ::1] pixels not None,
                 const uint64_t[::1] keys not None,
                 const double[::1] edges not None,
                 uint64_t first_edge,
                 const double[::1] settings not None,
                 const uint16_t[:, ::1] places not None,
                 double[:, ::1] state not None,
                 uint64_t[::1] counters not None,
                 float[::1] light not None,
                 Py_ssize_t start, Py_ssize_t stop, event_t[::1] out not None):
    """Events of one interval that ends with a video frame; else as pixel_events.

    quad (4, H, W): the frame; weights (4, H * W): what each pixel sees of each plane.
    Log light is linear over the interval, which needs a constant cutoff or none.
    light (H * W) receives the light at the interval's end.
    """
    cdef Py_ssize_t n = pixels.shape[0], i, j, many, saved, edge
    cdef config_t cfg
    cdef cell_t c
    cdef pixel_t_ p
    cdef sink_t sink
    cdef double v1, last, t1, burst_t = NEVER, top, bottom, drift, phi, a, b
    cdef int burst_p = 0, bursts, still
    cdef float v[512]
    if (quad.shape[0] != 4 or quad.shape[1] * quad.shape[2] != n
            or weights.shape[0] != 4 or weights.shape[1] != n or light.shape[0] != n
            or pixels.shape[1] != 3 or keys.shape[0] != n or places.shape[0] != n
            or places.shape[1] != 2 or state.shape[0] != n or state.shape[1] != 6
            or counters.shape[0] != n or settings.shape[0] != 12
            or not 0 <= start <= stop <= n):
        raise ValueError("video_events: shapes do not fit")
    if not settings[0] > 0 or settings[4] != 0:
        raise ValueError("video_events: the interval or the cutoff does not fit")
    read_config(settings, &cfg)
    t1 = cfg.t0 + cfg.h
    phi = cfg.cutoff * cfg.h
    c.i2 = c.i3 = c.b = c.e = c.slope = 0
    c.unfiltered = cfg.unfiltered
    c.phi = c.cutoff = phi
    c.series = phi < SERIES
    bursts = edges.shape[0] > 0 and cfg.burst_chance > 0
    sink.events = &out[0] if out.shape[0] else NULL
    sink.capacity = out.shape[0]
    sink.n = 0
    sink.full = 0
    j = start
    with nogil:
        while j < stop and not sink.full:
            many = stop - j if stop - j < 512 else 512
            weigh(&quad[0, 0, 0] + j, n, &weights[0, 0] + j, n, <float>cfg.dark, many,
                  &light[j], v)
            for i in range(j, j + many):
                v1 = v[i - j]
                if cfg.unfiltered:
                    last = v1
                else:
                    last = cfg.e * state[i, 0] + cfg.w0 * state[i, 5] + (
                        cfg.w1 * (v1 - state[i, 5]))
                drift = pixels[i, 2] * cfg.h
                top = state[i, 1] + pixels[i, 0]
                bottom = state[i, 1] - pixels[i, 1]
                # Nothing happens if the end is between the thresholds and the level
                # goes one way, or turns by less than the way to either.
                if bottom < last + drift < top and not bursts and (
                        state[i, 3] >= t1 or cfg.noise == 0) and (
                        state[i, 2] <= cfg.t0):
                    a = phi * (state[i, 5] - state[i, 0]) + drift
                    b = phi * (v1 - last) + drift
                    still = cfg.unfiltered or a * b >= 0
                    if not still:
                        a = a if a > 0 else -a
                        b = b if b > 0 else -b
                        a = a if a < b else b
                        still = (bottom + a < last < top - a - drift) and (
                            bottom + a < state[i, 0] < top - a - drift)
                else:
                    still = 0
                if still:
                    state[i, 0] = last
                    state[i, 1] -= drift
                    state[i, 4] = light[i]
                    state[i, 5] = v1
                    continue
                saved = sink.n
                p.level = state[i, 0]
                p.ref = state[i, 1]
                p.release = state[i, 2]
                p.noise_t = state[i, 3]
                p.light = state[i, 4]
                p.v = state[i, 5]
                p.counter = counters[i]
                p.key = keys[i]
                p.on = pixels[i, 0]
                p.off = pixels[i, 1]
                p.leak = pixels[i, 2]
                sink.x = places[i, 0]
                sink.y = places[i, 1]
                if p.counter == 0:
                    next_noise(&p, &cfg)
                if bursts:
                    edge = 0
                    burst_t = next_burst(&p, &cfg, edges, &edge, first_edge, cfg.t0,
                                         &burst_p)
                c.i0 = p.light
                c.i1 = light[i] - p.light
                c.v0 = p.v
                c.m0 = v1 - p.v
                c.level = p.level
                c.drift = drift
                c.ready = 0
                interval(&p, &cfg, &c, cfg.t0, last, &burst_t, burst_p, &sink)
                if sink.full:
                    sink.n = saved
                    break
                state[i, 0] = last
                state[i, 1] = p.ref - c.drift
                state[i, 2] = p.release
                state[i, 3] = p.noise_t
                state[i, 4] = light[i]
                state[i, 5] = v1
                counters[i] = p.counter
            else:
                j += many
                continue
            j = i
            break
    return j, sink.n
