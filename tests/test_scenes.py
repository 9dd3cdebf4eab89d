"""Scenes against Mueller calculus, and the camera's sampling of them."""
import math

import numpy as np
import pytest

from pdavis_cv.simulation import (
    Camera,
    Fan,
    FlatLight,
    FunctionScene,
    IrradianceSweep,
    MalusSweep,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Tendon,
    Texture,
    Truth,
)


def drain(recording):
    packets = list(recording.packets())
    frames = [frame for packet in packets for frame in packet.frames]
    return np.concatenate([packet.events for packet in packets]), frames


def rotation(angle):
    c, s = math.cos(2 * angle), math.sin(2 * angle)
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1.0]])


def element(kind, angle, retardance=0.0):
    """Mueller matrix of a polarizer or a retarder with its axis at an angle."""
    c, s = math.cos(retardance), math.sin(retardance)
    matrix = {
        "polarizer": np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0] * 4, [0] * 4]) / 2,
        "retarder": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]),
    }[kind]
    return rotation(-angle) @ matrix @ rotation(angle)


@pytest.mark.parametrize("retardance", [math.pi / 2, 1.1])
@pytest.mark.parametrize("geometry", [PolarizerBeforePlate, RotatingPlate])
def test_plate_scenes_equal_mueller_calculus(geometry, retardance):
    fixed, start, rpm = 0.4, 0.2, 90.0
    name = "axis" if geometry is PolarizerBeforePlate else "polarizer"
    scene = geometry(
        rpm=rpm, start_angle=start, retardance=retardance, s0=7.0, **{name: fixed})
    for t in (0, 12_345, 400_000):
        turned = start + 2 * math.pi * rpm / 60 * t / 1e6
        polarizer, axis = (
            (turned, fixed) if geometry is PolarizerBeforePlate else (fixed, turned))
        light = (element("retarder", axis, retardance)
                 @ element("polarizer", polarizer) @ [14.0, 0, 0, 0])
        np.testing.assert_allclose(scene.stokes(t), light[:3], atol=1e-12)


def test_tendon_equals_mueller_calculus_of_circular_light():
    scene = Tendon(hz=2.0)
    t, x, y = 170_000, 200.0, 100.0
    s0, s1, s2 = (float(s) for s in scene.stokes(t, x, y))
    dolp, aop = math.hypot(s1, s2) / s0, math.atan2(s2, s1) / 2
    # Fibre axis 45 degrees from the AoP, retardance asin(DoLP).
    light = element("retarder", aop - math.pi / 4, math.asin(dolp)) @ [s0, 0, 0, s0]
    assert 0.1 < dolp < 0.9
    np.testing.assert_allclose(light[:3], [s0, s1, s2], rtol=1e-9)
    strain = scene.strain(np.linspace(0, 500_000, 101))
    assert strain.min() == pytest.approx(0.02)
    assert strain.max() == pytest.approx(0.03)


def test_plate_geometries_differ_as_the_paper_says():
    # Haessig, figure 3: fixed plate: AoP is a square wave; turning plate: both cycle.
    t = np.arange(0, 1_000_000, 500)
    for scene in (PolarizerBeforePlate(rpm=60), RotatingPlate(rpm=60)):
        truth = Truth(scene, (2, 2))
        dolp, aop = truth.dolp(t), np.mod(truth.aop(t), np.pi)
        minima = np.count_nonzero((dolp[1:-1] < dolp[2:]) & (dolp[1:-1] <= dolp[:-2]))
        assert minima == 4
        values = len(np.unique(np.rint(np.rad2deg(aop)[dolp > 0.01]) % 180))
        if isinstance(scene, PolarizerBeforePlate):
            assert values == 2
        else:
            assert values > 90


