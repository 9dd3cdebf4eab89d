import itertools
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_image as reference
from images import DTYPES, LAYOUTS, apart, malus, random_mosaic, sample, scene

import pdavis_cv
from pdavis_cv import CHANNELS, Analyser, Layout, PolarFrame, debias_dolp, render
from pdavis_cv.polarimetry import adopted

POLARIZERS = np.deg2rad(np.array(CHANNELS, float)).reshape(4, 1, 1)


def random_quad(shape=(5, 7), seed=0):
    quad = np.random.default_rng(seed).uniform(0, 1000, (4, *shape))
    quad = quad.astype(np.float32)
    quad.flags.writeable = False
    return quad


@pytest.mark.parametrize("shape", [(0,), (1,), (5, 7), (2, 3, 4), (260, 346)])
def test_stokes_aop_and_dolp_equal_their_twins(shape):
    quad = random_quad(shape)
    planes = pdavis_cv.stokes(quad, extinction_ratio=40)
    np.testing.assert_array_equal(planes, reference.stokes(quad, 41 / 39))
    s0, s1, s2 = pdavis_cv.stokes(quad)
    np.testing.assert_array_equal((s0, s1, s2), reference.stokes(quad))
    angle, degree = pdavis_cv.aop(s1, s2), pdavis_cv.dolp(s0, s1, s2)
    np.testing.assert_array_equal(angle, reference.aop(s1, s2))
    np.testing.assert_array_equal(degree, reference.dolp(s0, s1, s2))
    assert planes.dtype == angle.dtype == degree.dtype == np.float32
    assert angle.shape == degree.shape == shape


@pytest.mark.parametrize("ratio", [None, 40.0])
@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (33, 64)])
def test_what_is_asked_for_first_does_not_matter(shape, ratio):
    quad = random_quad(shape)
    names = ("aop", "dolp", "s0", "s1")
    first, second = (PolarFrame(quad, extinction_ratio=ratio) for _ in range(2))
    expected = {name: getattr(first, name) for name in names}
    for name in reversed(names):
        np.testing.assert_array_equal(getattr(second, name), expected[name])
        assert not expected[name].flags.writeable


def test_aop_is_within_its_accuracy_all_the_way_round():
    turn = np.linspace(-np.pi, np.pi, 400_001)
    for size in (1e-30, 1e-3, 1.0, 1e30):
        s1, s2 = ((size * f(turn)).astype(np.float32) for f in (np.cos, np.sin))
        angle = pdavis_cv.aop(s1, s2)
        assert apart(angle, np.arctan2(s2, s1, dtype=float) / 2).max() < 2.1e-7
        assert angle.min() >= 0
        assert angle.max() < np.float32(np.pi)


@pytest.mark.parametrize(("s1", "s2", "angle"), [
    (1, 0, 0), (0, 1, np.pi / 4), (-1, 0, np.pi / 2), (0, -1, 3 * np.pi / 4),
    (1, -1e-9, 0), (0, 0, 0), (0.0, -0.0, 0), (-0.0, -0.0, 0), (-1, -0.0, np.pi / 2)])
def test_aop_of_the_axes(s1, s2, angle):
    assert pdavis_cv.aop(s1, s2) == np.float32(angle)


def test_nan_stays_nan_in_aop():
    nan = np.float32(np.nan)
    assert np.isnan(pdavis_cv.aop([nan, 1, nan], [1, nan, nan])).all()


def test_dolp_is_zero_without_light_and_not_clipped():
    assert pdavis_cv.dolp([0, -1, 2], [1, 1, 3], [0, 0, 4]).tolist() == [0, 0, 2.5]


@pytest.mark.parametrize("size", [1e-30, 1e-20, 1e30])
def test_dolp_neither_over_nor_underflows(size):
    got = pdavis_cv.dolp(*np.array([[5 * size], [3 * size], [4 * size]]))
    assert got[0] == pytest.approx(1, rel=3e-7)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_malus_gives_the_angle_back_for_every_layout(layout):
    for degrees in range(0, 180, 5):
        angle = np.full((6, 7), np.deg2rad(degrees))
        mosaic = sample(layout, 1000.0, 1.0, angle).astype(np.float32)
        frame = pdavis_cv.polarization(mosaic, layout)
        assert apart(frame.aop, angle).max() < 1e-6
        np.testing.assert_allclose(frame.dolp, 1, atol=1e-6)
        np.testing.assert_allclose(frame.s0, 1000, atol=1e-3)


