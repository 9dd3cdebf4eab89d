"""Kalman filter of log intensity and of both thresholds, one filter per pixel.

Between frames, log intensity is base + theta_on n_on - theta_off n_off, where events
are counted since the last sample (mid-exposure of the last frame used).  The state is
(base, theta_on, theta_off) with its covariance; `drift` is the process noise.  A frame
is de-blurred by the events of its exposure (event-based double integral) and measures
the base.  docs/theory/kalman.md derives it.
"""
from libc.math cimport NAN, fabs, sqrt
from libc.stdint cimport int32_t, int64_t

from _kernels._estimate cimport holds, noise_probability, part_at, theta_squared
from _kernels._exposure cimport divide, integrate, log_at, sum_t
from _kernels._hot cimport HOT_SAMPLES, contradicted, is_hot, weigh_odds
from _kernels._lag cimport PER_TURN
from _kernels._lamp cimport lamp_flickers, lamp_of, lamp_t
from _kernels._math cimport exp_f, log_f
from _kernels._measure cimport (
    TERMS, TOGETHER, group_t, hand_over, measure, policy_of, policy_t)
from _kernels._model cimport (
    check_given, exposure_t, node_t, sample_t, state_t, stored_t, track_t, tuning_t,
    wave_t)
from _kernels._segments cimport (
    add_segment, add_segments, begin_segments, begin_sums, de_blur, middle_row,
    segments_t, sums_t)
from _kernels._tracks cimport REST_US, at_rest, drift, start, step, walk_t
from _kernels._update cimport FIRST_VARIANCE, LEARN_EVENTS, propagate

cdef struct slot_t:
    # A pixel whose sample waits for `measure`: its column; log intensity at the middle
    # less the base; process noise since the last sample; the unit theta^2 of variances
    # of a part; squared change of log intensity since the last sample, of a hot pixel;
    # whether events came since then.
    Py_ssize_t x
    double middle
    double added
    double theta2
    double change
    bint moved

cdef struct blur_t:
    # Log of an exposure's mean light relative to a level; the mean counts, weighted by
    # light; the part of a threshold crossed at the exposure's middle; the log there.
    double log
    double n_on
    double n_off
    double part
    double middle

cdef enum:
    HOP = 8                     # pixels between prefetches of a chain's events
    THIRD = 3                   # order of the differences that tell noise from a trend

cdef extern from "_prefetch.h" nogil:
    enum:
        AHEAD "PDAVIS_AHEAD"
    void prefetch_all "PDAVIS_PREFETCH_ALL"(const void*, size_t)

cdef struct using_t:
    # What `kalman_frame` is given.
    Py_ssize_t h, w, rows       # of the image, and of a band
    const sample_t* samples
    const exposure_t* exposures
    int64_t known
    const stored_t* store
    const track_t* old
    int32_t committed
    const tuning_t* tuning
    lamp_t lamp
    policy_t policy
    track_t* tracks
    state_t* states
    double* innovations
    node_t* nodes               # NULL: for no smoother
    float* middles


cdef struct chains_t:
    # Chains of the next AHEAD pixels: the event fetched last of each, by pixel modulo
    # AHEAD; number of pixels to go until all of them have been passed.
    int32_t[AHEAD] events
    Py_ssize_t left


cdef inline void fetch_chains(chains_t* chains, Py_ssize_t at, Py_ssize_t stop,
                              const using_t* of) noexcept nogil:
    """Prefetch events of the pixels that follow pixel `at` and precede `stop`.

    A pixel's first event is fetched AHEAD pixels before it is needed.  Each of the next
    ones is HOP pixels later, when the one before, which holds its index, is there.
    """
    cdef Py_ssize_t ahead = at + AHEAD - HOP
    cdef int32_t* event = &chains.events[at & (AHEAD - 1)]
    event[0] = of.old[at + AHEAD].first if at + AHEAD < stop else -1
    if event[0] >= 0:
        chains.left = AHEAD
        prefetch_all(&of.store[event[0]], sizeof(stored_t))
    elif chains.left == 0:
        return
    chains.left -= 1
    while ahead > at:
        event = &chains.events[ahead & (AHEAD - 1)]
        if event[0] >= 0:
            event[0] = of.store[event[0]].next
            if event[0] >= 0:
                prefetch_all(&of.store[event[0]], sizeof(stored_t))
        ahead -= HOP


