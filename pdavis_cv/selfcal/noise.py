"""Event noise: process noise of the sum of events due to leak and noise events."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.kalman.threshold_drift import DRIFT
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of

__all__ = ["FRAME_SIGMAS", "fit_event_noise"]

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

FRAME_SIGMAS = (_NOISE[0], 0.05, 0.1, 0.2)
"""Residual errors of de-blurring (ln) that are told from noise of events, up to one
that hides a threshold.  Engineering choice: factors of 2 to 2.5, over which the noise
found changes by less than a step of its grid."""

_EVIDENCE = 40.0
"""Fall of -ln L required to assume that thresholds drift, as for their common scale."""


def fit_event_noise(
    sample: PixelSample, law: tuple[float, float],
    frame_sigmas: Sequence[float] = FRAME_SIGMAS[:1],
) -> float:
    """Return the process noise at which the innovations are likeliest.

    A drift of the thresholds changes sums of events as noise does, but consistently
    from frame to frame.  So if noise is found, a drift as large as `KalmanFilter`'s
    prior is tried too, and used if it is significantly likelier.  Errors of de-blurring
    have nothing in common from frame to frame, while noise of events lasts.

    Parameters
    ----------
    sample : PixelSample
    law : (float, float)
        Bandwidth: hz, hz_per_intensity.
    frame_sigmas : sequence of float
        Errors of de-blurring (ln) of which the likeliest is assumed; the least first.

    Returns
    -------
    float
        Variance per second, thresholds^2, from a grid whose least value also stands
        for less noise.
    """
    # More noise of frames leaves less for events: if none is found, this is the result.
    costs = _costs(sample, law, 0.0, frame_sigmas[:1])
    if np.argmin(costs):
        costs = _costs(sample, law, 0.0, frame_sigmas)
        drifting = _costs(sample, law, DRIFT**2, frame_sigmas)
        if costs.min() - drifting.min() > 2 * _EVIDENCE:
            costs = drifting
    return _GRID[int(np.argmin(costs))]


def _costs(
    sample: PixelSample, law: tuple[float, float], drift: float,
    frame_sigmas: Sequence[float],
) -> NDArray[np.float64]:
    """Return the least -2 ln L of each value of the grid, up to a constant."""
    shape = len(_GRID), len(frame_sigmas)
    candidates = candidates_of([law] * (shape[0] * shape[1]), _NOISE)
    candidates["noise_per_s"] = np.repeat(_GRID, shape[1])
    candidates["frame_sigma"] = np.tile(frame_sigmas, shape[0])
    candidates["drift"] = drift
    found = sample.innovations(candidates)
    costs = found["chi2"] + found["log_variance"]
    return np.asarray(costs.reshape(shape).min(1))
