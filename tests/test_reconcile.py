import numpy as np
import pytest

from pdavis_cv import Layout, PolarFrame, _kernels, demosaic
from pdavis_cv.analyser import Analyser
from pdavis_cv.mosaic import demosaic_variance, places_of, scratch_rows
from pdavis_cv.stokes_vector import stokes

IDEAL = np.array([1, -1, 1, -1], np.float32).reshape(4, 1, 1)


def images(seed=0, shape=(5, 7)):
    rng = np.random.default_rng(seed)
    quad = rng.uniform(1, 100, (4, *shape)).astype(np.float32)
    return quad, rng.uniform(1e-4, 1e-1, (4, *shape)).astype(np.float32)


def response(seed=1, shape=(5, 7)):
    exact = Analyser.ideal(40.0).response[:, :, None, None]
    return exact * np.random.default_rng(seed).uniform(0.9, 1.1, (4, 1, *shape))


@pytest.mark.parametrize("real", [False, True])
def test_the_solution_is_the_one_of_weighted_least_squares(real):
    quad, variance = images()
    analyser = Analyser(response()) if real else Analyser.ideal()
    null = analyser.null().reshape(4, *((5, 7) if real else (1, 1)))
    expected = np.empty((3, 5, 7))
    for at in np.ndindex(5, 7):
        a = analyser.response[(..., *at)] if real else analyser.response
        weight = 1 / np.sqrt(variance[(..., *at)]) / quad[(..., *at)]
        expected[(..., *at)] = np.linalg.lstsq(
            a * weight[:, None], quad[(..., *at)] * weight, rcond=None)[0]
    _kernels.reconcile(quad, variance, np.ascontiguousarray(null))
    np.testing.assert_allclose(stokes(quad, analyser), expected, rtol=1e-3, atol=1e-2)


def test_consistent_intensities_stay_as_they_are():
    quad, variance = images()
    quad[3] = quad[0] + quad[2] - quad[1]
    before = quad.copy()
    _kernels.reconcile(quad, variance, IDEAL)
    np.testing.assert_allclose(quad, before, atol=1e-4)


def test_a_channel_that_nothing_is_known_of_follows_from_the_others():
    quad, variance = images()
    variance[1] = 1e6
    others = quad[[0, 2, 3]].copy()
    _kernels.reconcile(quad, variance, IDEAL)
    np.testing.assert_allclose(quad[[0, 2, 3]], others, rtol=1e-2)
    np.testing.assert_allclose(quad[1], others[0] + others[1] - others[2], atol=0.5)


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (5, 7)])
def test_mismatch_is_what_malus_law_says_of_gain_angle_contrast_and_offset(shape):
    quad, variance = images(shape=shape)
    before = quad.copy(), variance.copy()
    _kernels.mismatch(quad, 0.02, 0.012, 0.004, 0.7, variance)
    np.testing.assert_array_equal(quad, before[0])
    # I = (S0 + c (S1 cos 2a + S2 sin 2a)) / 2, derivatives by angle and by c.
    side = np.roll(quad, -1, 0) - np.roll(quad, 1, 0)
    across = (quad - np.roll(quad, 2, 0)) / 2
    least = 1e-4 * quad.sum(0) ** 2
    moved = (0.012 * side) ** 2 + (0.004 * across) ** 2 + 0.7**2
    expected = before[1] + 0.02**2 + np.minimum(
        moved / np.maximum(quad**2, least), 1)
    np.testing.assert_allclose(variance, expected, rtol=1e-5)


def test_mismatch_checks_shapes():
    ones = np.ones((4, 2, 2), np.float32)
    for quad, variance in ((ones, ones[:3]), (ones[:, :1], ones)):
        with pytest.raises(ValueError, match="mismatch:"):
            _kernels.mismatch(quad.copy(), 0, 0, 0, 0, variance.copy())


def test_sigmas_of_reconciled_images_agree_with_their_scatter():
    rng = np.random.default_rng(3)
    angle = np.linspace(0, 3, 6).reshape(1, 6)
    axes = np.deg2rad([0, 45, 90, 135]).reshape(4, 1, 1)
    truth = (400 * (1 + 0.5 * np.cos(2 * (angle - axes)))).astype(np.float32)
    sigma = np.array([0.01, 0.04, 0.015, 0.005]).reshape(4, 1, 1)
    variance = np.ascontiguousarray(
        np.broadcast_to(sigma**2, truth.shape), np.float32)
    frame = PolarFrame(truth, variance=variance, reconciled=True)
    frames = []
    for _ in range(4000):
        quad = (truth * np.exp(rng.normal(0, 1, truth.shape) * sigma)).astype("f4")
        _kernels.reconcile(quad, variance, IDEAL)
        frames.append(PolarFrame(quad))
    scatter = np.std([np.sin(2 * (f.aop - frame.aop)) / 2 for f in frames], 0)
    np.testing.assert_allclose(frame.sigma_aop, scatter, rtol=0.05)
    np.testing.assert_allclose(
        frame.sigma_dolp, np.std([f.dolp for f in frames], 0), rtol=0.05)


