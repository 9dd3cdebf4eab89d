"""Event noise: leak and noise events that move the sum of a pixel's events."""
from __future__ import annotations

import numpy as np

from pdavis_cv.reconstruct.kalman import NOISE
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of

__all__ = ["fit_event_noise"]

_GRID = (NOISE[1], 0.4, 1.5, 5.0, 15.0)
"""Process noise: variance per second of the sum of a pixel's events, thresholds^2.

From `KalmanFilter`'s default to pixels with 15 noise events per second; a factor of
3.5 between two, since the filter's result changes little within it.
"""


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
        that is at or below `KalmanFilter`'s default.
    """
    candidates = candidates_of([law] * len(_GRID), NOISE)
    candidates["noise_per_s"] = _GRID
    found = sample.innovations(candidates)
    return _GRID[int(np.argmin(found["chi2"] + found["log_variance"]))]
