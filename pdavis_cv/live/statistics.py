"""What a session counts."""
from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

__all__ = ["Counter", "Patience", "SessionStats"]

WINDOW_S = 2.0
"""Rates and latencies are those of this time; s."""

MOST_JUMPS = 3
JUMPS_S = 30.0
"""After so many jumps of time within so many seconds a method is taken that costs less:
one may be a burst."""
SETTLING_S = 4.0
"""Jumps up to this time after the first image do not count: the camera is learned then,
at .5, 1, 2 and 4 s, which takes more than what comes later; s of the host's time."""


class Patience:
    """Whether a method has shown that it cannot follow: time jumps again and again."""

    def __init__(self) -> None:
        self._known = 0
        self._first_s: float | None = None
        self._jumped_s: deque[float] = deque(maxlen=MOST_JUMPS)

    def image_at(self, now_s: float) -> None:
        """Note that an image was made."""
        if self._first_s is None:
            self._first_s = now_s

    def spent(self, jumps: int, now_s: float) -> bool:
        """Tell whether a cheaper method is due; then it begins anew.

        Parameters
        ----------
        jumps : int
            How often time has jumped so far.
        now_s : float
            Host's time.
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
    """How a session fares; rates and latencies are of the last 2 s.

    Parameters
    ----------
    state : str
        ``"waiting"`` for the first packet, ``"running"``, ``"ended"``, or ``"failed"``.
    error : str or None
        Why it failed.
    method : str
        The method in use.
    chosen : bool
        False if the method was stated; else it is the best that keeps up.
    events_per_s, images_per_s : float
    latency_ms, latency_p95_ms : float or None
        From the time that an image shows, on the device's clock as the host knows it by
        the smallest delay seen, to when it was made: median and 95 % point.
    queued_packets : int
    queued_ms : float
        Stream time that waits to be fused.
    dropped_events : int
        Left out because fusing was more than 0.5 s behind.
    jumps : int
        How often that was.
    skipped_images : int
        Not made, because the next one was due.
    drift_ppm : float or None
        By how much the device's clock is slower than the host's.
    recorded_events, unrecorded_events : int
    recording : str or None
        File that is written.
    recording_error : str or None
        Why it could not be.
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
    """Sums and values of the last 2 s; threads may share it."""

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
