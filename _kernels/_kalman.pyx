"""Kalman filter of log intensity and of both thresholds, one filter per pixel.

Between frames log intensity is base + theta_on n_on - theta_off n_off, n counted since
the reference (mid-exposure of the last frame used).  The state is (base, theta_on,
theta_off) with its covariance, nine doubles: b, on, off, P00, P01, P02, P11, P12, P22.
A frame is de-blurred by the events of its exposure (event-based double integral).
"""
from libc.stdint cimport int32_t, int64_t

from _kernels._lamp cimport lamp_of, lamp_t, lit
from _kernels._math cimport exp_f, log_f
from _kernels._tracks cimport (
    ahead, between, corner, drift, lead, lead_variance, node_t, part_t, quiet, start,
    step, track_t, walk_t)
from _kernels._types cimport event_t

cdef enum:
    # A part of a lamp's period that two points are enough for.
    FINE_US = 1500

cdef struct sum_t:
    # Integrals over the exposure of exp(part), and of it times counts.
    double whole
    double on
    double off


cdef inline double at(const walk_t* walk, const event_t* store, int64_t known,
                      double t, double on, double off, double level,
                      const double* tuning, const lamp_t* lamp, double* n_on,
                      double* n_off) noexcept nogil:
    """Log intensity less level at t, between walk and its next event; the counts."""
    cdef double y, theta
    cdef part_t part
    cdef double hz = 0.0
    if lamp.blocks > 0:
        hz = corner(tuning[2], tuning[3], level + on * walk.n_on - off * walk.n_off)
    if walk.next >= 0 and store[walk.next].t <= known:
        part = between(walk, store[walk.next].t, store[walk.next].p, on, off, lamp,
                       hz, t)
    else:
        part = quiet(walk.t, walk.p, <double>known, lamp, hz, t)
    n_on[0] = walk.n_on
    n_off[0] = walk.n_off
    if part.p:
        n_on[0] += part.fraction
        theta = on
    else:
        n_off[0] += part.fraction
        theta = -off
    y = on * n_on[0] - off * n_off[0] + part.ripple
    return y + lead(theta * part.rate + part.ripple_rate, level + y, tuning[2],
                    tuning[3])


cdef inline void add_segment(sum_t* total, const walk_t* walk, const event_t* store,
                             int64_t known, double begin, double end, double on,
                             double off, double level, const double* tuning,
                             const lamp_t* lamp) noexcept nogil:
    """Integrate from begin to end, between walk and its next event (2-point Gauss)."""
    cdef double middle = 0.5 * (begin + end), half = 0.5 * (end - begin)
    cdef double node = half * 0.5773502691896258, y, n_on, n_off
    cdef int k
    for k in range(2):
        y = at(walk, store, known, middle + node if k else middle - node, on, off,
               level, tuning, lamp, &n_on, &n_off)
        y = half * exp_f(<float>y)
        total.whole += y
        total.on += y * n_on
        total.off += y * n_off


cdef void integrate(sum_t* total, walk_t* walk, const event_t* store,
                    const int32_t* link, int64_t begin, int64_t end, int64_t known,
                    double on, double off, double level, const double* tuning,
                    const lamp_t* lamp) noexcept nogil:
    """Integrate from begin to end, event by event, in parts that the lamp allows."""
    cdef double now = <double>begin, until
    cdef bint flickers = lit(lamp, now, <double>end)
    while True:
        until = <double>end
        if walk.next >= 0 and store[walk.next].t < end:
            until = <double>store[walk.next].t
        while flickers and until > now + FINE_US:
            add_segment(total, walk, store, known, now, now + FINE_US, on, off, level,
                        tuning, lamp)
            now += FINE_US
        if until > now:
            add_segment(total, walk, store, known, now, until, on, off, level, tuning,
                        lamp)
            now = until
        if walk.next < 0 or store[walk.next].t >= end:
            break
        step(walk, store, link)


cdef inline void propagate(double* s, double n_on, double n_off) noexcept nogil:
    """Move the reference past so many events: b += on n_on - off n_off."""
    s[0] += s[1] * n_on - s[2] * n_off
    s[3] += (n_on * n_on * s[6] + n_off * n_off * s[8]
             + 2.0 * (n_on * s[4] - n_off * s[5] - n_on * n_off * s[7]))
    s[4] += n_on * s[6] - n_off * s[7]
    s[5] += n_on * s[7] - n_off * s[8]


