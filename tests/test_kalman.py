import copy
import itertools
import pickle

import numpy as np
import pytest
import reference_kalman
from hypothesis import given, settings, strategies as st
from streams import feed, random_events, random_frame

from pdavis_cv import (
    EVENT_DTYPE,
    ApsFrame,
    Calibration,
    KalmanFilter,
    _kernels,
    fuse,
)
from pdavis_cv.analysis import Scorer
from pdavis_cv.reconstruct.lamp import BLOCK_US, Wave
from pdavis_cv.reconstruct.model import (
    GAP_DTYPE,
    NODE_DTYPE,
    PAST_DTYPE,
    STATE_DTYPE,
    STORED_DTYPE,
    TRACK_DTYPE,
    TUNING_DTYPE,
    WAVE_DTYPE,
)
from pdavis_cv.simulation import Camera, RotatingPolarizer, ideal

SHAPE = (3, 4)
MAPS = np.random.default_rng(9).uniform(0.1, 0.3, (2, *SHAPE))
BANDWIDTHS = [None, (250.0, 0.0, 0.1), (20.0, 8.0, 0.3)]
SLOW = (4.0, 0.5, 0.2)      # some events within a time constant
SINGULAR = 2 * 2 / 0.05     # see below: 80


def make(shape=SHAPE, on=0.2, off=0.25, **options):
    return KalmanFilter(shape, theta_on=on, theta_off=off, **options)


@pytest.fixture(scope="module")
def nominal_recording():
    camera = Camera.preset("nominal", seed=2, size=(8, 8))
    return camera, *camera.record(RotatingPolarizer(rpm=101.3, start_angle=0.5), 1.8)


@st.composite
def recordings(draw):
    origin = draw(st.sampled_from([0, 1_600_000_000_000_000]))
    seconds = draw(st.sampled_from([0.05, 0.4, 3.0]))
    stop = origin + int(seconds * 1e6)
    seed = draw(st.integers(0, 99))
    events = random_events(draw(st.integers(0, 300)), SHAPE, start_us=origin,
                           stop_us=stop, seed=seed)
    mids = sorted(draw(st.sets(st.integers(origin, stop - 1), max_size=12)))
    first = origin // BLOCK_US + draw(st.integers(-2, 3))
    rng = np.random.default_rng(seed)
    waves = [
        Wave((first + k) * BLOCK_US, *((
            rng.choice([100, 120.3]), *rng.uniform(-0.2, 0.2, 2), rng.random() < 0.5)
            if rng.random() < 0.8 else ()))
        for k in range(draw(st.sampled_from([0, 0, 1, 5, 40])))]
    frames = [random_frame(SHAPE, t, seed=i) for i, t in enumerate(mids)]
    return events, frames, waves, stop


@settings(max_examples=90)
@given(recordings(), st.sampled_from(["buffered", "causal", "offline"]), st.booleans(),
       st.sampled_from([*BANDWIDTHS, SLOW]), st.sampled_from([0.0, 0.035]),
       st.sampled_from([0, 7, 30_000, 49_000, 400_000]),
       st.sampled_from([30_000, 120_000, 500_000]), st.sampled_from([0.0, 2.0]),
       st.sampled_from([0.0, 900.0]), st.sampled_from([0.0, 700.0, 30_000.0]))
