"""What lies between scene and pixels: Mueller matrices, wave plates, circular light."""
import math

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.simulation import (
    LENSES,
    Behind,
    Camera,
    FlatLight,
    Flicker,
    FunctionScene,
    Lens,
    Optics,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Sum,
    Truth,
    VideoScene,
    Waveplate,
)
from pdavis_cv.simulation.crosstalk import kernel
from pdavis_cv.simulation.elements import quartz_birefringence
from pdavis_cv.simulation.mueller import (
    diattenuator,
    is_physical,
    retarder,
    rotated,
)
from pdavis_cv.tools import simulate

FULL = (260, 346)
WHOLE = 0, FULL, (0, 0), FULL
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


def places(n=60):
    rng = np.random.default_rng(2)
    radius, around = np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return radius * np.cos(around), radius * np.sin(around), np.pi * rng.random(n)


def rays_response(lens, x, y, angle, ratio):
    """Of collimated light on a polarizer: absorber and ray as vectors in space."""
    radial = math.atan2(y, x)
    incidence = math.atan(math.hypot(x, y) * math.tan(lens.chief_ray))
    # Unfolded: at the lens's other side the ray's own axes are radial and across.
    k = np.array([math.sin(incidence), 0, math.cos(incidence)])
    p, s = np.array([math.cos(incidence), 0, -math.sin(incidence)]), np.array([0, 1, 0])
    absorber = np.array([-math.sin(angle - radial), math.cos(angle - radial), 0])
    passes = np.cross(absorber, k)
    seen = math.atan2(passes @ s, passes @ p) + radial
    kappa = (ratio - 1) / (ratio + 1)
    return np.array([1, kappa * math.cos(2 * seen), kappa * math.sin(2 * seen), 0]) / 2


def test_no_lens_is_malus():
    x, y, angle = places()
    seen = Lens().seen(angle, np.full(angle.shape, 40.0), x, y)
    for a, row in zip(angle, seen, strict=True):
        np.testing.assert_allclose(
            row, [.5, 39 / 82 * math.cos(2 * a), 39 / 82 * math.sin(2 * a), 0],
            atol=1e-14)


def test_a_tilted_polarizer_is_the_one_of_vectors():
    lens = Lens(chief_ray=math.radians(25))
    x, y, angle = places()
    seen = lens.seen(angle, np.full(angle.shape, 40.0), x, y)
    for row, *place in zip(seen, x, y, angle, strict=True):
        np.testing.assert_allclose(row, rays_response(lens, *place, 40.0), atol=1e-13)


def test_small_tilts_turn_the_analyser_by_a_quarter_of_their_square():
    lens = Lens(chief_ray=0.1)
    angle = np.linspace(0, np.pi, 9)
    seen = lens.seen(angle, np.full(9, 40.0), np.array(1.0), np.array(0.0))
    turned = np.arctan2(seen[:, 2], seen[:, 1]) / 2 - angle
    np.testing.assert_allclose(
        np.arctan(np.tan(turned)), -0.1**2 / 4 * np.sin(2 * angle), atol=2e-5)


def test_extinction_ratio_falls_with_the_angle_and_the_cone():
    def ratio(lens, x):
        row = lens.seen(
            np.array([0.3]), np.array([40.0]), np.array([x]), np.zeros(1))[0]
        contrast = math.hypot(row[1], row[2]) / row[0]
        return (1 + contrast) / (1 - contrast)

    half = math.radians(20)
    assert ratio(Lens(chief_ray=half, half_ratio=half), 1.0) == pytest.approx(20)
    assert ratio(Lens(chief_ray=half, half_ratio=half), 0.0) == pytest.approx(40)
    found = [ratio(Lens(f_number=n, half_ratio=half), 0.0) for n in (1.4, 2.8, 8, 1e3)]
    assert found == sorted(found)
    assert found[-1] == pytest.approx(40, rel=1e-4)
    # The leak is that of the mean square angle, half of the cone's.
    leak = 1 + math.asin(1 / 5.6)**2 / 2 / half**2
    assert found[1] == pytest.approx(40 / leak, rel=0.02)


