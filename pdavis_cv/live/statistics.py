"""Statistics of a live session."""
from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

WINDOW_S = 2.0
"""Window of rates and latencies, s."""

MOST_JUMPS = 3
JUMPS_S = 30.0
"""This many jumps of time within so many seconds (`JUMPS_S`) make a session change to a
cheaper method; a single jump may be due to a burst of events."""
SETTLING_S = 4.0
"""Jumps up to this host time after the first image do not count, s: the camera's
parameters are estimated six times until then, which costs more than later."""


class Patience:
    """Decides whether a method is too slow, by the jumps of time."""

    def __init__(self) -> None:
        self._known = 0
        self._first_s: float | None = None
        self._jumped_s: deque[float] = deque(maxlen=MOST_JUMPS)

    def image_at(self, now_s: float) -> None:
        """Note that an image was made."""
        if self._first_s is None:
            self._first_s = now_s

    def spent(self, jumps: int, now_s: float) -> bool:
        """Tell whether to change to a cheaper method; if so, counting restarts.

        `jumps` is the number of jumps of time so far, `now_s` the host's time, s.
        """
        new, self._known = jumps - self._known, jumps
        if self._first_s is None or now_s - self._first_s < SETTLING_S:
            return False
        self._jumped_s.extend([now_s] * new)
        if len(self._jumped_s) < MOST_JUMPS or now_s - self._jumped_s[0] > JUMPS_S:
            return False
        self._jumped_s.clear()
        return True


@dataclass(frozen=True, kw_only=True)
class SessionStats:
    """Statistics of a session; rates and latencies are those of the last 2 s.

    Parameters
    ----------
    state : str
        ``"waiting"`` for the first packet, ``"running"``, ``"ended"``, or ``"failed"``.
    error : str or None
        Reason of a failure.
    method : str
        The method in use.
    chosen : bool
        True if the session chose the method; False if the caller stated it.
    events_per_s, images_per_s : float
        Events that arrived, and images that were made, per second.
    latency_ms, latency_p95_ms : float or None
        Time from the instant that an image shows until it was made: median and 95 %
        point.  The device's clock is related to the host's by the smallest delay seen.
    queued_packets : int
        Packets that wait to be fused.
    queued_ms : float
        Stream time that waits to be fused.
    dropped_events : int
        Events dropped because fusing was more than 0.5 s late.
    jumps : int
        Number of times that events were dropped.
    skipped_images : int
        Images that were skipped because the next one was due.
    drift_ppm : float or None
        Rate by which the device's clock is slower than the host's.
    recorded_events, unrecorded_events : int
        Events written to the recording, and events that could not be written.
    recording : str or None
        File that is being written.
    recording_error : str or None
        Reason why recording failed.
    """

    state: str
    error: str | None
    method: str
    chosen: bool
    events_per_s: float
    images_per_s: float
    latency_ms: float | None
    latency_p95_ms: float | None
    queued_packets: int
    queued_ms: float
    dropped_events: int
    jumps: int
    skipped_images: int
    drift_ppm: float | None
    recorded_events: int
    unrecorded_events: int
    recording: str | None
    recording_error: str | None


class Counter:
    """Values of the last 2 s, and their rate and quantiles; threads may share it."""

    def __init__(self) -> None:
        self._values: deque[tuple[float, float]] = deque()
        self._lock = threading.Lock()

    def add(self, value: float) -> None:
        """Note a value now."""
        now = time.monotonic()
        with self._lock:
            self._values.append((now, value))
            self._forget(now)

    def _forget(self, now: float) -> None:
        while self._values and now - self._values[0][0] > WINDOW_S:
            self._values.popleft()

    def _recent(self) -> list[tuple[float, float]]:
        with self._lock:
            self._forget(time.monotonic())
            return list(self._values)

    def rate(self) -> float:
        """Return the sum of the values per second."""
        recent = self._recent()
        if not recent:
            return 0.0
        passed = max(time.monotonic() - recent[0][0], 1e-3)
        return sum(value for _, value in recent) / passed

    def quantile(self, part: float) -> float | None:
        """Return a quantile of the values, None if there is none."""
        recent = self._recent()
        return float(np.quantile([v for _, v in recent], part)) if recent else None