def test_it_equals_float64_evaluation_of_the_equations(
        stream, mode, maps, bandwidth, sigma, later, ahead, offset, refractory,
        jitter):
    events, frames, waves, stop = stream
    on, off = MAPS if maps else (0.2, 0.25)
    offline = {"lookahead_us": ahead} if mode == "offline" else {}
    mine = make(on=on, off=off, mode=mode, threshold_sigma=sigma, bandwidth=bandwidth,
                offset_dn=offset, refractory_us=refractory, jitter_us=jitter,
                **offline)
    # What the channels' redundancy adds where frames are poor is another matter.
    mine._saturated.add_events = lambda events, workers: None
    for wave in waves:
        mine.add_wave(wave)
    feed(mine, events, frames)
    t = stop + later - mine.lookahead_us
    estimate = reference_kalman.alone(mine, t)
    log, variance, valid = reference_kalman.kalman(
        events, frames, SHAPE, on, off, t, sigma=sigma,
        bandwidth=bandwidth or (0, 0, 0), lookahead_us=mine.lookahead_us,
        offline=mode == "offline", offset_dn=offset, waves=waves,
        refractory_us=refractory, jitter_us=jitter)
    # What events say of pixels without a sample is another matter.
    measured = variance > 0
    np.testing.assert_allclose(
        estimate.log_intensity[measured], log[measured], atol=2e-3, rtol=1e-4)
    # Where light falls nearly too fast to be followed, the slope hardly tells the lag
    # u: its variance is divided by d(slope) / du squared, of which an error of u is 80
    # times as large a part (d >= f / 20, its change 2 f at most).
    ill = SINGULAR * np.abs(estimate.log_intensity - log) * bool(bandwidth)
    error = np.abs(estimate.variance - variance)
    assert (error <= 1e-5 + (5e-3 + ill) * variance)[measured].all()
    np.testing.assert_array_equal(estimate.valid[measured], valid[measured])


def test_it_equals_them_where_the_thresholds_seem_to_drift():
    # Each pixel's 200 events between the last two frames, most of them lost in resets,
    # make the variance of the thresholds' drift matter.
    mids = [0, 1, 129, 130, 777, 2676, 40_010]
    events = random_events(299, SHAPE, start_us=0, stop_us=50_000, seed=53)
    frames = [random_frame(SHAPE, t, seed=i) for i, t in enumerate(mids)]
    for refractory in (0.0, 900.0, 1500.0):
        mine = make(on=0.2, off=0.25, mode="causal", threshold_sigma=0.0,
                    refractory_us=refractory)
        mine._saturated.add_events = lambda events, workers: None
        feed(mine, events, frames)
        _, variance, _ = reference_kalman.kalman(
            events, frames, SHAPE, 0.2, 0.25, 50_007, sigma=0.0, lookahead_us=0,
            refractory_us=refractory)
        measured = variance > 0
        np.testing.assert_allclose(
            mine.read(50_007).variance[measured], variance[measured], rtol=1e-4)


def long_stream(shape=(4, 6), n=120_000, seconds=3.0):
    stop = int(seconds * 1e6)
    frames = [random_frame(shape, t, seed=i, low=50)
              for i, t in enumerate(range(20_000, stop, 50_000))]
    return random_events(n, shape, stop_us=stop), frames


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_packets_reads_and_snapshots_do_not_change_the_result(mode):
    events, frames = long_stream()
    shape = (4, 6)
    whole, cut = (make(shape, mode=mode, bandwidth=(250, 0)) for _ in range(2))
    feed(whole, events, frames)
    rng = np.random.default_rng(1)
    times = [*(f.mid_us for f in frames), 2**40]
    stream = iter(frames)
    for stop in times:
        part = events[(events["t"] >= cut._clock.last_us) & (events["t"] < stop)]
        while len(part):
            n = rng.integers(1, 900)
            cut.add_events(part[:n])
            if rng.random() < 0.1:
                cut.read(cut._clock.last_us + int(rng.integers(0, 60_000)))
                other = make(shape, mode=mode, bandwidth=(250, 0))
                other.restore(pickle.loads(pickle.dumps(cut.snapshot())))
                cut = other
            part = part[n:]
        if stop < 2**40:
            cut.add_frame(next(stream))
    assert same(whole.read(3_100_000), cut.read(3_100_000))
    assert same(whole.thresholds, cut.thresholds)
    assert len(whole._tracks.store) < len(events) / 2


@pytest.mark.parametrize("n", [400, 40_000])
def test_a_frame_that_comes_late_acts_as_one_that_came_in_time(n):
    shape = (4, 6)
    events = random_events(n, shape, seed=3)
    frames = [random_frame(shape, mid, seed=mid, exposure_us=30_000)
              for mid in range(110_000, 900_000, 50_000)]
    in_time, late = (make(shape, mode="causal", bandwidth=(250, 0)) for _ in range(2))
    feed(in_time, events, frames)
    at = 0
    for frame in frames:
        end = int(np.searchsorted(events["t"], frame.available_us, "right"))
        late.add_events(events[at:end])
        late.add_frame(frame)
        late.settle(frame.available_us)
        at = end
    late.add_events(events[at:])
    assert same(in_time.read(1_200_000), late.read(1_200_000))
    assert same(in_time.thresholds, late.thresholds)
    with pytest.raises(ValueError, match="before the last frame's, 860000 us"):
        late.add_frame(frames[-2])
    waiting = make(shape)
    waiting.add_events(events)
    with pytest.raises(ValueError, match="before the last time seen"):
        waiting.add_frame(frames[0])


