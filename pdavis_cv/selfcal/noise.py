"""Event noise: leak and noise events that move the sum of a pixel's events."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.kalman.threshold_drift import DRIFT
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of

__all__ = ["fit_event_noise"]

LEAST_NOISE = 0.1
"""Least process noise that is told from less, thresholds^2 per second."""

_GRID = (LEAST_NOISE, 0.4, 1.5, 5.0, 15.0)
"""Process noise: variance per second of the sum of a pixel's events, thresholds^2.

From what leak alone makes to pixels with 15 noise events per second; a factor of
3.5 between two, since the filter's result changes little within it.
"""


_NOISE = (0.02, LEAST_NOISE, 0.0003)
"""Of frames, ln units, and of events per second and each, thresholds^2: between those
of `KalmanFilter` and the larger ones of `FILTER_NOISE`."""


_EVIDENCE = 40.0
"""By how much -ln L must fall for thresholds to drift, as for their common scale."""


def fit_event_noise(sample: PixelSample, law: tuple[float, float]) -> float:
    """Return the process noise at which the innovations are likeliest.

    Thresholds that drift move sums as noise does, but from frame to frame alike.  So
    where noise is found, thresholds may also change as much as `KalmanFilter`'s prior
    of their drift is wide, if that is likelier.

    Parameters
    ----------
    sample : PixelSample
    law : (float, float)
        Bandwidth: hz, hz_per_intensity.

    Returns
    -------
    float
        Variance per second, thresholds^2, from a grid whose least value stands for all
        that is less.
    """
    costs = _costs(sample, law, 0.0)
    if np.argmin(costs):
        drifting = _costs(sample, law, DRIFT**2)
        if costs.min() - drifting.min() > 2 * _EVIDENCE:
            costs = drifting
    return _GRID[int(np.argmin(costs))]


def _costs(
    sample: PixelSample, law: tuple[float, float], drift: float
) -> NDArray[np.float64]:
    """Return -2 ln L of each noise of the grid, up to a constant."""
    candidates = candidates_of([law] * len(_GRID), _NOISE)
    candidates["noise_per_s"], candidates["drift"] = _GRID, drift
    found = sample.innovations(candidates)
    return np.asarray(found["chi2"] + found["log_variance"])
