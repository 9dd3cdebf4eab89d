"""Events of simulated pixels over intervals of time; the model is in _pixel.pxd."""
from libc.stdint cimport uint16_t, uint64_t

from _kernels._double cimport exp64, log64
from _kernels._pixel cimport (
    FAINT,
    NEVER,
    begin,
    cell_t,
    config_t,
    end_level,
    interval,
    next_burst,
    next_noise,
    no_crossing,
    pixel_t_,
    read_config,
    sink_t,
)
from _kernels._types cimport event_t

cdef extern from "_nodes.h" nogil:
    enum:
        NODES
        BESIDE
    ctypedef struct nodes_t:
        double *light
        double *slope
        double *log
        double *rise
        double *level
        double *monotonic
        double *drift
        double *flat
    ctypedef struct nodes_filter_t:
        double phi, e, w0, w1, w2, w3
    void nodes_level_row(Py_ssize_t n, const nodes_filter_t *filter,
                         const double *drift, const double *light,
                         const double *slope, const double *log, const double *rise,
                         const double *level0, double *level1,
                         double *monotonic,
                         double *flat)
    void nodes_row(Py_ssize_t n, double dark, double faint, const double *seen,
                   const double *change, double *light, double *slope, double *log,
                   double *rise)


cdef void look_ahead(nodes_t *nodes, const config_t *cfg, Py_ssize_t many,
                     Py_ssize_t k, const double[:, ::1] light,
                     const double[:, ::1] slope, const double[:, ::1] pixels,
                     const double[:, ::1] state, Py_ssize_t i) noexcept nogil:
    """Compute light and filtered log of pixels i ... i + many - 1 at all nodes.

    Events do not change either, so that this can be done for several pixels at once.
    """
    cdef Py_ssize_t j, at
    cdef nodes_filter_t filter
    for j in range(k + 1):
        at = j * BESIDE
        nodes_row(many, cfg.dark, FAINT, &light[j, i], &slope[j, i], &nodes.light[at],
                  &nodes.slope[at], &nodes.log[at], &nodes.rise[at])
    if cfg.cutoff_slope != 0 or cfg.leak_slope != 0:
        return
    filter.phi = cfg.cutoff * cfg.h
    filter.e = cfg.e
    filter.w0 = cfg.w0
    filter.w1 = cfg.w1
    filter.w2 = cfg.w2
    filter.w3 = cfg.w3
    for j in range(many):
        nodes.level[j] = state[i + j, 0]
        nodes.drift[j] = pixels[i + j, 2] * cfg.h
        nodes.flat[j] = 0
        if nodes.light[j] == state[i + j, 4]:
            nodes.log[j] = state[i + j, 5]
    for j in range(k):
        at = j * BESIDE
        nodes_level_row(many, &filter, nodes.drift, &nodes.light[at], &nodes.slope[at],
                        &nodes.log[at], &nodes.rise[at], &nodes.level[at],
                        &nodes.level[at + BESIDE], &nodes.monotonic[at + BESIDE],
                        nodes.flat)


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
    """Write the events of pixels [start, stop) in K intervals, in the order of pixels.

    light and slope are (K + 1, N), the light of each pixel at the nodes; with analyser
    (N, 3) they are (K + 1, 3), Stokes parameters that all pixels share.  slope is per
    interval.  pixels (N, 3) holds ON and OFF thresholds and leak, places (N, 2) x and
    y, state (N, 6) the filtered log, the reference, the end of the refractory period,
    the next noise candidate, the light and its log at the first node.
    Returns (index of the first pixel not done, number of events): a pixel whose events
    do not fit into out is not done.
    """
    cdef Py_ssize_t n = pixels.shape[0], k = light.shape[0] - 1, i, j, m, edge, many
    cdef Py_ssize_t saved
    cdef config_t cfg
    cdef cell_t c
    cdef pixel_t_ p
    cdef sink_t sink
    cdef double d0, d1, light1, v1, last, burst_t, t0, top = 0, bottom = 0, m0, m1
    cdef int burst_p = 0, shared = analyser is not None
    cdef int known, direct, still, known_ahead, passed
    cdef Py_ssize_t before, at, ahead = 0
    cdef nodes_t nodes
    m = 3 if shared else n
    if (k < 0 or light.shape[1] != m
            or slope.shape[0] != k + 1 or slope.shape[1] != m
            or pixels.shape[1] != 3 or keys.shape[0] != n or places.shape[0] != n
            or places.shape[1] != 2 or state.shape[0] != n or state.shape[1] != 6
            or counters.shape[0] != n or settings.shape[0] != 13
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
    # Several pixels are computed at once if the log is needed at every node.
    cdef int together = not (shared or cfg.unfiltered) and k < NODES
    with nogil:
        for i in range(start, stop):
            if together and (i - start) % BESIDE == 0:
                ahead = i
                many = stop - i if stop - i < BESIDE else BESIDE
                look_ahead(&nodes, &cfg, many, k, light, slope, pixels, state, i)
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
            d0 = m0 = m1 = v1 = passed = 0
            if p.counter == 0:
                next_noise(&p, &cfg)
            edge = 0
            known = 1
            # Without low-pass and leak, light is compared with the exponential of the
            # thresholds, which saves most logarithms.
            direct = cfg.unfiltered and p.leak == 0 and cfg.leak_slope == 0
            burst_t = next_burst(&p, &cfg, edges, &edge, first_edge, cfg.t0, &burst_p)
            # Constant light is treated below, interval by interval.
            known_ahead = (together and cfg.cutoff_slope == 0 and cfg.leak_slope == 0
                           and nodes.flat[i - ahead] == 0)
            for j in range(k + 1):
                if together:
                    at = j * BESIDE + i - ahead
                    if known_ahead and j > 0:
                        last = nodes.level[at] + nodes.drift[i - ahead]
                        t0 = cfg.t0 + (j - 1) * cfg.h
                        if (nodes.monotonic[at] and p.ref - p.off < last < p.ref + p.on
                                and p.noise_t >= t0 + cfg.h
                                and burst_t >= t0 + cfg.h and p.release <= t0):
                            p.ref -= nodes.drift[i - ahead]
                            passed = 1
                            continue
                        if passed:
                            at -= BESIDE
                            p.level = nodes.level[at]
                            p.light = nodes.light[at]
                            p.v = nodes.log[at]
                            d0 = nodes.slope[at]
                            m0 = nodes.rise[at]
                            at += BESIDE
                            passed = 0
                    light1 = nodes.light[at]
                    d1 = nodes.slope[at]
                    v1 = nodes.log[at]
                    m1 = nodes.rise[at]
                elif shared:
                    light1 = cfg.dark + analyser[i, 0] * light[j, 0] + (
                        analyser[i, 1] * light[j, 1] + analyser[i, 2] * light[j, 2])
                    d1 = analyser[i, 0] * slope[j, 0] + (
                        analyser[i, 1] * slope[j, 1] + analyser[i, 2] * slope[j, 2])
                else:
                    light1 = cfg.dark + light[j, i]
                    d1 = slope[j, i]
                if not together and light1 < FAINT:
                    light1 = FAINT
                    d1 = 0
                if j == 0:
                    if light1 != p.light:
                        p.light = light1
                        p.v = v1 if together else log64(light1)
                    d0 = d1
                    m0 = m1
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
                if light1 == p.light and d0 == 0 and d1 == 0 and still and (
                        p.level == p.v and not direct):
                    # Constant light, filter in steady state: only the leak changes.
                    c.drift = cfg.h * (p.leak + cfg.leak_slope * p.on * light1)
                    if p.ref - p.off < p.level + c.drift < p.ref + p.on:
                        p.ref -= c.drift
                        continue
                if not known:
                    p.level = p.v = log64(p.light)
                    known = 1
                if not together:
                    v1 = log64(light1)
                    if not cfg.unfiltered:
                        m0 = d0 / p.light
                        m1 = d1 / light1
                begin(&c, &cfg, &p, light1, v1, d0, d1, m0, m1)
                last = end_level(&c, &cfg, v1)
                if not (still and no_crossing(&c, &p, last)):
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
                m0 = m1
            if sink.full:
                sink.n = saved
                break
            if passed:
                at = k * BESIDE + i - ahead
                p.level = nodes.level[at]
                p.light = nodes.light[at]
                p.v = nodes.log[at]
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
