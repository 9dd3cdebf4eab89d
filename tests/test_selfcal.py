"""The online self-calibration: its window, its kernel, short and odd streams."""
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import reference_selfcal

from pdavis_cv import _kernels, fuse, open_recording
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.model import WAVE_DTYPE
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.selfcal import SelfCalibration, common_scale, window
from pdavis_cv.selfcal.bandwidth import fit_bandwidth
from pdavis_cv.selfcal.estimator import QUANTITIES
from pdavis_cv.selfcal.likelihood import (
    NORMAL,
    evidence,
    negative_log_likelihood,
    vertex,
)
from pdavis_cv.selfcal.pixel_sample import (
    CANDIDATE_DTYPE,
    INNOVATIONS_DTYPE,
    PIXEL_DTYPE,
    READING_DTYPE,
    PixelSample,
    candidates_of,
    select_busy_pixels,
)
from pdavis_cv.simulation import Camera, RotatingPolarizer

NOMINAL = (0.16, 0.18)
BOTH = frozenset({"bandwidth", "noise"})


@pytest.fixture(scope="module")
def recording():
    camera = Camera.preset("nominal", seed=3, size=(8, 8))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=1.0), 1.5)[0]


def looked_on(recording, cuts=None, **options):
    """Feed all frames by mid-exposure, and the events between them, cut or not."""
    options.setdefault("every_pixel", False)
    options.setdefault("nominal", NOMINAL)
    camera = SelfCalibration(recording.info.sensor_size, **options)
    events = recording.events()
    frames = [frame for packet in recording.packets() for frame in packet.frames]
    at = [0, *np.searchsorted(events["t"], [f.mid_us for f in frames]), len(events)]
    for i, (start, stop) in enumerate(pairwise(at)):
        for part in np.array_split(events[start:stop], cuts or 1):
            camera.add_events(part)
        if i < len(frames):
            camera.add_frame(frames[i])
    return camera


@pytest.mark.parametrize("deaf", [0.0, 700.0])
def test_the_kernel_is_its_twin(recording, deaf):
    camera = looked_on(recording)
    sample = select_busy_pixels(camera._window, NOMINAL, (0.2, 0.08)).with_refractory(
        deaf)
    candidates = candidates_of([(250.0, 0.0), (0.0, 8.0), (20.0, 3.0)])
    candidates["noise_per_s"][2] = 0.1
    candidates["drift"][1:] = 1e-4, 2.5e-5
    candidates["frame_sigma"][2] = 0.01
    candidates["scale_on"][2] = 1.3
    candidates["clock_us"][1:] = -1500, 7000
    got = sample.innovations(candidates, every=20)
    expected = np.zeros((3, 5))
    for i in range(0, len(sample.pixels), 20):
        start, stop, *_, on, off = sample._traits[i]
        mine = [(int(e["t"]), int(e["p"])) for e in sample._events[start:stop]]
        for k, candidate in enumerate(candidates):
            expected[k] += reference_selfcal.innovations(
                mine, sample._frames[:, i].tolist(), (on, off), 0.035, candidate, deaf)
    np.testing.assert_allclose(got.view(np.float64).reshape(3, 5), expected, rtol=1e-4)


def test_the_innovations_are_those_of_the_kalman_filter(recording):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    law, noise = (200.0, 2.0), (0.05, 1.3, 0.005)
    rows, columns = np.divmod(sample.pixels, 8)
    events = recording.events()
    place = np.full((8, 8), -1)
    place[rows, columns] = np.arange(len(rows))
    at = place[events["y"], events["x"]]
    events = events[at >= 0]
    events["x"], events["y"] = at[at >= 0], 0
    method = KalmanFilter((1, len(rows)), theta_on=NOMINAL[0], theta_off=NOMINAL[1],
                          threshold_sigma=0.035, bandwidth=law, noise=noise)
    fed = 0
    for packet in recording.packets():
        for frame in packet.frames:
            to = np.searchsorted(events["t"], frame.mid_us)
            method.add_events(events[fed:to])
            fed = to
            method.add_frame(ApsFrame(
                frame.dn[rows, columns][None], frame.exposure_start_us,
                frame.exposure_end_us, available_us=frame.available_us,
                valid=(None if frame.valid is None
                       else frame.valid[rows, columns][None])))
    method.add_events(events[fed:])
    got = sample.innovations(candidates_of([law], noise))[0]
    # The filter also fades to rest, learns of motion, lone events and frames' noise,
    # and linearizes that where it sees the light.
    np.testing.assert_allclose(
        [got[name] for name in ("chi2", "log_variance", "count")], method.misfit,
        rtol=5e-3)
    assert got["log_theta"] == pytest.approx(
        np.log(method.thresholds[0]).sum(), rel=5e-4)


