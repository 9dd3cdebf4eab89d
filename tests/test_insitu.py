"""The camera as a recording shows it, and thresholds in situ for other methods."""
import numpy as np
import pytest
from truth_errors import errors_of

from pdavis_cv import Calibration, fuse, recording_from_arrays
from pdavis_cv.fusion.learning import learned_camera
from pdavis_cv.simulation import Camera, RotatingPlate, RotatingPolarizer

pytestmark = pytest.mark.accuracy

NOMINAL = (0.16, 0.18)


@pytest.fixture(scope="module")
def nominal():
    camera = Camera.preset("nominal", seed=3, size=(8, 8))
    scene = RotatingPolarizer(rpm=200 * 1.013, start_angle=1.0)
    recording, truth = camera.record(scene, 2.5)
    return camera, recording, truth


@pytest.fixture(scope="module")
def found(nominal):
    return camera_of(nominal[1])


class camera_of:
    """Thresholds of the pixels as learned, and their errors."""

    def __init__(self, recording, **options):
        self.parts, self.ratio_sigma = learned_camera(
            recording, nominal=NOMINAL, **options)
        self.thetas, self.sigma = (np.stack([
            self.parts[f"theta_{name}{what}"] for name in ("on", "off")])
            for what in ("", "_sigma"))


def true_ratio(camera):
    return np.log(camera.maps["theta_on"] / camera.maps["theta_off"])


def ratio_error(camera, found):
    return np.log(found.thetas[0] / found.thetas[1]) - true_ratio(camera)


def test_the_ratio_of_each_pixel_s_thresholds_is_found(nominal, found):
    error = ratio_error(nominal[0], found)
    assert np.std(error) < 0.3 * np.std(true_ratio(nominal[0]))
    assert np.abs(np.mean(error)) < 0.02
    assert found.sigma.shape == (2, 8, 8)
    assert np.all(found.ratio_sigma < found.sigma.sum(0) / found.thetas.min())


@pytest.mark.gate
def test_one_sigma_covers_at_least_two_thirds_of_the_errors_of_thresholds():
    """Over chips, speeds and start angles: a part is the same in a whole chip."""
    covered = []
    for chip, rpm in enumerate((30, 60, 200, 60, 200, 400), 11):
        camera = Camera.preset("nominal", seed=chip, size=(8, 8))
        scene = RotatingPolarizer(rpm=rpm * 1.013, start_angle=0.5 * chip)
        found = camera_of(camera.record(scene, 2.0)[0])
        errors = (ratio_error(camera, found),
                  found.thetas[0] - camera.maps["theta_on"],
                  found.thetas[1] - camera.maps["theta_off"])
        covered.append([np.mean(np.abs(error) < sigma) for error, sigma in zip(
            errors, (found.ratio_sigma, *found.sigma), strict=True)])
    assert np.all(np.mean(covered, 0) > 0.6)


def test_without_change_the_estimate_is_the_nominal_value(nominal):
    camera = nominal[0]
    recording, _ = camera.record(RotatingPolarizer(rpm=0.0), 1.5)
    found = camera_of(recording)
    assert np.abs(found.thetas[0] / 0.16 - 1).max() < 1e-6
    assert np.all(found.sigma[0] > 0.05)


@pytest.mark.gate
@pytest.mark.parametrize(("preset", "scene", "rpm", "s0"), [
    ("nominal", RotatingPlate, 30.4, 30.0), ("realistic", RotatingPlate, 60.8, 30.0),
    ("hard", RotatingPlate, 60.8, 1.08), ("nominal", RotatingPolarizer, 30.4, 1.08)])
def test_where_little_is_told_thresholds_are_no_worse_than_nominal(
        preset, scene, rpm, s0):
    camera = Camera.preset(preset, seed=1, size=(12, 12))
    light = scene(rpm=rpm, start_angle=np.radians(17), s0=s0)
    found = camera_of(camera.record(light, 2.5)[0])
    assert np.std(ratio_error(camera, found)) < 1.1 * np.std(true_ratio(camera))


def test_too_little_gives_the_prior():
    recording = recording_from_arrays(None, sensor_size=(4, 4))
    found = camera_of(recording)
    assert "learned" not in found.parts
    np.testing.assert_allclose(found.thetas[0], 0.16)
    np.testing.assert_allclose(found.thetas[1], 0.18)
    assert np.all(found.sigma / found.thetas > 0.5)     # stated by nobody


@pytest.mark.gate
def test_frames_are_corrected_by_the_calibration_first(nominal):
    camera, recording, _ = nominal
    known = Calibration(sensor_size=(8, 8), dark=camera.maps["dark_dn"] + 30)
    other = camera_of(recording, calibration=known)
    plain = camera_of(recording)
    assert not np.allclose(other.thetas, plain.thetas, rtol=0.01)


def test_cf_takes_the_thresholds_of_each_pixel(nominal):
    camera, recording, truth = nominal

    def score(**options):
        return errors_of(fuse(
            recording, method="cf", demosaic="superpixel", cutoff_hz=0.2,
            times_us=np.arange(1_000_000, 2_400_000, 7_000),
            nominal_thresholds=(0.1, 0.1), **options), truth).aop

    known = score(thresholds=(camera.maps["theta_on"], camera.maps["theta_off"]))
    assert score(thresholds="in-situ") < 1.3 * known
    assert score(thresholds="in-situ") < 0.7 * score()


def test_kalman_corrects_thresholds_that_are_stated_wrong(nominal):
    _, recording, _ = nominal
    image = next(fuse(recording, method="kalman", nominal_thresholds=(0.08, 0.09)))
    off, on = image.provenance["parameters"]["model"].thresholds
    assert on == pytest.approx(0.16, rel=0.1)
    assert off == pytest.approx(0.18, rel=0.1)
    # Those that were measured are moved by a few of their 5 % at most.
    image = next(fuse(recording, method="kalman", thresholds=(0.12, 0.13)))
    off, on = image.provenance["parameters"]["model"].thresholds
    assert 0.12 < on < 0.16


@pytest.mark.gate
@pytest.mark.parametrize("options", [{"method": "kalman"}, {
    "method": "cf", "thresholds": "in-situ"}], ids=lambda one: one["method"])
def test_causal_images_do_not_know_the_future(nominal, options):
    _, recording, _ = nominal
    options = {**options, "nominal_thresholds": NOMINAL, "causal": True,
               "demosaic": "superpixel"}
    times = np.arange(300_000, 700_000, 17_000)
    images = list(fuse(recording, times_us=times, **options))
    parts = list(recording.packets(None, 700_000))
    short = recording_from_arrays(
        np.concatenate([part.events for part in parts]),
        [frame for part in parts for frame in part.frames], sensor_size=(8, 8),
        layout=recording.info.layout)
    for a, b in zip(images, fuse(short, times_us=times, **options), strict=False):
        np.testing.assert_array_equal(a.quad, b.quad)
