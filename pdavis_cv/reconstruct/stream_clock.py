"""Checks that all methods share: order in time, shape, and their parameters."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import typed
from pdavis_cv._types import Events
from pdavis_cv.events import bad_event, checked_time, timed_events
from pdavis_cv.recording.base import ApsFrame

NEVER = int(np.iinfo(np.int64).min)


class StreamClock:
    """The time up to which a Reconstructor has been fed, and checks of its inputs.

    `last_us` is that of the last event or frame; `NEVER` before the first.
    """

    __slots__ = ("last_us", "shape")

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.last_us = NEVER

    def took(self, events: Events, taken: int) -> None:
        """Record how many events a kernel processed; a ValueError names the next."""
        before = self.last_us
        if taken:
            self.last_us = int(events["t"][taken - 1])
        if taken < len(events):
            raise bad_event(events, taken, self.shape, before)

    def check_events(self, events: Any) -> Events:
        """Check events that the method ignores, and return them.

        A ValueError names one that lies outside the sensor or is late.
        """
        checked = timed_events(events)
        height, width = self.shape
        self.took(checked, _kernels.check_events(checked, self.last_us, height, width))
        return checked

    def check_frame(self, frame: ApsFrame, after_us: int | None = None) -> int:
        """Return the time of a frame, its mid-exposure, and record it.

        It must not lie before `after_us`, the last frame's if frames may be late, by
        default the time of the last event or frame.
        """
        typed("frame", frame, ApsFrame, "an ApsFrame")
        if frame.shape != self.shape:
            raise ValueError(
                f"frame must be {self.shape[1]}x{self.shape[0]}, got "
                f"{frame.shape[1]}x{frame.shape[0]}")
        mid = frame.mid_us
        before = self.last_us if after_us is None else after_us
        if mid < before:
            last = "time seen" if after_us is None else "frame's"
            raise ValueError(
                "frames must be fed in time order, but this one's mid-exposure "
                f"{mid} us lies before the last {last}, {before} us")
        self.last_us = max(self.last_us, mid)
        return mid

    def check_read(self, t_us: int) -> int:
        """Return the time to read at, which must not lie before the last one seen."""
        t = checked_time("t_us", t_us)
        if t < self.last_us:
            raise ValueError(
                f"t_us must not lie before the last time seen, {self.last_us}, "
                f"got {t}")
        return t


def steps(
    theta_on: float | NDArray[np.float64], theta_off: float | NDArray[np.float64],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Return the step of log intensity of each pixel by polarity, (H, W, 2)."""
    off, on = np.broadcast_arrays(np.negative(theta_off), theta_on)
    return np.broadcast_to(np.stack([off, on], axis=-1).astype(np.float32), (*shape, 2))
