"""Bandwidth of the photoreceptors: the law, its combination, its estimation."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.selfcal.pixel_sample import PixelSample
from pdavis_cv.selfcal.priors import USUAL_BANDWIDTH

__all__ = ["Bandwidth", "combine_bandwidths", "fit_bandwidth"]


@dataclass(frozen=True)
class Bandwidth:
    """Corner frequency of the photoreceptors: ``hz + hz_per_intensity * I``.

    Parameters
    ----------
    hz : float
        Part that does not depend on the light.
    hz_per_intensity : float
        Part in proportion to the intensity I, Hz per DN/ms.
    at_intensity : float
        Intensity in DN/ms at which the sum is known best: a tenth of a bright pixel's,
        since log intensity changes fastest where the light is dim.
    sigma : float
        Standard deviation of the ln of the corner frequency there.
    """

    hz: float
    hz_per_intensity: float
    at_intensity: float
    sigma: float

    @property
    def law(self) -> tuple[float, float]:
        """(hz, hz_per_intensity), what `KalmanFilter` takes."""
        return self.hz, self.hz_per_intensity


_MAX_SIGMAS_APART = 3.0
"""Beyond so many standard deviations the bias currents are assumed to have been changed
since the calibration, whose bandwidth is then ignored."""


def combine_bandwidths(stated: Sequence[float], found: Bandwidth) -> Bandwidth:
    """Combine what a calibration states with what a recording tells.

    The inverse-variance mean of the ln of both corner frequencies; the share that is in
    proportion to the light is taken from the one with the smaller variance.  If they
    differ by more than 3 standard deviations, the recording alone counts.

    Parameters
    ----------
    stated : (hz, hz_per_intensity, sigma)
    found : Bandwidth

    Returns
    -------
    Bandwidth
    """
    hz, slope, sigma = stated
    at = found.at_intensity
    there = found.hz + found.hz_per_intensity * at
    if not (hz + slope * at > 0 and there > 0):
        return found
    difference = math.log((hz + slope * at) / there)
    both = math.hypot(sigma, found.sigma)
    if abs(difference) > _MAX_SIGMAS_APART * both or both == 0:
        return found
    weight = (found.sigma / both) ** 2  # of what is stated
    best = found
    if sigma < found.sigma:
        best = Bandwidth(hz, slope, at, sigma)
        difference, weight = -difference, 1 - weight
    factor = math.exp(weight * difference)
    return replace(
        best, hz=best.hz * factor, hz_per_intensity=best.hz_per_intensity * factor,
        sigma=sigma * found.sigma / both)


_LN_HZ, _LN_HZ_SIGMA = math.log(USUAL_BANDWIDTH[0]), USUAL_BANDWIDTH[2]

_GRID_HZ = (30.0, 80.0, 160.0, 300.0, 600.0, 2000.0)
"""Corner frequencies at which the likelihood is first evaluated, Hz."""

# Standard deviation of the ln: inflation over the curvature of -ln L, and relative
# error of the model itself.
_CURVATURE_INFLATION, _MODEL_SIGMA = 1.2, 0.016

# Bias where the light turns: interpolation over the gap between two events looks like
# a lag of dt = 0.3 ms * (72 Hz / r)^4, r = events per second and pixel.
_TURN_LAG_S, _TURN_RATE_HZ, _TURN_POWER = 0.3e-3, 72.0, 4

_LAW_EVIDENCE = 20.0
"""By how much -ln L must fall for a bandwidth in proportion to the light to be
preferred to a constant one.  A fan's steps alone give up to 18; pixels that do follow,
at least 37 except in the dimmest light."""

_CONSTANT_CHANCE = 500.0
"""A constant bandwidth whose -ln L on the grid is larger by more is not refined."""


def fit_bandwidth(sample: PixelSample) -> Bandwidth:
    """Return the bandwidth at which the innovations are likeliest.

    Parameters
    ----------
    sample : PixelSample

    Returns
    -------
    Bandwidth
    """
    from scipy.optimize import minimize, minimize_scalar  # slow to load

    leakless = sample.with_leak_in_frames()

    def cost(point: NDArray[np.float64]) -> float:
        """Return -ln L of (ln hz, share in proportion to the light)."""
        prior = ((point[0] - _LN_HZ) / _LN_HZ_SIGMA) ** 2
        chi, log, n = leakless.innovations(_law(point, sample.bright))
        # L is maximised over a common factor of all variances: at high speed they are
        # stated tens of times too large, and sum ln v would decide instead of the fit.
        return 0.5 * float(n * np.log(max(chi / max(n, 1), 1e-9)) + log + prior)

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
    if found.x[1] > 0 and near < found.fun + _CONSTANT_CHANCE:
        # A law is applied beyond the light that told it, as where frames saturate:
        # without evidence for one the bandwidth is constant.
        constant = minimize_scalar(
            lambda at: cost(np.array([at, 0.0])), method="bounded",
            bounds=(ln_hz - 0.3, ln_hz + 0.3), options={"maxiter": 10})
        if constant.fun < found.fun + _LAW_EVIDENCE:
            found.x, found.fun = np.array([constant.x, 0.0]), constant.fun
    hz, slope = _law(found.x, sample.bright)
    step = np.array([0.1, 0.0])
    bend = (cost(found.x + step) + cost(found.x - step) - 2 * found.fun) / 0.1**2
    curvature_sigma = 1 / np.sqrt(max(bend, 1 / _LN_HZ_SIGMA**2))
    at = 0.1 * sample.bright
    lag_s = _TURN_LAG_S * (_TURN_RATE_HZ / max(sample.events_per_s, 1.0)) ** _TURN_POWER
    sigma = math.hypot(_CURVATURE_INFLATION * curvature_sigma, _MODEL_SIGMA,
                       2 * np.pi * (hz + slope * at) * lag_s)
    return Bandwidth(hz, slope, at, min(sigma, _LN_HZ_SIGMA))


def vertex(x: NDArray[np.float64], y: Sequence[float]) -> float:
    """Return where the parabola through the least y and its neighbours is least."""
    at = int(np.clip(np.argmin(y), 1, len(y) - 2))
    near = slice(at - 1, at + 2)
    bend, slope, _ = np.polyfit(x[near] - x[at], y[near], 2)
    by = -slope / (2 * bend) if bend > 0 else 0.0
    return float(x[at] + np.clip(by, x[at - 1] - x[at], x[at + 1] - x[at]))


def _law(point: NDArray[np.float64], bright: float) -> tuple[float, float]:
    hz, share = float(np.exp(point[0])), float(np.clip(point[1], 0, 1))
    return hz * (1 - share), hz * share / bright