cdef inline double update(double* s, double h_on, double h_off, double noise,
                          double error, bint learn, double per_dn, double* pull,
                          double* chi) noexcept nogil:
    """Kalman update with measured = b + h_on on + h_off off, innovation error.

    Without learn, thresholds stay what they are (Schmidt-Kalman update).  Returns the
    variance that a jump of the base was given.  pull is how far the base lies off per
    DN of offset of all frames, by per_dn in this one's log.
    """
    cdef double g0 = s[3] + h_on * s[4] + h_off * s[5]
    cdef double g1 = s[4] + h_on * s[6] + h_off * s[7]
    cdef double g2 = s[5] + h_on * s[7] + h_off * s[8]
    cdef double v = g0 + h_on * g1 + h_off * g2 + noise, k0, k1, k2, jump = 0.0
    chi[1] += log_f(<float>v)
    chi[2] += 1.0
    if error * error > 16.0 * v:
        # Lost events or a wrong sample: the base may have jumped, thresholds not.
        chi[0] += 16.0
        jump = error * error
        s[3] += jump
        g0 += jump
        v += jump
    else:
        chi[0] += error * error / v
    k0 = g0 / v
    k1 = g1 / v
    k2 = g2 / v
    s[0] += k0 * error
    pull[0] += k0 * (per_dn - pull[0])
    s[3] -= k0 * g0
    s[4] -= k0 * g1
    s[5] -= k0 * g2
    if not learn:
        return jump
    s[1] += k1 * error
    s[2] += k2 * error
    s[6] -= k1 * g1
    s[7] -= k1 * g2
    s[8] -= k2 * g2
    return jump


cdef inline double limited(double theta, double prior) noexcept nogil:
    if theta < 0.3 * prior:
        return 0.3 * prior
    return 3.0 * prior if theta > 3.0 * prior else theta


def kalman_frame(const float[:, ::1] sample not None,
                 const float[:, ::1] noise not None,
                 const float[:, ::1] per_dn not None,
                 const int64_t[:, ::1] times not None, int64_t known,
                 const event_t[::1] store not None, const int32_t[::1] link not None,
                 const int32_t[:, ::1] first not None,
                 const int64_t[:, :, ::1] old not None, Py_ssize_t committed,
                 const double[:, :, ::1] prior not None,
                 const double[::1] tuning not None,
                 const double[:, ::1] waves not None, int64_t lit_us,
                 track_t[:, ::1] tracks not None,
                 int64_t[:, ::1] reference not None, double[:, :, ::1] state not None,
                 double[:, ::1] pull not None, double[::1] chi not None,
                 int32_t[:, :, ::1] totals not None,
                 node_t[:, ::1] nodes not None):
    """Use a frame: de-blur it by the stored events up to `known`, update state.

    first and link chain the events since the exposure began, old holds the stamps of
    the last two before; those below index `committed` are counted in tracks.  sample
    is ln intensity, noise its variance, 0 or less where there is no usable sample,
    per_dn what a DN more adds to it; pull what one in all frames adds to the base.
    times holds start, middle and end of exposure by column.  prior is (row, column,
    (on, off)).  tuning: variance per second and per event in units of theta^2, hz, hz
    per unit of intensity, relative error of both.  waves (turns per us, cosine, sine,
    1 if of the light) are the lamp's, a row per block from lit_us on.  chi collects
    e^2/v (16 at most), ln v and their number.  nodes receives what a smoother needs,
    totals counts all events up to the last sample; both may be empty.
    """
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], n = store.shape[0]
    cdef Py_ssize_t y, x
    cdef lamp_t lamp
    cdef bint keep = nodes.shape[0] > 0
    cdef node_t node
    if (sample.shape[0] != h or sample.shape[1] != w or noise.shape[0] != h
            or noise.shape[1] != w or reference.shape[0] != h
            or reference.shape[1] != w or state.shape[0] != h or state.shape[1] != w
            or per_dn.shape[0] != h or per_dn.shape[1] != w or pull.shape[0] != h
            or pull.shape[1] != w or prior.shape[0] != h or prior.shape[1] != w
            or first.shape[0] != h or first.shape[1] != w or old.shape[0] != h
            or old.shape[1] != w or old.shape[2] != 2
            or times.shape[0] != 3 or times.shape[1] != w):
        raise ValueError("kalman_frame: all images must have one shape")
    if state.shape[2] != 9 or prior.shape[2] != 2 or tuning.shape[0] != 5:
        raise ValueError("kalman_frame: state, prior or tuning has a wrong length")
    if waves.shape[1] != 4:
        raise ValueError("kalman_frame: waves must be (blocks, 4)")
    if chi.shape[0] != 3 or link.shape[0] != n or n == 0:
        raise ValueError("kalman_frame: chi, store or link has a wrong length")
    if keep and (nodes.shape[0] != h or nodes.shape[1] != w or totals.shape[0] != h
                 or totals.shape[1] != w or totals.shape[2] != 2):
        raise ValueError("kalman_frame: nodes must be (h, w), totals (h, w, 2)")
    lamp = lamp_of(waves, lit_us)
    with nogil:
        for y in range(h):
            for x in range(w):
                node.noise = 0.0
                if noise[y, x] > 0:
                    use_sample(sample[y, x], noise[y, x], per_dn[y, x], times[0, x],
                               times[1, x], times[2, x], known, &store[0], &link[0],
                               first[y, x], &old[y, x, 0], <int32_t>committed,
                               &prior[y, x, 0], &tuning[0], &lamp, &tracks[y, x],
                               &reference[y, x], &state[y, x, 0], &pull[y, x],
                               &chi[0], &node)
                if keep:
                    if node.noise > 0:
                        totals[y, x, 0] += node.n_on
                        totals[y, x, 1] += node.n_off
                        node.n_on = totals[y, x, 0]
                        node.n_off = totals[y, x, 1]
                    nodes[y, x] = node


