"""Event noise: leak and noise events that move the sum of a pixel's events."""
from __future__ import annotations

import numpy as np

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


def fit_event_noise(sample: PixelSample, law: tuple[float, float]) -> float:
    """Return the process noise at which the innovations are likeliest.

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
    candidates = candidates_of([law] * len(_GRID), _NOISE)
    candidates["noise_per_s"] = _GRID
    found = sample.innovations(candidates)
    return _GRID[int(np.argmin(found["chi2"] + found["log_variance"]))]