cdef void use_bands(using_t* of, Py_ssize_t first, Py_ssize_t last) noexcept nogil:
    """Update the states of bands, each of which has its own sums of innovations."""
    cdef Py_ssize_t y, x, n, i, at
    cdef group_t group
    cdef slot_t[TOGETHER] slots
    cdef segments_t segments
    cdef sums_t sums
    cdef chains_t chains
    cdef Py_ssize_t stop = min(last * of.rows, of.h) * of.w
    chains.left = 0
    for i in range(AHEAD):
        chains.events[i] = -1
    begin_segments(&segments, &sums, of.tuning)
    for y in range(first * of.rows, min(last * of.rows, of.h)):
        n = 0
        for x in range(of.w):
            at = y * of.w + x
            fetch_chains(&chains, at, stop, of)
            if of.samples[at].variance > 0:
                slots[n].x = x
                prepare(of, at, &group, &segments, &sums, n, &slots[n])
                n += 1
            else:
                of.middles[at] = NAN
                if of.nodes != NULL:
                    of.nodes[at].noise = 0.0
            if n == TOGETHER or x == of.w - 1:
                if sums.n > 0:
                    predict_rows(of, y, &segments, &sums, &group, slots)
                measure(&group, &of.policy, n, of.innovations + y // of.rows * TERMS)
                for i in range(n):
                    at = y * of.w + slots[i].x
                    if of.nodes != NULL:
                        write_node(&group, i, &slots[i], &of.states[at], &of.nodes[at])
                    finish(&group, i, &slots[i], &of.states[at], &of.middles[at])
                n = 0


def kalman_frame(frame not None, chain not None, Py_ssize_t committed, model not None,
                 track_t[:, ::1] tracks not None, state_t[:, ::1] states not None,
                 double[:, ::1] innovations not None, node_t[:, ::1] nodes not None,
                 float[:, ::1] middles not None, bands not None):
    """De-blur a frame by the stored events and update the states with it.

    frame is (samples, exposures by column, time up to which events are known), chain
    (store, tracks that chain its events since the exposure began), model (tuning,
    waves).  Events below index `committed` are counted in tracks.  bands is (first,
    last, rows): only bands of so many rows with first <= band < last are used.  A row
    of innovations collects the sums of a band, of the terms listed in _measure.h.
    nodes receives the measurements for a smoother; it may be empty.  middles receives
    log intensity at each exposure's middle, NaN without a sample.
    """
    cdef const sample_t[:, ::1] samples
    cdef const exposure_t[::1] exposures
    cdef const stored_t[::1] store
    cdef const track_t[:, ::1] old
    cdef const tuning_t[::1] tuning
    cdef const wave_t[::1] waves
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], first, last
    cdef using_t using
    check_given((*frame, *chain, *model))
    samples, exposures, using.known = frame
    store, old = chain
    tuning, waves = model
    first, last, using.rows = bands
    if (samples.shape[0] != h or samples.shape[1] != w or states.shape[0] != h
            or states.shape[1] != w or old.shape[0] != h or old.shape[1] != w
            or exposures.shape[0] != w or middles.shape[0] != h
            or middles.shape[1] != w):
        raise ValueError("kalman_frame: all images must have one shape")
    if tuning.shape[0] != 1 or innovations.shape[1] != TERMS or store.shape[0] == 0:
        raise ValueError(
            "kalman_frame: tuning, innovations or store has a wrong length")
    if nodes.shape[0] > 0 and (nodes.shape[0] != h or nodes.shape[1] != w):
        raise ValueError("kalman_frame: nodes must be (h, w)")
    if (using.rows < 1 or first < 0 or last > innovations.shape[0]
            or innovations.shape[0] * using.rows < h):
        raise ValueError("kalman_frame: each band must have a row of innovations")
    if h * w == 0 or first >= last:
        return
    using.h, using.w, using.committed = h, w, <int32_t>committed
    using.samples, using.exposures = &samples[0, 0], &exposures[0]
    using.store, using.old, using.tuning = &store[0], &old[0, 0], &tuning[0]
    using.lamp, using.policy = lamp_of(waves), policy_of(&tuning[0])
    using.tracks, using.states = &tracks[0, 0], &states[0, 0]
    using.innovations, using.middles = &innovations[0, 0], &middles[0, 0]
    using.nodes = NULL
    if nodes.shape[0] > 0:
        using.nodes = &nodes[0, 0]
    with nogil:
        use_bands(&using, first, last)