@pytest.mark.parametrize("layout", [Layout.PDAVIS, Layout.SONY], ids=str)
def test_a_smooth_scene_is_recovered(layout):
    s0, degree, angle = scene((131, 173))
    frame = pdavis_cv.polarization(
        sample(layout, s0, degree, angle).astype(np.float32), layout)
    assert np.rad2deg(apart(frame.aop, angle)).max() < 0.1
    np.testing.assert_allclose(frame.dolp, degree, atol=2e-3)


SHAPES = [(40, 60), (41, 60), (40, 61), (41, 61)]
# A mirror reverses the sense of rotation; np.rot90 turns the scene with the pixels.
OPERATIONS = {
    "fliplr": (np.fliplr, lambda a: -a, lambda lay, h, w: lay.flip_x(w)),
    "flipud": (np.flipud, lambda a: -a, lambda lay, h, w: lay.flip_y(h)),
    "rot90": (np.rot90, lambda a: a + np.pi / 2,
              lambda lay, h, w: lay.rot90(1, (h, w))),
    "rot180": (lambda m: np.rot90(m, 2), lambda a: a,
               lambda lay, h, w: lay.rot90(2, (h, w))),
    "rot270": (lambda m: np.rot90(m, -1), lambda a: a + np.pi / 2,
               lambda lay, h, w: lay.rot90(-1, (h, w))),
}


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("layout", LAYOUTS[::5], ids=str)
def test_a_turned_or_mirrored_mosaic_gives_the_turned_or_mirrored_field(
        layout, shape, operation):
    pixels, angles, layouts = OPERATIONS[operation]
    s0, degree, angle = scene(shape)
    mosaic = sample(layout, s0, degree, angle).astype(np.float32)
    turned = layouts(layout, *shape)
    frame = pdavis_cv.polarization(pixels(mosaic), turned)
    assert np.rad2deg(apart(frame.aop, angles(pixels(angle)))).max() < 0.7
    np.testing.assert_allclose(frame.dolp, pixels(degree), atol=0.02)
    # The same, of noise: no smoothness helps here.
    noise = random_mosaic(shape, np.uint16)
    before = pdavis_cv.polarization(noise, layout)
    after = pdavis_cv.polarization(pixels(noise), turned)
    assert apart(after.aop, angles(pixels(before.aop))).max() < 1e-6
    np.testing.assert_allclose(after.dolp, pixels(before.dolp), rtol=1e-6)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_the_turned_world_before_an_unturned_camera_agrees(operation):
    """The layout of a turned image is that of a camera which sees the turned world."""
    pixels, angles, layouts = OPERATIONS[operation]
    shape = (41, 60)
    s0, degree, angle = scene(shape)
    turned = layouts(Layout.PDAVIS, *shape)
    world = pixels(s0), pixels(degree), angles(pixels(angle))
    np.testing.assert_allclose(
        sample(turned, *world), pixels(sample(Layout.PDAVIS, s0, degree, angle)),
        rtol=1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(2, 2), (3, 5), (260, 346)])
@pytest.mark.parametrize("ratio", [None, 40.0])
def test_one_pass_gives_the_bits_of_the_separate_steps(shape, dtype, ratio):
    mosaic = random_mosaic(shape, dtype)
    frame = pdavis_cv.polarization(mosaic, Layout.PDAVIS, extinction_ratio=ratio)
    angle, degree = frame.aop, frame.dolp
    quad = pdavis_cv.demosaic(mosaic, Layout.PDAVIS)
    s0, s1, s2 = pdavis_cv.stokes(quad, extinction_ratio=ratio)
    for image in (frame, PolarFrame(quad, extinction_ratio=ratio)):
        np.testing.assert_array_equal(image.aop, pdavis_cv.aop(s1, s2))
        np.testing.assert_array_equal(image.dolp, pdavis_cv.dolp(s0, s1, s2))
        np.testing.assert_array_equal(image.quad, quad)
        np.testing.assert_array_equal((image.s0, image.s1, image.s2), (s0, s1, s2))
    assert frame.aop is angle
    assert frame.dolp is degree
    after = pdavis_cv.polarization(mosaic, Layout.PDAVIS, extinction_ratio=ratio)
    np.testing.assert_array_equal(after.s1, s1)  # asked in the other order
    np.testing.assert_array_equal(after.aop, angle)


