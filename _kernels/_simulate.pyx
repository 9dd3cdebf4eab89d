"""Event pixels over intervals of light; the mathematics is in _pixel.pxd."""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, uint16_t, uint64_t

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

cdef extern from *:
    """
    #define NEVER_F 3e38f
    #define DRIFT 0.03
    #define MARGIN 4e-6
    #define ROUNDING 2e-7
    #if defined(__GNUC__)
    #define prefetch(p) __builtin_prefetch(p)
    #else
    #define prefetch(p) ((void)(p))
    #endif
    """
    const float NEVER_F     # us, beyond any time
    const double DRIFT      # thresholds that leak may move before a pixel is looked at
    const double MARGIN     # ln units, for the rounding of levels up to 32
    const double ROUNDING   # of a time to float, relative
    void prefetch(const void *p) nogil


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


cdef extern from "_film.h" nogil:
    ctypedef struct film_t:
        float dark, faint, w0, w1, t1
        int32_t unfiltered
    void film_row(const film_t *film, Py_ssize_t n, const float *i0, const float *i45,
                  const float *i90, const float *i135, const float *half,
                  const float *along, const float *across, const float *low,
                  const float *high, const float *until, float *light, float *level,
                  float *v, float *old_level, float *old_v, int32_t *busy)

cdef enum:
    ROW = 512               # pixels per call of film_row

cdef packed struct film_cell_t:
    # What a pixel before a video keeps beside the rows of `watch`.
    double ref              # log light that the comparator remembers
    double since            # us, when that was; it falls by leak from then on
    double release          # us, end of the refractory period
    double noise_t          # us, next candidate of shot noise
    double on, off          # thresholds
    double leak             # ln units per us
    uint64_t counter        # of candidates drawn


cdef inline int peaceful(config_t *cfg, cell_t *c, pixel_t_ *p, double v1,
                         double last) noexcept nogil:
    """Whether a constant cutoff lets nothing happen until the interval's end.

    The end is between the thresholds, and the level goes one way, or turns by less
    than the way to either.
    """
    cdef double bottom = p.ref - p.off, top = p.ref + p.on, a, b
    if not bottom < last + c.drift < top:
        return 0
    if cfg.unfiltered:
        return 1
    a = c.phi * (c.v0 - c.level) + c.drift
    b = c.phi * (v1 - last) + c.drift
    if a * b >= 0:
        return 1
    a = a if a > 0 else -a
    b = b if b > 0 else -b
    a = a if a < b else b
    top -= a + c.drift
    return bottom + a < last < top and bottom + a < c.level < top


cdef inline void rest(const film_cell_t *cell, double t1, float *low, float *high,
                      float *until) noexcept nogil:
    """Write how long, and between which levels, the pixel needs no look from t1 on.

    The margins are wider than the rounding to floats.
    """
    cdef double ref = cell.ref - cell.leak * (t1 - cell.since), stop = cell.noise_t
    if cell.leak * (stop - t1) > DRIFT * cell.on:
        stop = t1 + DRIFT * cell.on / cell.leak
    if cell.release > t1 or stop < t1:
        until[0] = -1
        return
    low[0] = <float>(ref - cell.off + MARGIN)
    high[0] = <float>(ref + cell.on - cell.leak * (stop - t1) - MARGIN)
    until[0] = <float>(stop * (1 - ROUNDING)) if stop < NEVER else <float>NEVER_F