cdef inline double third_difference(state_t* s, double log,
                                    bint moved) noexcept nogil:
    """Add ln intensity of a sample to the differences and return the third.

    Its four samples have no event in between if s.quiet is then at least `THIRD`.
    """
    cdef double first = log - s.unlit_log, second = first - s.first_difference
    cdef double third = second - s.second_difference
    s.unlit_log = <float>log
    s.first_difference = <float>first
    s.second_difference = <float>second
    s.quiet = (s.quiet + 1.0) * (not moved)
    return third


cdef inline void prepare_alone(const sample_t* sample, int64_t mid,
                               const tuning_t* tuning, state_t* s, group_t* group,
                               Py_ssize_t i, slot_t* slot) noexcept nogil:
    """Predict a sample of a hot pixel, whose events are ignored: it is not de-blurred.
    """
    slot.change = sample.log - s.base
    slot.change *= slot.change
    slot.added = s.moves + theta_squared(s) * drift(mid - s.sampled_us, 0.0, tuning)
    s.var_base += slot.added
    slot.theta2 = 0.0
    slot.middle = 0.0
    s.part = 0.0
    hand_over(s, sample, group, i)
    group.part[i] = 0.0
    group.silent[i] = 0.0
    group.motion[i] = 0.0
    group.n_on[i] = 0.0
    group.n_off[i] = 0.0
    group.h_on[i] = 0.0
    group.h_off[i] = 0.0
    group.noise[i] = 0.0
    group.innovation[i] = sample.log - s.base
    group.learn[i] = 0.0
    group.third[i] = third_difference(s, sample.log, True)
    group.rests[i] = 0.0
    group.unit[i] = 0.0
    group.events[i] = 0.0
    group.p_noise[i] = 0.0
    group.event_step[i] = 1.0
    group.included[i] = 0.0


cdef inline bint find_blur(const using_t* of, const track_t* old,
                           const exposure_t* exposure, const walk_t* middle,
                           const state_t* s, bint held, double level,
                           segments_t* segments, sums_t* sums, Py_ssize_t i,
                           blur_t* blur) noexcept nogil:
    """De-blur an exposure by the double integral; or leave it to segments: return True.

    level is that at the last event before the exposure's middle, which middle has
    passed, and to which counts are relative; held tells whether s `holds` the part.
    """
    cdef const stored_t* store = of.store
    cdef const tuning_t* tuning = of.tuning
    cdef const lamp_t* lamp = &of.lamp
    cdef int64_t known = of.known
    cdef int64_t begin = exposure.begin, mid = exposure.middle, end = exposure.end
    cdef walk_t walk, at_mid = middle[0]
    cdef sum_t total
    cdef bint followed = middle.next >= 0 and store[middle.next].t <= known
    cdef Py_ssize_t row
    if end <= begin:
        end = begin + 1
    at_mid.n_on = at_mid.n_off = 0.0
    if middle.t <= begin and (middle.next < 0 or store[middle.next].t >= end) and not (
            lamp_flickers(lamp, <double>begin, <double>end)):
        # No event in the whole exposure: the light at its middle is the mean light.
        if followed and lamp.blocks == 0:
            row = begin_sums(sums, i, 0.0)
            add_segment(segments, sums, row, &at_mid, store, known, <double>mid,
                        <double>mid, s, level, tuning)
            return True
        blur.log = log_at(&at_mid, store, known, <double>mid, s, level, tuning, lamp,
                          &blur.n_on, &blur.n_off)
        blur.part = blur.n_on + blur.n_off
        blur.middle = blur.log
        return False
    start(&walk, old)
    walk.n_on = -middle.n_on
    walk.n_off = -middle.n_off
    while walk.next >= 0 and store[walk.next].t <= begin:
        step(&walk, store, tuning.refractory_us)
    # Where no event follows, a segment takes light that moves and has no sample later.
    if (lamp.blocks == 0 and known >= end and known > mid and end - begin < REST_US
            and (s.samples == 0 or s.sampled_us <= begin)
            and (followed or not (held or at_rest(middle.t, mid)))):
        row = begin_sums(sums, i, <double>(end - begin))
        divide(segments, sums, row, &walk, store, begin, end, known, s, level, tuning)
        add_segment(segments, sums, middle_row(row), &at_mid, store, known,
                    <double>mid, <double>mid, s, level, tuning)
        return True
    total.whole = total.on = total.off = 0.0
    integrate(&total, &walk, store, begin, end, known, s, level, tuning, lamp)
    blur.log = log_f(<float>(total.whole / <double>(end - begin)))
    blur.n_on = total.on / total.whole
    blur.n_off = total.off / total.whole
    blur.middle = log_at(&at_mid, store, known, <double>mid, s, level, tuning, lamp,
                         &total.on, &total.off)
    blur.part = part_at(&at_mid, store, known, s.theta_on, s.theta_off, lamp, 0.0,
                        tuning, s, <double>mid).fraction
    return False