def arguments(n=2, frames=3):
    """Valid arguments of the kernel, the output last."""
    events = np.zeros(0, EVENT_DTYPE)
    pixels = np.zeros(n, PIXEL_DTYPE)
    pixels["first"] = frames * np.arange(n)
    pixels["last"] = pixels["first"] + frames
    return [events, pixels, np.zeros(frames * n, READING_DTYPE),
            np.zeros(0, WAVE_DTYPE), 0.035, 0.0, np.zeros(2, CANDIDATE_DTYPE),
            np.zeros(2, INNOVATIONS_DTYPE)]


@pytest.mark.parametrize(("n", "frames"), [(0, 0), (0, 3), (1, 0), (1, 1)])
def test_the_kernel_takes_nothing(n, frames):
    given = arguments(n, frames)
    given[1]["theta_on"] = given[1]["theta_off"] = 0.2
    for array in given[:4]:
        array.flags.writeable = False
    given[-1]["count"] = 5
    _kernels.sample_innovations(*given)
    assert np.all(given[-1]["count"] == 0)


def test_the_kernel_refuses_shapes_that_do_not_fit():
    for at, other, message in (
            (-1, np.zeros(3, INNOVATIONS_DTYPE), "one row per candidate"),
            (2, np.zeros(5, READING_DTYPE), "lie outside frames"),
            (1, np.array([(0, 0, 0, -1, .2, .2)] * 2, PIXEL_DTYPE), "outside frames"),
            (1, np.array([(0, 1, 0, 0, .2, .2)] * 2, PIXEL_DTYPE), "outside events")):
        given = arguments()
        given[at] = other
        with pytest.raises(ValueError, match=message):
            _kernels.sample_innovations(*given)


