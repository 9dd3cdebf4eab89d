"""Innovations of a pixel sample under many candidate cameras, in one call.

For each candidate (bandwidth and noise) and each pixel a Kalman filter of (base,
theta_on, theta_off) runs over the pixel's frames: the model and the equations are
those of kalman_frame, without its noise of motion, noise at rest, and rest.  The sums
of e^2 / v, |e / sqrt(v)|^1.5 and ln v are returned per candidate.
A pixel's events are contiguous in memory, so that no store of recent events is needed.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint16_t

from _kernels._lag cimport corner, lead
from _kernels._lamp cimport lamp_flickers, lamp_of, lamp_t
from _kernels._math cimport exp_f, log_f
from _kernels._model cimport tuning_t, wave_t
from _kernels._tracks cimport (
    LONG_AGO, at_rest, between, drift, part_t, pass_to, quiet, still, walk_t)
from _kernels._types cimport event_t
from _kernels._update cimport (
    FINE_US, FIRST_VARIANCE, GAUSS, JUMP_SIGMAS, LEARN_EVENTS, THETA_LEAST, THETA_MOST)

cdef enum:
    # Most candidates that are evaluated together.
    TOGETHER = 32
    # Events that are looked at before those of the sample among them are copied.
    CHUNK = 256

cdef packed struct pixel_t:
    int32_t start           # its events: from start to before stop
    int32_t stop
    int32_t first           # its frames: from first to before last
    int32_t last
    double theta_on         # prior
    double theta_off

cdef packed struct reading_t:
    float log               # ln intensity
    float variance          # of read and shot noise; 0 or less: no usable sample
    int64_t begin           # exposure
    int64_t middle
    int64_t end
    int64_t known           # events up to this time are used

cdef packed struct candidate_t:
    double noise_per_s      # process noise, thresholds^2 per second and per event
    double noise_per_event
    double drift            # variance of thresholds' relative change between samples
    double hz               # bandwidth: hz + hz_per_intensity * I
    double hz_per_intensity
    double frame_sigma      # residual error of de-blurring, ln
    double scale_on         # factors on the prior thresholds
    double scale_off
    int64_t clock_us        # added to the frames' times

cdef packed struct innovations_t:
    double chi2             # sum of e^2 / v, 16 at most each
    double deviation        # sum of their powers of 3/4, |e / sqrt(v)|^1.5
    double log_variance     # sum of ln v
    double count
    double log_theta        # sum over pixels of ln theta_on + ln theta_off, at the end

cdef struct state_t:
    double base
    double on
    double off
    double p00
    double p01
    double p02
    double p11
    double p12
    double p22

cdef struct blur_t:
    # Integrals over the exposure of exp(y), exp(y) n_on and exp(y) n_off, where y is
    # log intensity relative to a level.
    double whole
    double on
    double off


cdef inline void pass_event(walk_t* walk, const event_t* events, int32_t stop,
                            double refractory) noexcept nogil:
    pass_to(walk, events[walk.next].t, events[walk.next].p, refractory)
    walk.next += 1
    if walk.next >= stop:
        walk.next = -1


cdef inline double log_at(const walk_t* walk, const event_t* events, int64_t known,
                          double t, const state_t* s, double level,
                          const tuning_t* camera, const lamp_t* lamp,
                          double* n_on, double* n_off) noexcept nogil:
    """Log intensity at t relative to level, between walk and its next event.

    Sets n_on and n_off to the counts, including the part crossed since the last event.
    """
    cdef double y, theta, hz = 0.0
    cdef part_t part
    if lamp.blocks > 0:
        hz = corner(camera, level + s.on * walk.n_on - s.off * walk.n_off)
    if walk.next >= 0 and events[walk.next].t <= known:
        part = between(walk, events[walk.next].t, events[walk.next].p, s.on, s.off,
                       lamp, hz, camera.refractory_us, t)
    elif at_rest(walk.t, <int64_t>t):
        part = still(walk, lamp, hz, t)
    else:
        part = quiet(walk, <double>known, lamp, hz, camera.refractory_us, t)
    n_on[0] = walk.n_on
    n_off[0] = walk.n_off
    if part.p:
        n_on[0] += part.fraction
        theta = s.on
    else:
        n_off[0] += part.fraction
        theta = -s.off
    y = s.on * n_on[0] - s.off * n_off[0] + part.ripple
    return y + lead(theta * part.rate + part.ripple_rate, level + y, camera)


cdef inline void add_segment(blur_t* total, const walk_t* walk, const event_t* events,
                             int64_t known, double begin, double end,
                             const state_t* s, double level, const tuning_t* camera,
                             const lamp_t* lamp) noexcept nogil:
    """Integrate from begin to end, between walk and its next event (2-point Gauss)."""
    cdef double middle = 0.5 * (begin + end), half = 0.5 * (end - begin)
    cdef double node = half * GAUSS, y, n_on, n_off
    cdef int k
    for k in range(2):
        y = log_at(walk, events, known, middle + node if k else middle - node, s,
                   level, camera, lamp, &n_on, &n_off)
        y = half * exp_f(<float>y)
        total.whole += y
        total.on += y * n_on
        total.off += y * n_off


cdef blur_t integral(walk_t* walk, const event_t* events, int32_t stop,
                     const reading_t* frame, const state_t* s, double level,
                     const tuning_t* camera, const lamp_t* lamp) noexcept nogil:
    """Integrate over the exposure, event by event; in short steps if a lamp flickers.
    """
    cdef blur_t total
    cdef double now = <double>frame.begin, end = <double>frame.end, until
    cdef bint flickers = lamp_flickers(lamp, now, end)
    total.whole = 0.0
    total.on = 0.0
    total.off = 0.0
    while True:
        until = end
        if walk.next >= 0 and events[walk.next].t < frame.end:
            until = <double>events[walk.next].t
        while flickers and until > now + FINE_US:
            add_segment(&total, walk, events, frame.known, now, now + FINE_US, s,
                        level, camera, lamp)
            now += FINE_US
        if until > now:
            add_segment(&total, walk, events, frame.known, now, until, s, level,
                        camera, lamp)
            now = until
        if walk.next < 0 or events[walk.next].t >= frame.end:
            return total
        pass_event(walk, events, stop, camera.refractory_us)


cdef inline void propagate(state_t* s, double n_on, double n_off,
                           double process_noise) noexcept nogil:
    """Transition over n events: base += on n_on - off n_off."""
    s.base += s.on * n_on - s.off * n_off
    s.p00 += (n_on * n_on * s.p11 + n_off * n_off * s.p22 + process_noise
              + 2.0 * (n_on * s.p01 - n_off * s.p02 - n_on * n_off * s.p12))
    s.p01 += n_on * s.p11 - n_off * s.p12
    s.p02 += n_on * s.p12 - n_off * s.p22


cdef inline void update(state_t* s, double h_on, double h_off, double noise,
                        double error, bint learn, innovations_t* out) noexcept nogil:
    """Kalman update by measured = base + h_on on + h_off off; error: the innovation.

    Without learn, the thresholds stay fixed (Schmidt-Kalman update).
    """
    cdef double g0 = s.p00 + h_on * s.p01 + h_off * s.p02
    cdef double g1 = s.p01 + h_on * s.p11 + h_off * s.p12
    cdef double g2 = s.p02 + h_on * s.p12 + h_off * s.p22
    cdef double v = g0 + h_on * g1 + h_off * g2 + noise, k0, k1, k2, square, jump
    out.log_variance += log_f(<float>v)
    out.count += 1.0
    if error * error > JUMP_SIGMAS * JUMP_SIGMAS * v:
        # Lost events or a wrong sample make the base jump, but not the thresholds.
        square = JUMP_SIGMAS * JUMP_SIGMAS
        jump = error * error
        s.p00 += jump
        g0 += jump
        v += jump
    else:
        square = error * error / v
    out.chi2 += square
    out.deviation += sqrt(square * sqrt(square))
    k0 = g0 / v
    k1 = g1 / v
    k2 = g2 / v
    s.base += k0 * error
    s.p00 -= k0 * g0
    s.p01 -= k0 * g1
    s.p02 -= k0 * g2
    if not learn:
        return
    s.on += k1 * error
    s.off += k2 * error
    s.p11 -= k1 * g1
    s.p12 -= k1 * g2
    s.p22 -= k2 * g2


cdef inline double limited(double theta, double prior) noexcept nogil:
    if theta < THETA_LEAST * prior:
        return THETA_LEAST * prior
    return THETA_MOST * prior if theta > THETA_MOST * prior else theta


cdef inline void place(walk_t* walk, const event_t* events, const pixel_t* pixel,
                       int32_t i) noexcept nogil:
    """Start before a pixel's event i, with counts of 0."""
    walk.t_prev = events[i - 2].t if i >= pixel.start + 2 else LONG_AGO
    walk.p_prev = events[i - 2].p if i >= pixel.start + 2 else 0
    walk.t = events[i - 1].t if i > pixel.start else LONG_AGO
    walk.p = events[i - 1].p if i > pixel.start else 0
    walk.next = i if i < pixel.stop else -1
    walk.n_on = 0.0
    walk.n_off = 0.0


