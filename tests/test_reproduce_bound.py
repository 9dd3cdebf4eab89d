"""Least errors: they follow from theory, and no method lies below them."""
import math

import numpy as np
import pytest

from pdavis_cv.simulation import FULL, Camera, FlatLight, Optics
from pdavis_cv.tools.reproduce import run as runs
from pdavis_cv.tools.reproduce.bound import frame_bound, optics_bound
from pdavis_cv.tools.reproduce.rotation import SCENES

RPM = 200.0
TURN_US = 60e6 / RPM
NOMINAL = Camera.preset("nominal")
TURNING, = SCENES["fig2"]
PLATE, BEFORE_PLATE = SCENES["fig3"]


def light(rotation, rpm=RPM):
    return rotation.light(rpm, math.radians(17))(FULL)


def test_errors_of_angles_alone_stay_as_they_are():
    # AoP is off by the mean of the angles' errors weighted by sin^2 2(psi - a) / 2; the
    # equation of the four shows differences of orthogonal ones, which are not in it.
    sigma, psi = math.radians(0.7), np.linspace(0, np.pi, 200, endpoint=False)
    optics = Optics(extinction_ratio=1e6, angle_sigma=sigma)
    expected = sigma * np.sqrt((np.cos(2 * psi)**4 + np.sin(2 * psi)**4) / 2).mean()
    assert optics_bound(optics, light(TURNING), TURN_US).aop_deg == pytest.approx(
        math.sqrt(2 / math.pi) * math.degrees(expected), rel=1e-4)
    assert optics_bound(Optics(), light(TURNING), TURN_US).aop_deg == 0


def test_gains_alone_can_be_learned_where_polarization_turns():
    optics = Optics(gain_sigma=0.02)
    turning = optics_bound(optics, light(TURNING), TURN_US)
    assert (turning.aop_deg, turning.dolp) == pytest.approx((0, 0), abs=1e-6)
    # On a line of S1 and S2, or at rest, they show in part only.
    on_line = optics_bound(optics, light(BEFORE_PLATE), TURN_US)
    still = optics_bound(optics, FlatLight(s0=FULL, dolp=1.0, aop=0.3), TURN_US)
    assert min(on_line.aop_deg, still.aop_deg) > 0.1


@pytest.mark.parametrize("rotation", [TURNING, PLATE, BEFORE_PLATE])
def test_the_best_estimate_from_exact_intensities_errs_by_the_bound(rotation):
    # Twin: specimens with drawn optics, exact intensities, and the posterior mean of
    # their optics by weighted least squares on what breaks n I = 0.
    scene, optics = light(rotation), NOMINAL.optics
    bound = optics_bound(optics, scene, TURN_US)
    times = np.arange(90) * TURN_US / 90
    stokes = np.array(scene.stokes(times, 0, 0))
    errors = []
    for seed in range(6):
        camera = Camera.preset("nominal", seed=seed, size=(12, 12))
        analyser = camera.maps["analyser"].reshape(6, 2, 6, 2, 3).transpose(
            0, 2, 1, 3, 4).reshape(36, 4, 3)
        errors += [posterior_error(each, optics, stokes) for each in analyser]
    per_pixel = np.mean(errors, 1)
    standard_error = per_pixel.std() / math.sqrt(len(per_pixel))
    assert per_pixel.mean() == pytest.approx(bound.aop_deg, abs=3 * standard_error)
    assert per_pixel.std() == pytest.approx(bound.aop_spread_deg, rel=0.25)


