"""Time of the streams of a recording: order, outliers, and segments.

A time is accepted on the evidence of those around it.  Where time falls, the fewest
samples are dropped that leave the others in order.  Where it falls by more than a
second and most of the samples that follow agree, a new segment begins, which is moved
to follow the one before.  After a smaller fall, samples are dropped and counted until
time has caught up.
"""
from __future__ import annotations

import copy
import itertools
from _thread import allocate_lock  # threading is slow to import
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE, FAR
from pdavis_cv.recording.base import joined
from pdavis_cv.recording.scratch import Scratch, copy_rows

NEVER = -FAR
"""A time before any that a file may hold, us."""
EARLIEST = -(1 << 55)
"""Times before this are damage, us, as in the kernel."""
SEGMENT_US = 1_000_000
WRAP_US = 1 << 32
"""Jump backward of a 32-bit microsecond counter that overflows, us."""
LOOK_AHEAD = 3
"""Number of packets that follow from which `possible_range` is found: of three, one may
be damaged."""
REACH, HELD = 8, 64
"""Events after one that decide on it, and events before it that may still be dropped,
as in the kernel."""

# Indices into the state of a Clock.
FILLED, LAST, OFFSET, OUTSIDE, BACKWARD, ORDERED, BEFORE = range(7)


class SegmentError(Exception):
    """Raised where a segment begins in a stream that is read without the others."""


class Timeline:
    """The segments of one pass over a recording, shared by its streams.

    `alone` tells that one of several streams is read: the shift of a segment depends on
    all.  A counter of 32 bits in the file has overflowed if it falls by more than half
    of its range, others only if they fall by 2**32 us.
    """

    def __init__(self, *, alone: bool = False, bits: int = 64) -> None:
        self._moves: list[int] = []
        self._alone = alone
        self._near = WRAP_US // 2 if bits == 32 else SEGMENT_US

    def move(self, jump: int, back_us: int) -> int:
        """Return the shift of the times after a stream's next jump, by `back_us`."""
        if self._alone:
            raise SegmentError
        if jump == len(self._moves):
            # A counter of 32 bits cannot fall by several of its periods.
            wraps = abs(back_us - WRAP_US) < self._near
            self._moves.append(WRAP_US if wraps else back_us + 1)
        return self._moves[jump]