cdef inline void advance(walk_t* since, walk_t* walk, const event_t* events,
                         const pixel_t* pixel, const reading_t* frame,
                         double refractory_us, double* n_on,
                         double* n_off) noexcept nogil:
    """Count events up to the middle of an exposure, and place walk at its begin."""
    cdef int32_t i
    cdef double on, off
    since.n_on = 0.0
    since.n_off = 0.0
    while since.next >= 0 and events[since.next].t <= frame.middle:
        pass_event(since, events, pixel.stop, refractory_us)
    n_on[0] = since.n_on
    n_off[0] = since.n_off
    i = since.next if since.next >= 0 else pixel.stop
    while i > pixel.start and events[i - 1].t > frame.begin:
        i -= 1
    place(walk, events, pixel, i)
    while walk.next >= 0 and events[walk.next].t <= frame.middle:
        pass_event(walk, events, pixel.stop, refractory_us)
    on = walk.n_on
    off = walk.n_off
    place(walk, events, pixel, i)
    walk.n_on = -on
    walk.n_off = -off


cdef inline void begin_pixel(state_t* s, double on, double off,
                             double theta_sigma) noexcept nogil:
    s.base = 0.0
    s.on = on
    s.off = off
    s.p00 = FIRST_VARIANCE
    s.p01 = 0.0
    s.p02 = 0.0
    s.p11 = theta_sigma * theta_sigma
    s.p12 = 0.0
    s.p22 = s.p11