def test_superpixel_polarization_has_half_the_size():
    mosaic = random_mosaic((6, 8), np.uint16)
    frame = pdavis_cv.polarization(mosaic, Layout.SONY, "superpixel")
    quad = pdavis_cv.demosaic(mosaic, Layout.SONY, "superpixel")
    np.testing.assert_array_equal(frame.aop, PolarFrame(quad).aop)
    assert frame.shape == (3, 4)


def test_an_empty_mosaic_gives_an_empty_frame():
    frame = pdavis_cv.polarization(np.empty((0, 6), np.uint8), Layout.SONY)
    assert frame.aop.shape == frame.valid.shape == (0, 6)


def test_a_frame_survives_changes_of_what_it_was_made_from():
    mosaic, quad = np.full((4, 4), 7, np.uint8), np.ones((4, 2, 2), np.float32)
    usable = np.ones((2, 2), bool)
    of_mosaic = pdavis_cv.polarization(mosaic, Layout.SONY)
    of_quad = PolarFrame(quad, valid=usable, variance=quad)
    mosaic[:], quad[:], usable[:] = 9, 9, False
    assert of_mosaic.quad.max() == 7
    assert of_quad.s0.max() == 2
    assert of_quad.valid.all()
    assert of_quad.variance.max() == 1
    for name in ("quad", "s0", "s1", "s2", "aop", "dolp", "valid"):
        assert not getattr(of_quad, name).flags.writeable
        assert not getattr(of_mosaic, name).flags.writeable


def test_adopt_takes_the_array_itself():
    quad = np.ones((4, 2, 2), np.float32)
    frame = adopted(quad, t_us=5)
    assert frame.quad is quad
    assert not quad.flags.writeable
    with pytest.raises(TypeError, match="quad must be C-contiguous float32"):
        adopted(np.ones((4, 2, 2)))


def test_valid_needs_light():
    quad = np.array([[1, -1, 0, 1]] * 4, np.float32).reshape(4, 1, 4)
    usable = np.array([[True, True, True, False]])
    assert PolarFrame(quad, valid=usable).valid.tolist() == [
        [True, False, False, False]]
    assert PolarFrame(quad).valid.tolist() == [[True, False, False, True]]


def test_extinction_ratio_gives_the_degree_back():
    angle = np.linspace(0, np.pi, 50).reshape(5, 10)
    ratio = 40.0
    ideal = malus(900.0, 0.7, angle, POLARIZERS)
    crossed = malus(900.0, 0.7, angle + np.pi / 2, POLARIZERS)
    leaky = (ratio * ideal + crossed) / (ratio + 1)
    frame = PolarFrame(leaky, extinction_ratio=ratio)
    np.testing.assert_allclose(frame.dolp, 0.7, atol=1e-6)
    assert apart(frame.aop, angle).max() < 1e-6
    assert PolarFrame(leaky).dolp.max() < 0.67


def response(shape=(5, 7), seed=1):
    """Responses with errors of angle, transmission and extinction per pixel."""
    rng = np.random.default_rng(seed)
    angle = POLARIZERS + rng.normal(0, 0.05, (4, *shape))
    purity = rng.uniform(0.9, 1, (4, *shape))
    rows = np.stack([np.ones_like(angle), purity * np.cos(2 * angle),
                     purity * np.sin(2 * angle)], 1)
    return rows * rng.uniform(0.4, 0.6, (4, 1, *shape))


def test_an_analyser_gives_the_light_back():
    truth = np.random.default_rng(2).normal(0, 100, (3, 5, 7))
    truth[0] += 800
    matrix = response()
    quad = np.einsum("kjyx,jyx->kyx", matrix, truth)
    for analyser in (matrix, Analyser(matrix)):
        np.testing.assert_allclose(pdavis_cv.stokes(quad, analyser), truth, atol=1e-3)
    frame = PolarFrame(quad, analyser=matrix)
    np.testing.assert_allclose(frame.s1, truth[1], atol=1e-3)
    np.testing.assert_array_equal(frame.aop, pdavis_cv.aop(frame.s1, frame.s2))
    np.testing.assert_array_equal(
        frame.dolp, pdavis_cv.dolp(frame.s0, frame.s1, frame.s2))