class Clock:
    """The time of one stream: which samples are in order, and the shift of their times.

    The last samples are held back until those that follow decide on them.

    Parameters
    ----------
    timeline : Timeline, optional
        Segments of the recording; default: there are none, times only increase.
    last : int
        Time before the first sample.
    reach, held : int
        How many samples after one decide on it, and how many before it may be dropped.

    Attributes
    ----------
    state : ndarray of int64, shape (7,)
        As in ``_kernels/_check.pxd``: filled, last, offset, outside, backward,
        ordered, before.
    jumps : int
        Number of segments that began.
    """

    def __init__(self, timeline: Timeline | None, last: int = NEVER, *,
                 reach: int = REACH, held: int = HELD) -> None:
        self._timeline, self._reach, self._most_held = timeline, reach, held
        self.jumps = 0
        self.state = np.array([0, last, 0, 0, 0, -1, last], np.int64)
        self._held: NDArray[Any] | None = None
        self._accepted = self._offset_before = 0

    @property
    def last(self) -> int:
        """Time of the last sample that was returned; no later one is before it."""
        return int(self.state[BEFORE])

    @property
    def offset(self) -> int:
        """What is added to times of the file now."""
        return int(self.state[OFFSET])

    @property
    def begun(self) -> bool:
        """Whether it has seen samples."""
        return self._held is not None

    def overdue(self, t_us: int) -> bool:
        """Return whether samples are held back that other streams will not wait for."""
        held = self._held
        return held is not None and len(held) > 0 and (
            int(held["t"][0]) + (0 if self._accepted else self.offset) < t_us)

    def _jump(self, back_us: int) -> int:
        assert self._timeline is not None
        self.jumps += 1
        return self._timeline.move(self.jumps - 1, back_us)

    def room(self, memory: Scratch, count: int) -> NDArray[Any]:
        """Return memory in which a kernel appends up to count events, for `settled`.

        The counts of dropped events are reset.
        """
        held = 0 if self._held is None else len(self._held)
        out = memory.room(held + count)
        if self._held is not None:
            copy_rows(self._held, out[:held])
            self._held = out[:held]     # what was there may be written over
        state = self.state
        state[FILLED] = state[ORDERED] = held
        state[LAST], state[OUTSIDE], state[BACKWARD] = NEVER, 0, 0
        return out

    def settled(self, out: NDArray[Any], *, final: bool = False) -> NDArray[Any]:
        """Return the events in memory from `room` that are accepted for good.

        `final` says that none follow.
        """
        left, done = self._settle(out, int(self.state[FILLED]), final)
        self._held = out[done:left]
        return out[:done]

    def moved(self, t: NDArray[np.int64], after_us: int) -> NDArray[np.int64]:
        """Return times of another stream of the piece that was settled last.

        They are in the order of the file, after a last sample at `after_us`.
        """
        before = t + self._offset_before
        fallen = np.maximum(np.maximum.accumulate(before), after_us) - before
        return np.where(fallen > SEGMENT_US, t + int(self.state[OFFSET]), before)

    def order(self, samples: NDArray[Any], *, final: bool = False) -> NDArray[Any]:
        """Return the samples that are accepted for good, of those held and the next.

        They have a field t; `final` says that none follow.
        """
        if self._held is not None:
            samples = joined((self._held, samples))
        self.state[OUTSIDE:BEFORE] = 0, 0, -1
        times, last, n = samples["t"].tolist(), self.last, len(samples)
        if n and not self.state[OFFSET] and (   # as usual
                max(last, EARLIEST) <= times[0] and times[-1] < last + SEGMENT_US
                and times == sorted(times)):
            accepted = n if final else max(n - self._reach, self._accepted)
            done = accepted if final else max(accepted - self._most_held, 0)
            self._accepted = accepted - done
            for place, count in ((LAST, accepted), (BEFORE, done)):
                if count:
                    self.state[place] = times[count - 1]
        else:
            rows = _rows(samples["t"])
            left, done = self._settle(rows, n, final)
            samples = samples[_indices(rows[:left])]
            samples["t"] = rows["t"][:left]
        self._held = samples[done:]
        return samples[:done]

    def among(self, samples: NDArray[Any], following: Sequence[int]) -> NDArray[Any]:
        """Return the samples that are accepted, given times in the file that follow.

        For streams of which no sample can be held back.
        """
        last, offset, jumps = self.last, int(self.state[OFFSET]), self.jumps
        rows = _rows(np.append(samples["t"], np.asarray(following[:REACH], np.int64)))
        _, done = self._settle(rows, len(rows), True)
        kept = _indices(rows[:done])
        kept = kept[kept < len(samples)]
        times = rows["t"][:len(kept)]
        if not len(kept) or samples["t"][kept[-1]] + offset == times[-1]:
            self.state[OFFSET], self.jumps = offset, jumps    # a segment may follow
        self.state[[LAST, BEFORE]] = times[-1] if len(kept) else last
        self.state[[OUTSIDE, BACKWARD]] = 0, len(samples) - len(kept)
        self._accepted = 0
        samples = samples[kept]
        samples["t"] = times
        return samples

    def _settle(self, rows: NDArray[Any], n: int, final: bool) -> tuple[int, int]:
        """Return how many events are left of n, and how many of these are certain."""
        self._offset_before = int(self.state[OFFSET])
        accepted, left, done = _kernels.settle(
            rows, self._accepted, n, self._reach, self._most_held, final,
            None if self._timeline is None else self._jump, self.state)
        self._accepted = accepted - done
        return left, done


def _rows(times: NDArray[np.int64]) -> NDArray[Any]:
    """Return rows for the kernel, with the index in place of an event's pixel."""
    rows, index = np.empty(len(times), EVENT_DTYPE), np.arange(len(times))
    rows["t"], rows["x"], rows["y"] = times, index & 0xFFFF, index >> 16
    return rows


def _indices(rows: NDArray[Any]) -> NDArray[np.int64]:
    found: NDArray[np.int64] = rows["x"] | rows["y"].astype(np.int64) << 16
    return found


class Marks:
    """Positions where reading can resume, with the decoder's state there.

    They serve as index for files in which samples depend on everything before them; the
    first pass makes it.  Two marks lie at least `spacing` apart, in the unit of
    positions.
    """

    def __init__(self, spacing: int) -> None:
        self._spacing = spacing
        self._lock = allocate_lock()
        self._places: list[int] = []
        self._newest: list[int] = []
        self._states: list[Any] = []

    def note(self, place: int, newest_us: int, state: Any) -> None:
        """Add a mark, unless there is one near it.

        The place increases while reading, in each pass the same way; `newest_us` is the
        latest time of all samples before it.  A copy is kept of the state, from which
        reading can resume.
        """
        with self._lock:
            if place < (self._places[-1] if self._places else 0) + self._spacing:
                return
            self._places.append(place)
            self._newest.append(newest_us)
            self._states.append(copy.deepcopy(state))

    def cover(self, start_us: int, stop_us: int) -> None:
        """Let marks inside an interval be of use for later times only."""
        with self._lock:
            self._newest = [stop_us if start_us <= t < stop_us else t
                            for t in self._newest]

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

    They are found from the packets around it, of which some may be damaged too:
    `following` are the times of the next `LOOK_AHEAD` packets of the stream that have
    any, `before` that of the last sample.  A packet is doubted if its own times run
    backward or span more than a segment's limit, or if its median does not fit those
    around it.  Among the packets that are left, the border between this one and the
    next is where the fewest times lie on the wrong side.  (NEVER, -NEVER) is returned
    if a new segment may begin.
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