def test_no_light_stays_no_light():
    quad = np.zeros((4, 1, 1), np.float32)
    _kernels.reconcile(quad, np.ones_like(quad), IDEAL)
    assert not quad.any()


@pytest.mark.parametrize("bad", [
    {"quad": np.ones((3, 2, 2), np.float32)},
    {"variance": np.ones((4, 2, 1), np.float32)},
    {"null": np.ones((4, 1, 2), np.float32)},
])
def test_shapes_are_checked(bad):
    arguments = {"quad": np.ones((4, 2, 2), np.float32),
                 "variance": np.ones((4, 2, 2), np.float32), "null": IDEAL, **bad}
    with pytest.raises(ValueError, match="reconcile:"):
        _kernels.reconcile(**arguments)


@pytest.mark.parametrize("shape", [(2, 2), (3, 5), (26, 34)])
@pytest.mark.parametrize("spread", [(0, 0, 0, 0), (0.02, 0.012, 0.004, 0.7)])
@pytest.mark.parametrize("own_null", [False, True])
def test_one_pass_by_rows_equals_one_step_after_another(shape, spread, own_null):
    rng = np.random.default_rng(4)
    mosaic = rng.uniform(1, 100, shape).astype(np.float32)
    samples = rng.uniform(1e-4, 1e-1, shape).astype(np.float32)
    null = rng.normal(size=(4, *shape)).astype(np.float32) if own_null else IDEAL
    quad = demosaic(mosaic, Layout.PDAVIS, variance=samples)
    variance = demosaic_variance(
        samples, Layout.PDAVIS, valid=np.ones(shape, bool))
    _kernels.mismatch(quad, *spread, variance)
    _kernels.reconcile(quad, variance, null)
    aop, dolp, got_aop, got_dolp = np.full((4, *shape), np.nan, np.float32)
    _kernels.s0_aop_dolp(quad.reshape(4, -1), 1.02, np.empty_like(aop).ravel(),
                         aop.ravel(), dolp.ravel())
    got, got_variance = np.full((2, 4, *shape), np.nan, np.float32)
    middle = shape[0] // 2
    for rows in ((middle, shape[0]), (0, middle)):
        _kernels.bilinear_weighted(
            mosaic, samples, places_of(Layout.PDAVIS), np.array(spread, np.float32),
            null, rows, scratch_rows(2, shape[1]), got, got_variance, 1.02, got_aop,
            got_dolp)
    np.testing.assert_array_equal(got, quad)
    np.testing.assert_array_equal(got_variance, variance)
    np.testing.assert_array_equal(got_aop, aop)
    np.testing.assert_array_equal(got_dolp, dolp)


SMALL = np.ones((3, 4), np.float32)


@pytest.mark.parametrize(("changes", "message"), [
    ({0: np.ones((1, 4), np.float32)}, "sides >= 2"),
    ({1: np.ones((4, 5), np.float32)}, "sides >= 2"),
    ({3: np.ones(2, np.float32)}, "spread"), ({4: IDEAL.repeat(2, 1)}, "null must"),
    ({5: (0, 5)}, "rows"), ({6: np.ones(9, np.float32)}, "scratch"),
    ({2: np.zeros(4, np.intp)}, "permutation"), ({10: SMALL}, "aop and dolp"),
    ({10: np.ones((0, 0), np.float32)}, "aop and dolp"),
    ({10: SMALL, 11: SMALL}, "aop and dolp")])
def test_the_one_pass_checks_what_it_is_handed(changes, message):
    image, planes = np.ones((4, 4), np.float32), np.ones((2, 4, 4, 4), np.float32)
    given = [image, image, places_of(Layout.PDAVIS), np.zeros(4, np.float32), IDEAL,
             (0, 4), scratch_rows(2, 4), *planes, 1.0, image.copy(), image.copy()]
    _kernels.bilinear_weighted(*given)
    for at, value in changes.items():
        given[at] = value
    with pytest.raises(ValueError, match=message):
        _kernels.bilinear_weighted(*given)