def test_fan_sector_shows_its_polarizer_turned_with_the_wheel():
    scene = Fan(rpm=60.0, start_angle=0.1)
    for t in (0, 50_000):
        turned = 0.1 + 2 * math.pi * t / 1e6
        for k in range(6):
            where = turned + (k + 0.5) * math.pi / 3
            x = scene.centre[0] + 80 * math.cos(where)
            y = scene.centre[1] - 80 * math.sin(where)
            s0, s1, s2 = scene.stokes(t, x, y)
            aop = math.atan2(s2, s1) / 2
            want = turned + k * math.pi / 6
            assert math.cos(2 * (aop - want)) == pytest.approx(1, abs=1e-12)
            assert math.hypot(s1, s2) == pytest.approx(s0)
            assert s0 == pytest.approx(scene.s0 * (2000 if x < scene.centre[0] else 1))
    assert scene.lit(scene.centre[0], scene.centre[1] + 60)
    assert not scene.lit(*scene.centre)


def test_fan_between_its_sectors_is_their_smooth_mixture():
    scene = Fan(rpm=-200.0, start_angle=7.0, edge=5.0)
    rng = np.random.default_rng(0)
    t, r, where = rng.uniform((0, 30, 0), (1e6, 110, 2 * np.pi), (2000, 3)).T
    s0, s1, s2 = scene.stokes(t, scene.centre[0] + r * np.cos(where),
                              scene.centre[1] - r * np.sin(where))
    turned = 7.0 - 2 * np.pi * 200 / 60e6 * t
    place = (where - turned) * 3 / np.pi
    u = (place - np.rint(place)) * r * np.pi / 3 / 5.0
    weight = np.where(u < 0, 0.0, 1.0)
    inside = abs(u) < 0.5
    v = u[inside] + 0.5
    weight[inside] = 6 * v**5 - 15 * v**4 + 10 * v**3
    before, after = (np.exp(1j * (2 * turned + np.pi / 3 * (np.rint(place) + k)))
                     for k in (-1, 0))
    assert 50 < np.count_nonzero(inside) < 1000
    np.testing.assert_allclose(s1 + 1j * s2, s0 * (before + weight * (after - before)),
                               rtol=1e-9, atol=1e-9 * scene.s0 * 2000)


@pytest.mark.parametrize("scene", [
    Fan(rpm=203.0, centre=(9.0, 6.0), radius=11.0, hub=2.0), Texture(seed=3),
    Texture(seed=3) + Fan(rpm=-1000.0, centre=(9.0, 6.0), radius=11.0, hub=2.0)])
def test_light_on_a_grid_is_the_light_at_each_of_its_places(scene):
    t, y, x = np.meshgrid(np.arange(0, 40_000, 3_000.0), np.arange(14), np.arange(19),
                          indexing="ij")
    one_by_one = np.stack(scene.stokes(t.ravel(), x.ravel(), y.ravel()))
    grid = np.stack(scene.stokes(t[:, :1, :1], x[0, :1], y[0, :, :1]))
    still = np.stack(scene.stokes(t[3, 0, 0], x[0, :1], y[0, :, :1]))
    close = {"rtol": 1e-10, "atol": 1e-10 * one_by_one[0].max()}
    np.testing.assert_allclose(grid.reshape(3, -1), one_by_one, **close)
    np.testing.assert_allclose(still, grid[:, 3], **close)


def test_malus_sweep_holds_and_moves_smoothly():
    scene = MalusSweep(step=math.radians(5), hold_us=100_000, move_us=10_000)
    truth = Truth(scene, (2, 2))
    degrees = np.rad2deg(truth.aop(np.array([50_000, 115_000, 190_000, 250_000])))
    np.testing.assert_allclose(degrees, [0, 5, 5, 10], atol=1e-9)


def test_irradiance_sweep_covers_six_decades_in_equal_ratios():
    scene = IrradianceSweep(levels=7, hold_us=1_000_000)
    held = scene.irradiance(np.arange(7) * 1_000_000 + 900_000)
    np.testing.assert_allclose(held[[0, -1]], [0.04, 42_000])
    np.testing.assert_allclose(held[1:] / held[:-1], (42_000 / 0.04) ** (1 / 6))


