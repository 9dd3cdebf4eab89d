"""The Kalman method: filter, and pixels that no frame has measured.

For `fuse(method="kalman")` and for programs that feed a filter themselves.
"""
from pdavis_cv.reconstruct.kalman.estimator import KalmanFilter

__all__ = ["KalmanFilter"]
