"""Adaptive noise estimation: the filter fits its noise to its own innovations."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Records
from pdavis_cv.reconstruct.kalman.event_noise import MOTION, event_noise
from pdavis_cv.reconstruct.kalman.frame_noise import frame_noise
from pdavis_cv.reconstruct.kalman.threshold_drift import (
    drift_product,
    drift_variance,
    frame_drift,
)

__all__ = ["ADAPT_FRAMES", "KEPT", "MISFIT", "SUMS", "adapt"]

P_NOISE = (0.5, 50.0)
"""Prior probability that an event of a pixel at rest is noise, and its weight, that of
as many events that frames have tested.  Engineering choice: even odds."""
ADAPT_FRAMES = 20.0
"""Memory of the innovation statistics: their weight decays by 1/e in so many frames.
Engineering choice: a second of the paper's cameras."""

# Layout of the array of statistics.  First come the sums over samples that kalman_frame
# collects (terms in _measure.h), of which the first three are `KalmanFilter.misfit`;
# then sums over frames for motion and events, and for the drift of the thresholds;
# last the drift found in the frame before.
SUMS, MISFIT, _OF_EVENTS, _OF_DRIFT, _LAST = 20, 3, 5, 2, 5
KEPT = SUMS + _OF_EVENTS + _OF_DRIFT + _LAST
# Where the remembered statistics are split: noise at rest; motion and events, noise
# of frames, and drift of the present frame; then motion and events, and drift, summed
# over frames.
_ENDS = 2, 7, 12, 17, 22


def adapt(
    innovations: NDArray[np.float64], tuning: Records, per_event: float,
) -> None:
    """Re-estimate the noise of events, motion and frames from the innovations.

    Parameters
    ----------
    innovations : ndarray of float64, shape (KEPT,)
        Innovation statistics, those of the present frame included; older ones are
        discounted in place.
    tuning : ndarray of TUNING_DTYPE, shape (1,)
        Receives the estimates.
    per_event : float
        Stated process noise per event, thresholds^2: the lower bound of its estimate.
    """
    kept, before = np.split(innovations[MISFIT:], [-_LAST])
    noise, frame, normal, drift, frames, drifts = np.split(kept, _ENDS)
    (noise_count, noise_weight), (share, weight) = noise, P_NOISE
    tuning["p_noise"] = (share * weight + noise_count) / (weight + noise_weight)
    # Each frame's normal equations are scaled to a weight of at most 1: the first
    # frames, before thresholds and bandwidth are known, must not outweigh the rest.
    least = 2 / MOTION[1]**2     # e^2 / v of a Gaussian innovation has variance 2
    frames += frame / (frame[2] + least)
    tuning["motion_variance"], tuning["noise_per_event"] = event_noise(
        frames.tolist(), per_event)
    tuning["read_variance"], tuning["shot_variance"] = frame_noise(normal.tolist())
    now = frame_drift(drift.tolist())
    drifts += drift_product(now, before.tolist())
    tuning["threshold_drift"] = drift_variance(drifts.tolist())
    before[:], frame[:], drift[:] = now, 0, 0
    kept *= math.exp(-1 / ADAPT_FRAMES)