def test_one_response_for_all_pixels_equals_the_repeated_one():
    one, quad = response((1, 1)), random_quad()
    np.testing.assert_array_equal(
        pdavis_cv.stokes(quad, one[:, :, 0, 0]),
        pdavis_cv.stokes(quad, np.tile(one, (1, 1, 5, 7))))


def test_mix_equals_its_twin():
    quad, analyser = random_quad(), Analyser(response())
    np.testing.assert_array_equal(
        pdavis_cv.stokes(quad, analyser), reference.mix(quad, analyser.solution))


def test_the_least_squares_are_those_of_numpy():
    matrix = response((1, 1))[:, :, 0, 0]
    np.testing.assert_allclose(
        Analyser(matrix).solution, np.linalg.pinv(matrix), atol=1e-6)


def test_the_ideal_analyser_is_the_plain_formula():
    quad = random_quad()
    for ratio in (None, 40):
        np.testing.assert_allclose(
            pdavis_cv.stokes(quad, Analyser.ideal(ratio)),
            pdavis_cv.stokes(quad, extinction_ratio=ratio), atol=1e-3)


def test_sigmas_agree_with_the_scatter_of_noisy_images():
    rng = np.random.default_rng(3)
    angle = np.linspace(0, 3, 6).reshape(1, 6)
    truth = malus(800.0, 0.5, angle, POLARIZERS)
    sigma_log = np.array([0.01, 0.02, 0.015, 0.005]).reshape(4, 1, 1)
    noisy = truth * np.exp(rng.normal(0, 1, (4000, *truth.shape)) * sigma_log)
    variance = np.broadcast_to(sigma_log**2, truth.shape)
    for options in ({}, {"extinction_ratio": 40}, {"analyser": Analyser.ideal(40)}):
        frames = [PolarFrame(quad, **options) for quad in noisy]
        frame = PolarFrame(truth, variance=variance, **options)
        scatter = np.std([np.sin(2 * (f.aop - frame.aop)) / 2 for f in frames], 0)
        np.testing.assert_allclose(frame.sigma_aop, scatter, rtol=0.05)
        scatter = np.std([f.dolp for f in frames], 0)
        np.testing.assert_allclose(frame.sigma_dolp, scatter, rtol=0.05)
        # sigma across the polarization, relative to S0, is 2 DoLP times that of AoP
        np.testing.assert_allclose(
            frame.dolp_debiased, debias_dolp(
                frame.dolp, 2 * frame.dolp * frame.sigma_aop), rtol=1e-6)


def test_sigmas_of_a_mosaic_tell_that_its_channels_are_taken_apart():
    """An edge within a cell and between two: about a sigma; even light: nothing."""
    errors, stated = [], []
    places = (0, 0), (0, 1), (1, 1), (1, 0)
    for angle, edge in itertools.product(np.linspace(0, np.pi, 12, False), (21, 22)):
        light = np.where(np.arange(48) < edge, 100.0, 140.0) * np.ones((48, 1))
        quad = np.stack([
            malus(light, 0.4, angle, polarizer)[y::2, x::2]
            for (y, x), polarizer in zip(places, POLARIZERS.ravel(), strict=True)])
        small = np.full(quad.shape, 1e-6, np.float32)
        frame, plain = (adopted(quad.astype(np.float32), variance=small,
                                places_differ=way) for way in (True, False))
        errors.append(frame.dolp[12, 8:13] - 0.4)
        stated.append(frame.sigma_dolp[12, 8:13])
        for part in (slice(None, 8), slice(14, None)):
            np.testing.assert_array_equal(
                frame.sigma_dolp[:, part], plain.sigma_dolp[:, part])
        again = pickle.loads(pickle.dumps(frame))
        np.testing.assert_array_equal(again.sigma_dolp, frame.sigma_dolp)
    # Half of the variance of edges: so it is that of even slopes twice.
    ratio = np.mean(np.square(errors)) / np.mean(np.square(stated))
    assert ratio == pytest.approx(2, abs=0.4)