cdef inline void blur_at_rest(const walk_t* middle, const state_t* s, bint held,
                              blur_t* blur) noexcept nogil:
    """What `find_blur` returns for a pixel at rest in steady light."""
    cdef double p = middle.p
    blur.part = s.part if held else 0.0
    blur.n_on = p * blur.part
    blur.n_off = (1.0 - p) * blur.part
    blur.log = s.theta_on * blur.n_on - s.theta_off * blur.n_off
    blur.middle = blur.log


cdef void prepare(const using_t* of, Py_ssize_t pixel, group_t* group,
                  segments_t* segments, sums_t* sums, Py_ssize_t i,
                  slot_t* slot) noexcept nogil:
    """Propagate the state to a sample, de-blur the sample, add both to the group.

    The last two are left to `predict_rows` if they take segments.
    """
    cdef const sample_t* sample = &of.samples[pixel]
    cdef const stored_t* store = of.store
    cdef const track_t* old = &of.old[pixel]
    cdef const tuning_t* tuning = of.tuning
    cdef track_t* track = &of.tracks[pixel]
    cdef state_t* s = &of.states[pixel]
    cdef int64_t known = of.known
    cdef int32_t committed = of.committed
    cdef walk_t at_mid, later
    cdef blur_t blur
    cdef double p_noise = 0.0, motion = 0.0, unit = 0.0, event_step = 1.0, events = 0.0
    cdef double theta2 = theta_squared(s)
    cdef double at_on, at_off, all_on, all_off, p
    cdef int64_t mid = of.exposures[slot.x].middle
    cdef double n_on, n_off, level, added = 0.0, noise = 0.0
    cdef bint fresh = s.samples == 0, learn = False, moved = True, waits, held
    # Events from the begin of the exposure to its middle, and to the last committed.
    start(&at_mid, old)
    while at_mid.next >= 0 and store[at_mid.next].t <= mid:
        step(&at_mid, store, tuning.refractory_us)
    p = at_mid.p
    at_on = all_on = at_mid.n_on
    at_off = all_off = at_mid.n_off
    if at_mid.next >= 0 and at_mid.next < committed:
        later = at_mid
        while later.next >= 0 and later.next < committed:
            step(&later, store, tuning.refractory_us)
        all_on = later.n_on
        all_off = later.n_off
    n_on = track.n_on - (all_on - at_on)
    n_off = track.n_off - (all_off - at_off)
    s.seen_on += n_on
    s.seen_off += n_off
    if fresh:
        n_on = n_off = 0
        level = sample.log
        s.var_base = FIRST_VARIANCE
    else:
        weigh_odds(s, n_on + n_off >= LEARN_EVENTS and contradicted(
            s.theta_on * n_on - s.theta_off * n_off,
            s.theta_on * n_on + s.theta_off * n_off, sample.log - s.frame_log,
            2.0 * sample.variance))
    s.frame_log = sample.log
    track.n_on = all_on - at_on
    track.n_off = all_off - at_off
    if is_hot(s):
        prepare_alone(sample, mid, tuning, s, group, i, slot)
        s.samples += 1
        s.sampled_us = mid
        return
    if not fresh:
        learn = n_on + n_off >= LEARN_EVENTS
        p_noise = noise_probability(&at_mid, store, known, s.sampled_us, tuning)
        added = theta2 * (drift(mid - s.sampled_us, n_on + n_off, tuning)
                          + p_noise * (1.0 - p_noise))
        motion = theta2 * tuning.motion_variance
        events = theta2 * (n_on + n_off)
        moved = n_on + n_off > 0.5  # less than that is no event, up to rounding
        if moved:
            unit = 2.0 * theta2
            added += motion
            noise += motion
        elif at_mid.next >= 0 and store[at_mid.next].t <= known:
            unit = theta2
            noise += motion
        # Not by branches, which depend on events and are hard to predict.
        n_on -= p * p_noise
        n_off -= (1.0 - p) * p_noise
        event_step = p * s.theta_on - (1.0 - p) * s.theta_off
        if learn:
            s.var_on += tuning.threshold_drift * s.theta_on * s.theta_on
            s.var_off += tuning.threshold_drift * s.theta_off * s.theta_off
        if n_on != 0.0 or n_off != 0.0:
            propagate(s, n_on, n_off)
        s.var_base += added
        level = s.base
    held = holds(s, &at_mid, tuning)
    if (at_mid.next < 0 and at_rest(at_mid.t, mid) and of.lamp.blocks == 0
            and at_mid.t <= of.exposures[slot.x].begin):
        waits = False
        blur_at_rest(&at_mid, s, held, &blur)
    else:
        waits = find_blur(of, old, &of.exposures[slot.x], &at_mid, s, held, level,
                          segments, sums, i, &blur)
    slot.added = added
    slot.theta2 = theta2
    slot.moved = moved
    if of.lamp.blocks == 0 and not held:
        s.part = 0.0
    group.n_on[i] = n_on
    group.n_off[i] = n_off
    group.silent[i] = (tuning.holds_part > 0.0 and of.lamp.blocks == 0
                       and at_mid.t <= of.exposures[slot.x].begin)
    group.motion[i] = noise
    group.noise[i] = noise
    group.learn[i] = learn
    group.unit[i] = unit
    group.events[i] = events
    group.p_noise[i] = p_noise
    group.event_step[i] = event_step
    group.included[i] = 1.0
    s.samples += 1
    s.sampled_us = mid
    if not waits:
        predict(of, s, sample, &blur, group, i, slot)