@pytest.mark.parametrize("bandwidth", BANDWIDTHS)
def test_pixels_read_at_once_show_what_they_show_one_by_one(bandwidth):
    # A dead time of 1e-6 us changes nothing, but takes the other way through the code.
    shape, log = (9, 17), []
    for refractory_us in (0.0, 1e-6):
        method = make(shape, mode="causal", bandwidth=bandwidth,
                      refractory_us=refractory_us, offset_dn=2.0)
        method.add_events(random_events(1500, shape, stop_us=300_000, seed=3))
        for k in range(2):
            method.add_frame(random_frame(shape, 100_000 * (k + 1), seed=k))
        method.add_events(random_events(
            700, shape, start_us=300_000, stop_us=450_000, seed=4))
        log.append(method.read(450_000))
    np.testing.assert_allclose(*(each.log_intensity for each in log), rtol=0, atol=1e-6)
    np.testing.assert_allclose(*(each.variance for each in log), rtol=1e-5)
    np.testing.assert_array_equal(*(each.valid for each in log))


def test_thresholds_are_learned_from_frames():
    on, off = 0.12, 0.21
    recording, _ = ideal.rotating_polarizer(
        60 * 1.013, 4.0, size=(4, 4), theta=(on, off))
    method = make((4, 4), 0.16, 0.18)
    packets = list(recording.packets())
    feed(method, np.concatenate([p.events for p in packets]),
         [frame for p in packets for frame in p.frames])
    (learned_on, learned_off), covariance = method.thresholds
    ratio = learned_on / learned_off / (on / off)
    np.testing.assert_allclose(ratio, 1, atol=0.02)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_a_pixel_without_a_usable_sample_is_not_valid():
    method = make((2, 2))
    dn = np.array([[100.0, 0.0], [300.0, 200.0]])
    method.add_frame(ApsFrame(dn, 0, 10_000, valid=np.array([[1, 1], [1, 0]], bool)))
    log, variance, valid = method.read(100_000)
    np.testing.assert_array_equal(valid, [[True, False], [True, False]])
    np.testing.assert_allclose(log[:, 0], np.log([10, 30]), atol=1e-6)
    assert np.all(variance[valid] > 0)


@pytest.fixture(scope="module")
def recorded():
    """Recordings of a polarizer at 200 RPM, their truth, by camera."""
    scene = RotatingPolarizer(rpm=200 * 1.013, start_angle=0.4)
    return {name: Camera.preset(name, seed=5, size=(12, 12)).record(scene, 2.0)
            for name in ("nominal", "realistic")}


@pytest.mark.gate
@pytest.mark.parametrize(("camera", "options"), [
    ("nominal", {"causal": True}),
    ("nominal", {"thresholds": "in-situ"}),
    ("nominal", {"thresholds": "in-situ", "mode": "offline"}),
    ("realistic", {"thresholds": "in-situ"}),
])
def test_one_sigma_covers_about_two_thirds_of_the_errors(recorded, camera, options):
    recording, truth = recorded[camera]
    scorer = Scorer(truth, (6, 6))
    for image in fuse(recording, times_us=np.arange(1_000_000, 1_900_000, 5003),
                      method="kalman", demosaic="superpixel",
                      nominal_thresholds=(0.16, 0.18), **options):
        scorer.add(image)
    assert 0.55 < scorer.score.aop_coverage < 0.85
    # A degree that lasts is better known than the channels, whose sigmas are given.
    assert 0.55 < scorer.score.dolp_coverage < (0.85 if "mode" in options else 0.95)
    assert scorer.score.aop_error < np.deg2rad(1.1)