def test_sigmas_where_nothing_is_polarized_or_lit():
    quad = np.array([1, 1, 1, 1, 0, 0, 0, 0], np.float32).reshape(2, 4, 1, 1)
    lit, dark = (PolarFrame(q, variance=np.full((4, 1, 1), 0.01)) for q in quad)
    assert lit.sigma_aop[0, 0] == np.float32(np.pi / np.sqrt(12))
    # S1 and S2 scatter by sqrt(2) * 0.1 of S0 = 2
    assert lit.sigma_dolp[0, 0] == pytest.approx(np.sqrt(2) * 0.1 / 2)
    assert dark.sigma_dolp[0, 0] == np.inf
    assert dark.dolp_debiased[0, 0] == 0
    assert PolarFrame(quad[0]).sigma_aop is None
    assert PolarFrame(quad[0]).sigma_dolp is None


def test_a_frame_pickles():
    frame = PolarFrame(
        random_quad(), valid=random_quad()[0] > 500, t_us=7, frame_us=3,
        analyser=response(), variance=random_quad(seed=1), provenance={"method": "cf"},
        reconciled=True)
    for image in (frame, pdavis_cv.polarization(
            random_mosaic((4, 6), np.uint8), Layout.SONY, extinction_ratio=40)):
        again = pickle.loads(pickle.dumps(image))
        for name in ("quad", "s0", "s1", "s2", "aop", "dolp", "valid"):
            np.testing.assert_array_equal(getattr(again, name), getattr(image, name))
            assert not getattr(again, name).flags.writeable
        for name in ("t_us", "frame_us", "extinction_ratio", "provenance"):
            assert getattr(again, name) == getattr(image, name)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frame)).sigma_aop,
                                  frame.sigma_aop)


def test_an_array_of_a_frame_is_its_four_channels():
    frame = PolarFrame(np.arange(8.0).reshape(4, 1, 2))
    assert np.shares_memory(np.asarray(frame), frame.quad)
    assert np.asarray(frame, np.float64).tolist() == frame.quad.tolist()
    assert np.array(frame).flags.writeable
    if np.lib.NumpyVersion(np.__version__) >= "2.0.0":
        with pytest.raises(ValueError, match="copy"):
            np.array(frame, np.float64, copy=False)


def test_a_notebook_shows_s0_aop_and_dolp():
    cv2 = pytest.importorskip("cv2")
    quad = np.full((4, 6, 8), 2.0)
    quad[0], quad[2] = 4, 0                    # AoP 0, fully polarized
    quad[:, :, 4:] = [[[2.2]], [[1.8]], [[1.8]], [[2.2]]]   # AoP 157.5, DoLP .141
    frame = PolarFrame(quad, valid=np.arange(48).reshape(6, 8) > 0)
    picture = cv2.imdecode(np.frombuffer(frame._repr_png_(), np.uint8), 1)
    seen = {tuple(colour) for colour in picture.reshape(-1, 3).tolist()}
    assert tuple(render.aop_bgr([[0.0]])[0, 0].tolist()) in seen
    assert render.INVALID[0] in seen
    # Colours fade below a DoLP of .25.
    weak = np.sqrt(0.02) / 0.25 * render.aop_bgr([[np.deg2rad(157.5)]])[0, 0]
    assert min(np.abs(np.array(sorted(seen)) - weak).max(1)) <= 1
    nothing = PolarFrame(quad, valid=np.zeros((6, 8), bool))
    assert nothing._repr_png_().startswith(b"\x89PNG")


def test_the_repr_says_what_it_is():
    frame = PolarFrame(random_quad(), t_us=7, frame_us=3, provenance={"method": "cf"})
    assert repr(frame) == "PolarFrame(7x5, t_us=7, method='cf')"
    assert repr(Analyser.ideal()) == "Analyser(one for all pixels, shape (4, 3))"


def test_provenance_is_read_only_and_a_copy():
    given = {"method": "cf"}
    frame = PolarFrame(random_quad(), provenance=given)
    given["method"] = "other"
    assert frame.provenance == {"method": "cf"}
    with pytest.raises(TypeError, match="does not support item assignment"):
        frame.provenance["method"] = "other"


