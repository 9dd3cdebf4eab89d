"""Least errors: they follow from theory, and no method lies below them."""
import math

import numpy as np
import pytest

from lab.paper import run as runs
from lab.paper.bound import Bound, Limits, frame_bound, held_errors, optics_bound
from lab.paper.rotation import SCENES, Comparison
from lab.paper.rotation_page import below_bound
from pdavis_cv.simulation import FULL, Camera, FlatLight, Optics

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


def test_held_frames_err_by_delay_and_blur():
    # A frame is shown from 22 to 72 ms after its middle: AoP turns by 47 ms' worth on
    # average, and an exposure takes sinc of what AoP turns by in it off DoLP.
    slow, fast = (held_errors(NOMINAL, light(TURNING, rpm), 60e6 / rpm)
                  for rpm in (10.0, 200.0))
    assert slow[0] == pytest.approx(360 * 10 / 60 * 0.047, rel=1e-3)
    blur = 2 * math.pi * 200 / 60 * 0.02
    assert fast[1] == pytest.approx(1 - math.sin(blur) / blur, rel=1e-3)
    # Behind a plate DoLP is |cos|; a blur that is whole leaves a half of it: its mean
    # distance from that is (2 / pi) (sqrt(3) - 1 - pi / 12).
    long = Camera.preset("nominal", aps={"fps": 1.0, "exposure_us": 1_000_000})
    whole = held_errors(long, light(PLATE, 1000 * runs.OFF_LOCK), 60e3 / runs.OFF_LOCK)
    assert whole[1] == pytest.approx(
        2 / math.pi * (math.sqrt(3) - 1 - math.pi / 12), abs=0.01)
    with pytest.raises(ValueError, match="must have frames"):
        held_errors(Camera.preset("nominal", aps=None), light(TURNING), TURN_US)


@pytest.mark.gate
@pytest.mark.parametrize("rotation", [TURNING, PLATE, BEFORE_PLATE])
@pytest.mark.parametrize("rpm", [60.0, 1000.0])
def test_simulated_frames_err_as_theory_says(rotation, rpm):
    case = runs.Case(scene=rotation.name, rpm=rpm, light=rotation.light(
        rpm * runs.OFF_LOCK, math.radians(17)), seconds=3.0)
    settings = runs.Settings(
        step_us=5077, methods=("frames", "Sony 50 fps", "Sony 75 fps"))
    found = list(runs.run(case, settings, runs.Takes(case)))
    assert len(found) == 3
    for row in found:
        method = runs.METHODS[row.method]
        s0 = case.sony_dn_per_ms if method.preset else case.event_dn_per_ms
        aop, dolp = held_errors(case.specimen(method), case.light(s0), case.turn_us)
        if rotation is not BEFORE_PLATE:    # there AoP is one of two, at times few
            assert row.aop_error_roi_deg == pytest.approx(aop, rel=0.06, abs=0.3), row
        assert row.dolp_error_roi == pytest.approx(dolp, rel=0.04, abs=0.008), row


def test_a_regions_mean_errs_by_the_root_of_its_super_pixels_less():
    one = optics_bound(NOMINAL.optics, light(TURNING), TURN_US)
    region = one.of_region(36)
    assert (region.aop_deg, region.dolp) == (one.aop_deg / 6, one.dolp / 6)
    # Twin: the mean light of super-pixels whose optics the posterior is drawn of.
    scene = light(TURNING)
    stokes = np.array(scene.stokes(np.arange(60) * TURN_US / 60, 0, 0))
    errors = []
    for seed in range(40):
        camera = Camera.preset("nominal", seed=seed, size=(12, 12), optics={
            "gain_sigma": 0.0, "extinction_ratio_sigma": 0.0})
        analyser = camera.maps["analyser"].reshape(6, 2, 6, 2, 3).transpose(
            0, 2, 1, 3, 4).reshape(36, 4, 3)
        nominal = Camera.preset("nominal", size=(2, 2), optics=Optics()).maps[
            "analyser"].reshape(4, 3)
        mean = (np.linalg.pinv(nominal) @ (analyser @ stokes)).mean(0)
        off = (np.arctan2(mean[2], mean[1]) - np.arctan2(stokes[2], stokes[1])) / 2
        errors.append(np.rad2deg(np.abs((off + np.pi / 2) % np.pi - np.pi / 2)).mean())
    angles = Optics(angle_sigma=NOMINAL.optics.angle_sigma, extinction_ratio=40.0)
    expected = optics_bound(angles, scene, TURN_US).of_region(36)
    assert np.mean(errors) == pytest.approx(
        expected.aop_deg, abs=3 * expected.aop_spread_deg / math.sqrt(40))


def test_what_lies_below_the_bound_by_more_than_its_error_is_named():
    bound = Bound(0.4, 0.01, 0.6, 0.006)        # of 36 super-pixels .1 and .001
    limits = [Limits("event camera", RPM, bound, bound, (1.0, 0.1), 1.0, 36),
              Limits("Sony 50 fps", RPM, Bound(0.1, 0.002, 0.06, 0.0006), bound,
                     (1.0, 0.1), 1.0, 36)]
    numbers = {name: math.nan for name in runs.Row.__dataclass_fields__}

    def row(method, aop, dolp):
        return runs.Row(**{**numbers, "scene": "", "region": "", "camera": "",
                           "seed": 1, "start_deg": 0.0, "rpm": RPM, "method": method,
                           "aop_error_deg": aop, "dolp_error": dolp})

    good = [row("kalman", 0.31, 0.0091), row("joint", 0.5, 0.02),
            row("Sony 50 fps, own times", 0.2, 0.003)]
    assert below_bound(Comparison(TURNING, good, limits=limits)) == []
    bad = [*good, row("cf", 0.29, 0.02), row("Sony 50 fps", 0.2, 0.0015)]
    cf, sony = below_bound(Comparison(TURNING, bad, limits=limits))
    assert cf.startswith("cf, 200 RPM, aop_error_deg")
    assert sony.startswith("Sony 50 fps, 200 RPM, dolp_error")
