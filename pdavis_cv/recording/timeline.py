"""Making time run forward: what is dropped, and where a new segment begins.

Jumps back by more than a second start a new segment, which is moved to follow
the one before it; smaller ones are dropped and counted.
"""
from __future__ import annotations

import copy
import threading
from bisect import bisect_left
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import FAR

__all__ = ["NEVER", "SEGMENT_US", "SPIKE_US", "Clock", "Marks", "Timeline", "spikes"]

NEVER = -FAR
"""Before any time that a file may hold."""
SEGMENT_US = 1_000_000
SPIKE_US = 1_000
WRAP_US = 1 << 32
"""A 32-bit microsecond counter that was not unwrapped jumps back by this."""

# Places in the state of a Clock.
FILLED, LAST, OFFSET, OUTSIDE, BACKWARD, BEFORE = 0, 1, 2, 3, 4, 6


class Timeline:
    """The segments of one pass over a recording, common to its streams."""

    def __init__(self) -> None:
        self._moves: list[int] = []
        self.last = NEVER

    def move(self, jump: int, back_us: int) -> int:
        """Return by how much the times after a stream's jump-th jump are moved.

        Parameters
        ----------
        jump : int
            How many jumps this stream had before.
        back_us : int
            By how much its time fell.
        """
        if jump == len(self._moves):
            wraps = round(back_us / WRAP_US)
            if wraps and abs(back_us - wraps * WRAP_US) < SEGMENT_US:
                self._moves.append(wraps * WRAP_US)
            else:
                self._moves.append(back_us + 1)
        return self._moves[jump]


class Clock:
    """Time of one stream: its last sample, and what is added to the file's times.

    Attributes
    ----------
    state : ndarray of int64, shape (7,)
        As in ``_kernels/_check.pxd``: filled, last, offset, outside, backward,
        first bad, before.
    """

    def __init__(self, timeline: Timeline, last: int = NEVER) -> None:
        self._timeline = timeline
        self._jumps = 0
        self.state = np.array([0, last, 0, 0, 0, -1, last], np.int64)

    @property
    def last(self) -> int:
        """Time of the last sample taken."""
        return int(self.state[1])

    def begin(self) -> None:
        """Begin to count anew what is taken and dropped."""
        self.state[[FILLED, OUTSIDE, BACKWARD]] = 0
        self.state[BEFORE] = self.last

    def jump(self, t_us: int) -> int:
        """Begin a new segment before a sample at t_us; return how far it was moved."""
        back = self.last - t_us
        move = self._timeline.move(self._jumps, back)
        self._jumps += 1
        # Times that jump from one end of their range to the other add up beyond it.
        self.state[2] = min(max(int(self.state[2]) + move, -2 * FAR), 2 * FAR)
        return move

    def order(self, times: NDArray[Any]) -> tuple[NDArray[np.bool_], list[int]]:
        """Move times in place; return which samples to keep and where segments begin.

        Parameters
        ----------
        times : ndarray of int64, shape (N,)
        """
        keep = np.ones(len(times), np.bool_)
        segments: list[int] = []
        if not len(times):
            return keep, segments
        offset = int(self.state[2])
        if (self.last <= int(times[0]) + offset and np.all(times[1:] >= times[:-1])
                and -FAR < int(times[0]) and int(times[-1]) + offset < FAR):
            times += offset
            self.state[1] = times[-1]
            return keep, segments
        for i, raw in enumerate(times.tolist()):
            t = raw + int(self.state[2])
            while self.last - t > SEGMENT_US and -FAR < t:
                t += self.jump(t)
                segments.append(i)
            keep[i] = self.last <= t < FAR and t > -FAR
            if keep[i]:
                times[i] = t
                self.state[1] = t
            else:
                self.state[4] += 1
        return keep, segments


class Marks:
    """Places where reading can begin again, noted as they are passed.

    For files whose samples depend on everything before them: the first pass makes
    the index.

    Parameters
    ----------
    spacing : int
        Least distance between two marks, in the unit of their places.
    """

    def __init__(self, spacing: int) -> None:
        self._spacing = spacing
        self._lock = threading.Lock()
        self._places: list[int] = []
        self._newest: list[int] = []
        self._states: list[Any] = []

    def note(self, place: int, newest_us: int, state: Any) -> None:
        """Note what is known at a place, unless there is a mark near it.

        Parameters
        ----------
        place : int
            Grows while reading, the same way in each pass.
        newest_us : int
            No sample before the place is later.
        state : object
            What reading on needs; a copy is kept.
        """
        with self._lock:
            if place < (self._places[-1] if self._places else 0) + self._spacing:
                return
            self._places.append(place)
            self._newest.append(newest_us)
            self._states.append(copy.deepcopy(state))

    def before(self, t_us: int) -> Any:
        """Return a copy of the last state before which all samples lie before a time.

        None if there is none.
        """
        with self._lock:
            i = bisect_left(self._newest, t_us)
            return copy.deepcopy(self._states[i - 1]) if i else None


def spikes(times: NDArray[np.int64], limit_us: int) -> NDArray[np.bool_]:
    """Return which times, of all but the first and last, a damaged word has made.

    They lie far from both neighbours, on the same side, while those two go on as time
    does.

    Parameters
    ----------
    times : ndarray of int64, shape (N,)
    limit_us : int
        What is far.
    """
    left, here, right = times[:-2], times[1:-1], times[2:]
    found: NDArray[np.bool_] = (right - left > -limit_us) & (
        (np.minimum(here - left, here - right) > limit_us)
        | (np.minimum(left - here, right - here) > limit_us))
    return found
