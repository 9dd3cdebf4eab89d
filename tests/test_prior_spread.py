"""The thresholds' prior is exchanged in what a filter has learned."""
import numpy as np
import pytest

from pdavis_cv import fuse
from pdavis_cv.analysis import Scorer
from pdavis_cv.reconstruct.kalman.lasting_degree import LastingDegree
from pdavis_cv.reconstruct.kalman.prior_spread import change_spread
from pdavis_cv.reconstruct.model import STATE_DTYPE
from pdavis_cv.sensor import THRESHOLD_SIGMA
from pdavis_cv.simulation import Camera, RotatingPolarizer

NOMINAL = (0.16, 0.18)


def learned(spread, shape=(40, 3), seed=4):
    """States that have a prior of this spread and random measurements on top."""
    rng = np.random.default_rng(seed)
    h = rng.normal(size=(*shape, 5, 3))
    information = np.einsum("...ki,...kj", h, h) * 10**rng.uniform(2, 5, (*shape, 1, 1))
    information += np.diag([1e-2, *(1 / np.square(spread))])
    states = np.zeros(shape, STATE_DTYPE)
    states["prior_on"], states["prior_off"] = NOMINAL
    states["base"] = rng.normal(size=shape)
    for name, theta in zip(("on", "off"), NOMINAL, strict=True):
        states[f"theta_{name}"] = theta + 0.01 * rng.normal(size=shape)
    put(states, np.linalg.inv(information))
    return states


def put(states, covariance):
    for i, j, name in ((0, 0, "var_base"), (0, 1, "cov_base_on"), (1, 1, "var_on"),
                       (0, 2, "cov_base_off"), (1, 2, "cov_on_off"), (2, 2, "var_off")):
        states[name] = covariance[..., i, j]


def taken(states):
    """Return mean and covariance."""
    rows = [["var_base", "cov_base_on", "cov_base_off"],
            ["cov_base_on", "var_on", "cov_on_off"],
            ["cov_base_off", "cov_on_off", "var_off"]]
    mean = [states[name] for name in ("base", "theta_on", "theta_off")]
    covariance = [np.stack([states[name] for name in row], -1) for row in rows]
    return np.stack(mean, -1), np.stack(covariance, -2)


@pytest.mark.parametrize(("before", "after"), [
    ((0.035, 0.035), (0.011, 0.012)), ((0.011, 0.012), (0.035, 0.02)),
    ((0.03, 0.01), (0.01, 0.03))])
def test_it_equals_the_information_form(before, after):
    states = learned(before)
    mean, covariance = taken(states)
    change_spread(states, before, after)
    more = np.diag([0, *(1 / np.square(after) - 1 / np.square(before))])
    wanted = np.linalg.inv(np.linalg.inv(covariance) + more)
    prior = np.array([0, *NOMINAL])
    new_mean = np.einsum("...ij,...j", wanted, np.einsum(
        "...ij,...j", np.linalg.inv(covariance), mean) + more @ prior)
    found, spread = taken(states)
    np.testing.assert_allclose(spread, wanted, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found, new_mean, rtol=1e-7, atol=1e-9)
    change_spread(states, after, before)
    np.testing.assert_allclose(taken(states)[0], mean, rtol=1e-6, atol=1e-8)


def test_less_than_nothing_is_not_left():
    """Drift made them less certain than the prior, which a wider one cannot undo."""
    states = learned((0.01, 0.01))
    put(states, np.diag([0.1, 0.02**2, 0.005**2]))
    change_spread(states, (0.01, 0.01), (0.04, 0.04))
    np.testing.assert_array_equal(states["theta_on"], NOMINAL[0])
    np.testing.assert_allclose(states["var_on"], 0.04**2)
    assert (states["var_off"] < 0.02**2).all()
    # The same prior changes nothing, and one without spread fixes them.
    same = learned((0.01, 0.01))
    states = same.copy()
    change_spread(states, (0.01, 0.01), (0.01, 0.01))
    np.testing.assert_array_equal(states, same)
    change_spread(states, (0.01, 0.01), (0.0, 0.01))
    np.testing.assert_array_equal(states["var_on"], 0)
    np.testing.assert_array_equal(states["theta_on"], NOMINAL[0])
    change_spread(states, (0.0, 0.01), (0.03, 0.01))
    np.testing.assert_allclose(states["var_on"], 0.03**2)


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize(("preset", "least", "most"), [
    ("nominal", 0.05, 0.13), ("hard", 0.2, 0.35)])
def test_stated_thresholds_that_hold_are_known_as_well_as_chip_and_scale(
        preset, least, most, causal):
    recording, _ = Camera.preset(preset, seed=12, size=(12, 12)).record(
        RotatingPolarizer(rpm=202.6, start_angle=0.4), 1.2)
    image, = fuse(recording, method="kalman", causal=causal, times_us=[1_150_000],
                  nominal_thresholds=NOMINAL, demosaic="superpixel")
    parameters = image.provenance["parameters"]
    np.testing.assert_array_equal(parameters["theta_on"], np.float32(NOMINAL[0]))
    relative = np.mean(parameters["threshold_sigma"][0] / NOMINAL[0])
    assert least < relative < most
    told, = fuse(recording, method="kalman", causal=causal, times_us=[1_150_000],
                 nominal_thresholds=NOMINAL, demosaic="superpixel",
                 threshold_sigma=THRESHOLD_SIGMA)
    assert np.all(told.provenance["parameters"]["threshold_sigma"] == THRESHOLD_SIGMA)


def unweighed(degree, log, variance, valid, workers, out=None):
    """Leave each image its own degree."""
    if out is not None:
        np.copyto(out, log)


@pytest.mark.gate
def test_live_what_wrong_stamps_taught_the_thresholds_is_soon_replaced(monkeypatch):
    """At 30 RPM and frames 10 ms early: DoLP of each image by itself."""
    monkeypatch.setattr(LastingDegree, "weigh", unweighed)
    errors = {"learned": [], "of any scale": []}
    for seed in (14, 15, 16):
        recording, truth = Camera.preset(
            "nominal", seed=seed, size=(12, 12), faults={"frame_offset_us": -10_000},
        ).record(RotatingPolarizer(rpm=30.4, start_angle=0.3 * seed), 1.5)
        for name, told in zip(
                errors, ({}, {"threshold_sigma": THRESHOLD_SIGMA}), strict=True):
            scorer = Scorer(truth, (6, 6))
            for image in fuse(recording, causal=True, method="kalman",
                              nominal_thresholds=NOMINAL, demosaic="superpixel",
                              times_us=range(1_000_000, 1_440_000, 10_007), **told):
                scorer.add(image)
            errors[name].append(scorer.score.dolp_error)
    learned, before = (np.mean(each) for each in errors.values())
    assert learned < 0.0168
    assert learned < 0.95 * before
