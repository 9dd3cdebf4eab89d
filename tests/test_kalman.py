"""What the filter promises of light, by simulated cameras and by streams made by hand.

test_increments.py compares it with its plain version.
"""
import numpy as np
import pytest
from ideal import rotating_polarizer
from streams import feed, random_events
from truth_errors import errors_of

from pdavis_cv import EVENT_DTYPE, ApsFrame, Calibration, KalmanFilter, fuse
from pdavis_cv.pixel.learn import Priors, prior_model
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer

MODES = ("causal", "buffered", "offline")


def make(shape=(3, 4), on=0.2, off=0.25, **options):
    return KalmanFilter(shape, theta_on=on, theta_off=off, **options)


def test_thresholds_are_learned_from_frames():
    on, off = 0.12, 0.21
    recording, _ = rotating_polarizer(
        60 * 1.013, 4.0, size=(4, 4), theta=(on, off))
    start = {"on": np.full((4, 4), 0.16), "off": np.full((4, 4), 0.18)}
    start["on"][:, ::2] *= 1.1
    method = make((4, 4), **start, mode="causal")
    packets = list(recording.packets())
    feed(method, np.concatenate([p.events for p in packets]),
         [frame for p in packets for frame in p.frames])
    (learned_on, learned_off), covariance = method.thresholds
    # Beginning at 1.33 to 1.46 times the ratio.
    np.testing.assert_allclose(learned_on / learned_off / (on / off), 1, atol=0.12)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_before_any_data_thresholds_are_those_stated():
    on = np.linspace(0.1, 0.3, 12).reshape(3, 4)
    method = make(on=on, off=0.25)
    thetas, covariance = method.thresholds
    np.testing.assert_allclose(thetas[0], on, rtol=1e-6)
    np.testing.assert_allclose(thetas[1], 0.25, rtol=1e-6)
    spread = method._model.spread
    np.testing.assert_allclose(np.sqrt(covariance[..., 0, 0]), spread * on, rtol=1e-5)
    assert not covariance[..., 0, 1].any()


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


def scored(recording, truth, **options):
    return errors_of(fuse(
        recording, times_us=np.arange(1_000_000, 1_900_000, 5003), method="kalman",
        demosaic="superpixel", **options), truth)


@pytest.mark.accuracy
@pytest.mark.gate
@pytest.mark.parametrize(("camera", "options"), [
    ("nominal", {"causal": True}), ("nominal", {}), ("nominal", {"mode": "offline"}),
])
def test_one_sigma_covers_about_two_thirds_of_the_errors(recorded, camera, options):
    score = scored(*recorded[camera], nominal_thresholds=(0.16, 0.18), **options)
    assert 0.55 < score.aop_coverage < 0.85
    # A degree that lasts is better known than the channels, whose sigmas are given.
    assert score.dolp_coverage > 0.55
    assert score.aop < np.deg2rad(1.1)


@pytest.mark.parametrize("s0", [1.0, 5.0])
def test_sigmas_have_what_no_number_of_frames_averages(s0):
    light = FlatLight(s0=s0, dolp=0.3, aop=0.5)     # 10 and 50 DN: offsets are 2 DN
    recording, truth = Camera.preset("typical", seed=41, size=(48, 48)).record(light, 2)
    found = errors_of(fuse(
        recording, times_us=[1_900_000], demosaic="superpixel"), truth)
    assert 0.55 < found.aop_coverage < 0.8
    assert 0.55 < found.dolp_coverage < 0.8


@pytest.mark.accuracy
@pytest.mark.gate
@pytest.mark.parametrize(("mode", "aop_deg", "dolp"), [
    ("buffered", 0.5, 0.003), ("offline", 0.35, 0.003)])
def test_a_complete_calibration_takes_the_pixels_differences_out(
        recorded, mode, aop_deg, dolp):
    camera = Camera.preset("nominal", seed=5, size=(12, 12))
    calibration = Calibration(**camera.exact_calibration(), bandwidth_hz=250.0)
    score = scored(*recorded["nominal"], mode=mode, calibration=calibration)
    assert score.aop < np.deg2rad(aop_deg)
    assert score.dolp < dolp
    # Sigmas are those of learned noise, which is cautious where the light is simple,
    # and what pixels differ in looks like light that does.
    assert 0.55 < score.aop_coverage < 0.995
    assert score.dolp_coverage > 0.5


@pytest.mark.gate
def test_frames_after_a_time_make_offline_images_better(recorded):
    camera = Camera.preset("nominal", seed=5, size=(12, 12))
    calibration = Calibration(**camera.exact_calibration(), bandwidth_hz=250.0)
    buffered, offline = (scored(*recorded["nominal"], mode=mode,
                                calibration=calibration).aop
                         for mode in ("buffered", "offline"))
    assert offline < 0.85 * buffered


def test_without_events_variance_grows_with_time():
    """At the rate of the model: alpha."""
    method = make((1, 1), 0.2, 0.2)
    method.add_frame(ApsFrame(np.full((1, 1), 400.0), 0, 10_000))
    early, late = (float(method.read(t).variance[0, 0])
                   for t in (1_000_000, 3_000_000))
    assert late - early == pytest.approx(2 * method._model.noise[0], rel=1e-3)


def test_events_outside_or_late_are_refused_by_name():
    method = make()
    events = random_events(10, (3, 4)).copy()
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
    ({"ratio_sigma": -1}, "ratio_sigma must be"),
    ({"on": 0}, "theta_on must be positive"),
])
def test_impossible_parameters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_empty_and_read_only_input():
    method = make((1, 1))
    method.add_events(np.empty(0, EVENT_DTYPE))
    assert not method.read(0).valid[0, 0]
    method.add_events(random_events(3, (1, 1), read_only=True))


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