@pytest.mark.parametrize("room", [0, 7, 300, 2000])
def test_events_of_the_sample_are_those_that_a_search_finds(room):
    rng, shape = np.random.default_rng(3), (6, 7)
    place = np.full(shape, -1, np.int32)
    place.flat[rng.permutation(42)[:15]] = np.arange(15)
    events = np.zeros(1999, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(1999), rng.integers(0, 2, 1999)
    events["x"], events["y"] = rng.integers(0, (9, 8), (1999, 2)).T  # some outside
    out = np.zeros(room, EVENT_DTYPE)
    n = _kernels.sample_events(events, place, out)
    inside = events[(events["x"] < 7) & (events["y"] < 6)]
    at = place[inside["y"], inside["x"]]
    want = inside[at >= 0]
    want["x"], want["y"] = at[at >= 0], 0
    assert 300 < len(want) < 600
    np.testing.assert_array_equal(out[:n], want[:room])
    assert n == min(room, len(want))


def test_many_candidates_find_the_same_as_each_alone(recording):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    candidates = candidates_of([(250.0, 0.0), (0.0, 8.0), (60.0, 2.0)] * 30)
    candidates["clock_us"] = np.repeat([0, 1500, 0, -4000], [40, 10, 1, 39])
    candidates["scale_on"] = np.linspace(0.5, 2, len(candidates))
    together = sample.innovations(candidates)
    alone = [sample.innovations(candidates[i:i + 1])[0] for i in range(90)]
    assert together.tolist() == [each.tolist() for each in alone]


@pytest.mark.parametrize(("least", "step"), [(1000, 1), (20, 3), (7, 9)])
def test_a_part_of_the_pixels_is_what_one_in_so_many_tells(recording, least, step):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    assert len(sample.pixels) == 64
    part = sample.thinned(least)
    assert part.pixels.tolist() == sample.pixels[::step].tolist()
    candidates = candidates_of([(250.0, 0.0), (0.0, 8.0)])
    assert part.innovations(candidates).tolist() == sample.innovations(
        candidates, step).tolist()
    for change in (PixelSample.without_dim_samples, PixelSample.with_leak_in_frames,
                   lambda one: one.with_thresholds_scaled(0.8, 1.2)):
        np.testing.assert_array_equal(
            change(part)._readings(1)[1], change(sample)._readings(step)[1])
    np.testing.assert_array_equal(
        part.between_like_events(0.0)._frames,
        sample.between_like_events(0.0)._frames[:, ::step])
    inside = [sample.gaps_us[0][:0], *(
        np.diff(sample._events["t"][one["start"]:one["stop"]])
        for one in sample._traits[::step])]
    np.testing.assert_array_equal(part.gaps_us[0], np.concatenate(inside))


def test_searches_that_meet_are_followed_once(recording, monkeypatch):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    law, fits = (250.0, 0.0), []

    def counted(sample):
        fits.append(sample)
        return fit_bandwidth(sample)

    monkeypatch.setattr(common_scale, "fit_bandwidth", counted)
    found = common_scale.fit_common_scale(sample, law)
    both = len(fits)
    again = common_scale.fit_common_scale(sample, law, before=found)
    assert len(fits) == 2 * both    # the third search ends where the first one did
    assert again.on == pytest.approx(found.on, rel=1e-3)


def test_blocks_of_time_add_up_to_what_the_whole_sample_tells(recording):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    candidates = candidates_of([(250.0, 0.0), (0.0, 8.0)])
    whole, parts = sample.innovations(candidates), sample.innovations_by_time(
        candidates, 7)
    for name in whole.dtype.names:
        np.testing.assert_allclose(parts[name].sum(1), whole[name], rtol=1e-9)
    half = sample.innovations_by_time(candidates, 2)["count"]
    assert np.all(half > 0.3 * whole["count"][:, None])
    gain, error = evidence(*parts)
    assert gain == pytest.approx(np.diff(negative_log_likelihood(whole))[0])
    assert 0 < error < np.inf


def test_innovations_smaller_than_stated_are_little_evidence():
    one, other = np.zeros((2, 4), INNOVATIONS_DTYPE)
    for found, square in ((one, 0.05), (other, 0.06)):
        found["count"], found["chi2"] = 50, 50 * square
    scaled, _ = evidence(one, other, NORMAL)
    assert scaled == pytest.approx(100 * np.log(1.2))
    stated, error = evidence(one, other, NORMAL, least=1.0)
    assert stated == pytest.approx(100 * 0.01)
    assert error == 0
    for found in (one, other):
        found["chi2"] *= 100
    assert evidence(one, other, NORMAL, least=1.0)[0] == pytest.approx(scaled)


def test_frames_between_like_events_are_those_that_a_search_per_pixel_finds(recording):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    t, p = sample._events["t"], sample._events["p"]
    for delay, least in ((0.0, None), (-3000.4, 3), (9000.0, 2), (1e9, 1)):
        got = sample.between_like_events(delay, least)._frames["variance"] > 0
        for i, (start, stop) in enumerate(zip(
                sample._traits["start"], sample._traits["stop"], strict=True)):
            mine, sign = t[start:stop], p[start:stop]
            for frame, kept in zip(sample._frames[:, i], got[:, i], strict=True):
                begin, middle, end = (int(frame[name]) + round(delay)
                                      for name in ("begin", "middle", "end"))
                k = np.count_nonzero(mine <= middle)
                like = 2 <= k < len(mine) and len(set(sign[k - 2:k + 1].tolist())) == 1
                if least is not None:
                    like |= np.count_nonzero((mine >= begin) & (mine < end)) >= least
                assert kept == (like and frame["variance"] > 0)


def test_eight_threads_find_the_same(recording):
    sample = select_busy_pixels(looked_on(recording)._window, NOMINAL, (0.2, 0.08))
    candidates = candidates_of([(250.0, 0.0), (0.0, 8.0)])
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(sample.innovations, [candidates] * 16))
    assert all(np.array_equal(each, results[0]) for each in results)


def test_an_estimate_does_not_depend_on_how_the_stream_was_cut(recording):
    one, other = looked_on(recording), looked_on(recording, cuts=7)
    assert one.estimate(wanted=BOTH).bandwidth == other.estimate(wanted=BOTH).bandwidth


