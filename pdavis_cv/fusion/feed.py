"""Events and frames of a source, in the order in which a method takes them."""
from __future__ import annotations

import warnings
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from pdavis_cv._types import Events
from pdavis_cv.errors import ExposureWarning
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import ApsFrame, Packet, joined

LONGEST_DELAY_US = 2_000_000
"""A camera is taken to have no frames if none arrives within this time of its first
sample; a frame that arrives later than this after its mid-exposure is left out; us of
stream time."""

_LOOKAHEAD_US = 200_000
"""Shortest time, us, that events are held back for a frame that acts before them and
may still arrive.  Four times the longest delay of a frame so far is used if longer."""

_TOGETHER = 65_536
"""Most events of small packets that are passed on as one array: those of one packet at
most (see `Packet`)."""

_NEVER, _FOREVER = -(2**62), 2**62


class Feed:
    """Iterate once over events and frames of a stream of packets, in time order.

    The time of a frame is its mid-exposure, which lies before its arrival: events are
    held back until the next frame is known, or can no longer act on them.  With
    `by_arrival` the time of a frame is the end of its readout, ``available_us``; it
    follows the events of that microsecond, and nothing is held back.

    Events up to `after_us`, inclusive, are left out, and frames whose mid-exposure is
    not after `frames_after_us`.  `has_frames` is False if the stream is known to have
    none, `stop_us` one past its last sample, if known; `reached_us` is that of another
    Feed of the stream, which shows that it has a sample at or after this time.
    `clock_us` is added to the frames' exposure times: with `by_arrival` it only decides
    when a frame is yielded; the frame itself is unchanged, and the attribute may be set
    during the iteration.
    """

    def __init__(
        self,
        packets: Iterator[Packet],
        *,
        by_arrival: bool,
        has_frames: bool = True,
        stop_us: int | None = None,
        after_us: int | None = None,
        frames_after_us: int | None = None,
        reached_us: int | None = None,
        clock_us: int = 0,
    ) -> None:
        self.clock_us, self._after_us = clock_us, after_us
        self._frames_after, self._by_arrival = frames_after_us, by_arrival
        self.has_frames = has_frames
        self._packets = packets
        self._events: deque[Events] = deque()
        self._frames: deque[ApsFrame] = deque()
        self._reached_us = _NEVER if reached_us is None else reached_us
        self._last_us = _NEVER          # all samples before it have been read
        self._last_mid_us = _NEVER      # mid-exposure of the last frame read
        # Time up to which, inclusive, everything has been yielded.
        self._yielded_us = _NEVER if after_us is None else after_us
        self._done = False
        self._wait_us = _LOOKAHEAD_US if has_frames and not by_arrival else 0
        self._stop_us = stop_us

    def first_us(self) -> int | None:
        """Return the mid-exposure of the first frame; call it before iterating.

        If no frame comes within `LONGEST_DELAY_US` of the first event, that is the time
        of the first event; None if there is neither.
        """
        first: int | None = None
        while not self._frames and self._read():
            if self._events:
                first = int(self._events[0]["t"][0]) if first is None else first
                if not self.has_frames or self._last_us - first > LONGEST_DELAY_US:
                    break
        if self._frames:
            return self._frames[0].mid_us
        self.has_frames = False
        return int(self._events[0]["t"][0]) if self._events else None

    def until(self, t_us: int | None) -> Iterator[ApsFrame | Events]:
        """Yield what is not yet yielded up to t_us, inclusive; None = to the end."""
        target = _FOREVER if t_us is None else t_us
        # Yield while reading, so that a jump over a long time needs bounded memory.
        while not self._knows(target) and self._read():
            yield from self._release(min(self._settled_us(), target))
        yield from self._release(target)

    def frame_mid(self, after_us: int) -> int | None:
        """Return the mid-exposure of the first frame after after_us that was read."""
        return next((frame.mid_us for frame in self._frames
                     if frame.mid_us > after_us), None)

    def read_on(self) -> int | None:
        """Read a packet; return the time up to which no later frame can act.

        None at the end of the stream.
        """
        if not self._read():
            return None
        return self._last_us - 1 - max(self._wait_us, LONGEST_DELAY_US)

    @property
    def reached_us(self) -> int:
        """Time up to which the stream is known to extend."""
        return max(self._reached_us, self._last_us)

    def reaches(self, t_us: int) -> bool:
        """Return whether the stream has a sample at or after t_us."""
        return all(due is not None for due in self.reaching(t_us))

    def reaching(self, t_us: int) -> Iterator[int | None]:
        """Read until the stream has a sample at or after t_us.

        Yields the times of frames up to which everything has been read, so that `until`
        such a time needs no reading, only with `by_arrival`; and None if the stream
        ends before t_us.
        """
        if self._stop_us is not None:
            if t_us >= self._stop_us:
                yield None
            return
        while self.reached_us < t_us:
            if not self._read():
                yield None
                return
            if self._by_arrival and self._frames:
                due = self._time(self._frames[0])
                if due < t_us and self._knows(due):
                    yield due

    def _time(self, frame: ApsFrame) -> int:
        return (frame.moved(self.clock_us).available_us if self._by_arrival
                else frame.mid_us)

    def _knows(self, t_us: int) -> bool:
        """Return whether everything at or before t_us has been read."""
        return self._done or (t_us < self._last_us and t_us <= self._settled_us())

    def _settled_us(self) -> int:
        """Time up to which, inclusive, no unread sample can act."""
        settled = self._last_us - 1 - self._wait_us
        if not self._by_arrival:
            # Exposures do not overlap: the next frame's lies after the last known.
            settled = max(settled, min(self._last_mid_us, self._last_us - 1))
        return settled

    def _read(self) -> bool:
        packet = next(self._packets, None)
        if packet is None:
            self._done = True
            return False
        if packet.stop_us is not None:
            self._last_us = max(self._last_us, packet.stop_us - 1)
        if packet.until_us is not None:
            self._last_us = max(self._last_us, packet.until_us)
        events = packet.events
        if self._after_us is not None and len(events):
            events = events[bisect_right(events["t"], self._after_us):]
        if len(events):
            self._events.append(events)
        for frame in packet.frames:
            one = frame if self._by_arrival else frame.moved(self.clock_us)
            if self._frames_after is None or one.mid_us > self._frames_after:
                self._take(one)
        return True

    def _take(self, frame: ApsFrame) -> None:
        delay = frame.available_us - frame.mid_us
        if self._time(frame) <= self._yielded_us:
            warnings.warn(
                f"the frame exposed at {frame.mid_us} us arrived {delay} us later, "
                f"more than the {self._wait_us} us that events wait: left out",
                ExposureWarning, stacklevel=2)
            return
        if not self._by_arrival:
            self._wait_us = max(self._wait_us, 4 * delay)
        self._last_mid_us = max(self._last_mid_us, frame.mid_us)
        self._frames.append(frame)

    def _release(self, t_us: int) -> Iterator[ApsFrame | Events]:
        while self._frames and self._time(self._frames[0]) <= t_us:
            frame = self._frames.popleft()
            yield from self._release_events(self._time(frame) - (not self._by_arrival))
            yield frame
        yield from self._release_events(t_us)
        self._yielded_us = max(t_us, self._yielded_us)

    def _release_events(self, t_us: int) -> Iterator[Events]:
        while parts := self._taken(t_us):
            yield from together(parts)

    def _taken(self, t_us: int) -> list[Events]:
        """Remove the first events up to t_us, as many as are passed on together."""
        parts: list[NDArray[Any]] = []
        room = _TOGETHER
        while self._events and (not parts or len(self._events[0]) <= room):
            events = self._events[0]
            if events["t"][-1] > t_us:
                # searchsorted would copy the column.
                n = bisect_right(events["t"], t_us)
                if n:
                    self._events[0] = events[n:]
                    parts.append(events[:n])
                break
            parts.append(self._events.popleft())
            room -= len(events)
        return parts


def together(parts: list[NDArray[Any]]) -> list[Events]:
    """Return arrays of events as one array, where that is cheap."""
    if len(parts) > 1 and all(
            each.dtype == EVENT_DTYPE and each.flags.c_contiguous for each in parts):
        return [joined(parts)]
    return parts
