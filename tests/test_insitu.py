import numpy as np
import pytest

from pdavis_cv import (
    Calibration,
    FusionOptions,
    bandwidth_in_situ,
    fuse,
    recording_from_arrays,
    thresholds_in_situ,
)
from pdavis_cv.analysis import Scorer
from pdavis_cv.fusion.learning import Learning
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.selfcal import Bandwidth
from pdavis_cv.selfcal.thresholds import variance_inflation
from pdavis_cv.simulation import Camera, Fan, RotatingPlate, RotatingPolarizer

NOMINAL = (0.16, 0.18)


def in_force(recording, **options):
    """Return the parameters that kalman works with."""
    image = next(fuse(recording, method="kalman", **options))
    return image.provenance["parameters"]


@pytest.fixture(scope="module")
def nominal():
    camera = Camera.preset("nominal", seed=3, size=(8, 8))
    scene = RotatingPolarizer(rpm=200 * 1.013, start_angle=1.0)
    recording, truth = camera.record(scene, 2.5)
    return camera, recording, truth


@pytest.fixture(scope="module")
def estimate(nominal):
    return thresholds_in_situ(nominal[1], nominal=NOMINAL)


def ratio_error(camera, estimate):
    return (np.log(estimate.theta_on / estimate.theta_off)
            - np.log(camera.maps["theta_on"] / camera.maps["theta_off"]))


def test_the_ratio_of_the_thresholds_is_found(nominal, estimate):
    error = ratio_error(nominal[0], estimate)
    assert np.sqrt(np.mean(error**2)) < 0.003
    assert estimate.sigma.shape == (2, 8, 8)


@pytest.mark.gate
@pytest.mark.parametrize("rpm", [30, 60, 200, 1000])
def test_one_sigma_covers_two_thirds_of_the_errors_of_thresholds(rpm):
    """Over chips and start angles: a part of the error is the same in a whole chip."""
    covered = []
    for chip in range(11, 17):
        camera = Camera.preset("nominal", seed=chip, size=(8, 8))
        scene = RotatingPolarizer(rpm=rpm * 1.013, start_angle=0.5 * chip)
        found = thresholds_in_situ(
            camera.record(scene, 2.0)[0], nominal=NOMINAL,
            bandwidth=Bandwidth(250, 0, 3, 0.03))
        errors = (ratio_error(camera, found),
                  found.theta_on - camera.maps["theta_on"],
                  found.theta_off - camera.maps["theta_off"])
        covered.append([np.mean(np.abs(error) < sigma) for error, sigma in zip(
            errors, (found.ratio_sigma, *found.sigma), strict=True)])
        assert 0.001 < found.common_scale_sigma < 0.02
        assert np.all(np.linalg.eigvalsh(found.covariance) > 0)
    ratio, on, off = np.mean(covered, 0)
    assert 0.56 < ratio < 0.82
    assert 0.58 < on < 0.82
    assert 0.58 < off < 0.82


@pytest.mark.gate
def test_one_sigma_covers_two_thirds_of_the_errors_of_a_bench():
    """A slow recording of 8 s with dark values: thresholds to a half per cent."""
    covered = []
    for chip in (21, 22, 23):
        camera = Camera.preset("nominal", seed=chip, size=(8, 8))
        known = Calibration(sensor_size=(8, 8), dark=camera.maps["dark_dn"])
        found = thresholds_in_situ(
            camera.record(RotatingPolarizer(rpm=60.8, start_angle=0.7 * chip), 8.0)[0],
            nominal=NOMINAL, calibration=known, bandwidth=Bandwidth(250, 0, 3, 0.03))
        ratio = ratio_error(camera, found)
        size = np.stack([found.theta_on - camera.maps["theta_on"],
                         found.theta_off - camera.maps["theta_off"]])
        assert np.sqrt(np.mean(ratio**2)) < 0.0025
        assert np.sqrt(np.mean(size**2)) < 0.0013
        covered.append([np.mean(np.abs(ratio) < found.ratio_sigma),
                        np.mean(np.abs(size) < found.sigma)])
    assert np.all(np.abs(np.mean(covered, 0) - 0.68) < 0.12)