def test_an_estimate_changes_nothing_and_states_go_on_equally(recording):
    camera = looked_on(recording)
    first = camera.estimate(wanted=BOTH)
    kept = pickle.loads(pickle.dumps(camera.state()))
    late = recording.events()[:100]
    late["t"] += 2_000_000
    camera.add_events(late)
    other = SelfCalibration((8, 8), NOMINAL, every_pixel=False)
    other.restore(kept)
    assert other.estimate(wanted=BOTH).bandwidth == first.bandwidth
    assert other.estimate(wanted=BOTH).noise == first.noise


def test_the_window_is_bounded_and_recent(recording, monkeypatch):
    whole = looked_on(recording)
    assert not whole.full
    monkeypatch.setattr(window, "MAX_FRAMES", 12)
    short = looked_on(recording)
    assert short.full
    assert len(short._window.intervals) == 12
    assert short._window.intervals[-1].exposure_us.max() == (
        whole._window.intervals[-1].exposure_us.max())
    assert short._window.nbytes < 0.6 * whole._window.nbytes
    assert short.estimate(wanted=BOTH).bandwidth.hz == pytest.approx(250, rel=0.25)


@pytest.mark.parametrize("every_pixel", [False, True])
def test_the_number_of_events_is_bounded(recording, monkeypatch, every_pixel):
    monkeypatch.setattr(window, "MAX_EVENTS", 2000)
    monkeypatch.setattr(window, "SENSOR_MAX_EVENTS", 2000)
    monkeypatch.setattr(window, "MAX_CELL_EVENTS", 100)
    camera = looked_on(recording, every_pixel=every_pixel)
    assert camera.full
    assert camera.nbytes < (1 + every_pixel) * 6000 * 13


@pytest.mark.parametrize(("bound", "kept"), [
    ({"SENSOR_MAX_US": 700}, 701), ({"SENSOR_MAX_EVENTS": 333}, 333)])
def test_packets_do_not_decide_which_events_of_all_pixels_are_kept(
        monkeypatch, bound, kept):
    for name, value in bound.items():
        monkeypatch.setattr(window, name, value)
    events = np.zeros(1000, EVENT_DTYPE)
    events["t"] = 5_000 + np.arange(1000)
    for size in (1, 10, 64, 1000):
        whole = window.SensorWindow((4, 4))
        for part in np.split(events, range(size, len(events), size)):
            whole.add(part)
        np.testing.assert_array_equal(np.concatenate(whole.items), events[:kept])
        assert whole.full


def test_without_frames_memory_is_bounded_too(monkeypatch):
    monkeypatch.setattr(window, "MAX_EVENTS", 500)
    monkeypatch.setattr(window, "MAX_CELL_EVENTS", 200)
    camera = SelfCalibration((4, 4), every_pixel=False)
    empty = camera.nbytes
    events = np.zeros(100, EVENT_DTYPE)
    for i in range(100):
        events["t"] = i
        camera.add_events(events)
    assert camera.nbytes <= empty + (500 + 300) * 13
    assert camera.estimate(wanted=BOTH).bandwidth is None


@pytest.mark.parametrize("dn", [0.0, 5.0, np.nan, 1023.0])
def test_frames_without_contrast_tell_nothing(dn):
    """Nothing is busy, or nothing is usable: the prior stays."""
    camera = SelfCalibration((4, 4), every_pixel=False)
    rng = np.random.default_rng(0)
    for i in range(10):
        events = np.zeros(3, EVENT_DTYPE)
        events["t"], events["p"] = 50_000 * i, rng.integers(0, 2, 3)
        camera.add_events(events)
        camera.add_frame(ApsFrame(np.full((4, 4), dn, np.float32), 50_000 * i + 10,
                                  50_000 * i + 20_010))
    found = camera.estimate(wanted=BOTH)
    assert found.bandwidth is None or found.bandwidth.sigma > 0.5


@pytest.mark.parametrize("seed", [   # test_short_recordings.py has 200 in the gate
    seed if seed < 2 else pytest.param(seed, marks=pytest.mark.gate)
    for seed in range(12)])
def test_short_slow_recordings_fuse(seed):
    """10 to 100 RPM for .2 to 2 s: few events, odd counts, causal and not."""
    rng = np.random.default_rng(seed)
    camera = Camera.preset("nominal", seed=seed, size=(8, 8))
    made, _ = camera.record(
        RotatingPolarizer(rpm=rng.uniform(10, 100), start_angle=rng.uniform(0, 3)),
        rng.uniform(0.2, 2.0))
    for causal in (False, True):
        images = list(fuse(made, method="kalman", causal=causal, fps=5))
        assert all(np.isfinite(image.quad).all() for image in images)
    looked_on(made, every_pixel=True).estimate(
        wanted={"thresholds", "bandwidth", "noise"})