cdef inline void predict(const using_t* of, state_t* s, const sample_t* sample,
                         const blur_t* blur, group_t* group, Py_ssize_t i,
                         slot_t* slot) noexcept nogil:
    """Hand a pixel and its sample, de-blurred, over to the group."""
    cdef double h_on = blur.n_on, h_off = -blur.n_off
    cdef bint steady = of.lamp.blocks == 0
    if s.samples == 1:
        s.base = sample.log - blur.log
    slot.middle = blur.middle
    hand_over(s, sample, group, i)
    group.part[i] = blur.part if of.tuning.holds_part > 0.0 and steady else 0.0
    group.h_on[i] = h_on
    group.h_off[i] = h_off
    group.innovation[i] = sample.log - s.base - blur.log
    group.third[i] = third_difference(
        s, sample.log if steady else <float>(
            sample.log - blur.log + h_on * s.theta_on + h_off * s.theta_off),
        slot.moved)
    group.rests[i] = (s.quiet >= THIRD) & (group.unit[i] == 0.0)


cdef void predict_rows(const using_t* of, Py_ssize_t y, segments_t* segments,
                       sums_t* sums, group_t* group, slot_t* slots) noexcept nogil:
    """Predict the samples of row y for which `prepare` has left segments."""
    cdef Py_ssize_t row, middle, pixel, i
    cdef blur_t blur
    add_segments(segments, sums)
    de_blur(sums)
    for row in range(sums.n):
        i = sums.slot[row]
        pixel = y * of.w + slots[i].x
        middle = middle_row(row) if sums.span[row] > 0.0 else row
        blur.log = sums.whole[row]
        blur.n_on = sums.on[row]
        blur.n_off = sums.off[row]
        blur.part = sums.on[middle] + sums.off[middle]
        blur.middle = sums.whole[middle]
        predict(of, &of.states[pixel], &of.samples[pixel], &blur, group, i, &slots[i])
    sums.n = 0