@pytest.mark.parametrize(("leak_hz", "told"), [
    (0.1, {}), (0.2, {}), (0.4, {}), (0.7, {"leak_hz": (0.7, 0.08)})])
def test_leak_is_taken_out_of_the_ratio(leak_hz, told):
    """What is left is what it differs by, divided by the ON events per second."""
    camera = Camera.preset("nominal", seed=5, size=(8, 8), dvs={"leak_hz": leak_hz})
    recording, _ = camera.record(RotatingPolarizer(rpm=506.5), 2.0)
    on_per_s = sum(np.count_nonzero(packet.events["p"]) for packet
                   in recording.packets()) / 64 / 2.0
    found = thresholds_in_situ(recording, nominal=NOMINAL,
                               bandwidth=Bandwidth(250, 0, 3, 0.03), **told)
    left = -np.mean(ratio_error(camera, found)) * on_per_s
    expected = leak_hz - told.get("leak_hz", (0.2,))[0]
    assert left == pytest.approx(expected, abs=0.1)
    assert np.median(found.ratio_sigma) * on_per_s == pytest.approx(0.12, abs=0.04)


@pytest.mark.parametrize("leak_hz", [0.3, (0.3, -0.1), (np.nan, 0.1)])
def test_a_leak_is_a_mean_and_a_standard_deviation(nominal, leak_hz):
    with pytest.raises(ValueError, match="leak_hz"):
        thresholds_in_situ(nominal[1], nominal=NOMINAL, leak_hz=leak_hz)


def test_pixels_are_not_pulled_together_more_than_they_scatter():
    """Half a turn a second tells the ratio better than the nominal value does."""
    slopes = []
    for chip in (31, 32):
        camera = Camera.preset("nominal", seed=chip, size=(8, 8))
        recording, _ = camera.record(RotatingPolarizer(rpm=30.4), 2.5)
        found = thresholds_in_situ(recording, nominal=NOMINAL,
                                   bandwidth=Bandwidth(250, 0, 3, 0.03))
        true = np.log(camera.maps["theta_on"] / camera.maps["theta_off"])
        slopes.append(np.polyfit(true.ravel(), np.log(
            found.theta_on / found.theta_off).ravel(), 1)[0])
    assert 0.85 < np.mean(slopes) < 1.05


@pytest.mark.parametrize("overrated", [0.02, 1.0, 3.0])
def test_what_settles_less_than_its_variance_was_overrated(overrated):
    rng = np.random.default_rng(5)
    shape, true = (12, 12), np.log(0.9)
    full, half = 0.01**2, 0.02**2
    now = true + np.sqrt(full * overrated) * rng.normal(size=shape)
    then = now + np.sqrt((half - full) * overrated) * rng.normal(size=shape)
    then[0, 0] = 5.0                                      # one that jumped
    states = []
    for ratio, variance in ((then + 0.3, half), (now, full)):  # leak is in common
        theta = np.stack([0.2 * np.exp(ratio / 2), 0.2 * np.exp(-ratio / 2)])
        relative = 0.05**2 + variance / 4 * np.array([[1, -1], [-1, 1]])
        covariance = relative * np.einsum("iyx,jyx->yxij", theta, theta)
        states.append((theta, covariance))
    assert variance_inflation(*states) == pytest.approx(overrated, rel=0.3)
    assert variance_inflation(states[1], states[1]) is None


def test_a_dark_frame_makes_thresholds_better_known(nominal, estimate):
    camera, recording, _ = nominal
    known = Calibration(sensor_size=(8, 8), dark=camera.maps["dark_dn"])
    calibrated = thresholds_in_situ(
        recording, nominal=NOMINAL, calibration=known, bandwidth=estimate.bandwidth)
    errors = [np.abs(found.theta_on - camera.maps["theta_on"])
              for found in (estimate, calibrated)]
    assert np.mean(errors[1]) < 0.8 * np.mean(errors[0])
    sigmas = [found.sigma[0] for found in (estimate, calibrated)]
    assert np.mean(sigmas[1]) < 0.8 * np.mean(sigmas[0])
    assert 0.5 < np.mean(errors[1] < sigmas[1]) < 0.85


