"""Events of simulated pixels over intervals of time; the model is in _pixel.pxd."""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t

from _kernels._double cimport exp64, log64
from _kernels._pixel cimport (
    FAINT,
    NEVER,
    SERIES,
    begin,
    cell_t,
    config_t,
    emit,
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

cdef extern from *:
    """
    #if defined(__GNUC__)
    #define prefetch(p) __builtin_prefetch(p)
    #else
    #define prefetch(p) ((void)(p))
    #endif
    """
    void prefetch(const void *p) nogil

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
    interval; if it has no rows, light is linear between nodes.  pixels (N, 3) holds ON
    and OFF thresholds and leak, places (N, 2) x and y, state (N, 6) the filtered log,
    the reference, the end of the refractory period, the next noise candidate, the light
    and its log at the first node.
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
    cdef int linear = slope.shape[0] == 0
    cdef nodes_t nodes
    m = 3 if shared else n
    if (k < 0 or light.shape[1] != m
            or (not linear and (slope.shape[0] != k + 1 or slope.shape[1] != m))
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
    cdef int together = not (shared or linear or cfg.unfiltered) and k < NODES
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
                    if not linear:
                        d1 = analyser[i, 0] * slope[j, 0] + (
                            analyser[i, 1] * slope[j, 1] + analyser[i, 2] * slope[j, 2])
                else:
                    light1 = cfg.dark + light[j, i]
                    if not linear:
                        d1 = slope[j, i]
                if not together and light1 < FAINT:
                    light1 = FAINT
                    d1 = 0
                if linear:
                    d0 = d1 = light1 - p.light
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


cdef extern from "_film.h" nogil:
    enum:
        GROUP
        NO_EVENT
        ON
        UNDECIDED
    ctypedef struct film_t:
        float dark, faint, w0, w1, soon
        int32_t unfiltered, single
        double t0, h, t1, phi
    ctypedef struct film_group_t:
        double *ref
        double *since
        double *release
        double *noise_t
        double *on
        double *off
        double *leak
        double *level
        double *last
        double *v0
        double *v1
        double *at
        int64_t *outcome
        float *low
        float *high
        float *until
    const double FILM_ROUNDING
    void film_row(const film_t *film, Py_ssize_t n, const float *i0, const float *i45,
                  const float *i90, const float *i135, const float *half,
                  const float *along, const float *across, const float *low,
                  const float *high, const float *until, float *light, float *level,
                  float *v, float *old_level, float *old_v, uint8_t *busy)
    Py_ssize_t film_indices(const uint8_t *marks, Py_ssize_t n, int32_t *places)
    void film_solve(const film_t *film, Py_ssize_t n, film_group_t *group)
    void film_rest(double ref, double on, double off, double leak, double release,
                   double noise_t, double t1, float *low, float *high, float *until)

cdef enum:
    ROW = 512               # pixels per call of film_row
    FRAMES = 16             # intervals per call of video_events

cdef packed struct film_cell_t:
    # State of a pixel in front of a video, in addition to the rows of `watch`.
    double ref              # log light memorised by the comparator
    double since            # its time, us; the memory falls by leak from then on
    double release          # end of the refractory period, us
    double noise_t          # next candidate of a noise event, us
    double on, off          # thresholds
    double leak             # ln units per us
    uint64_t counter        # number of candidates drawn


cdef struct film_job_t:
    # Arguments of video_events that all its intervals share; n pixels.
    Py_ssize_t n, width
    const float *weights    # (3, n)
    const uint64_t *keys
    float *watch            # (5, n)
    film_cell_t *cells


cdef inline void film_undecided(
        const film_job_t *job, config_t *cfg, cell_t *c, film_group_t *g, Py_ssize_t k,
        const double[::1] edges, uint64_t first_edge, film_cell_t *cell, Py_ssize_t i,
        sink_t *sink) noexcept nogil:
    """Compute an interval of pixel i, the k-th of the group, by the general solver."""
    cdef pixel_t_ p
    cdef double t1 = cfg.t0 + cfg.h, ref, burst_t = NEVER
    cdef Py_ssize_t edge = 0, saved = sink.n
    cdef int burst_p = 0, bursts = edges.shape[0] > 0 and cfg.burst_chance > 0
    cdef int noisy = cell.noise_t < t1 or bursts
    p.ref = ref = cell.ref - cell.leak * (cfg.t0 - cell.since)
    p.release = cell.release
    p.noise_t = cell.noise_t
    p.on = cell.on
    p.off = cell.off
    p.counter = cell.counter
    p.key = job.keys[i]
    c.v0 = g.v0[k]
    c.m0 = g.v1[k] - c.v0
    c.level = g.level[k]
    c.drift = cell.leak * cfg.h
    c.ready = 0
    if noisy and p.counter == 0:
        next_noise(&p, cfg)
    if bursts:
        burst_t = next_burst(&p, cfg, edges, &edge, first_edge, cfg.t0, &burst_p)
    if noisy or c.unfiltered:
        c.i0 = exp64(c.v0)
        c.i1 = exp64(g.v1[k]) - c.i0
    interval(&p, cfg, c, cfg.t0, g.last[k], &burst_t, burst_p, sink)
    if sink.full:
        sink.n = saved
        return
    if p.ref != ref:
        cell.ref = p.ref - c.drift
        cell.since = t1
    cell.release = p.release
    cell.noise_t = p.noise_t
    cell.counter = p.counter
    film_rest(cell.ref - cell.leak * (t1 - cell.since), cell.on, cell.off, cell.leak,
              cell.release, cell.noise_t, t1, &g.low[k], &g.high[k], &g.until[k])


cdef Py_ssize_t film_interval(const film_job_t *job, config_t *cfg, const float *quad,
                              float *light, const double[::1] edges,
                              uint64_t first_edge, Py_ssize_t start, Py_ssize_t stop,
                              sink_t *sink) noexcept nogil:
    """Compute one interval of pixels [start, stop); return the first one not done.

    quad (4, n) is the frame at the end of the interval.  light (n) receives the light
    of the pixels at that time, unless it is NULL.
    """
    cdef Py_ssize_t n = job.n, i, j = start, k, many, found, first, some
    cdef film_t film
    cdef film_group_t g
    cdef cell_t c
    cdef film_cell_t *cell
    cdef float *levels = job.watch
    cdef float *logs = job.watch + n
    cdef float *low = job.watch + 2 * n
    cdef float *high = job.watch + 3 * n
    cdef float *until = job.watch + 4 * n
    cdef float unseen[ROW]
    cdef float old_level[ROW]
    cdef float old_v[ROW]
    cdef uint8_t busy[ROW]
    cdef int32_t places[ROW + 1]
    cdef int bursts = edges.shape[0] > 0 and cfg.burst_chance > 0
    film.dark = <float>cfg.dark
    film.faint = <float>FAINT
    film.w0 = <float>cfg.w0
    film.w1 = <float>cfg.w1
    film.unfiltered = cfg.unfiltered
    film.t0 = cfg.t0
    film.h = cfg.h
    film.t1 = cfg.t0 + cfg.h
    film.phi = c.phi = c.cutoff = cfg.cutoff * cfg.h
    # film_solve divides by phi, and fall64 takes arguments up to 700.
    film.single = not cfg.unfiltered and not cfg.refractory > 0 and 1e-3 < c.phi < 700
    # If edges of exposures can cause bursts of events, every pixel is busy.
    film.soon = INFINITY if bursts else <float>(film.t1 * (1 + FILM_ROUNDING))
    c.i0 = c.i1 = c.i2 = c.i3 = c.b = c.e = c.slope = 0
    c.unfiltered = cfg.unfiltered
    c.series = c.phi < SERIES
    while j < stop:
        many = stop - j if stop - j < ROW else ROW
        for i in range(many, (many + 7) & ~7):
            busy[i] = 0
        film_row(&film, many, quad + j, quad + n + j, quad + 2 * n + j,
                 quad + 3 * n + j, job.weights + j, job.weights + n + j,
                 job.weights + 2 * n + j, low + j, high + j, until + j,
                 &unseen[0] if light == NULL else light + j, levels + j, logs + j,
                 old_level, old_v, busy)
        found = film_indices(busy, many, places)
        for k in range(found):
            prefetch(&job.cells[j + places[k]])
        first = 0
        while first < found:
            some = found - first if found - first < GROUP else GROUP
            for k in range(some):
                i = places[first + k]
                cell = &job.cells[j + i]
                g.ref[k] = cell.ref
                g.since[k] = cell.since
                g.release[k] = cell.release
                # film_solve does not model bursts: a noise candidate in the past makes
                # the pixel undecided.
                g.noise_t[k] = -NEVER if bursts else cell.noise_t
                g.on[k] = cell.on
                g.off[k] = cell.off
                g.leak[k] = cell.leak
                g.level[k] = old_level[i]
                g.last[k] = levels[j + i]
                g.v0[k] = old_v[i]
                g.v1[k] = logs[j + i]
            film_solve(&film, some, &g)
            for k in range(some):
                i = places[first + k]
                cell = &job.cells[j + i]
                if g.outcome[k] != NO_EVENT:
                    sink.x = <uint16_t>(<uint32_t>(j + i) % <uint32_t>job.width)
                    sink.y = <uint16_t>(<uint32_t>(j + i) // <uint32_t>job.width)
                    if g.outcome[k] == UNDECIDED:
                        film_undecided(job, cfg, &c, &g, k, edges, first_edge, cell,
                                       j + i, sink)
                    else:
                        emit(sink, g.at[k], g.outcome[k] == ON)
                    if sink.full:
                        first = i
                        for i in range(first, many):
                            levels[j + i] = old_level[i]
                            logs[j + i] = old_v[i]
                        return j + first
                    if g.outcome[k] != UNDECIDED:
                        cell.ref = g.ref[k]
                        cell.since = film.t1
                i += j
                low[i] = g.low[k]
                high[i] = g.high[k]
                until[i] = g.until[k]
            first += some
        j += many
    return stop


def video_events(tuple quads not None, const float[:, ::1] weights not None,
                 float[:, ::1] light not None, const uint64_t[::1] keys not None,
                 const double[::1] edges not None, uint64_t first_edge,
                 const double[:, ::1] settings not None,
                 float[:, ::1] watch not None, film_cell_t[::1] cells not None,
                 Py_ssize_t start, Py_ssize_t stop, Py_ssize_t band, Py_ssize_t done,
                 event_t[::1] out not None):
    """Write the events of pixels [start, stop) in intervals that end with video frames.

    quads has one frame (4, H, W) per interval, settings (K, 13) are as for
    pixel_events; K is at most 16.  weights (3, H * W) are the response of each pixel to
    I0 + I45 + I90 + I135, I0 - I90 and I45 - I135.  Log light is linear over an
    interval, so cutoff and leak must not depend on the light.  light (K, H * W)
    receives the light at the ends of the intervals, unless it has no rows.  watch
    (5, H * W) holds the filtered log, the log of light, and the two levels and the time
    within which a pixel makes no event.  Pixels are taken through all intervals in
    bands of `band`, which fit a cache.
    Returns (pixel-intervals done, number of events).  It stops before a pixel-interval
    whose events do not fit into out; the next call continues from there with `done`.
    """
    cdef Py_ssize_t n = keys.shape[0], frames = len(quads), height, k, at, first, last
    cdef film_job_t job
    cdef sink_t sink
    cdef const float *planes[FRAMES]
    cdef config_t cfgs[FRAMES]
    cdef const float[:, :, ::1] quad
    if (not 0 < frames <= FRAMES or settings.shape[0] != frames
            or settings.shape[1] != 13 or weights.shape[0] != 3
            or weights.shape[1] != n or light.shape[0] not in (0, frames)
            or light.shape[1] != n or watch.shape[0] != 5 or watch.shape[1] != n
            or cells.shape[0] != n or not 0 <= start <= stop <= n or band < 1
            or not 0 <= done <= (stop - start) * frames):
        raise ValueError("video_events: shapes do not fit")
    if start == stop:
        return 0, 0
    for k in range(frames):
        quad = quads[k]
        height, job.width = quad.shape[1], quad.shape[2]
        if (quad.shape[0] != 4 or height * job.width != n or height > 65536
                or job.width > 65536):
            raise ValueError("video_events: shapes do not fit")
        if not settings[k, 0] > 0 or settings[k, 4] != 0 or settings[k, 12] != 0:
            raise ValueError(
                "video_events: the interval, the cutoff or the leak does not fit")
        planes[k] = &quad[0, 0, 0]
        read_config(settings[k], &cfgs[k])
    job.n = n
    job.weights = &weights[0, 0]
    job.keys = &keys[0]
    job.watch = &watch[0, 0]
    job.cells = &cells[0]
    sink.events = &out[0] if out.shape[0] else NULL
    sink.capacity = out.shape[0]
    sink.n = 0
    sink.full = 0
    with nogil:
        first = start + done // (band * frames) * band
        done -= (first - start) * frames
        while first < stop:
            last = first + band if first + band < stop else stop
            k = done // (last - first)
            at = first + done % (last - first)
            while k < frames:
                at = film_interval(
                    &job, &cfgs[k], planes[k], &light[k, 0] if light.shape[0] else NULL,
                    edges, first_edge, at, last, &sink)
                if sink.full:
                    break
                at = first
                k += 1
            if k < frames:
                break
            done = 0
            first = last
    # k and at are those of the interval at which out was full.
    if first < stop:
        return (first - start) * frames + k * (last - first) + at - first, sink.n
    return (stop - start) * frames, sink.n
