"""Divide streams of samples into packets with fixed boundaries."""
from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    MAX_PACKET_EVENTS,
    MAX_PACKET_US,
    TRIGGER_DTYPE,
    ApsFrame,
    Packet,
    joined,
)
from pdavis_cv.recording.limits import Budget

END_OF_TIME = 1 << 62
_PIXEL = 5
"""Bytes of a frame's pixel: its DN, and whether it is valid."""
_MOST_KEPT = 64
"""A packet that keeps more than so many times its own memory is copied."""
_SMALL, _TOGETHER = 1 << 14, 32
"""Bytes up to which it takes longer to begin a copy than to make it; so many of them
are copied together."""


@dataclass(slots=True, eq=False)
class Batch:
    """Samples decoded by a reader, each kind in time order.

    Frames are in the order of ``available_us``.  No later batch holds a sample before
    `complete_us`.
    """

    events: NDArray[Any] | None = None
    frames: list[ApsFrame] = field(default_factory=list)
    imu: NDArray[Any] | None = None
    triggers: NDArray[Any] | None = None
    complete_us: int = END_OF_TIME


def cell_start(t_us: int) -> int:
    """Return the start of the 10 ms interval of a time, which no packet crosses."""
    return t_us // MAX_PACKET_US * MAX_PACKET_US


def packetise(
    batches: Iterable[Batch], start_us: int | None = None, stop_us: int | None = None,
    budget: Budget | None = None, *, own: bool = False,
) -> Iterator[Packet]:
    """Divide batches into packets and yield those in start_us <= time < stop_us.

    A packet ends at a multiple of 10 ms, just after a frame, or after 65,536 events,
    whichever comes first.  Batches must hold every sample from ``cell_start(start_us)``
    on, so that boundaries do not depend on the interval.  With `own`, nobody else uses
    the memory of the batches, so that it may become that of packets; else they are
    copies.  Without a budget, nothing is bounded.
    """
    events, imu, triggers = (
        _Queue(dtype, _MOST_KEPT if own else 0)
        for dtype in (EVENT_DTYPE, IMU_DTYPE, TRIGGER_DTYPE))
    queues = (events, imu, triggers)
    frames: deque[ApsFrame] = deque()
    first = -END_OF_TIME if start_us is None else start_us
    end = END_OF_TIME if stop_us is None else stop_us
    begin = first if start_us is None else cell_start(start_us)
    whole = start_us is stop_us is None
    taken, latest = 0, -END_OF_TIME
    for batch in chain(batches, (Batch(),)):
        for queue, samples in zip(
                queues, (batch.events, batch.imu, batch.triggers), strict=True):
            if samples is not None and len(samples):
                queue.put(samples, begin)
                taken += samples.nbytes
        frames.extend(f for f in batch.frames if f.available_us >= begin)
        others = None   # when the next sample comes that is no event
        while True:
            if others is None:
                closing = frames[0].available_us if frames else END_OF_TIME
                others = min(imu.next_us, triggers.next_us, closing)
            while own and events.inside and (parts := events.whole(
                    min(others, batch.complete_us, end, latest))):
                for part in parts:
                    yield Packet(part, (), imu.none, triggers.none)
            at = events.next_us if events.next_us < others else others
            if at >= end:
                break
            until = at - at % MAX_PACKET_US + MAX_PACKET_US
            if until > closing:
                until = closing + 1
            if until > batch.complete_us:
                break
            if at > latest:
                latest = END_OF_TIME if budget is None else budget.time(at)
            part = events.take(until, MAX_PACKET_EVENTS)
            if others >= until:
                packet = Packet(part, (), imu.none, triggers.none)
            else:
                part_end, others = min(events.next_us, until), None
                shut = (frames.popleft(),) if part_end > closing else ()
                packet = Packet(part, shut, imu.take(part_end), triggers.take(part_end))
            if not whole:
                packet = cut(packet, first, end)
            if whole or packet.start_us is not None:
                yield packet
        if batch.complete_us >= end and at >= end:
            return
        if budget is not None:
            budget.total(taken)
            budget.waiting(events.nbytes + imu.nbytes + triggers.nbytes + (
                _PIXEL * len(frames) * math.prod(frames[0].shape) if frames else 0))