def test_the_bandwidth_is_found(estimate):
    assert estimate.bandwidth.hz == pytest.approx(250, rel=0.1)
    share = estimate.bandwidth.hz_per_intensity * estimate.bandwidth.at_intensity
    assert share < 0.1 * estimate.bandwidth.hz
    # Nothing tells that it follows the light, which would reach far beyond the frames.
    assert estimate.bandwidth.hz_per_intensity == 0
    assert 0 < estimate.bandwidth.sigma < 0.1


def test_the_bandwidth_is_found_at_high_speed_too():
    """There the stated variances are tens of times too large, and must not decide."""
    camera = Camera.preset("nominal", seed=4, size=(8, 8))
    scene = RotatingPolarizer(rpm=1013.0, start_angle=0.7)
    found = bandwidth_in_situ(camera.record(scene, 2.0)[0], nominal=NOMINAL)
    assert found.hz == pytest.approx(250, rel=0.035)
    assert abs(np.log(found.hz / 250)) < 1.5 * found.sigma < 0.08


@pytest.mark.gate
def test_leak_does_not_pass_for_a_slow_photoreceptor():
    """Chips at 100 RPM: it made the bandwidth 7 % too low in all of them."""
    errors = []
    for chip in (51, 52, 53, 54):
        camera = Camera.preset("nominal", seed=chip, size=(8, 8))
        recording, _ = camera.record(
            RotatingPolarizer(rpm=101.3, start_angle=0.6 * chip), 2.0)
        found = bandwidth_in_situ(recording, nominal=NOMINAL)
        errors.append(np.log(found.hz / 250))
        assert 0.02 < found.sigma < 0.06
    assert abs(np.mean(errors)) < 0.035
    assert np.std(errors) < 0.06


@pytest.mark.gate
def test_a_fan_s_steps_do_not_pass_for_a_bandwidth_that_follows_the_light():
    camera = Camera.preset("nominal", size=(8, 32), origin=(54, 156))
    recording, _ = camera.record(Fan(rpm=1013.0), 1.3)
    found = bandwidth_in_situ(recording, nominal=NOMINAL)
    assert found.hz == pytest.approx(250, rel=0.1)
    assert found.hz_per_intensity == 0


def test_a_bandwidth_in_proportion_to_the_light_is_told_apart():
    camera = Camera.preset("realistic", seed=3, size=(6, 6))
    recording, _ = camera.record(RotatingPolarizer(rpm=202.6), 2.0)
    found = bandwidth_in_situ(recording, nominal=NOMINAL)
    assert found.hz_per_intensity == pytest.approx(0.42 * 20, rel=0.1)
    assert found.hz < 10


@pytest.mark.gate
@pytest.mark.parametrize("chip", [101, 102, 201])
def test_one_pixel_unlike_the_others_does_not_decide_on_the_bandwidth(chip):
    """A chip whose thresholds scatter has some at a quarter of the nominal value."""
    camera = Camera.preset("hard", seed=chip, size=(12, 12))
    angle = np.random.default_rng(chip * 7 + 1000).uniform(0, np.pi)
    recording, _ = camera.record(RotatingPolarizer(rpm=1013.0, start_angle=angle), 2.0)
    found = thresholds_in_situ(recording, nominal=NOMINAL)
    assert found.bandwidth.hz < 1
    assert found.bandwidth.hz_per_intensity == pytest.approx(0.42 * 20, rel=0.1)
    covered = np.mean([np.abs(theta - camera.maps[name]) < sigma for theta, name, sigma
                       in zip((found.theta_on, found.theta_off),
                              ("theta_on", "theta_off"), found.sigma, strict=True)])
    assert 0.45 < covered < 0.85


@pytest.mark.gate
def test_the_bandwidth_s_uncertainty_is_as_large_as_its_error():
    relative, sigmas = [], []
    for chip, rpm in enumerate((60, 100, 200, 300, 500, 800)):
        camera = Camera.preset("nominal", seed=21 + chip, size=(6, 6))
        scene = RotatingPolarizer(rpm=rpm * 1.013, start_angle=0.5 * chip)
        found = bandwidth_in_situ(camera.record(scene, 2.0)[0], nominal=NOMINAL)
        there = found.hz + found.hz_per_intensity * found.at_intensity
        relative.append(np.log(there / 250) / found.sigma)
        sigmas.append(found.sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(relative))) < 1.4
    assert max(sigmas) < 0.3
    assert np.median(sigmas) < 0.12


