"""Make times increase: drop samples that run backward, and begin new segments.

A jump backward by more than a second starts a new segment, which is moved to follow the
one before it.  After a smaller jump, samples are dropped and counted until time has
caught up.
"""
from __future__ import annotations

import copy
import itertools
import threading
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import FAR

__all__ = ["LOOK_AHEAD", "NEVER", "SEGMENT_US", "Clock", "Marks", "Timeline",
           "possible_range"]

NEVER = -FAR
"""A time before any that a file may hold, us."""
SEGMENT_US = 1_000_000
WRAP_US = 1 << 32
"""Jump backward of a 32-bit microsecond counter that overflows, us."""
LOOK_AHEAD = 3
"""Number of packets that follow from which `possible_range` is found: of three, one may
be damaged."""

# Indices into the state of a Clock.
FILLED, LAST, OFFSET, OUTSIDE, BACKWARD, BEFORE = 0, 1, 2, 3, 4, 6


class Timeline:
    """The segments of one pass over a recording, shared by its streams."""

    def __init__(self) -> None:
        self._moves: list[int] = []
        self.last = NEVER

    def move(self, jump: int, back_us: int) -> int:
        """Return the shift of the times after a jump of one stream.

        Parameters
        ----------
        jump : int
            Number of jumps of this stream before.
        back_us : int
            Size of the jump backward.
        """
        if jump == len(self._moves):
            # A counter of 32 bits cannot fall by several of its periods.
            wraps = abs(back_us - WRAP_US) < SEGMENT_US
            self._moves.append(WRAP_US if wraps else back_us + 1)
        return self._moves[jump]


class Clock:
    """The time of one stream: its last sample, and the shift added to its times.

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
        """Time of the last accepted sample."""
        return int(self.state[1])

    def begin(self) -> None:
        """Reset the counts of accepted and dropped samples."""
        self.state[[FILLED, OUTSIDE, BACKWARD]] = 0
        self.state[BEFORE] = self.last

    def jump(self, t_us: int) -> int:
        """Begin a new segment before a sample at t_us; return its shift."""
        back = self.last - t_us
        move = self._timeline.move(self._jumps, back)
        self._jumps += 1
        # Repeated jumps over the whole range would overflow.
        self.state[2] = min(max(int(self.state[2]) + move, -2 * FAR), 2 * FAR)
        return move

    def order(self, times: NDArray[Any]) -> tuple[NDArray[np.bool_], list[int]]:
        """Shift times in place; return which samples to keep and where segments begin.

        A time ahead of both its neighbours is dropped, and so is one far behind both.

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
        raws = times.tolist()
        for i, raw in enumerate(raws):
            t, later = raw + int(self.state[2]), raws[i + 1:i + 2]
            # As `take` in _check.pxd: time jumps back only if the next one agrees.
            while self.last - t > SEGMENT_US and -FAR < t and (
                    later[0] + int(self.state[2]) < self.last if later
                    else len(raws) == 1):
                t += self.jump(t)
                segments.append(i)
            ahead = bool(later) and t > later[0] + int(self.state[2]) >= self.last
            keep[i] = self.last <= t < FAR and t > -FAR and not ahead
            if keep[i]:
                times[i] = t
                self.state[1] = t
            else:
                self.state[4] += 1
        return keep, segments


class Marks:
    """Positions where reading can resume, with the decoder's state there.

    They serve as index for files in which samples depend on everything before them; the
    first pass makes it.

    Parameters
    ----------
    spacing : int
        Smallest distance of two marks, in the unit of positions.
    """

    def __init__(self, spacing: int) -> None:
        self._spacing = spacing
        self._lock = threading.Lock()
        self._places: list[int] = []
        self._newest: list[int] = []
        self._states: list[Any] = []

    def note(self, place: int, newest_us: int, state: Any) -> None:
        """Add a mark, unless there is one near it.

        Parameters
        ----------
        place : int
            Position, which increases while reading, in each pass the same way.
        newest_us : int
            Latest time of all samples before it.
        state : object
            State from which reading can resume; a copy is stored.
        """
        with self._lock:
            if place < (self._places[-1] if self._places else 0) + self._spacing:
                return
            self._places.append(place)
            self._newest.append(newest_us)
            self._states.append(copy.deepcopy(state))

    def before(self, t_us: int) -> Any:
        """Return a copy of the state of the last mark with no later sample before it.

        None if there is none for the time.
        """
        with self._lock:
            i = bisect_left(self._newest, t_us)
            return copy.deepcopy(self._states[i - 1]) if i else None


def possible_range(
    times: NDArray[np.int64], following: Sequence[NDArray[np.int64]],
    before: int = NEVER,
) -> tuple[int, int]:
    """Return the first and last time that samples of a packet may have.

    They are found from the packets around it, of which some may be damaged too.  A
    packet is doubted if its own times run backward or span more than a segment's
    limit, or if its median does not fit those around it.  Among the packets that are
    left, the border between this one and the next is where the fewest times lie on the
    wrong side.  (NEVER, -NEVER) is returned if a new segment may begin.

    Parameters
    ----------
    times : ndarray of int64, shape (N,)
        At least one.
    following : sequence of ndarray of int64
        Times of the next `LOOK_AHEAD` packets of the stream that have any.
    before : int, optional
        Time of the last sample before; default: there is none.
    """
    ends = [before, *(int(t) for one in (times, *following[:2]) for t in one[[0, -1]])]
    if all(a <= b for a, b in itertools.pairwise(ends)):
        return before, ends[3] if following else -NEVER
    middle = _median(times)
    trusted = [one for one in following if _in_order(one)]
    if not trusted:
        if _in_order(times):
            return before if before <= middle else NEVER, -NEVER
        trusted = list(following)
    later = [one for one in trusted if _median(one) >= before]
    if 2 * len(later) < len(trusted) or not later:
        return NEVER, -NEVER
    medians = [_median(one) for one in later]
    passed = [one for one, its in zip(later, medians, strict=True) if its < middle]
    if len(passed) > 1 and 2 * len(passed) > len(later):
        return before, min(int(one[0]) for one in passed)
    if len(later) == 1 and before == NEVER and _in_order(times) and (
            middle - medians[0] > SEGMENT_US):
        return NEVER, -NEVER
    own = np.unique(times[times >= before])
    own = own[own <= min((its for its in medians if its >= middle),
                         default=medians[0] + SEGMENT_US)]
    # Of each border: own times beyond it, and times of the others that do not reach it.
    wrong = np.arange(len(own), -1, -1)
    wrong[1:] += np.searchsorted(np.unique(np.concatenate(later)), own)
    best = len(own) - int(np.argmin(wrong[::-1]))
    return before, int(own[best - 1]) if best else before - 1


def _in_order(times: NDArray[np.int64]) -> bool:
    return bool(np.all(times[1:] >= times[:-1])) and (
        int(times[-1]) - int(times[0]) <= SEGMENT_US)


def _median(times: NDArray[np.int64]) -> int:
    """Return a median that is one of the times."""
    return int(np.sort(times)[len(times) // 2])