cdef inline void write_node(const group_t* group, Py_ssize_t i, const slot_t* slot,
                            const state_t* s, node_t* node) noexcept nogil:
    """Write the smoother's node; s is the state before the update."""
    cdef double p_noise = group.p_noise[i]
    # Of the sample as `measure` has linearized it, so that R belongs to it.
    node.level = <float>(
        s.base + group.innovation[i] + group.h_on[i] * s.theta_on
        + group.h_off[i] * s.theta_off)
    node.h_on = <float>group.h_on[i]
    node.h_off = <float>group.h_off[i]
    node.noise = <float>group.noise[i]
    # The smoother counts a possible noise event in full: its squared bias is added.
    node.drift = <float>(slot.added + group.jump[i] + slot.theta2 * p_noise * p_noise)
    node.n_on = s.seen_on
    node.n_off = s.seen_off


cdef inline void finish(const group_t* group, Py_ssize_t i, const slot_t* slot,
                        state_t* s, float* middle) noexcept nogil:
    """Copy the updated state from the group."""
    s.base = group.base[i]
    s.theta_on = group.theta_on[i]
    s.theta_off = group.theta_off[i]
    s.var_base = group.var_base[i]
    s.cov_base_on = group.cov_base_on[i]
    s.cov_base_off = group.cov_base_off[i]
    s.var_on = group.var_on[i]
    s.cov_on_off = group.cov_on_off[i]
    s.var_off = group.var_off[i]
    s.pull = group.pull[i]
    s.part = group.held[i]
    middle[0] = <float>(s.base + slot.middle)
    if is_hot(s):
        s.moves += (slot.change - s.moves) / HOT_SAMPLES


cdef inline double lag_of(double hz, double per_light, double light) noexcept nogil:
    """Lag of a photoreceptor, s; 0: none."""
    hz += per_light * light
    return PER_TURN / hz if hz > 0.0 else 0.0


cdef inline double share_of(double error, double prior, double sigma) noexcept nogil:
    """Share of a threshold's variance that a relative error of it leaves to the prior.
    """
    cdef double ratio
    if sigma <= 0.0:
        return 0.0
    ratio = error * prior / sigma
    return min(ratio * ratio, 1.0)


def kalman_inflate(state_t[:, ::1] states not None,
                   const double[:, :, :] sigmas not None, lags not None):
    """Inflate the covariance of thresholds by the error that a wrong lag caused.

    sigmas (2, h, w) are the priors' standard deviations of theta_on and of theta_off.
    lags is ((hz, hz per intensity) before, the same from now on, share of a pixel's
    light at which the lag counts, us by which frames move, us between frames).
    """
    cdef Py_ssize_t y, x
    cdef double hz_before, slope_before, hz, slope, share, moved_us, frame_us
    cdef double light, error, on, off, sigma_on, sigma_off
    cdef state_t* s
    (hz_before, slope_before), (hz, slope), share, moved_us, frame_us = lags
    if (sigmas.shape[0] != 2 or sigmas.shape[1] != states.shape[0]
            or sigmas.shape[2] != states.shape[1]):
        raise ValueError("kalman_inflate: sigmas must be (2, h, w)")
    if not frame_us > 0.0:
        raise ValueError("kalman_inflate: frames must be apart")
    slope_before *= share
    slope *= share
    with nogil:
        for y in range(states.shape[0]):
            for x in range(states.shape[1]):
                s = &states[y, x]
                light = exp_f(<float>s.base)
                error = 1e6 * fabs(lag_of(hz, slope, light) - lag_of(
                    hz_before, slope_before, light) + 1e-6 * moved_us)
                error = 2.0 * error / frame_us
                sigma_on, sigma_off = sigmas[0, y, x], sigmas[1, y, x]
                on = share_of(error, s.prior_on, sigma_on)
                off = share_of(error, s.prior_off, sigma_off)
                s.var_on = (1.0 - on) * s.var_on + on * (sigma_on * sigma_on)
                s.var_off = (1.0 - off) * s.var_off + off * (sigma_off * sigma_off)
                on = sqrt(1.0 - on)
                off = sqrt(1.0 - off)
                s.theta_on = s.prior_on + on * (s.theta_on - s.prior_on)
                s.theta_off = s.prior_off + off * (s.theta_off - s.prior_off)
                s.cov_base_on *= on
                s.cov_base_off *= off
                s.cov_on_off = s.cov_on_off * on * off