@pytest.mark.parametrize(("mode", "aop_deg", "dolp"), [
    ("buffered", 0.5, 0.010), ("offline", 0.35, 0.007)])
def test_a_complete_calibration_takes_the_pixels_differences_out(
        recorded, mode, aop_deg, dolp):
    recording, truth = recorded["nominal"]
    camera = Camera.preset("nominal", seed=5, size=(12, 12))
    calibration = Calibration(**camera.exact_calibration(), bandwidth_hz=250.0)
    scorer = Scorer(truth, (6, 6))
    for image in fuse(recording, times_us=np.arange(1_000_000, 1_900_000, 5003),
                      method="kalman", mode=mode, demosaic="superpixel",
                      calibration=calibration):
        scorer.add(image)
    assert scorer.score.aop_error < np.deg2rad(aop_deg)
    assert scorer.score.dolp_error < dolp
    # With the noise of pixels that differ, 92 to 98 % of the errors were covered.
    assert 0.55 < scorer.score.aop_coverage < 0.85
    # A degree that lasts is better known than the channels, whose sigmas are given.
    assert 0.55 < scorer.score.dolp_coverage < (0.85 if mode == "offline" else 0.95)


def test_read_and_shot_noise_count_as_often_as_they_are_told_to():
    frame = ApsFrame(np.full((1, 1), 400.0), 0, 10_000)
    variances = []
    for noise in ((0.01, 0.0, 0.0), (0.01, 0.0, 0.0, 0.25)):
        method = make((1, 1), noise=noise)
        method.add_frame(frame)
        variances.append(method.read(100_000).variance[0, 0])
    of_frame = (2**2 + 400 / 10) / 400**2
    assert variances[0] - variances[1] == pytest.approx(0.75 * of_frame, rel=1e-4)


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_an_offset_of_all_frames_counts_as_much_as_it_moves_the_result(mode):
    methods = {off: make((1, 2), mode=mode, offset_dn=0.5) for off in (0.0, 0.5)}
    for off, method in methods.items():
        for start in range(0, 500_000, 50_000):
            dn = np.array([[10.0, 400.0]]) + off
            method.add_frame(ApsFrame(dn, start, start + 10_000))
    t = 1_100_000 - method.lookahead_us
    right, wrong = (method.read(t) for method in methods.values())
    moved = (wrong.log_intensity - right.log_intensity) ** 2
    plain = make((1, 2), mode=mode)
    for start in range(0, 500_000, 50_000):
        plain.add_frame(ApsFrame(np.array([[10.0, 400.0]]), start, start + 10_000))
    added = right.variance - plain.read(t).variance
    np.testing.assert_allclose(added[0, 0], moved[0, 0], rtol=0.1)
    assert added[0, 1] < added[0, 0] / 100


def test_without_events_variance_grows_at_the_stated_rate():
    method = make((1, 1), 0.2, 0.2)
    method.add_frame(ApsFrame(np.full((1, 1), 400.0), 0, 10_000))
    early, late = (float(method.read(t).variance[0, 0])
                   for t in (1_000_000, 3_000_000))
    assert late - early == pytest.approx(2 * 0.02 * 0.2**2, rel=1e-4)


def test_reading_does_not_change_the_state():
    events, frames = long_stream(n=5000)
    method = make((4, 6))
    feed(method, events, frames)
    first = method.read(3_050_000)
    method.read(9_000_000)
    assert same(first, method.read(3_050_000))
    assert events.flags.writeable is False


def test_events_outside_or_late_are_refused_by_name():
    method = make()
    events = random_events(10, SHAPE).copy()
    events["x"][7] = 9
    with pytest.raises(ValueError, match=r"event 7 at \(x=9"):
        method.add_events(events)
    assert method._clock.last_us == events["t"][6]
    with pytest.raises(ValueError, match="event 0 at t="):
        method.add_events(events[:2])
    with pytest.raises(ValueError, match="last time seen"):
        method.read(int(events["t"][6]) - 50_001)