QUAD = np.ones((4, 2, 2), np.float32)


@pytest.mark.parametrize(("options", "error", "words"), [
    ({"quad": QUAD[:3]}, ValueError, r"quad must have shape \(4, H, W\)"),
    ({"quad": QUAD[0]}, ValueError, r"quad must have shape \(4, H, W\)"),
    ({"quad": QUAD * 1j}, TypeError, "quad must hold real numbers, got complex64"),
    ({"valid": np.ones((2, 2))}, TypeError, "valid must be bool, got float64"),
    ({"valid": np.ones((2, 3), bool)}, ValueError, r"valid must have shape \(2, 2\)"),
    ({"variance": QUAD[0]}, ValueError, r"variance must have shape \(4, 2, 2\)"),
    ({"extinction_ratio": 1}, ValueError, "extinction_ratio must be greater than 1"),
    ({"extinction_ratio": np.nan}, ValueError, "must be greater than 1, got nan"),
    ({"extinction_ratio": 40, "analyser": Analyser.ideal()}, ValueError,
     "extinction_ratio must be None when analyser is given, got 40"),
    ({"analyser": np.ones((3, 4))}, ValueError, r"analyser must have shape \(4, 3\)"),
    ({"analyser": response((3, 3))}, ValueError, r"\(4, 3\) or \(4, 3, 2, 2\), got"),
    ({"analyser": np.ones((4, 3))}, ValueError, "rows are linearly dependent$"),
])
def test_a_bad_argument_of_a_frame_is_named(options, error, words):
    with pytest.raises(error, match=words):
        PolarFrame(**{"quad": QUAD} | options)


def test_a_response_that_determines_nothing_is_placed():
    matrix = response()
    matrix[:, :, 2, 3] = 0.5
    with pytest.raises(ValueError, match=r"linearly dependent at \(y=2, x=3\)"):
        Analyser(matrix)