def test_busy_pixels_are_found_where_counts_are_far_apart():
    """The 95 % quantile lies between 1 and 100: no pixel within a factor of two."""
    camera = SelfCalibration((5, 4), every_pixel=False)
    for i in range(6):
        n = np.array([1 if i == 0 else 0] * 19 + [20])
        events = np.zeros(n.sum(), EVENT_DTYPE)
        events["t"] = 50_000 * i + np.arange(n.sum())
        events["y"], events["x"] = np.divmod(np.repeat(np.arange(20), n), 4)
        camera.add_events(events)
        camera.add_frame(ApsFrame(np.full((5, 4), 100, np.float32), 50_000 * i + 1000,
                                  50_000 * i + 21_000))
    assert len(select_busy_pixels(camera._window, NOMINAL, (0.2, 0.08)).pixels) >= 1
    assert camera.estimate(wanted=BOTH).bandwidth is not None


@pytest.mark.parametrize("nominal", [(0.1, 0.1), (0.3, 0.2), (0.4, 0.45)])
def test_nominal_thresholds_that_do_not_hold_are_given_up(recording, nominal):
    camera = looked_on(recording, nominal=nominal)
    found = camera.estimate(wanted={"scale", "bandwidth"})
    for theta, true in ((found.theta_on, 0.16), (found.theta_off, 0.18)):
        assert np.ptp(theta) == 0
        assert theta[0, 0] == pytest.approx(true, rel=0.08)
    assert found.bandwidth.hz == pytest.approx(250, rel=0.1)
    assert 0.02 < found.common_scale_sigma < 0.1


def test_every_pixel_s_thresholds_start_from_the_scale_found(recording):
    truth = Camera.preset("nominal", seed=3, size=(8, 8)).maps
    found = looked_on(recording, nominal=(0.3, 0.2), every_pixel=True).estimate()
    for theta, true in ((found.theta_on, truth["theta_on"]),
                        (found.theta_off, truth["theta_off"])):
        assert np.mean(theta) == pytest.approx(np.mean(true), rel=0.04)
        assert np.corrcoef(theta.ravel(), true.ravel())[0, 1] > 0.8


@pytest.mark.parametrize(("rpm", "s0"), [
    (202.6, 30.0), (30.4, 30.0), (0.0, 30.0), (30.4, 1.08), (60.8, 1.08)])
def test_nominal_thresholds_stay_where_they_hold_or_nothing_is_told(rpm, s0):
    """At rest and in dim light most events are noise: it looks like a small scale."""
    camera = Camera.preset("realistic", seed=1, size=(8, 8))
    made, _ = camera.record(RotatingPolarizer(rpm=rpm, s0=s0, start_angle=0.3), 2.0)
    found = looked_on(made).estimate(wanted={"scale"})
    np.testing.assert_array_equal(found.theta_on, NOMINAL[0])
    assert found.common_scale_sigma == 0


@pytest.mark.gate
@pytest.mark.parametrize("preset", ["drawn", "davis346"])
def test_the_scale_of_cameras_of_other_families_is_found(preset):
    """Nothing was chosen on these; their thresholds are stated as .2."""
    for seed in (11, 12):
        camera = Camera.preset(preset, seed=seed, size=(10, 10))
        made, _ = camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.5)
        found = looked_on(made, nominal=(0.2, 0.2)).estimate(wanted=QUANTITIES - {
            "thresholds"})
        for theta, name in zip((found.theta_on, found.theta_off),
                               ("theta_on", "theta_off"), strict=True):
            assert theta[0, 0] == pytest.approx(camera.maps[name].mean(), rel=0.1)


@pytest.mark.gate
@pytest.mark.parametrize(("rpm", "dvs"), [
    (202.6, {}), (1013.0, {"refractory_us": 0.0})])