@pytest.mark.parametrize(("options", "message"), [
    ({"mode": "offline?"}, "mode must be"),
    ({"mode": "causal", "lookahead_us": 5}, "lookahead_us must be"),
    ({"lookahead_us": 0}, "lookahead_us must be"),
    ({"threshold_sigma": -1}, "threshold_sigma must be finite"),
    ({"threshold_sigma": np.ones(3)}, "threshold_sigma must be a scalar or"),
    ({"bandwidth": (-1, 0)}, "bandwidth must hold"),
    ({"on": 0}, "theta_on must be positive"),
    ({"offset_dn": -1}, "offset_dn must be finite"),
])
def test_impossible_parameters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_empty_and_read_only_input():
    method = make((1, 1))
    method.add_events(np.empty(0, EVENT_DTYPE))
    assert not method.read(0).valid[0, 0]
    method.add_events(random_events(3, (1, 1), read_only=True))


def test_frames_after_a_time_make_offline_images_better(nominal_recording):
    camera, recording, truth = nominal_recording
    known = Calibration(**camera.exact_calibration(), bandwidth_hz=250.0)
    times = np.arange(300_000, 1_500_000, 7_000)
    error = {}
    for mode in ("buffered", "offline"):
        images = fuse(recording, calibration=known, mode=mode, times_us=times,
                      method="kalman", demosaic="superpixel")
        error[mode] = np.mean([np.abs(
            (image.aop - truth.aop(image.t_us) + np.pi / 2) % np.pi - np.pi / 2)
            for image in images])
    assert error["offline"] < 0.85 * error["buffered"]
    assert np.degrees(error["offline"]) < 0.35


@pytest.mark.parametrize("dn", [6.0, 12.0, 50.0])
def test_after_the_last_frame_offline_images_are_those_of_the_filter(dn):
    # Both linearize a sample where the filter sees the light.  Logarithms of the noisy
    # samples themselves would give 6 % less light at 6 DN.  The filter's first base has
    # a variance of 100, and the smoother's none.
    methods = [make((10, 12), mode=mode) for mode in ("buffered", "offline")]
    rng = np.random.default_rng(3)
    for start in range(0, 1_000_000, 50_000):
        noisy = rng.normal(dn, np.sqrt(4 + dn / 10), (10, 12)).clip(1)
        for method in methods:
            method.add_frame(ApsFrame(noisy, start, start + 10_000))
    filtered, smoothed = (method.read(960_000) for method in methods)
    np.testing.assert_allclose(
        smoothed.log_intensity, filtered.log_intensity, atol=1e-3)


def test_a_pixel_without_a_sample_before_t_is_known_from_the_one_after():
    method = make((1, 2), mode="offline", lookahead_us=200_000)
    events = np.zeros(1, EVENT_DTYPE)
    events["t"], events["p"] = 50_000, 1
    method.add_events(events)
    method.add_frame(ApsFrame(np.array([[100.0, 200.0]]), 95_000, 105_000))
    log, variance, valid = method.read(20_000)
    assert valid.all()
    # Before the only event the light was a threshold lower.
    np.testing.assert_allclose(log[0], np.log([10, 20]) - [0.2, 0], atol=0.13)
    assert variance[0, 0] > method.read(100_000).variance[0, 0]


STEADY = np.zeros(0, WAVE_DTYPE)


def shown(*shape):
    """Planes that kernels write: log intensity, variance, valid."""
    return tuple(np.zeros(shape, dtype) for dtype in (np.float32, np.float32, np.uint8))