def test_without_change_the_estimate_is_the_nominal_value(nominal):
    camera = nominal[0]
    recording, _ = camera.record(RotatingPolarizer(rpm=0.0), 1.5)
    estimate = thresholds_in_situ(recording, nominal=NOMINAL)
    assert np.abs(estimate.theta_on - 0.16).max() < 0.02
    prior = np.log(0.16 / 0.18) - np.log(
        camera.maps["theta_on"] / camera.maps["theta_off"])
    assert np.std(ratio_error(camera, estimate)) < 1.2 * np.std(prior)


@pytest.mark.parametrize(("preset", "scene", "rpm", "s0"), [
    ("nominal", RotatingPlate, 30.4, 30.0), ("nominal", RotatingPlate, 30.4, 4.3),
    ("realistic", RotatingPlate, 60.8, 30.0), ("hard", RotatingPlate, 60.8, 1.08),
    ("nominal", RotatingPolarizer, 30.4, 1.08),
    ("nominal", RotatingPolarizer, 60.8, 1.08),
    ("realistic", RotatingPolarizer, 30.4, 1.08)])
def test_where_little_is_told_thresholds_are_no_worse_than_nominal(
        preset, scene, rpm, s0):
    """Frames err alike in both halves of a recording; in dim light, by much."""
    camera = Camera.preset(preset, seed=1, size=(12, 12))
    light = scene(rpm=rpm, start_angle=np.radians(17), s0=s0)
    found = thresholds_in_situ(camera.record(light, 2.5)[0], nominal=NOMINAL)
    prior = np.log(NOMINAL[0] / NOMINAL[1]) - np.log(
        camera.maps["theta_on"] / camera.maps["theta_off"])
    assert np.std(ratio_error(camera, found)) < 1.1 * np.std(prior)
    for theta, name, at_first in zip((found.theta_on, found.theta_off),
                                     ("theta_on", "theta_off"), NOMINAL, strict=True):
        true = camera.maps[name]
        assert np.sqrt(np.mean((theta - true)**2)) < 1.1 * np.sqrt(
            np.mean((at_first - true)**2))


def test_a_window_of_the_recording_is_enough(nominal):
    camera, recording, _ = nominal
    late = thresholds_in_situ(
        recording, nominal=NOMINAL, start_us=1_000_000, stop_us=2_000_000)
    assert np.std(ratio_error(camera, late)) < 0.012


def test_too_little_gives_the_prior():
    recording = recording_from_arrays(None, sensor_size=(4, 4))
    estimate = thresholds_in_situ(recording, nominal=NOMINAL)
    assert estimate.bandwidth is None
    np.testing.assert_array_equal(estimate.theta_on, 0.16)
    assert bandwidth_in_situ(recording) is None


def errors(truth, images):
    return np.rad2deg(np.mean([np.abs(
        (image.aop - truth.aop(image.t_us) + np.pi / 2) % np.pi - np.pi / 2)
        for image in images]))


def test_fuse_learns_before_the_first_image(nominal):
    _, recording, truth = nominal
    options = dict(method="kalman", nominal_thresholds=NOMINAL, demosaic="superpixel",
                   times_us=np.arange(300_000, 2_400_000, 7_000))
    images = list(fuse(recording, thresholds="in-situ", **options))
    assert errors(truth, images) < 1.0
    learned = images[0].provenance["parameters"]
    assert learned["bandwidth"][0] == pytest.approx(250, rel=0.1)
    assert np.std(learned["theta_on"]) > 0.002
    lagging = list(fuse(recording, bandwidth=None, **options))
    assert errors(truth, lagging) > errors(truth, images) + 0.1


