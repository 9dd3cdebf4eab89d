"""Event noise: process noise of the sum of events due to leak and noise events."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.kalman.threshold_drift import DRIFT
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of

__all__ = ["fit_event_noise"]

LEAST_NOISE = 0.1
"""Least value of the grid, thresholds^2 per second; it also stands for less noise."""

_GRID = (LEAST_NOISE, 0.4, 1.5, 5.0, 15.0)
"""Process noise: variance per second of the sum of a pixel's events, thresholds^2.

From leak alone to pixels with 15 noise events per second, in factors of 3.5, within
which the filter's result changes little.
"""

_NOISE = (0.02, LEAST_NOISE, 0.0003)
"""Noise of the candidates, as `FILTER_NOISE`: of frames (ln units), and of events per
second and per event (thresholds^2).  The values lie between those of `KalmanFilter` and
the larger ones of `FILTER_NOISE`."""


_EVIDENCE = 40.0
"""Fall of -ln L required to assume that thresholds drift, as for their common scale."""


def fit_event_noise(sample: PixelSample, law: tuple[float, float]) -> float:
    """Return the process noise at which the innovations are likeliest.

    A drift of the thresholds changes sums of events as noise does, but consistently
    from frame to frame.  So if noise is found, a drift as large as `KalmanFilter`'s
    prior is tried too, and used if it is significantly likelier.

    Parameters
    ----------
    sample : PixelSample
    law : (float, float)
        Bandwidth: hz, hz_per_intensity.

    Returns
    -------
    float
        Variance per second, thresholds^2, from a grid whose least value also stands
        for less noise.
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
    """Return -2 ln L of each value of the grid, up to a constant."""
    candidates = candidates_of([law] * len(_GRID), _NOISE)
    candidates["noise_per_s"], candidates["drift"] = _GRID, drift
    found = sample.innovations(candidates)
    return np.asarray(found["chi2"] + found["log_variance"])