def test_background_and_flicker_add_as_light_does():
    scene, back = RotatingPolarizer(rpm=60.0), FlatLight(s0=10.0, dolp=0.3, aop=0.5)
    t = np.arange(0, 20_000, 700)
    both = (scene + back).flicker(50.0, depth=0.4)
    lamp = 1 + 0.4 * np.cos(2 * np.pi * 100e-6 * t)
    for got, a, b in zip(both.stokes(t, 0, 0), scene.stokes(t), back.stokes(t),
                         strict=True):
        np.testing.assert_allclose(got, (a + b) * lamp)
    assert both.uniform
    assert both.step_us == pytest.approx(0.04 / (2 * math.pi * 100e-6))


def test_texture_is_light_and_moves_as_a_whole():
    scene = Texture(velocity=(100.0, -40.0))
    x, y = np.meshgrid(np.arange(200.0), np.arange(150.0))
    s0, s1, s2 = scene.stokes(0, x, y)
    dolp = np.hypot(s1, s2) / s0
    assert 0.05 < dolp.min() < 0.3
    assert 0.7 < dolp.max() < 0.95
    assert np.std(np.log(s0)) == pytest.approx(0.5, rel=0.4)
    later = scene.stokes(100_000, x + 10, y - 4)
    np.testing.assert_allclose(later, (s0, s1, s2))


SMOOTH = [
    ("ideal", RotatingPolarizer(rpm=1013.0)),
    ("nominal", RotatingPolarizer(rpm=1013.0)),
    ("nominal", RotatingPolarizer(rpm=30.39)),
    ("realistic", RotatingPolarizer(rpm=1013.0)),
    ("realistic", RotatingPlate(rpm=506.5, start_angle=0.1)),
    ("nominal", PolarizerBeforePlate(rpm=506.5, axis=0.3)),
    ("ideal", RotatingPolarizer(rpm=300.0).flicker(60.0)),
    ("realistic", Fan(rpm=200.0, centre=(172.0, 180.0))),
    ("nominal", Tendon(hz=10.0)),
    ("realistic", Texture()),
]


@pytest.mark.parametrize(("preset", "scene"), SMOOTH)
def test_halving_the_step_moves_no_noise_free_event(preset, scene):
    quiet = {"dvs": {"shot_noise_hz": 0.0, "burst_chance": 0.0}, "bus": None}
    quiet = quiet if preset != "ideal" else {}
    camera = Camera.preset(preset, size=(6, 6), **quiet)
    step = min(scene.step_us, 10_000)
    (whole, _), (halved, _) = (
        drain(camera.record(scene, 0.3, step_us=step / n)[0]) for n in (1, 2))
    assert len(whole) > 50
    assert len(whole) == len(halved)
    whole, halved = (e[np.lexsort((e["t"], e["x"], e["y"]))] for e in (whole, halved))
    np.testing.assert_array_equal(whole["p"], halved["p"])
    assert np.max(np.abs(whole["t"] - halved["t"])) <= 1


def test_users_function_equals_the_scene_that_it_copies():
    scene = RotatingPolarizer(rpm=300.0)
    camera = Camera.preset("nominal", size=(4, 4))
    for uniform in (False, True):
        own = FunctionScene(scene.stokes, sampling_us=scene.step_us, uniform=uniform)
        (a, f), (b, g) = (drain(camera.record(s, 0.1)[0]) for s in (scene, own))
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(f[0].reset, g[0].reset)


@pytest.mark.parametrize(("make", "name"), [
    (lambda: RotatingPolarizer(rpm=1, dolp=1.2), "dolp"),
    (lambda: RotatingPlate(rpm=1, s0=-1), "s0"),
    (lambda: Fan(rpm=1, hub=200.0), "radius"),
    (lambda: Tendon(strain_high=0.01), "strain_high"),
    (lambda: Texture(dolp=0.9), "dolp"),
    (lambda: MalusSweep(move_us=300_000), "move_us"),
    (lambda: IrradianceSweep(low_uw_cm2=0.0), "low_uw_cm2"),
    (lambda: FlatLight(dolp=-0.1), "dolp"),
    (lambda: FlatLight().flicker(50.0, depth=2.0), "depth")])
def test_impossible_scenes_are_refused_by_name(make, name):
    with pytest.raises(ValueError, match=f"^{name} must"):
        make()
