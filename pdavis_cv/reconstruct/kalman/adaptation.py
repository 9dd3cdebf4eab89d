"""What the filter learns of noise from its own innovations, frame by frame."""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.kalman.event_noise import MOTION, event_noise
from pdavis_cv.reconstruct.kalman.frame_noise import frame_noise
from pdavis_cv.reconstruct.kalman.threshold_drift import (
    drift_product,
    drift_variance,
    frame_drift,
)

__all__ = ["ADAPT_FRAMES", "DOUBT", "KEPT", "MISFIT", "SUMS", "adapt"]

DOUBT = (0.5, 50.0)
"""Prior probability that an event of a pixel at rest is noise, and how many such events
it counts for beside those that frames confirm or deny.  Engineering choice: even."""
ADAPT_FRAMES = 20.0
"""Frames for which the innovations that tell of noise are remembered, by 1/e;
engineering choice, a second of the paper's cameras."""

# Sums over samples that kalman_frame collects, terms in _measure.h, the first three
# being `KalmanFilter.misfit`; beside them, sums over frames of what they say of motion
# and events, and of the thresholds' drift.  Last what the frame before said of that.
SUMS, MISFIT, _OF_EVENTS, _OF_DRIFT, _LAST = 20, 3, 5, 2, 5
KEPT = SUMS + _OF_EVENTS + _OF_DRIFT + _LAST
# Where what is remembered of the first, doubted events, ends, and what follows: of
# motion and events, noise of frames, and drift, by one frame; then sums over frames.
_ENDS = 2, 7, 12, 17, 22


def adapt(
    innovations: NDArray[np.float64], tuning: NDArray[Any], per_event: float,
) -> None:
    """Take the noise of events, motion and reads for what innovations say it is.

    Parameters
    ----------
    innovations : ndarray of float64, shape (KEPT,)
        Sums, a frame's added; in place, what is older counts for less.
    tuning : ndarray of TUNING_DTYPE, shape (1,)
        Changed in place.
    per_event : float
        Variance of the sum of events per event that is stated, thresholds^2.
    """
    kept, before = np.split(innovations[MISFIT:], [-_LAST])
    (denied, doubted), frame, normal, drift, frames, drifts = np.split(kept, _ENDS)
    share, weight = DOUBT
    tuning["doubt"] = (share * weight + denied) / (weight + doubted)
    # By least squares in each frame, and no frame outweighs the others: the first
    # ones come before thresholds and bandwidth are known.
    least = 2 / MOTION[1]**2     # the variance of e^2 / v is 2
    frames += frame / (frame[2] + least)
    tuning["motion_variance"], tuning["noise_per_event"] = event_noise(
        frames.tolist(), per_event)
    tuning["read_variance"], tuning["shot_variance"] = frame_noise(normal.tolist())
    now = frame_drift(drift.tolist())
    drifts += drift_product(now, before.tolist())
    tuning["threshold_drift"] = drift_variance(drifts.tolist())
    before[:], frame[:], drift[:] = now, 0, 0
    kept *= math.exp(-1 / ADAPT_FRAMES)
