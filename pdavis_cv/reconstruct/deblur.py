"""The event double integral: what a blurred frame was at one time."""
from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv.events import checked_time
from pdavis_cv.reconstruct.base import Estimate
from pdavis_cv.reconstruct.frames import log_samples
from pdavis_cv.reconstruct.kalman import LOOKAHEAD_US, KalmanFilter
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame

__all__ = ["deblur"]


def deblur(
    frame: ApsFrame, events: ArrayLike, *, theta_on: ArrayLike, theta_off: ArrayLike,
    t_us: int | None = None,
) -> Estimate:
    """Take the motion during its exposure out of one frame.

    The frame is the mean of intensity over the exposure, the events say how intensity
    changed, so intensity at one time is the frame over the mean of that change
    relative to then.  Between two events of a pixel the log intensity is taken to go on
    evenly, so less than a threshold is followed too.

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
        When, default the middle of the exposure.

    Returns
    -------
    Estimate
        Natural log of DN per ms, float32 of shape (H, W), its variance as far as the
        frame's noise and the interpolation go, and where the frame was usable.

    Raises
    ------
    ValueError
        If an argument has a wrong shape or order, or events lie outside the frame.

    Notes
    -----
    `KalmanFilter` does the same to each frame and weighs the results; here one frame
    counts alone, with the thresholds as given.  Event-based double integral: Pan et
    al., CVPR 2019.
    """
    if not isinstance(frame, ApsFrame):
        raise TypeError(f"frame must be an ApsFrame, got {type(frame).__name__}")
    events = StreamClock(frame.shape).check_events(events)
    t = frame.mid_us if t_us is None else checked_time("t_us", t_us)
    begin = min(t, int(np.min(frame.column_mid_us)))
    stop = max(t, int(np.max(frame.exposure_end_us)))
    # Read so far ahead that the frame, and the events that it needs, have been seen.
    ahead = stop - begin + LOOKAHEAD_US
    one = KalmanFilter(
        frame.shape, theta_on=theta_on, theta_off=theta_off, mode="offline",
        lookahead_us=ahead, threshold_sigma=0.0, noise=(0.0, 0.0, 0.0))
    split, end = (bisect_right(events["t"], time) for time in (frame.mid_us, t + ahead))
    one.add_events(events[:split])
    one.add_frame(frame)
    one.add_events(events[split:end])
    log, variance, valid = one.read(t)
    return Estimate(log, variance, valid & log_samples(frame)[1])

