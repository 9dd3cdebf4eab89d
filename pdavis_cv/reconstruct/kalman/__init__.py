"""The Kalman method: filter, smoother, and pixels that no frame has measured.

For `fuse(method="kalman")` and for programs that feed a filter themselves.
"""
from pdavis_cv.reconstruct.kalman.filter import (
    CALIBRATED_NOISE,
    LOOKAHEAD_US,
    NOISE,
    KalmanFilter,
)

__all__ = ["CALIBRATED_NOISE", "LOOKAHEAD_US", "NOISE", "KalmanFilter"]