def test_thresholds_and_clocks_that_are_both_wrong_are_found(rpm, dvs):
    """Nothing was chosen on these; a pixel's refractory period takes events at speed.

    The limits are twice the sigmas that are stated: models of frames and interpolation
    .03 of the scale, a lag of 530 us that is known to a factor of e^.5.
    """
    for seed in range(41, 47):
        camera = Camera.preset("davis346", seed=seed, size=(10, 10), dvs=dvs)
        made, _ = camera.record(
            RotatingPolarizer(rpm=rpm, start_angle=0.5 * seed, dolp=0.8), 1.5)
        found = looked_on(made, nominal=(0.2, 0.2)).estimate(
            wanted=QUANTITIES - {"thresholds"})
        true = camera.maps["theta_on"].mean() * camera.maps["theta_off"].mean()
        got = found.theta_on[0, 0] * found.theta_off[0, 0]
        assert 0.5 * np.log(got / true) == pytest.approx(0, abs=0.06)
        assert found.clock_offset.applied_us == pytest.approx(
            -camera.faults.frame_offset_us, abs=600)


def test_the_scale_of_a_real_camera_is_that_of_a_regression():
    """On and off by regression of frames' differences on counts: .29 and .37."""
    data = os.environ.get("PDAVIS_TEST_DATA")
    if not data:
        pytest.skip("PDAVIS_TEST_DATA is not set")
    with open_recording(Path(data) / "davis346.aedat4") as made:
        found = looked_on(made, nominal=(0.2, 0.2)).estimate(wanted={
            "scale", "bandwidth"})
    assert found.theta_on[0, 0] == pytest.approx(0.29, rel=0.12)
    assert found.theta_off[0, 0] == pytest.approx(0.37, rel=0.12)


def test_a_stated_bandwidth_is_combined(recording):
    alone = looked_on(recording).estimate(wanted=BOTH).bandwidth
    stated = (alone.hz * 1.02, 0.0, alone.sigma)
    both = looked_on(recording, stated_bandwidth=stated).estimate(wanted=BOTH).bandwidth
    assert both.hz == pytest.approx(alone.hz * np.sqrt(1.02))
    assert both.sigma == pytest.approx(alone.sigma / np.sqrt(2))


def test_impossible_arguments_are_refused(recording):
    with pytest.raises(ValueError, match="threshold_sigma must be positive"):
        SelfCalibration((4, 4), threshold_sigma=0)
    with pytest.raises(ValueError, match="leak_hz must be"):
        SelfCalibration((4, 4), leak_hz=(0.3, -0.1))
    camera = SelfCalibration((4, 4), every_pixel=False)
    with pytest.raises(ValueError, match="wanted must be among"):
        camera.estimate(wanted={"lamp"})
    with pytest.raises(ValueError, match=r"every_pixel=True"):
        camera.estimate(wanted={"thresholds"})
    with pytest.raises(ValueError, match="thresholds were not estimated"):
        _ = camera.estimate(wanted=BOTH).sigma


@pytest.mark.parametrize("at", [-0.7, 0.05, 0.9])
def test_a_parabola_s_vertex_is_found_on_uneven_points(at):
    x = np.array([-1.0, -0.2, 0.3, 1.0])
    assert vertex(x, 3 * (x - at)**2 + 5) == pytest.approx(at)
    assert vertex(x, -x) == 1.0
    assert vertex(x, np.ones(4)) in x


def test_calibrated_frames_count(recording):
    """A dark frame's presence makes the scale of the thresholds better known."""
    wanted = {"thresholds", "noise"}
    plain, dark = (looked_on(recording, dark=each, every_pixel=True).estimate(
        wanted=wanted, bandwidth=(250.0, 0.0)) for each in (False, True))
    assert np.median(dark.sigma) < 0.9 * np.median(plain.sigma)
    assert dark.common_scale_sigma < plain.common_scale_sigma



@pytest.mark.parametrize("seed", [18, 22])
def test_sums_that_are_noise_tell_no_scale(seed):
    """A tenth of the events is lost: a third and a quarter of the thresholds fitted."""
    camera = Camera.preset("nominal", seed=seed, size=(12, 12), faults={"lost": 0.1})
    made, _ = camera.record(RotatingPolarizer(
        rpm=1013.0, start_angle=np.deg2rad((17 + 111.2 * seed) % 180)), 1.5)
    look = SelfCalibration((12, 12), NOMINAL, every_pixel=False)
    for packet in made.packets():
        look.add_events(packet.events)
        for frame in packet.frames:
            look.add_frame(frame)
    found = look.estimate(wanted={"scale", "bandwidth", "clock_offset"})
    assert found.common_scale_sigma == 0
    assert np.all(found.theta_on == NOMINAL[0])
