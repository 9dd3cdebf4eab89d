"""Event-based double integral: the sharp image at one time from a blurred frame."""
from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv.events import checked_time
from pdavis_cv.reconstruct.base import Estimate
from pdavis_cv.reconstruct.frames import log_samples
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame

__all__ = ["deblur"]

_WAIT_US = 50_000
"""How long events after the exposure, or after the time of the estimate, count, us."""


def deblur(
    frame: ApsFrame, events: ArrayLike, *, theta_on: ArrayLike, theta_off: ArrayLike,
    t_us: int | None = None,
) -> Estimate:
    """Remove the motion blur of one frame.

    The frame is the mean of the intensity over the exposure, and the events give the
    intensity relative to that at t_us; the intensity at t_us is the frame divided by
    the mean of this ratio over the exposure.  Log intensity is interpolated between the
    events of a pixel, which resolves changes below the threshold.

    Parameters
    ----------
    frame : ApsFrame
        Shape (H, W).
    events : ndarray of EVENT_DTYPE, shape (N,)
        In the order of time; those from the exposure's start on, and from ``t_us``
        on if that is earlier.  Those up to 50 ms on either side improve the result.
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    t_us : int, optional
        Time of the estimate; default the middle of the exposure.

    Returns
    -------
    Estimate
        Natural log of DN per ms, float32 of shape (H, W), its variance by noise of the
        frame and interpolation, and where the frame was usable.

    Raises
    ------
    ValueError
        If an argument has a wrong shape or order, or events lie outside the frame.

    Notes
    -----
    `KalmanFilter` does the same to each frame and weights the results; here a single
    frame is used, with the given thresholds.  Event-based double integral: Pan et al.,
    CVPR 2019.
    """
    if not isinstance(frame, ApsFrame):
        raise TypeError(f"frame must be an ApsFrame, got {type(frame).__name__}")
    events = StreamClock(frame.shape).check_events(events)
    t = frame.mid_us if t_us is None else checked_time("t_us", t_us)
    begin = min(t, int(np.min(frame.column_mid_us)))
    stop = max(t, int(np.max(frame.exposure_end_us)))
    # Long enough that the frame, and the events that it needs, are used before a read.
    ahead = stop - begin + _WAIT_US
    one = KalmanFilter(
        frame.shape, theta_on=theta_on, theta_off=theta_off, mode="offline",
        lookahead_us=ahead)
    split, end = (bisect_right(events["t"], time) for time in (frame.mid_us, t + ahead))
    one.add_events(events[:split])
    one.add_frame(frame)
    one.add_events(events[split:end])
    log, variance, valid = one.read(t)
    return Estimate(log, variance, valid & log_samples(frame)[1])