@pytest.mark.parametrize(("kernel", "changes", "message"), [
    (_kernels.smooth_past, {"times": np.zeros(3, np.int64)}, "smooth_past: all"),
    (_kernels.smooth_past, {"states": np.zeros((2, 3), STATE_DTYPE)},
     "smooth_past: all"),
    (_kernels.smooth_gap, {"order": np.array([7], np.int32)}, "order must hold"),
    (_kernels.smooth_gap, {"passed": np.array([0, 2], np.int32)}, "passed must lie"),
    (_kernels.smooth_gap, {"times": np.zeros((2, 2), np.int64)}, "smooth_gap: all"),
    (_kernels.smooth_gap, {"rows": (0, 3)}, "smooth_gap: rows must lie"),
    (_kernels.smooth_read, {"model": (np.zeros(2, TUNING_DTYPE), STEADY)},
     "smooth_read: tuning"),
    (_kernels.smooth_read, {"shown": shown(2, 3)}, "smooth_read: all"),
])
def test_kernels_of_the_smoother_check_sizes(kernel, changes, message):
    nodes, times = np.zeros((1, 2, 2), NODE_DTYPE), np.zeros((1, 2), np.int64)
    past, gaps = np.zeros((2, 2), PAST_DTYPE), np.zeros((2, 2), GAP_DTYPE)
    states, order, passed = np.zeros((2, 2), STATE_DTYPE), np.zeros(
        1, np.int32), np.zeros(2, np.int32)
    gaps["before"]["var"] = gaps["after"]["var"] = 0.01
    tracks = np.zeros((2, 2), TRACK_DTYPE)
    tracks["first"] = -1
    arguments = {
        _kernels.smooth_past: dict(
            nodes=nodes[0], times=times[0], states=states, past=past),
        _kernels.smooth_gap: dict(
            nodes=nodes, times=times, order=order, passed=passed, states=states,
            past=past, rows=(0, 2), out=gaps, following=gaps.copy()),
        _kernels.smooth_read: dict(
            t=0, known=1, chain=(np.zeros(1, STORED_DTYPE), tracks),
            model=(np.zeros(1, TUNING_DTYPE), STEADY), gaps=gaps, states=states,
            shown=shown(2, 2)),
    }[kernel]
    kernel(*arguments.values())
    with pytest.raises(ValueError, match=message):
        kernel(*{**arguments, **changes}.values())


def make_again(method):
    other = make(method.shape, offset_dn=0.5)
    other.assign(method)
    return other


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_a_filter_goes_on_with_another_bandwidth_and_noise(mode):
    events, frames = long_stream(n=5000)
    shape, law, noise = (4, 6), (200.0, 1.0, 0.05), (0.01, 0.02, 0.0001, 0.5)
    plain, told, late = make(shape, mode=mode), make(
        shape, mode=mode, bandwidth=law, noise=noise), make(shape, mode=mode)
    late.retune(bandwidth=law, noise=noise)
    for method in (plain, told, late):
        feed(method, events, frames)
    assert late.parameters["bandwidth"] == law
    assert late.parameters["noise"] == noise
    assert same(told.read(3_100_000), late.read(3_100_000))
    found = plain.thresholds
    plain.retune(noise=noise)
    assert same(found, plain.thresholds)
    # Thresholds that explain two samples T apart err by 2 dt / T, relatively, where the
    # lag errs by dt; no more is given up than the prior's variance.
    theta, covariance = told.thresholds
    prior, first = make(shape, mode=mode).thresholds
    frame_us = frames[-1].mid_us - frames[-2].mid_us
    for hz, slope in ((210.0, 1.0), (1.0, 0.0)):
        other = copy.deepcopy(told)
        light = np.exp(told._states["base"])
        lags = [1 / (2 * np.pi * (a + 0.12 * b * light)) for a, b in (
            law[:2], (hz, slope))]
        wrong = 2e6 * (lags[1] - lags[0]) / frame_us
        part = np.minimum((wrong * prior)**2 / np.moveaxis(
            first.diagonal(0, 2, 3), -1, 0), 1)
        assert (part.max() < 0.1) if hz > 100 else (part.min() == 1)
        other.retune(bandwidth=(hz, slope, law[2]))
        given, after = other.thresholds
        np.testing.assert_allclose(
            given, prior + np.sqrt(1 - part) * (theta - prior), rtol=1e-6)
        kept = np.sqrt((1 - part[0]) * (1 - part[1]))
        np.testing.assert_allclose(
            after[..., 0, 1], kept * covariance[..., 0, 1], rtol=1e-5, atol=1e-15)
        for i in (0, 1):
            np.testing.assert_allclose(after[..., i, i], (
                1 - part[i]) * covariance[..., i, i] + part[i] * first[..., i, i],
                rtol=1e-6)
        assert (np.linalg.eigvalsh(after) > 0).all()
    on, off = told.parameters["theta_on"] * 1.5, told.parameters["theta_off"] * 1.2
    told.retune(theta_on=on, theta_off=off, threshold_sigma=0.05)
    anew, spread = told.thresholds
    for found, stated in zip(anew, (on, off), strict=True):
        np.testing.assert_allclose(found, np.broadcast_to(stated, shape), rtol=1e-15)
    np.testing.assert_allclose(spread, np.broadcast_to(
        np.diag([0.05**2, 0.05**2]), spread.shape), rtol=1e-15)
    assert np.all(told.parameters["threshold_sigma"] == 0.05)
    with pytest.raises(TypeError, match=r"retune takes bandwidth, .*, got leak"):
        plain.retune(leak=3)