@pytest.mark.gate
def test_causal_images_do_not_know_the_future(nominal):
    _, recording, truth = nominal
    options = dict(method="kalman", nominal_thresholds=NOMINAL, causal=True,
                   thresholds="in-situ", demosaic="superpixel")
    times = np.arange(1_000_000, 1_500_000, 7_000)
    images = list(fuse(recording, times_us=times, **options))
    assert errors(truth, images) < 2.5
    parts = list(recording.packets(None, 1_500_000))
    short = recording_from_arrays(
        np.concatenate([part.events for part in parts]),
        [frame for part in parts for frame in part.frames], sensor_size=(8, 8),
        layout=recording.info.layout)
    for a, b in zip(images, fuse(short, times_us=times, **options), strict=False):
        np.testing.assert_array_equal(a.quad, b.quad)
    for a, b in zip(images, fuse(recording, bandwidth="in-situ", times_us=times,
                                 **options), strict=True):
        np.testing.assert_array_equal(a.quad, b.quad)


def test_impossible_parameters_are_refused(nominal):
    with pytest.raises(ValueError, match="sigma must be positive"):
        thresholds_in_situ(nominal[1], sigma=0)
    with pytest.raises(ValueError, match="bandwidth must be 'in-situ'"):
        thresholds_in_situ(nominal[1], bandwidth="fast")
    with pytest.raises(ValueError, match="bandwidth must be"):
        fuse(nominal[1], method="kalman", bandwidth="fast")


def test_frames_are_corrected_by_the_calibration_first(nominal):
    camera, recording, _ = nominal
    dark = np.full((8, 8), 100.0, np.float32)
    known = Calibration(sensor_size=(8, 8), dark=dark)
    for packet in recording.packets():
        for frame in packet.frames:
            np.add(frame.dn, dark, out=frame.dn)
    calibrated = thresholds_in_situ(recording, nominal=NOMINAL, calibration=known)
    for packet in recording.packets():
        for frame in packet.frames:
            np.subtract(frame.dn, dark, out=frame.dn)
    assert np.std(ratio_error(camera, calibrated)) < 0.006


@pytest.mark.parametrize(("hz", "low", "high"), [(0, 0, 0.5), (10, 4, 16)])
def test_noise_of_events_is_told_from_how_badly_frames_agree_with_them(
        nominal, hz, low, high):
    _, recording, _ = nominal
    true, shape = recording.events(), recording.info.sensor_size
    rng = np.random.default_rng(4)
    # Each of these moves the sum of a pixel's events by a threshold, for good.
    more = np.zeros(int(hz * 2.5 * shape[0] * shape[1]), true.dtype)
    more["t"] = rng.integers(0, 2_500_000, len(more))
    more["y"], more["x"] = rng.integers(0, shape[0], (2, len(more)))
    more["p"] = rng.integers(0, 2, len(more))
    events = np.concatenate([true, more])
    noisy = recording_from_arrays(
        events[np.argsort(events["t"], kind="stable")],
        [f for packet in recording.packets() for f in packet.frames],
        sensor_size=shape, layout=recording.info.layout)
    learned = in_force(noisy, nominal_thresholds=NOMINAL, bandwidth=(250, 0))
    assert low <= learned["noise"][1] <= high
    assert learned["bandwidth"][:2] == (250, 0)


def test_a_calibration_s_bandwidth_without_an_uncertainty_is_taken_as_it_is(nominal):
    known = Calibration(sensor_size=(8, 8), bandwidth_hz=240.0)
    usual = 0.03
    assert in_force(nominal[1], calibration=known)["bandwidth"] == (240.0, 0.0, usual)


@pytest.mark.gate
def test_a_calibration_s_bandwidth_with_an_uncertainty_is_learned_onwards(
        nominal, estimate):
    def used(recording=nominal[1], **options):
        known = Calibration(sensor_size=(8, 8), **options)
        return in_force(recording, calibration=known,
                        nominal_thresholds=NOMINAL)["bandwidth"]

    alone = used()
    hz, slope, sigma = used(bandwidth_hz=236.0, bandwidth_sigma=alone[2])
    assert hz == pytest.approx(np.sqrt(236 * alone[0]), rel=1e-6)
    assert slope == 0
    assert sigma == pytest.approx(alone[2] / np.sqrt(2))
    sure = used(bandwidth_hz=230.0, bandwidth_sigma=0.001)
    assert sure == pytest.approx((230, 0, 0.001), rel=0.01)
    # Of other biases: both cannot be right, and the recording is.
    assert used(bandwidth_hz=80.0, bandwidth_sigma=0.1) == alone
    still, _ = Camera.preset("nominal", seed=3, size=(8, 8)).record(
        RotatingPolarizer(rpm=0.0), 0.1)
    assert used(still, bandwidth_hz=200.0, bandwidth_sigma=0.1) == (200, 0, 0.1)


