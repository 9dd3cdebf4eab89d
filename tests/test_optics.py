"""What lies between scene and pixels: Mueller matrices, wave plates, circular light."""
import math

import numpy as np
import pytest

from pdavis_cv.simulation import (
    Behind,
    FlatLight,
    Flicker,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Sum,
    Truth,
    Waveplate,
)
from pdavis_cv.simulation.elements import quartz_birefringence
from pdavis_cv.simulation.mueller import (
    diattenuator,
    is_physical,
    retarder,
    rotated,
)

ANGLES = np.linspace(-2, 4, 13)


def linear(angle):
    return np.array([1, math.cos(2 * angle), math.sin(2 * angle), 0])


def test_a_full_diattenuator_obeys_malus():
    for axis in ANGLES:
        polarizer = diattenuator(1.0, axis)
        for angle in ANGLES:
            # Its mean transmission is 1: cos^2 is of light that passes all at best.
            assert (polarizer @ linear(angle))[0] / 2 == pytest.approx(
                math.cos(angle - axis) ** 2, abs=1e-12)


def test_retarders_keep_energy_and_degree_of_polarization():
    rng = np.random.default_rng(1)
    light = rng.normal(size=(50, 4))
    light[:, 0] = 1.5 * np.linalg.norm(light[:, 1:], axis=1)
    for delta in ANGLES:
        out = light @ retarder(delta, 0.3).T
        np.testing.assert_allclose(out[:, 0], light[:, 0], rtol=1e-14)
        np.testing.assert_allclose(np.linalg.norm(out[:, 1:], axis=1),
                                   np.linalg.norm(light[:, 1:], axis=1), rtol=1e-12)


def test_turning_an_element_and_back_is_nothing():
    one = retarder(0.7, 0.2) @ diattenuator(0.4, 1.1)
    for angle in ANGLES:
        np.testing.assert_allclose(rotated(rotated(one, angle), -angle), one,
                                   atol=1e-14)
        np.testing.assert_allclose(rotated(diattenuator(0.4, 1.1), angle),
                                   diattenuator(0.4, 1.1 + angle), atol=1e-14)
        # Element and light turned together: the same intensity.
        assert (rotated(one, angle) @ linear(0.5 + angle))[0] == pytest.approx(
            (one @ linear(0.5))[0], abs=1e-14)


def test_elements_are_physical_and_others_are_not():
    grid = np.meshgrid(np.linspace(0, 1, 7), ANGLES)
    assert is_physical(diattenuator(*grid) @ retarder(grid[1], grid[0]))
    assert not is_physical(np.diag([1, 1, 1, -1.0]))  # turns handedness only
    assert not is_physical(diattenuator(0.5) * [[1], [1.5], [1], [1]])
    assert is_physical(np.diag([1, 0, 0, 0]))         # an ideal depolarizer


def test_half_wave_plate_mirrors_the_angle_about_its_axis():
    plate = Waveplate(retardance=math.pi, axis=0.4).mueller()
    for angle in ANGLES:
        np.testing.assert_allclose(plate @ linear(angle), linear(2 * 0.4 - angle),
                                   atol=1e-12)


def test_two_quarter_wave_plates_are_a_half_wave_plate():
    quarter = Waveplate(axis=0.3).mueller()
    half = Waveplate(retardance=math.pi, axis=0.3).mueller()
    np.testing.assert_allclose(quarter @ quarter, half, atol=1e-14)


def test_quartz_has_its_birefringence():
    # Sodium's D line: n_e 1.5533, n_o 1.5442, of any table.
    assert quartz_birefringence(589.3) == pytest.approx(0.0091, abs=5e-5)


def test_a_wave_plate_is_chromatic_and_more_so_at_higher_order():
    at = {order: Waveplate(order=order).retardance_at(560)
          - Waveplate(order=order).retardance_at(550) for order in (0, 3)}
    assert at[0] < 0
    assert at[3] / at[0] == pytest.approx(13)  # (3 + 1/4) / (1/4) waves
    plate = Waveplate(achromatic=True)
    assert plate.retardance_at(450) == plate.retardance_at(650) == math.pi / 2


@pytest.mark.parametrize("scene", [
    RotatingPlate(rpm=60, polarizer=0.3, retardance=1.1),
    PolarizerBeforePlate(rpm=60, axis=0.3, retardance=2.1)])
def test_plates_of_scenes_lose_no_polarization(scene):
    truth = Truth(scene, (4, 4))
    t = np.linspace(0, 1e6, 40)
    parts = np.stack([*truth.stokes(t)[1:], truth.s3(t)])
    np.testing.assert_allclose(np.linalg.norm(parts, axis=0), truth.s0(t), rtol=1e-12)


def test_a_plate_behind_a_polarizer_is_the_scene_of_both():
    t = np.linspace(0, 1e6, 40)
    both = PolarizerBeforePlate(rpm=60, axis=0.3, retardance=2.1)
    parts = Behind(RotatingPolarizer(rpm=60),
                   Waveplate(retardance=2.1, axis=0.3).mueller())
    for one, other in zip(both.stokes(t, 0, 0), parts.stokes(t, 0, 0), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(both.s3(t, 0, 0), parts.s3(t, 0, 0), atol=1e-12)


def test_circular_light_adds_and_flickers():
    one = FlatLight(s0=4.0, docp=0.5)
    total = Flicker(Sum(one, RotatingPolarizer(rpm=60)), hz=100, depth=0.2)
    assert total.circular
    assert total.s3(0.0, 0, 0) == pytest.approx(1.2 * 2.0)
    assert not Sum(RotatingPolarizer(rpm=60), FlatLight(dolp=0.2)).circular
    assert RotatingPolarizer(rpm=60).s3(np.zeros(3), 0, 0).tolist() == [0, 0, 0]


def test_circular_light_behind_a_quarter_wave_plate_is_linear():
    scene = Behind(FlatLight(docp=1.0), Waveplate(axis=0.2).mueller())
    s0, s1, s2 = scene.stokes(0.0, 0, 0)
    assert math.hypot(s1, s2) == pytest.approx(s0)
    assert math.sin(math.atan2(s2, s1) - 2 * (0.2 + math.pi / 4)) == pytest.approx(
        0, abs=1e-12)  # at 45 degrees to the axis


@pytest.mark.parametrize(("make", "says"), [
    (lambda: FlatLight(dolp=0.8, docp=0.7), "docp"),
    (lambda: Waveplate(design_nm=0), "design_nm"),
    (lambda: Waveplate(order=-1), "order"),
    (lambda: Waveplate().retardance_at(3000), "wavelength_nm"),
    (lambda: Behind(FlatLight(), np.diag([1, 1, 1, -1.0])), "matrix")])
def test_impossible_ones_are_refused(make, says):
    with pytest.raises(ValueError, match=says):
        make()