def test_the_lens_loses_no_light_and_no_response_is_impossible():
    x, y, angle = places()
    ratio = np.full(angle.shape, 40.0)
    for f_number in (1.4, math.inf):
        lens = Lens(f_number=f_number, chief_ray=0.4, half_ratio=0.5,
                    diattenuation=0.3, retardance=1.0)
        assert is_physical(lens.mueller(x, y))
        seen = lens.seen(angle, ratio, x, y)
        assert np.all(np.linalg.norm(seen[:, 1:], axis=1) <= seen[:, 0])
        assert np.abs(seen[:, 3]).max() > 0.1  # circular light is seen
    # Of parallel light a polarizer passes what the one across it does not.
    radial = np.arctan2(y, x)
    both = sum(lens.seen(radial + turn, ratio, x, y) for turn in (0, np.pi / 2))
    np.testing.assert_allclose(both[:, 0], 1, atol=1e-12)


def test_turning_field_point_analyser_and_light_together_changes_nothing():
    lens = Lens(f_number=2.8, chief_ray=0.3, half_ratio=0.5, diattenuation=0.2,
                retardance=0.7)
    x, y, angle = places()
    ratio = np.full(angle.shape, 40.0)
    before = lens.seen(angle, ratio, x, y)
    turn = math.pi / 4  # a symmetry of the pupil's rays
    after = lens.seen(angle + turn, ratio, x * math.cos(turn) - y * math.sin(turn),
                      x * math.sin(turn) + y * math.cos(turn))
    np.testing.assert_allclose(after[:, 0], before[:, 0], atol=1e-14)
    np.testing.assert_allclose(after[:, 1], -before[:, 2], atol=1e-14)
    np.testing.assert_allclose(after[:, 2], before[:, 1], atol=1e-14)
    np.testing.assert_allclose(after[:, 3], before[:, 3], atol=1e-14)


def test_crosstalk_costs_contrast_as_in_theory():
    side, corner = 0.02, 0.005
    maps = Optics(crosstalk=kernel(side, corner)).maps(0, (6, 6), (10, 20), FULL)
    # Side neighbours are +-45 degrees off and cancel, corners are crossed.
    contrast = 39 / 41 * (1 - 4 * side - 8 * corner)
    np.testing.assert_allclose(maps["extinction_ratio"],
                               (1 + contrast) / (1 - contrast))
    np.testing.assert_allclose(maps["gain"], 1)
    np.testing.assert_allclose(maps["angle"], Optics().maps(
        0, (6, 6), (10, 20), FULL)["angle"], atol=1e-12)


def test_uniform_light_keeps_its_intensity_at_the_sensors_edge():
    maps = Optics(crosstalk=kernel(0.02, 0.005)).maps(*WHOLE)
    np.testing.assert_allclose(maps["gain"], 1)


def test_nothing_of_a_lens_is_in_plain_optics():
    plain = Optics(gain_sigma=0.02, angle_sigma=0.01, extinction_ratio_sigma=2)
    with_lens = Optics(gain_sigma=0.02, angle_sigma=0.01, extinction_ratio_sigma=2,
                       lens=Lens(), crosstalk=kernel(0.0))
    one, other = plain.maps(5, (8, 8), (2, 4), FULL), with_lens.maps(
        5, (8, 8), (2, 4), FULL)
    assert "circular" not in one
    for name, values in one.items():
        np.testing.assert_allclose(other[name], values, rtol=1e-12)


def structured(scene):
    """The same light, but the simulator does not know that it is uniform."""
    return FunctionScene(scene.stokes, sampling_us=scene.step_us)


def drained(recording):
    packets = list(recording.packets())
    return (np.concatenate([packet.events for packet in packets]),
            [frame.dn for packet in packets for frame in packet.frames])


def test_uniform_light_is_the_same_when_it_is_simulated_pixel_by_pixel():
    scene = RotatingPolarizer(rpm=200)
    camera = Camera.preset("ideal", optics="f2.8", size=(8, 8), origin=(0, 0))
    (events, frames), (others, again) = (
        drained(camera.record(light, 0.2)[0]) for light in (scene, structured(scene)))
    np.testing.assert_allclose(frames, again, rtol=1e-6)
    assert len(frames) == 4
    assert len(events) == len(others) > 500