@pytest.mark.gate
def test_on_and_off_thresholds_of_a_calibration_err_together(nominal):
    """Of independent errors the scale would have 1 / sqrt(2) of the stated one."""
    thresholds = dict.fromkeys(("theta_on", "theta_off"), np.full((8, 8), 0.17))
    sigmas = {f"{name}_sigma": np.full((8, 8), 0.001) for name in thresholds}
    used = [in_force(nominal[1], calibration=Calibration(
        sensor_size=(8, 8), **thresholds, **more)) for more in ({}, sigmas)]
    assert used[0]["threshold_sigma"] == pytest.approx(0.0005)
    assert used[1]["threshold_sigma"] == pytest.approx(0.001 * np.sqrt(2), rel=1e-5)


@pytest.mark.gate
def test_a_bandwidth_from_a_slow_recording_does_not_mislead_a_fast_one():
    """Errors of AoP at 1000 RPM, by a calibration at 60 RPM and without."""
    camera = Camera.preset("nominal", seed=41, size=(8, 8))
    exact = camera.exact_calibration()
    slow, _ = camera.record(RotatingPolarizer(rpm=60.8), 4.0, run=2)
    fast, truth = camera.record(RotatingPolarizer(rpm=1013.0, start_angle=1.0), 2.0)
    told = bandwidth_in_situ(slow, nominal=NOMINAL, calibration=Calibration(**exact))
    assert told.sigma > 0.05
    stated = Calibration(**exact, bandwidth_hz=told.hz, bandwidth_sigma=told.sigma)
    degrees, covered = [], []
    for known in (stated, Calibration(**exact)):
        scorer = Scorer(truth, (4, 4))
        for image in fuse(fast, times_us=np.arange(1_000_000, 1_900_000, 5003),
                          calibration=known, demosaic="superpixel"):
            scorer.add(image)
        degrees.append(np.rad2deg(scorer.score.aop_error))
        covered.append(scorer.score.aop_coverage)
    assert degrees[0] < 1.05 * degrees[1]
    assert max(degrees) < 0.18
    assert min(covered) > 0.6


@pytest.mark.gate
def test_a_contradicted_scale_is_corrected_unless_thresholds_are_stated():
    camera = Camera.preset("realistic", seed=4, size=(8, 8))
    recording, _ = camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.8)

    def tuning(**options):
        options = FusionOptions(demosaic="superpixel", **options)
        learned = Learning(recording, options, {}, KalmanFilter.needs)
        return learned.beginning(recording, recording.packets())

    # .16/.18 in truth; twice that is contradicted, the truth is not.
    twice = tuning(nominal_thresholds=(0.32, 0.36))
    np.testing.assert_allclose(np.mean(twice.theta_on), NOMINAL[0], rtol=0.1)
    np.testing.assert_allclose(np.mean(twice.theta_off), NOMINAL[1], rtol=0.1)
    assert np.ptp(twice.theta_on) == 0      # the scale, not the pixels
    sigma = twice.parameters["threshold_sigma"]
    assert sigma.shape == (2, 8, 8)
    assert 0.035 * NOMINAL[0] < sigma.mean() < 0.1 * NOMINAL[1]
    right = tuning(nominal_thresholds=NOMINAL)
    np.testing.assert_allclose(right.theta_on, NOMINAL[0])
    # Thresholds that hold are known to the error of their scale and the pixels' spread.
    sigma = right.parameters["threshold_sigma"]
    assert sigma.shape == (2, 8, 8)
    assert 0.01 * NOMINAL[0] < sigma.mean() < 0.1 * NOMINAL[1]
    stated = tuning(thresholds="nominal", nominal_thresholds=(0.32, 0.36))
    assert stated.theta_on == pytest.approx(0.32)
    known = tuning(thresholds=(0.32, 0.36))
    assert known.theta_on == pytest.approx(0.32)