cdef void take_frame(state_t* s, const walk_t* begin, const event_t* events,
                     const pixel_t* pixel, const reading_t* frame, double n_on,
                     double n_off, int64_t reference, bint fresh, double on, double off,
                     const lamp_t* lamp, const tuning_t* camera,
                     innovations_t* out) noexcept nogil:
    """Update a candidate's state by a frame, given the events since the last one."""
    cdef walk_t walk = begin[0]
    cdef blur_t total
    cdef double h_on, h_off, theta2, blur, level
    if fresh:
        level = frame.log
    else:
        theta2 = 0.25 * (s.on + s.off) * (s.on + s.off)
        if n_on + n_off >= LEARN_EVENTS:
            s.p11 += camera.threshold_drift * s.on * s.on
            s.p22 += camera.threshold_drift * s.off * s.off
        propagate(s, n_on, n_off, theta2 * drift(
            frame.middle - reference, n_on + n_off, camera))
        level = s.base
    if (walk.next < 0 or events[walk.next].t >= frame.end) and not lamp_flickers(
            lamp, <double>frame.begin, <double>frame.end):
        # No event in the whole exposure: the light at its middle is the mean light.
        blur = log_at(&walk, events, frame.known, 0.5 * (
            <double>frame.begin + <double>frame.end), s, level, camera, lamp,
            &h_on, &h_off)
        h_off = -h_off
    else:
        total = integral(&walk, events, pixel.stop, frame, s, level, camera, lamp)
        blur = log_f(<float>(total.whole / <double>(frame.end - frame.begin)))
        h_on = total.on / total.whole
        h_off = -total.off / total.whole
    if fresh:
        s.base = frame.log - blur
    update(s, h_on, h_off,
           frame.variance + camera.frame_sigma * camera.frame_sigma,
           frame.log - s.base - blur,
           not fresh and n_on + n_off >= LEARN_EVENTS, out)
    s.on = limited(s.on, on)
    s.off = limited(s.off, off)


cdef void run_pixel(const event_t* events, const pixel_t* pixel,
                    const reading_t* reading, double theta_sigma,
                    const candidate_t* candidates, const tuning_t* cameras, int many,
                    const lamp_t* lamp, innovations_t* out) noexcept nogil:
    """Run over a pixel's frames, for candidates with the clock offset of the first."""
    cdef reading_t frame
    cdef state_t states[TOGETHER]
    cdef walk_t walk, since
    cdef double n_on, n_off
    cdef int64_t reference = 0, clock_us = candidates[0].clock_us
    cdef int32_t k
    cdef int c
    cdef bint fresh = True
    for c in range(many):
        begin_pixel(&states[c], pixel.theta_on * candidates[c].scale_on,
                    pixel.theta_off * candidates[c].scale_off, theta_sigma)
    place(&since, events, pixel, pixel.start)
    for k in range(pixel.first, pixel.last):
        frame = reading[k]
        if not frame.variance > 0.0:
            continue
        frame.begin += clock_us
        frame.middle += clock_us
        frame.end += clock_us
        frame.known += clock_us
        advance(&since, &walk, events, pixel, &frame, cameras[0].refractory_us, &n_on,
                &n_off)
        for c in range(many):
            take_frame(&states[c], &walk, events, pixel, &frame, n_on, n_off, reference,
                       fresh, pixel.theta_on * candidates[c].scale_on,
                       pixel.theta_off * candidates[c].scale_off, lamp, &cameras[c],
                       &out[c])
        fresh = False
        reference = frame.middle
    for c in range(many):
        out[c].log_theta += log_f(<float>states[c].on) + log_f(<float>states[c].off)