@pytest.mark.parametrize(("call", "error", "words"), [
    (lambda: pdavis_cv.stokes(QUAD[:2]), ValueError, r"quad must have shape \(4, "),
    (lambda: pdavis_cv.stokes(QUAD, out=np.zeros((3, 2, 2))), TypeError,
     "out must be float32"),
    (lambda: pdavis_cv.stokes(QUAD, out=QUAD.copy()[:3][:, ::-1]), ValueError,
     "out must be C-contiguous"),
    (lambda: pdavis_cv.aop([1, 2], [1]), ValueError,
     r"s1 and s2 must have one shape, got s1 \(2,\), s2 \(1,\)"),
    (lambda: pdavis_cv.aop(["a"], [1]), TypeError, "s1 must hold real numbers"),
    (lambda: pdavis_cv.dolp([1, 2], [1], [1]), ValueError, "s0 and s1 and s2 must"),
    (lambda: pdavis_cv.polarization(np.ones((4, 4)), Layout.SONY), TypeError,
     "mosaic must be uint8"),
    (lambda: pdavis_cv.polarization(np.ones((4, 4), "u1"), Layout.SONY, "x"),
     ValueError, "demosaic method must be one of"),
    (lambda: pdavis_cv.polarization(np.ones((4, 4), "u1"), Layout.SONY,
                                    extinction_ratio=0), ValueError,
     "extinction_ratio must be greater than 1, got 0"),
])
def test_a_bad_argument_is_named(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_inputs_may_be_strided_and_of_other_dtypes():
    quad = np.random.default_rng(4).integers(0, 255, (4, 6, 8), np.uint8)
    view = quad[:, ::2, ::-1]
    np.testing.assert_array_equal(
        pdavis_cv.stokes(view), reference.stokes(view.astype(np.float32)))
    _, s1, s2 = pdavis_cv.stokes(quad)
    np.testing.assert_array_equal(
        pdavis_cv.aop(s1[::2].astype(float), s2[::2]), pdavis_cv.aop(s1, s2)[::2])


def test_eight_threads_share_frames():
    mosaics = [random_mosaic((64, 66), np.uint16, seed) for seed in range(8)]
    frames = [pdavis_cv.polarization(m, Layout.PDAVIS) for m in mosaics] * 16

    def work(frame):
        return frame.aop, frame.dolp, frame.s0, frame.valid

    want = [work(pdavis_cv.polarization(m, Layout.PDAVIS)) for m in mosaics]
    with ThreadPoolExecutor(8) as pool:
        for i, got in enumerate(pool.map(work, frames)):
            for a, b in zip(got, want[i % 8], strict=True):
                np.testing.assert_array_equal(a, b)


def test_the_kernels_check_sizes_themselves():
    kernels = pdavis_cv._kernels
    f4 = np.zeros((4, 6), np.float32)
    for call, words in (
            (lambda: kernels.stokes(f4, 1.0, f4), "stokes"),
            (lambda: kernels.aop(f4[0], f4[0, :5], f4[0]), "aop"),
            (lambda: kernels.dolp(f4[0], f4[0], f4[0, :5], f4[0]), "dolp"),
            (lambda: kernels.s0_aop_dolp(f4, 1.0, f4[0], f4[0], f4[0, :5]), "s0_aop"),
            (lambda: kernels.mix(f4, f4, f4[:3]), "mix: solution"),
            (lambda: kernels.mix(f4, np.zeros((12, 6), "f4"), f4), "mix: quad")):
        with pytest.raises(ValueError, match=words):
            call()


def test_a_real_sony_mosaic_agrees_with_polanalysers_formulas(data_dir):
    """Bilinear by convolution, Stokes by pseudo-inverse, in float64."""
    cv2 = pytest.importorskip("cv2")
    mosaic = cv2.imread(str(data_dir / "camera_IMX250MZR.png"), cv2.IMREAD_GRAYSCALE)
    mosaic = np.ascontiguousarray(mosaic[600:1200, 800:1600])
    y, x = np.indices(mosaic.shape) % 2
    weights = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
    cell = np.array([[90, 45], [135, 0]])
    planes = [cv2.filter2D(np.where(cell[y, x] == angle, mosaic, 0.0), -1, weights)
              for angle in (0, 45, 90, 135)]
    theta = np.deg2rad([0, 45, 90, 135])
    mueller = np.stack([np.ones(4), np.cos(2 * theta), np.sin(2 * theta)], 1) / 2
    s0, s1, s2 = np.tensordot(np.linalg.pinv(mueller), planes, 1)
    inside = np.s_[1:-1, 1:-1]
    frame = pdavis_cv.polarization(mosaic, Layout.SONY)
    np.testing.assert_allclose(frame.s0[inside], s0[inside], atol=1e-3)
    lit = s0[inside] > 0
    degree = np.sqrt(s1**2 + s2**2)[inside][lit] / s0[inside][lit]
    np.testing.assert_allclose(frame.dolp[inside][lit], degree, atol=1e-5)
    angle = np.mod(np.arctan2(s2, s1) / 2, np.pi)[inside][lit]
    certain = degree > 1e-6
    assert apart(frame.aop[inside][lit], angle)[certain].max() < 1e-6
    assert 0.05 < frame.dolp[frame.valid].mean() < 0.5


@pytest.mark.parametrize("true", [0.0, 0.05, 0.2, 0.5, 0.9])
def test_debiased_dolp_has_a_smaller_bias_than_what_is_read(true):
    # S1 / S0 and S2 / S0 scatter by sigma: the raw reading is Rice-distributed
    sigma, rng = 0.05, np.random.default_rng(4)
    s1, s2 = rng.normal([[true], [0.0]], sigma, (2, 400_000))
    read = np.hypot(s1, s2)
    left = debias_dolp(read, sigma)
    assert left.min() >= 0
    assert abs(left.mean() - true) < 0.8 * abs(read.mean() - true)
    if true >= 4 * sigma:  # 0.2 % of sigma is the scatter of the mean
        assert abs(left.mean() - true) < 0.02 * sigma


def test_debiasing_leaves_alone_what_has_no_noise_and_ends_at_nothing():
    read = np.array([0.0, 0.3, 1.0], np.float32)
    np.testing.assert_array_equal(debias_dolp(read, 0), read)
    assert debias_dolp(read, np.inf)[1] == pytest.approx(0.15)