def test_a_pixel_is_the_same_in_a_larger_region():
    rng = np.random.default_rng(3)
    video = VideoScene(rng.random((4, 4, 40, 40)) + 0.2, 50.0, origin=(90, 90))
    large = Camera.preset("ideal", optics="f2.8", size=(20, 20), origin=(100, 100))
    small = Camera.preset("ideal", optics="f2.8", size=(8, 8), origin=(104, 106))
    (_, one), (_, other) = (drained(c.record(video, 0.06, threads=n)[0])
                            for c, n in ((large, 2), (small, 1)))
    np.testing.assert_allclose(one[0][4:12, 6:14], other[0], rtol=1e-6)


def test_a_bright_pixel_lights_its_neighbours_by_their_share():
    quad = np.zeros((1, 4, 5, 5))
    quad[0, :, 2, 2] = 1.0
    shares = ((0.01, 0.02, 0.0), (0.03, 0.9, 0.04), (0.0, 0.0, 0.0))
    camera = Camera.preset("ideal", dvs=None, optics={"crosstalk": shares},
                           size=(5, 5), origin=(100, 100))
    _, (dn, *_) = drained(
        camera.record(VideoScene(quad, 10.0, origin=(100, 100)), 0.06)[0])
    # A pixel has `shares[0][1]` of the one above it: what is below lights up.
    np.testing.assert_allclose(dn[1:4, 1:4] / dn.sum(), np.array(shares)[::-1, ::-1],
                               atol=1e-6)


def test_a_lens_that_retards_shows_circular_light():
    delta = math.radians(30)
    for lens, degree in ((None, 0.0), (Lens(retardance=delta), math.sin(delta))):
        camera = Camera.preset("ideal", dvs=None, size=(2, 2), origin=(0, 0),
                               optics={"lens": lens, "extinction_ratio": 1e6})
        _, (dn, *_) = drained(camera.record(FlatLight(docp=1.0), 0.06)[0])
        quad = dict(zip(np.ravel(camera.layout.angles_deg), dn.ravel(), strict=True))
        s1, s2 = quad[0] - quad[90], quad[45] - quad[135]
        assert math.hypot(s1, s2) / (sum(quad.values()) / 2) == pytest.approx(
            degree, abs=0.01)  # the pixel at the corner is not quite at the corner


def test_presets_are_worse_towards_the_corner_and_at_large_apertures():
    ratios = {}
    for name in LENSES:
        maps = Camera.preset("ideal", optics=name, size=FULL).maps
        ratio = maps["extinction_ratio"]
        ratios[name] = ratio[128:132, 171:175].mean(), ratio[2:6, 2:6].mean()
    for middle, corner in ratios.values():
        assert 40 > middle > corner > 10
    assert ratios["f8"] > ratios["f2.8"]


@pytest.mark.parametrize(("given", "says"), [
    ({"f_number": 0.2}, "f_number"), ({"chief_ray": 2.0}, "chief_ray"),
    ({"half_ratio": 0.0}, "half_ratio"), ({"diattenuation": 1.0}, "diattenuation"),
    ({"retardance": math.inf}, "retardance")])
def test_impossible_lenses_are_refused(given, says):
    with pytest.raises(ValueError, match=f"^{says} must"):
        Lens(**given)


@pytest.mark.parametrize("shares", [
    ((0, 0, 0), (0, 0.9, 0), (0, 0, 0)), ((0, 0.3, 0), (0.3, 0.4, 0), (0, 0, 0)),
    (0.1, 0.2), ((0, -0.1, 0), (0, 1.1, 0), (0, 0, 0))])
def test_impossible_crosstalk_is_refused(shares):
    with pytest.raises(ValueError, match=r"^crosstalk must"):
        Optics(crosstalk=shares)


def test_an_unknown_lens_is_refused():
    with pytest.raises(ValueError, match=r"optics must be one of .*got 'f3'"):
        Camera.preset("ideal", optics="f3")


def test_the_command_puts_a_lens_before_the_camera(tmp_path):
    frames = {}
    for given in ([], ["--optics", "f2.8"]):
        path = tmp_path / f"{len(given)}.aedat4"
        assert simulate.main(["malus", "--camera", "sony", "--seconds", "0.1", "--size",
                              "4x4", *given, "-o", str(path)]) == 0
        with pdavis_cv.open_recording(path) as recording:
            frames[len(given)] = drained(recording)[1][0].astype(float)
    assert not np.array_equal(frames[0], frames[2])