def video_events(const float[:, :, ::1] quad not None,
                 const float[:, ::1] weights not None,
                 const float[::1] before not None, float[::1] light not None,
                 const uint64_t[::1] keys not None,
                 const double[::1] edges not None,
                 uint64_t first_edge,
                 const double[::1] settings not None,
                 float[:, ::1] watch not None, film_cell_t[::1] cells not None,
                 Py_ssize_t start, Py_ssize_t stop, event_t[::1] out not None):
    """Events of one interval that ends with a video frame; else as pixel_events.

    quad (4, H, W): the frame; weights (3, H * W): what each pixel sees of I0 + I45 +
    I90 + I135, I0 - I90 and I45 - I135.  Log light is linear over the interval, which
    needs a constant cutoff or none.  before and light (H * W): light at the interval's
    start, and what receives that at its end.  watch (5, H * W): level, log of light,
    and the two levels and the time up to which a pixel needs no look.
    """
    cdef Py_ssize_t n = keys.shape[0], width = quad.shape[2]
    cdef Py_ssize_t i, j, k, many, found, saved, edge
    cdef config_t cfg
    cdef film_t film
    cdef cell_t c
    cdef pixel_t_ p
    cdef film_cell_t *cell
    cdef sink_t sink
    cdef double v1, last, t1, ref, burst_t = NEVER
    cdef int burst_p = 0, bursts, noisy
    cdef float old_level[ROW]
    cdef float old_v[ROW]
    cdef int32_t busy[ROW]
    if (quad.shape[0] != 4 or quad.shape[1] * quad.shape[2] != n
            or weights.shape[0] != 3 or weights.shape[1] != n or light.shape[0] != n
            or before.shape[0] != n or watch.shape[0] != 5 or watch.shape[1] != n
            or cells.shape[0] != n or quad.shape[2] > 65536 or quad.shape[1] > 65536
            or settings.shape[0] != 12 or not 0 <= start <= stop <= n):
        raise ValueError("video_events: shapes do not fit")
    if not settings[0] > 0 or settings[4] != 0:
        raise ValueError("video_events: the interval or the cutoff does not fit")
    read_config(settings, &cfg)
    t1 = cfg.t0 + cfg.h
    bursts = edges.shape[0] > 0 and cfg.burst_chance > 0
    film.dark = <float>cfg.dark
    film.faint = <float>FAINT
    film.w0 = <float>cfg.w0
    film.w1 = <float>cfg.w1
    film.unfiltered = cfg.unfiltered
    # Every pixel is looked at where frame edges can burst.
    film.t1 = INFINITY if bursts else <float>(t1 * (1 + ROUNDING))
    c.i2 = c.i3 = c.b = c.e = c.slope = 0
    c.unfiltered = cfg.unfiltered
    c.phi = c.cutoff = cfg.cutoff * cfg.h
    c.series = c.phi < SERIES
    sink.events = &out[0] if out.shape[0] else NULL
    sink.capacity = out.shape[0]
    sink.n = 0
    sink.full = 0
    j = start
    with nogil:
        while j < stop:
            many = stop - j if stop - j < ROW else ROW
            film_row(&film, many, &quad[0, 0, 0] + j, &quad[1, 0, 0] + j,
                     &quad[2, 0, 0] + j, &quad[3, 0, 0] + j, &weights[0, j],
                     &weights[1, j], &weights[2, j], &watch[2, j], &watch[3, j],
                     &watch[4, j], &light[j], &watch[0, j], &watch[1, j], old_level,
                     old_v, busy)
            found = 0
            for i in range(many):  # the marks become places, in place
                k = busy[i]
                busy[found] = <int32_t>i
                found += k
            for k in range(found):
                prefetch(&cells[j + busy[k]])
            for k in range(found):
                i = busy[k]
                cell = &cells[j + i]
                v1 = watch[1, j + i]
                last = watch[0, j + i]
                p.ref = ref = cell.ref - cell.leak * (cfg.t0 - cell.since)
                p.release = cell.release
                p.noise_t = cell.noise_t
                p.on = cell.on
                p.off = cell.off
                c.v0 = old_v[i]
                c.m0 = v1 - c.v0
                c.level = old_level[i]
                c.drift = cell.leak * cfg.h
                if p.noise_t < t1 or p.release > cfg.t0 or bursts or not peaceful(
                        &cfg, &c, &p, v1, last):
                    saved = sink.n
                    noisy = p.noise_t < t1 or bursts
                    if noisy:
                        p.counter = cell.counter
                        p.key = keys[j + i]
                        if p.counter == 0:
                            next_noise(&p, &cfg)
                    if bursts:
                        edge = 0
                        burst_t = next_burst(&p, &cfg, edges, &edge, first_edge,
                                             cfg.t0, &burst_p)
                    sink.x = <uint16_t>((j + i) % width)
                    sink.y = <uint16_t>((j + i) // width)
                    c.i0 = before[j + i]
                    c.i1 = light[j + i] - c.i0
                    c.ready = 0
                    interval(&p, &cfg, &c, cfg.t0, last, &burst_t, burst_p, &sink)
                    if sink.full:
                        sink.n = saved
                        for i in range(i, many):
                            watch[0, j + i] = old_level[i]
                            watch[1, j + i] = old_v[i]
                        break
                    if p.ref != ref:
                        cell.ref = p.ref - c.drift
                        cell.since = t1
                    cell.release = p.release
                    if noisy:
                        cell.noise_t = p.noise_t
                        cell.counter = p.counter
                rest(cell, t1, &watch[2, j + i], &watch[3, j + i], &watch[4, j + i])
            else:
                j += many
                continue
            j += busy[k]
            break
    return j, sink.n