def sample_innovations(const event_t[::1] events not None,
                       const pixel_t[::1] pixels not None,
                       const reading_t[::1] frames not None,
                       const wave_t[::1] waves not None, double theta_sigma,
                       double refractory_us,
                       const candidate_t[::1] candidates not None,
                       innovations_t[::1] out not None):
    """Sum the innovations of all pixels for each candidate.

    events and frames are ordered by pixel, then by time; frames have end > begin.
    waves are the lamp's, as in kalman_frame.  theta_sigma is the prior standard
    deviation of a threshold, refractory_us the refractory period.  out is overwritten.
    """
    cdef Py_ssize_t n = pixels.shape[0], c, i, m = candidates.shape[0]
    cdef int many, k
    cdef lamp_t lamp
    cdef tuning_t cameras[TOGETHER]
    cdef const event_t* first = NULL
    cdef const reading_t* reading = NULL
    if out.shape[0] != m:
        raise ValueError("sample_innovations: out must have one row per candidate")
    for i in range(n):
        if not 0 <= pixels[i].start <= pixels[i].stop <= events.shape[0]:
            raise ValueError("sample_innovations: a pixel's events lie outside events")
        if not 0 <= pixels[i].first <= pixels[i].last <= frames.shape[0]:
            raise ValueError("sample_innovations: a pixel's frames lie outside frames")
    if events.shape[0] > 0:
        first = &events[0]
    if frames.shape[0] > 0:
        reading = &frames[0]
    lamp = lamp_of(waves)
    with nogil:
        c = 0
        while c < m:
            # Those that move frames alike walk over a pixel's events once.
            many = 0
            while (many < TOGETHER and c + many < m
                   and candidates[c + many].clock_us == candidates[c].clock_us):
                k = many
                out[c + k].chi2 = 0.0
                out[c + k].deviation = 0.0
                out[c + k].log_variance = 0.0
                out[c + k].count = 0.0
                out[c + k].log_theta = 0.0
                cameras[k].refractory_us = refractory_us
                cameras[k].leak_per_s = candidates[c + k].noise_per_s
                cameras[k].noise_per_event = candidates[c + k].noise_per_event
                cameras[k].threshold_drift = candidates[c + k].drift
                cameras[k].bandwidth_hz = candidates[c + k].hz
                cameras[k].bandwidth_hz_per_intensity = (
                    candidates[c + k].hz_per_intensity)
                cameras[k].frame_sigma = candidates[c + k].frame_sigma
                many += 1
            for i in range(n):
                run_pixel(first, &pixels[i], reading, theta_sigma, &candidates[c],
                          cameras, many, &lamp, &out[c])
            c += many


def sample_events(const event_t[::1] events not None,
                  const int32_t[:, ::1] place not None, event_t[::1] out not None):
    """Copy the events of sampled pixels to out; return their number.

    place gives the pixel's number in the sample, which is the copy's x (its y is 0), or
    is negative.  Ends when out is full.
    """
    cdef Py_ssize_t h = place.shape[0], w = place.shape[1], size = events.shape[0]
    cdef Py_ssize_t i, k, m, at = 0, stop, n = 0
    cdef Py_ssize_t[CHUNK] chosen
    cdef const event_t* event
    with nogil:
        while at < size and n < out.shape[0]:
            m = 0
            stop = min(at + CHUNK, size)
            for i in range(at, stop):
                event = &events[i]
                # No branch: which pixel is next cannot be predicted.
                chosen[m] = i
                if event.y < h and event.x < w:
                    m += place[event.y, event.x] >= 0
            for k in range(min(m, out.shape[0] - n)):
                event = &events[chosen[k]]
                out[n] = event[0]
                out[n].x = <uint16_t>place[event.y, event.x]
                out[n].y = 0
                n += 1
            at = stop
    return n
