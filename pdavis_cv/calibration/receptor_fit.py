"""How fast photoreceptors are and how noisy their events, by what fits frames best."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.calibration.bandwidth import TYPICAL_BANDWIDTH, Bandwidth
from pdavis_cv.calibration.certainty import vertex
from pdavis_cv.calibration.sample import Sample
from pdavis_cv.reconstruct.kalman import NOISE

__all__ = ["USUAL_BANDWIDTH", "fit_bandwidth", "fit_noise"]

USUAL_BANDWIDTH = (TYPICAL_BANDWIDTH[0], 0.0, 1.5)
"""Corner frequency at bright pixels that a DAVIS has at usual biases, and the standard
deviation of its ln."""

# Of images, variance of the sum of events per second: from quiet pixels to noisy ones.
_GRID_NOISE = (NOISE[1], 0.4, 1.5, 5.0, 15.0)
_LN_HZ, _LN_HZ_SIGMA = np.log(USUAL_BANDWIDTH[0]), USUAL_BANDWIDTH[2]
# By how much the misfit's curvature overrates what is known of it, and what is wrong
# with the law.  Measured, as the following is.
_ALIKE, _LAW = 1.2, 0.016
# Where a pixel turns, interpolation over the gap between two events passes for a lag
# of so many seconds, if there are so many events per second; the less, by the power,
# the more there are.
_TURN_S, _TURN_PER_S, _TURN_POWER = 0.3e-3, 72.0, 4
_GRID_HZ = (30.0, 80.0, 160.0, 300.0, 600.0, 2000.0)
# How much likelier, in ln, a bandwidth that follows the light must be than a constant
# one (a fan's steps make it up to 18, pixels that do follow 37 or more, but for the
# dimmest light); and how near a coarse look must come for the constant one to have a
# chance.
_EVIDENCE, _NEAR = 20.0, 500.0


def fit_bandwidth(sample: Sample) -> Bandwidth:
    """Return the bandwidth under which events agree with the frames best."""
    from scipy.optimize import minimize, minimize_scalar  # slow to load

    leaked = sample.with_leak()

    def cost(point: NDArray[np.float64]) -> float:
        prior = ((point[0] - _LN_HZ) / _LN_HZ_SIGMA) ** 2
        chi, log, n = leaked.misfit(_law(point, sample.bright))
        # The scale of the variances, which a fast light overrates by tens, is what
        # makes the innovations likeliest: else sum ln v decides, not what fits.
        return 0.5 * float(n * np.log(max(chi / max(n, 1), 1e-9)) + log + prior)

    # Between the grid's points the misfit may be far less than at them.
    tried: list[tuple[float, NDArray[np.float64]]] = []
    for share in (0.0, 1.0):
        points = [np.array([np.log(hz), share]) for hz in _GRID_HZ]
        tried += (costs := [(cost(point), point) for point in points])
        ln_hz = vertex(np.log(_GRID_HZ), [each for each, _ in costs])
        point = np.array([ln_hz, share])
        tried.append((cost(point), point))
    _, best = min(tried, key=lambda each: each[0])
    toward = np.diag([0.3, 0.3 - 0.6 * best[1]])
    found = minimize(cost, best, method="Nelder-Mead", options={
        "maxfev": 22, "xatol": 0.01, "fatol": 0.1, "initial_simplex": [
            best, best + toward[0], best + toward[1]]})
    near, (ln_hz, _) = min((each for each in tried if each[1][1] == 0),
                           key=lambda each: each[0])
    if found.x[1] > 0 and near < found.fun + _NEAR:
        # A law of the light is followed beyond the light that told it, as where frames
        # saturate: without evidence for it the bandwidth is constant.
        constant = minimize_scalar(
            lambda at: cost(np.array([at, 0.0])), method="bounded",
            bounds=(ln_hz - 0.3, ln_hz + 0.3), options={"maxiter": 10})
        if constant.fun < found.fun + _EVIDENCE:
            found.x, found.fun = np.array([constant.x, 0.0]), constant.fun
    hz, slope = _law(found.x, sample.bright)
    step = np.array([0.1, 0.0])
    bend = (cost(found.x + step) + cost(found.x - step) - 2 * found.fun) / 0.1**2
    sigma = 1 / np.sqrt(max(bend, 1 / _LN_HZ_SIGMA**2))
    at = 0.1 * sample.bright
    seconds = _TURN_S * (_TURN_PER_S / max(sample.per_s, 1.0)) ** _TURN_POWER
    turns = 2 * np.pi * (hz + slope * at) * seconds
    sigma = min(math.hypot(_ALIKE * sigma, _LAW, turns), _LN_HZ_SIGMA)
    return Bandwidth(hz, slope, at, sigma)


def fit_noise(sample: Sample, law: tuple[float, float]) -> float:
    """Return the noise of events under which frames are the most likely."""
    best, least = _GRID_NOISE[0], np.inf
    for each in _GRID_NOISE:
        chi, log, _ = sample.misfit(law, (NOISE[0], each, NOISE[2]))
        if chi + log >= least:
            break
        best, least = each, chi + log
    return best


def _law(point: NDArray[np.float64], bright: float) -> tuple[float, float]:
    hz, share = float(np.exp(point[0])), float(np.clip(point[1], 0, 1))
    return hz * (1 - share), hz * share / bright