cdef void use_sample(double sample, double noise, double per_dn, int64_t begin,
                     int64_t mid, int64_t end, int64_t known, const event_t* store,
                     const int32_t* link, int32_t first, const int64_t* old,
                     int32_t committed, const double* prior, const double* tuning,
                     const lamp_t* lamp, track_t* track, int64_t* reference, double* s,
                     double* pull, double* chi, node_t* node) noexcept nogil:
    cdef walk_t walk
    cdef sum_t total
    cdef int at_on = 0, at_off = 0, all_on, all_off
    cdef double n_on, n_off, h_on, h_off, theta2, blur, level, added = 0.0
    cdef bint fresh = s[3] < 0
    # Counts from the start of exposure to the middle and to the last committed.
    start(&walk, old[0], old[1], first)
    while walk.next >= 0 and store[walk.next].t <= mid:
        step(&walk, store, link)
    at_on = walk.n_on
    at_off = walk.n_off
    while walk.next >= 0 and walk.next < committed:
        step(&walk, store, link)
    all_on = walk.n_on
    all_off = walk.n_off
    n_on = track.n_on - (all_on - at_on)
    n_off = track.n_off - (all_off - at_off)
    node.n_on = <int32_t>n_on
    node.n_off = <int32_t>n_off
    if fresh:
        n_on = 0
        n_off = 0
        level = sample
        s[3] = 100.0
    else:
        theta2 = 0.25 * (s[1] + s[2]) * (s[1] + s[2])
        propagate(s, n_on, n_off)
        added = theta2 * drift(mid - reference[0], n_on + n_off, tuning)
        s[3] += added
        level = s[0]
    # The double integral, relative to the level at the last event before mid.
    start(&walk, old[0], old[1], first)
    walk.n_on = -at_on
    walk.n_off = -at_off
    if end <= begin:
        end = begin + 1
    while walk.next >= 0 and store[walk.next].t <= begin:
        step(&walk, store, link)
    if (walk.next < 0 or store[walk.next].t >= end) and not lit(
            lamp, <double>begin, <double>end):
        # Less than a threshold over the whole exposure: its middle says it all.
        blur = at(&walk, store, known, 0.5 * (<double>begin + <double>end), s[1], s[2],
                  level, tuning, lamp, &h_on, &h_off)
        h_off = -h_off
    else:
        total.whole = 0.0
        total.on = 0.0
        total.off = 0.0
        integrate(&total, &walk, store, link, begin, end, known, s[1], s[2], level,
                  tuning, lamp)
        blur = log_f(<float>(total.whole / <double>(end - begin)))
        h_on = total.on / total.whole
        h_off = -total.off / total.whole
    if fresh:
        s[0] = sample - blur
    node.level = <float>(sample - blur + h_on * s[1] + h_off * s[2])
    node.h_on = <float>h_on
    node.h_off = <float>h_off
    node.noise = <float>noise
    # One or two events are as likely noise, which would teach that thresholds are 0.
    added += update(s, h_on, h_off, noise, sample - s[0] - blur, n_on + n_off >= 3,
                    per_dn, pull, chi)
    node.drift = <float>added
    s[1] = limited(s[1], prior[0])
    s[2] = limited(s[2], prior[1])
    track.n_on = all_on - at_on
    track.n_off = all_off - at_off
    reference[0] = mid


