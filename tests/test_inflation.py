"""A lag that was wrong makes what thresholds were learned from less certain."""
import math

import numpy as np
import pytest

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.kalman.inflation import inflate_for_lag
from pdavis_cv.reconstruct.model import STATE_DTYPE

SHAPE = (5, 7)
DIM_SHARE = 0.12


def some_states(seed=0):
    rng = np.random.default_rng(seed)
    states = np.zeros(SHAPE, STATE_DTYPE)
    for name, low, high in (
            ("base", 1, 6), ("theta_on", 0.1, 0.3), ("theta_off", 0.1, 0.3),
            ("prior_on", 0.1, 0.3), ("prior_off", 0.1, 0.3), ("var_on", 1e-5, 1e-3),
            ("var_off", 1e-5, 1e-3), ("cov_base_on", -1e-4, 1e-4),
            ("cov_base_off", -1e-4, 1e-4), ("cov_on_off", -1e-5, 1e-5)):
        states[name] = rng.uniform(low, high, SHAPE)
    return states


def inflated(states, sigmas, before, after, moved_us, interval_us):
    """Do the same, plainly."""
    states = states.copy()
    light = np.empty(SHAPE, np.float32)
    _kernels.exp(states["base"].astype(np.float32), light)

    def lag_s(bandwidth):
        hz = bandwidth[0] + bandwidth[1] * DIM_SHARE * light.astype(float)
        return np.divide(1 / math.tau, hz, out=np.zeros(SHAPE), where=hz > 0)

    error = 2 * (1e6 * np.abs(
        lag_s(after) - lag_s(before) + 1e-6 * moved_us)) / interval_us
    for name, each in zip(("on", "off"), sigmas, strict=True):
        sigma, prior = np.broadcast_to(each, SHAPE), states[f"prior_{name}"]
        share = np.divide(error * prior, sigma, where=sigma > 0, out=np.zeros(SHAPE))
        part = np.minimum(share**2, 1)
        kept = np.sqrt(1 - part)
        states[f"theta_{name}"] = prior + kept * (states[f"theta_{name}"] - prior)
        states[f"var_{name}"] = (1 - part) * states[f"var_{name}"] + part * sigma**2
        states[f"cov_base_{name}"] *= kept
        states["cov_on_off"] *= kept
    return states


@pytest.mark.parametrize("sigmas", [
    np.array([0.02, 0.03]), np.array([0.0, 0.03]),
    np.random.default_rng(1).uniform(0.01, 0.04, (2, *SHAPE))], ids=str)
@pytest.mark.parametrize(("before", "after", "moved_us"), [
    ((200.0, 0.0, 1.0), (150.0, 0.0, 0.1), 0), ((0.0, 3.0), (10.0, 2.0), 0),
    ((0.0, 0.0), (0.0, 0.0), 700), ((0.0, 0.0), (0.0, 0.01), -20)], ids=str)
def test_the_kernel_equals_numpy(sigmas, before, after, moved_us):
    states = some_states()
    expected = inflated(states, sigmas, before, after, moved_us, 40_000)
    inflate_for_lag(states, sigmas, before, after, moved_us, 40_000)
    np.testing.assert_array_equal(states, expected)


def test_an_error_of_the_whole_interval_leaves_the_prior():
    """2 dt / T = 100 times the prior's relative spread: nothing learned is kept."""
    states = some_states()
    inflate_for_lag(
        states, np.array([0.02, 0.02]), (0.0, 0.0), (0.0, 0.0), 200_000, 20_000)
    for name in ("on", "off"):
        np.testing.assert_array_equal(states[f"theta_{name}"], states[f"prior_{name}"])
        np.testing.assert_allclose(states[f"var_{name}"], 0.02**2)
        assert not states[f"cov_base_{name}"].any()
    assert not states["cov_on_off"].any()


def test_an_unchanged_lag_changes_nothing():
    states = some_states()
    before = states.copy()
    inflate_for_lag(states, np.array([0.02, 0.03]), (5.0, 2.0), (5.0, 2.0), 0, 40_000)
    for name in STATE_DTYPE.names:
        np.testing.assert_allclose(states[name], before[name], rtol=1e-14)


def test_what_does_not_fit_is_refused():
    states, lags = some_states(), ((0.0, 1.0), (0.0, 2.0), DIM_SHARE, 0, 40_000)
    with pytest.raises(ValueError, match=r"sigmas must be \(2, h, w\)"):
        _kernels.kalman_inflate(states, np.ones((2, 5, 6)), lags)
    with pytest.raises(ValueError, match="frames must be apart"):
        _kernels.kalman_inflate(states, np.ones((2, *SHAPE)), (*lags[:4], 0))
