import numpy as np
import pytest

from pdavis_cv import _kernels
from pdavis_cv.analyser import Analyser
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