def cut(packet: Packet, first: int, end: int) -> Packet:
    """Return the part of a packet with first <= time < end; its arrays are views."""
    if packet.start_us is None or packet.stop_us is None or (
            packet.start_us >= first and packet.stop_us <= end):
        return packet
    return Packet(
        between(packet.events, first, end),
        tuple(f for f in packet.frames if first <= f.available_us < end),
        between(packet.imu, first, end), between(packet.triggers, first, end))


def between(samples: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
    """Return a view of those time-ordered samples with start <= time < stop."""
    # bisect, because searchsorted copies a strided column.
    times = samples["t"]
    return samples[bisect_left(times, start):bisect_left(times, stop)]


class _Queue:
    """Samples of one kind that are not yet in a packet.

    They are in `_runs`: samples, where the cells among them begin, and end, and the
    times of their first ones; of the first run, from the cell `_at` on.  The last cell
    may go on in the next run; `inside` a run there are others, which do not.
    """

    __slots__ = ("_at", "_most", "_runs", "inside", "nbytes", "next_us", "none")

    def __init__(self, dtype: np.dtype[Any], most: int) -> None:
        self._most = most
        self._runs: deque[tuple[NDArray[Any], list[int], list[int]]] = deque()
        self.none = np.empty(0, dtype)
        self.nbytes = self._at = 0
        self.inside = False
        self.next_us = END_OF_TIME

    def put(self, samples: NDArray[Any], begin: int) -> None:
        starts, times = _kernels.cells(
            np.ascontiguousarray(samples).view(np.uint8), samples.itemsize,
            MAX_PACKET_US)
        first = bisect_left(times, begin)
        if first < len(times):
            starts.append(len(samples))
            self.nbytes += (len(samples) - starts[first]) * samples.itemsize
            self._runs.append((samples, starts[first:], times[first:]))
            self.next_us = self._runs[0][2][self._at]

    def take(self, until: int, limit: int = END_OF_TIME) -> NDArray[Any]:
        """Remove and return samples before until, at most limit, all of one cell."""
        if self.next_us >= until:
            return self.none
        got, partial = [], until % MAX_PACKET_US
        while self.next_us < until and limit > 0:
            samples, starts, times = self._runs[0]
            at = self._at
            start, end = starts[at], starts[at + 1]
            stop = end if end - start <= limit else start + limit
            if partial:
                stop = bisect_left(samples["t"], until, start, stop)
            got.append(samples[start:stop])
            limit -= stop - start
            if stop < end:
                starts[at], times[at] = stop, int(samples["t"][stop])
                self.next_us = times[at]
            else:
                self._move(at + 1)
        found = got[0]
        if len(got) > 1 or _kept(found) > self._most * found.nbytes:
            found = joined(got)
        self.nbytes -= found.nbytes
        return found

    def whole(self, until: int) -> list[NDArray[Any]]:
        """Remove and return the next cells `inside` that end by a time, if small."""
        samples, starts, times = self._runs[0]
        at = self._at
        last = bisect_left(times, cell_start(until), at,
                           min(at + _TOGETHER, len(times) - 1))
        first, block = starts[at], samples[starts[at]:starts[last]]
        if last == at or block.nbytes > _TOGETHER * _SMALL:
            return []
        kept = _kept(block)
        if self._most * block.nbytes < kept * (last - at):
            block, kept = joined([block]), block.nbytes
        parts = [block[start - first:stop - first]
                 for start, stop in pairwise(starts[at:last + 1])]
        least = kept / (self._most * samples.itemsize)
        if min(map(len, parts)) < least:
            parts = [part if len(part) >= least else joined([part]) for part in parts]
        self.nbytes -= block.nbytes
        self._move(last)
        return parts

    def _move(self, at: int) -> None:
        """Go on to a cell of the first run, or to the next run."""
        if at == len(self._runs[0][2]):
            self._runs.popleft()
            at = 0
        self._at = at
        times = self._runs[0][2] if self._runs else [END_OF_TIME]
        self.next_us, self.inside = times[at], 0 < at < len(times) - 1


def _kept(part: NDArray[Any]) -> int:
    """Return how many bytes of memory a view keeps."""
    return 0 if part.base is None else part.base.nbytes