def kalman_read(int64_t t, int64_t known, const event_t[::1] store not None,
                const int32_t[::1] link not None,
                const int32_t[:, ::1] first not None,
                const double[::1] tuning not None,
                const double[:, ::1] waves not None, int64_t lit_us,
                const track_t[:, ::1] tracks not None,
                const int64_t[:, ::1] reference not None,
                const double[:, :, ::1] state not None, double most,
                float[:, ::1] out not None, float[:, ::1] variance not None,
                unsigned char[:, ::1] valid not None):
    """Log intensity and its variance at t from the events up to known >= t.

    first and link chain the events that are not counted in tracks yet.

    waves are as in kalman_frame.
    variance is -1 where no frame was used yet; out then counts from 0.  valid is 1
    where it is at most `most`, not counting that of the lag.
    """
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], n = store.shape[0]
    cdef Py_ssize_t y, x
    cdef lamp_t lamp
    if (reference.shape[0] != h or reference.shape[1] != w or state.shape[0] != h
            or state.shape[1] != w or out.shape[0] != h or out.shape[1] != w
            or variance.shape[0] != h or variance.shape[1] != w
            or valid.shape[0] != h or valid.shape[1] != w
            or first.shape[0] != h or first.shape[1] != w):
        raise ValueError("kalman_read: all images must have one shape")
    if (state.shape[2] != 9 or tuning.shape[0] != 5 or waves.shape[1] != 4
            or link.shape[0] != n or n == 0):
        raise ValueError(
            "kalman_read: state, tuning, waves, store or link has a wrong length")
    lamp = lamp_of(waves, lit_us)
    with nogil:
        for y in range(h):
            for x in range(w):
                read_pixel(t, known, &store[0], &link[0], first[y, x], &tuning[0],
                           &lamp, &tracks[y, x], reference[y, x], &state[y, x, 0], most,
                           &out[y, x], &variance[y, x], &valid[y, x])


cdef void read_pixel(int64_t t, int64_t known, const event_t* store,
                     const int32_t* link, int32_t first, const double* tuning,
                     const lamp_t* lamp, const track_t* track, int64_t reference,
                     const double* s, double most, float* out, float* variance,
                     unsigned char* valid) noexcept nogil:
    cdef walk_t walk
    cdef part_t part
    cdef double n_on, n_off, theta, theta2, level, v, u, hz = 0.0
    start(&walk, track.prev, track.last, first)
    walk.n_on = track.n_on
    walk.n_off = track.n_off
    while walk.next >= 0 and store[walk.next].t <= t:
        step(&walk, store, link)
    n_on = walk.n_on
    n_off = walk.n_off
    if lamp.blocks > 0:
        hz = corner(tuning[2], tuning[3], s[0] + s[1] * n_on - s[2] * n_off)
    if walk.next >= 0 and store[walk.next].t <= known:
        part = between(&walk, store[walk.next].t, store[walk.next].p, s[1], s[2],
                       lamp, hz, <double>t)
    elif known > t:
        part = quiet(walk.t, walk.p, <double>known, lamp, hz, <double>t)
    else:
        part = ahead(&walk, s[1], s[2], lamp, hz, <double>t)
    theta2 = 0.25 * (s[1] + s[2]) * (s[1] + s[2])
    if part.p:
        n_on += part.fraction
        theta = s[1]
    else:
        n_off += part.fraction
        theta = -s[2]
    level = s[0] + s[1] * n_on - s[2] * n_off + part.ripple
    u = lead(theta * part.rate + part.ripple_rate, level, tuning[2], tuning[3])
    out[0] = <float>(level + u)
    if s[3] < 0:
        variance[0] = -1.0
        valid[0] = 0
        return
    v = (theta2 * part.var + s[3] + n_on * n_on * s[6] + n_off * n_off * s[8]
         + 2.0 * (n_on * s[4] - n_off * s[5] - n_on * n_off * s[7])
         + theta2 * drift(t - reference, walk.n_on + walk.n_off, tuning))
    v = v if v > 1e-8 else 1e-8
    u = lead_variance(u, theta2 * part.rate_var, s[2] * part.fall, level,
                      tuning)
    variance[0] = <float>(v + u)
    valid[0] = v <= most
