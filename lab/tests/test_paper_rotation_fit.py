import numpy as np
import pytest
from streams import random_events

import pdavis_cv
from lab.paper.rotation_fit import RotationFit, fit_rotation
from pdavis_cv import fuse
from pdavis_cv.analysis import axial_difference
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer


def simulated(rpm, *, seconds=3.0, camera="nominal", seed=3, **scene):
    return Camera.preset(camera, seed=seed).record(
        RotatingPolarizer(rpm=rpm, start_angle=1.0, **scene), seconds)


@pytest.mark.parametrize("rpm", [12, 60, -202.6, 600, 1013, -2222])
def test_speed_and_angle_return_from_a_file_that_does_not_know_them(rpm, tmp_path):
    """600 RPM is locked to the frame clock; at 2222 a frame sees 1.5 cycles."""
    recording, truth = simulated(rpm)
    path = tmp_path / "turning.aedat4"
    pdavis_cv.write_aedat4(path, recording)
    with pdavis_cv.open_recording(path) as read:
        fit = fit_rotation(read, extinction_ratio=40)
    assert abs(fit.rpm - rpm) < 4 * fit.rpm_sigma
    off = axial_difference(fit.aop(fit.origin_us), truth.aop(fit.origin_us))
    # The chip's own mean error: 0.7 degrees of angle in each of 144 pixels.
    assert abs(off) < 4 * np.hypot(fit.angle_sigma, np.deg2rad(0.7 / 12))
    assert fit.degree == pytest.approx(1, abs=0.01)


def test_the_standard_errors_are_those_of_the_frames_noise():
    recording, truth = simulated(202.6)
    fit = fit_rotation(recording, extinction_ratio=40)
    off = []
    for image in fuse(recording, method="frames", hold="mid", demosaic="superpixel"):
        s1, s2 = (plane.mean(dtype=np.float64) for plane in (image.s1, image.s2))
        off.append(axial_difference(np.arctan2(s2, s1) / 2, truth.aop(image.t_us)))
    noise, n = np.std(off), len(off)
    assert fit.frames == n
    assert fit.residual == pytest.approx(noise, rel=0.5)
    seconds = (n - 1) / 20
    rpm_sigma = noise * np.sqrt(12 / n) / seconds / (2 * np.pi) * 60
    assert fit.rpm_sigma == pytest.approx(rpm_sigma, rel=0.5)
    assert fit.angle_sigma == pytest.approx(noise / np.sqrt(n), rel=0.5)


def test_errors_of_the_speed_are_as_large_as_claimed():
    pulls = []
    for seed in range(12):
        fit = fit_rotation(simulated(60.8, seconds=1.5, seed=seed)[0])
        pulls.append((fit.rpm - 60.8) / fit.rpm_sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.8


def test_partly_polarized_light_has_its_degree_back_though_the_frames_are_blurred():
    fit = fit_rotation(simulated(500, dolp=0.4)[0], extinction_ratio=40)
    assert fit.degree == pytest.approx(0.4, abs=0.01)


def test_the_fit_is_light_whose_polarization_is_known():
    fit = RotationFit(60.0, 0.1, 0.5, 0.01, 1_000_000, 0.9, 0.01, 60)
    assert fit.aop(1_000_000) == pytest.approx(0.5)
    assert fit.aop(1_250_000) == pytest.approx((0.5 + np.pi / 2) % np.pi)
    x, y = np.zeros((2, 3)), np.ones((2, 3))
    assert fit.aop(0, x, y).shape == (2, 3)
    assert fit.dolp(0, x, y).tolist() == [[0.9] * 3] * 2


@pytest.mark.parametrize(("make", "message"), [
    (lambda: simulated(60, seconds=0.2)[0], "6 frames or more"),
    (lambda: simulated(1500)[0], "less or more than 20 ms"),
    (lambda: Camera.preset("nominal").record(FlatLight(dolp=0.5), 2.0)[0], "turns"),
    (lambda: pdavis_cv.recording_from_arrays(
        random_events(3000, (8, 8)), [pdavis_cv.ApsFrame(
            np.full((8, 8), 300, np.float32), t, t + 9000)
            for t in range(0, 900_000, 50_000)], sensor_size=(8, 8),
        layout=pdavis_cv.Layout.PDAVIS), "not polarized|no speed stands"),
    (lambda: simulated(60, s0=1e4)[0], "usable in the region, got 0 of .*saturated")])
def test_what_cannot_be_fitted_is_said(make, message):
    with pytest.raises(ValueError, match=message):
        fit_rotation(make())
