"""Bounded queue of packets from the thread that reads to the one that fuses."""
from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence

from pdavis_cv.events import FAR
from pdavis_cv.recording.base import MAX_PACKET_EVENTS, MAX_PACKET_US, Packet, joined
from pdavis_cv.recording.files import ProblemLog

LONGEST_LAG_US = 500_000
"""Most stream time that may wait to be fused, us; beyond it, time jumps to now."""
MOST_BYTES = 128 * 2**20
"""Most bytes of packets that may wait: 0.3 s of 30 million events per second."""


_BYTES_PER_US, _OBJECTS = 1_000, 1_000
"""Twice what USB 3 carries, and the bytes that the objects of a packet take."""


class Waiting(Exception):
    """The queue is empty now; ask again after the next packet."""


class Flood:
    """Drops what no camera can send in its time, as it would have to wait for that.

    Times tell when data may be used: if they hardly advance, data only gather.
    """

    def __init__(self, log: ProblemLog) -> None:
        self._log, self._bytes, self._newest_us = log, 0, -FAR

    def passed(self, packet: Packet, newest_us: int) -> Packet:
        """Return a packet, which ends at a time, without its samples if too many."""
        carried = _BYTES_PER_US * max(newest_us - self._newest_us, 0)
        waiting = max(self._bytes - carried, 0) + size_of(packet)
        self._newest_us = newest_us
        if waiting <= MOST_BYTES or packet.start_us is None:
            self._bytes = waiting
            return packet
        self._log.add("flood", None, "samples were dropped because no camera sends so "
                      "many in so short a time", start_us=newest_us, stop_us=newest_us,
                      count=len(packet.events) + len(packet.frames))
        return Packet(until_us=newest_us)


class Inbox:
    """A queue of packets of bounded age and size.

    If it is `lossy`, `put` never waits; if the queue would hold more than 0.5 s of
    stream time, all waiting packets are dropped except the last frame, and counted in
    the log.  Else `put` waits for room, and nothing is dropped.  Unless it `waits`,
    iterating over an empty queue raises `Waiting`.
    """

    def __init__(self, lossy: bool, log: ProblemLog, *, waits: bool = True) -> None:
        self._lossy, self._log, self._waits = lossy, log, waits
        self._packets: deque[Packet] = deque()
        self._flood = Flood(log)
        self._bytes = 0
        self._change = threading.Condition()
        self._ended = False
        self._error: Exception | None = None
        self.newest_us: int | None = None
        self.dropped_events = 0
        self.jumps = 0

    def put(self, packet: Packet) -> None:
        """Add a packet; drop what has waited too long, or wait for room."""
        ends = [t for t in (packet.until_us, packet.stop_us) if t is not None]
        if not ends:
            return
        packet = self._flood.passed(packet, max(ends))
        with self._change:
            while not self._lossy and not self._ended and self._full(max(ends)):
                self._change.wait()
            self._packets.append(packet)
            self._bytes += size_of(packet)
            self.newest_us = max(ends)
            if self._full(self.newest_us):
                self._jump(self.newest_us)
            self._change.notify_all()

    def _full(self, newest_us: int) -> bool:
        return self._bytes > MOST_BYTES or self._lag_us(newest_us) > LONGEST_LAG_US

    def _lag_us(self, newest_us: int) -> int:
        if not self._packets:
            return 0
        oldest = self._packets[0]
        begins = oldest.until_us if oldest.start_us is None else oldest.start_us
        return 0 if begins is None else newest_us - begins

    def _jump(self, newest_us: int) -> None:
        """Drop the waiting packets except the last frame, which updates the state."""
        if not self._lossy:
            return
        first = self._packets[0]
        dropped = sum(len(packet.events) for packet in self._packets)
        frames = [frame for packet in self._packets for frame in packet.frames]
        self.dropped_events += dropped
        self.jumps += 1
        self._log.add(
            "too slow", None, "events were dropped because fusing could not "
            "follow: time jumped to now", count=dropped,
            start_us=first.until_us if first.start_us is None else first.start_us,
            stop_us=newest_us)
        left = Packet(frames=tuple(frames[-1:]), until_us=newest_us)
        self._packets.clear()
        self._packets.append(left)
        self._bytes = size_of(left)

    def end(self, error: Exception | None = None) -> None:
        """Note that no packet follows; waiting packets are still handed out."""
        with self._change:
            self._ended, self._error = True, self._error or error
            self._change.notify_all()

    def close(self) -> None:
        """End, and drop the waiting packets."""
        with self._change:
            self._packets.clear()
            self._bytes = 0
            self._ended = True
            self._change.notify_all()

    @property
    def error(self) -> Exception | None:
        """The error that ended the source, None if it simply ended."""
        return self._error

    @property
    def waiting(self) -> tuple[int, int]:
        """Number of waiting packets, and the stream time in us that they span."""
        with self._change:
            return len(self._packets), self._lag_us(self.newest_us or 0)

    def __iter__(self) -> Iterator[Packet]:
        return self

    def __next__(self) -> Packet:
        with self._change:
            while not self._packets:
                if self._ended:
                    raise StopIteration
                if not self._waits:
                    raise Waiting
                self._change.wait()
            parts = [self._packets.popleft()]
            if self._lossy:     # each packet has an overhead, so small ones are joined
                n = fitting(parts[0], self._packets)
                parts += [self._packets.popleft() for _ in range(n)]
            self._bytes -= sum(map(size_of, parts))
            self._change.notify_all()
        return together(parts)


def size_of(packet: Packet) -> int:
    """Return the bytes of a packet."""
    return (_OBJECTS + packet.events.nbytes + packet.imu.nbytes + packet.triggers.nbytes
            + sum(4 * math.prod(frame.shape) for frame in packet.frames))


def fitting(first: Packet, others: Iterable[Packet]) -> int:
    """Return how many of the next packets can be joined with the first."""
    begin = first.until_us if first.start_us is None else first.start_us
    events, frames, n = len(first.events), len(first.frames), 0
    for other in others:
        end = other.until_us if other.stop_us is None else other.stop_us
        events, frames = events + len(other.events), frames + len(other.frames)
        if (begin is None or end is None or end - begin > MAX_PACKET_US
                or events > MAX_PACKET_EVENTS or frames > 1):
            break
        n += 1
    return n


def together(parts: Sequence[Packet]) -> Packet:
    """Join successive packets, at least one, into one."""
    if len(parts) == 1:
        return parts[0]
    until = [part.until_us for part in parts if part.until_us is not None]
    return Packet(
        joined([part.events for part in parts]),
        tuple(frame for part in parts for frame in part.frames),
        joined([part.imu for part in parts]),
        joined([part.triggers for part in parts]), max(until, default=None))