def steps_and_frames(worth, spread, *, per_frame, seed=5, frames=60, every=100_000):
    """Pixels whose light steps by ``worth`` thresholds per event, and an error."""
    rng = np.random.default_rng(seed)
    shape, level, events, taken = (20, 20), 3.0, [], []
    base, error = np.full(shape, level), 0.0
    for k in range(1, frames + 1):
        count = rng.random(shape) < per_frame
        y, x = np.nonzero(count)
        batch = np.zeros(len(y), EVENT_DTYPE)
        batch["t"] = np.sort((k - 1) * every + rng.integers(20_000, 80_000, len(y)))
        batch["x"], batch["y"], batch["p"] = x, y, rng.random(len(y)) < 0.5
        events.append(batch)
        base[y, x] += worth * 0.2 * np.where(batch["p"], 1, -1)
        error = rng.normal(0, 0.2 * spread, shape)
        dn = np.exp(base + error) * 20
        taken.append(ApsFrame(dn, k * every - 10_000, k * every + 10_000))
    return shape, np.concatenate(events), taken


def coverage_before_frames(method, events, frames):
    """Part of the pixels that a frame finds within one sigma, after 20 frames."""
    within = []
    for before, frame in itertools.pairwise(frames):
        part = events[(events["t"] > before.mid_us) & (events["t"] <= frame.mid_us)]
        method.add_frame(before)
        method.add_events(part)
        estimate = method.read(frame.mid_us)
        off = estimate.log_intensity - np.log(frame.dn / frame.exposure_ms)
        within.append(np.abs(off) <= np.sqrt(estimate.variance))
    return np.mean(within[20:])


@pytest.mark.parametrize("spread", [0.3, 0.6])
def test_sigmas_follow_what_innovations_show(spread):
    """Light that frames find elsewhere than events say, at every frame anew."""
    shape, events, frames = steps_and_frames(1.0, spread, per_frame=1.0)
    method = make(shape, 0.2, 0.2, mode="causal", threshold_sigma=0.0)
    assert 0.6 < coverage_before_frames(method, events, frames) < 0.76


@pytest.mark.parametrize(("worth", "low", "high"), [(0.0, 0.85, 1.0), (1.0, 0.0, 0.2)])
def test_the_noise_probability_of_lone_events_follows_frames(worth, low, high):
    shape, events, frames = steps_and_frames(worth, 0.02, per_frame=0.1)
    method = make(shape, 0.2, 0.2, mode="causal", threshold_sigma=0.0)
    coverage_before_frames(method, events, frames)
    assert low < method._tuning["p_noise"][0] < high


@pytest.mark.parametrize("read_dn", [3.0, 6.0])
def test_the_noise_of_frames_is_learned_and_biases_nothing(read_dn):
    rng = np.random.default_rng(1)
    light = rng.uniform(30, 300, (24, 24))
    method = make(light.shape, 0.2, 0.2, mode="causal")
    for k in range(60):
        dn = light + read_dn * rng.normal(size=light.shape)
        method.add_frame(ApsFrame(dn.astype(np.float32), 50_000 * k, 50_000 * k + 500))
    method.settle(3_000_000)
    log = method.read(3_000_000).log_intensity
    off = (log - np.log(light / 0.5))[light < 100]
    learned = method._tuning["read_variance"][0] ** 0.5
    assert read_dn / 1.3 < learned < 1.3 * read_dn
    assert abs(off.mean()) < 0.1 * off.std()    # weighed by their own DN: .12, .15
    assert off.std() < 0.4 * np.mean(read_dn / light[light < 100])  # else .7 at 6 DN