def posterior_error(analyser, optics, stokes):
    """Return |AoP error| in degrees where DoLP exceeds .2, for one super-pixel."""
    angles = 2 * np.deg2rad(np.array(optics.layout.angles_deg).reshape(-1))
    kappa = (optics.extinction_ratio - 1) / (optics.extinction_ratio + 1)

    def rows(p):
        gain, angle, contrast = p.reshape(3, 4)
        phase = angles + 2 * angle
        k = kappa + contrast
        return (1 + gain)[:, None] / 2 * np.stack(
            (np.ones(4), k * np.cos(phase), k * np.sin(phase)), -1)

    prior = np.repeat((optics.gain_sigma, optics.angle_sigma,
                       2 / (optics.extinction_ratio + 1)**2
                       * optics.extinction_ratio_sigma), 4)
    null = np.linalg.svd(rows(np.zeros(12)).T)[2][3]
    step = 1e-5
    # How n . I changes by each parameter, over a turn: data are exact, so their noise
    # is a millionth.
    design = np.array([null @ (rows(step * one) - rows(0 * one)) @ stokes / step
                       for one in np.eye(12)]).T * prior
    seen = null @ (analyser - rows(np.zeros(12))) @ stokes
    found = prior * np.linalg.solve(
        design.T @ design + 1e-8 * np.eye(12), design.T @ seen)
    estimate = np.linalg.pinv(rows(found)) @ analyser @ stokes
    aop, true = (np.arctan2(s[2], s[1]) / 2 for s in (estimate, stokes))
    off = np.abs((aop - true + np.pi / 2) % np.pi - np.pi / 2)
    return np.rad2deg(off[np.hypot(stokes[1], stokes[2]) > 0.2 * stokes[0]])


def test_a_frames_noise_is_that_of_frames():
    # Simulated frames of a camera of which all is nominal, at rest.
    aop = 0.4
    scene = FlatLight(s0=FULL, dolp=0.8, aop=aop)
    camera = Camera.preset("nominal", size=(32, 32), optics=Optics(), aps={
        "offset_fpn_dn": 0.0, "dark_dn_s": 0.0, "fps": 40.0, "readout_us": 4000},
        dvs=None)
    recording, _ = camera.record(scene, 0.25)
    bound = frame_bound(camera, scene, TURN_US)
    k = 39 / 41
    errors = []
    for frame in (f for packet in recording.packets() for f in packet.frames):
        dn = frame.dn.astype(float)
        angles = np.array(camera.layout.angles_deg)
        by = {a: dn[y::2, x::2] for y in (0, 1) for x in (0, 1)
              for a in [angles[y, x]]}
        s1, s2 = (by[0] - by[90]) / k, (by[45] - by[135]) / k
        s0 = sum(by.values()) / 2
        errors.append((np.arctan2(s2, s1) / 2 - aop, np.hypot(s1, s2) / s0 - 0.8))
    aop_error, dolp_error = np.abs(np.array(errors)).mean((0, 2, 3))
    assert math.degrees(aop_error) == pytest.approx(bound.aop_deg, rel=0.04)
    assert dolp_error == pytest.approx(bound.dolp, rel=0.04)


def test_blur_costs_what_the_sinc_says():
    exposure = NOMINAL.aps.exposure_us
    still, fast = (frame_bound(NOMINAL, light(TURNING, rpm), 60e6 / rpm).aop_deg
                   for rpm in (1.0, 1000.0))
    turned = 2 * math.pi * 1000 / 60e6 * exposure      # of AoP, in radians
    # The noise stays nearly the same (photons shift between channels).
    assert fast / still == pytest.approx(turned / math.sin(turned), rel=0.05)


@pytest.mark.gate
@pytest.mark.parametrize("rotation", [TURNING, PLATE])
def test_no_method_beats_it_by_more_than_its_standard_error(rotation):
    case = runs.Case(scene=rotation.name, rpm=RPM, light=rotation.light(
        RPM * runs.OFF_LOCK, math.radians(17)), seconds=1.6, size=(16, 16))
    settings = runs.Settings(step_us=5077, methods=(
        "frames, own times", "Sony 50 fps, own times", "kalman offline"))
    scene = light(rotation)
    takes = runs.Takes(case)
    for row in runs.run(case, settings, takes):
        camera = case.specimen(runs.METHODS[row.method])
        bound = optics_bound(camera.optics, scene, TURN_US)
        assert row.aop_error_deg > bound.aop_deg - bound.aop_error_deg(64), row.method
        assert row.dolp_error > bound.dolp - bound.dolp_spread / 8, row.method