# ---- light at rest ---------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_light_that_has_stopped_is_shown_as_frames_have_it(mode):
    """Part of a threshold after the last event; frames then say where the light is."""
    method, theta, gap = make((1, 1), 0.2, 0.2, mode=mode), 0.2, 5_000
    events = np.zeros(8, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(1, 9) * gap, 1
    stopped = 8.4 * gap     # .4 thresholds after the last event

    def log(t):
        return np.log(20) + theta * np.minimum(t, stopped) / gap

    frames = []
    for start in range(0, 2_000_000, 50_000):
        dn = 10 * np.exp(log(start + np.arange(50, 10_000, 100))).mean()
        frames.append(ApsFrame(np.full((1, 1), dn), start, start + 10_000))
    feed(method, events, frames)
    last = frames[-1].mid_us
    for t in (last + 10_000, last + 1_000_000):
        estimate = method.read(t)
        assert abs(estimate.log_intensity[0, 0] - log(t)) < 0.1 * theta


@pytest.mark.parametrize("t", [340_000, 940_000, 1_140_000])
def test_a_stream_shows_light_that_stopped_as_frames_have_it(t):
    """Though frames are taken with more of a threshold crossed than silence leaves."""
    theta = 0.2
    method = make((1, 1), theta, theta, mode="causal",
                  model=prior_model(Priors(theta=(theta, theta)), 0))
    events = np.zeros(8, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(1, 9) * 10_000, 1
    # It stops .4 thresholds after the last event, before the exposure of 100 ms.
    dn = np.full((1, 1), 200 * np.exp(8.4 * theta))
    frames = [ApsFrame(np.full((1, 1), 200.0), -20_000, -10_000),
              *(ApsFrame(dn, s, s + 10_000) for s in range(100_000, t, 50_000))]
    feed(method, events, frames)
    shown = method.read(t).log_intensity[0, 0]
    assert abs(shown - np.log(dn / 10)) < 0.06 * theta


def test_slow_light_is_as_frames_around_show_it():
    """What a silence says at both frames is as known by now, as at the time read."""
    theta, gap = 0.2, 240_000

    def passed(t):      # thresholds: up, and from 4.5 gaps on down
        return np.minimum(t, 9 * gap - t) / gap

    events = np.zeros(7, EVENT_DTYPE)
    events["t"] = [gap, 2 * gap, 3 * gap, 4 * gap, 6 * gap, 7 * gap, 8 * gap]
    events["p"] = [1, 1, 1, 1, 0, 0, 0]
    frames = [ApsFrame(np.full((1, 1), 200 * np.exp(theta * passed(s + 5000))), s,
                       s + 10_000) for s in range(0, 2_100_000, 50_000)]
    errors = []
    for t in range(300_000, 2_000_000, 17_000):
        method = make((1, 1), theta, theta,
                      model=prior_model(Priors(theta=(theta, theta)), 50_000))
        seen = t + method.lookahead_us
        feed(method, events[events["t"] <= seen],
             [frame for frame in frames if frame.mid_us <= seen])
        errors.append(method.read(t).log_intensity[0, 0] - np.log(20))
        errors[-1] -= theta * passed(t)
    assert np.sqrt(np.mean(np.square(errors))) < 0.07 * theta   # 0.14 as of each frame


def test_light_at_rest_is_as_good_as_frames():
    """Noise events hardly move it, and more than one frame tells of it."""
    recording, truth = Camera.preset("nominal", seed=4, size=(12, 12)).record(
        FlatLight(dolp=0.3, aop=0.5), 2.0)

    def error(**options):
        times = range(1_000_000, 1_900_000, 9_000)
        return np.array(errors_of(fuse(
            recording, times_us=times, demosaic="superpixel",
            nominal_thresholds=(0.16, 0.18), **options), truth)[:2])

    frames = error(method="frames")
    assert np.all(error(method="kalman") < 1.2 * frames)
    assert np.all(error(method="kalman", causal=True) < 1.25 * frames)


def test_a_pixel_that_stopped_is_shown_at_rest():
    """Silence says so: what is extrapolated goes back to nothing."""
    method = make((1, 1), mode="causal",
                  model=prior_model(Priors(theta=(0.2, 0.2)), 0))
    method.add_frame(ApsFrame(np.full((1, 1), 400.0), 0, 10_000))
    events = np.zeros(5, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(20_000, 120_000, 20_000), 1
    method.add_events(events)
    shown = [float(method.read(t).log_intensity[0, 0])
             for t in (110_000, 130_000, 800_000, 2_000_000)]
    at_event = shown[-1]
    assert shown[1] - at_event > shown[0] - at_event > 0.05
    assert abs(shown[2] - at_event) < 0.02


@pytest.mark.parametrize(("rpm", "most_deg", "most_dolp"), [
    (30, 2.4, 0.018), (600, 2.5, 0.03)])
def test_frames_tell_slow_light_and_events_what_looks_slow(rpm, most_deg, most_dolp):
    """At 600 RPM light is the same in every frame, and a line between them is wrong.

    Such frames tell no thresholds: these are known.
    """
    recording, truth = Camera.preset("nominal", seed=1310, size=(8, 8)).record(
        RotatingPolarizer(rpm=rpm, dolp=0.3, start_angle=0.3), 2.0)
    times = np.arange(1_000_000, 1_900_000, 7_013)
    errors = errors_of(fuse(
        recording, times_us=times, method="kalman", demosaic="superpixel",
        thresholds=(0.16, 0.18)), truth)
    assert np.degrees(errors.aop) < most_deg
    assert errors.dolp < most_dolp
