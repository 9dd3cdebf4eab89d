"""Samples of a source in the order in which a reconstruction takes them."""
from __future__ import annotations

import warnings
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.errors import ExposureWarning
from pdavis_cv.recording.base import ApsFrame, Packet

__all__ = ["LONGEST_DELAY_US", "Feed"]

LONGEST_DELAY_US = 2_000_000
"""A camera with frames gives its first within this time of its first sample, and none
arrives later than this after its mid-exposure; us of stream time."""

# How long events wait for a frame that may still arrive and act before them, at
# least; four times the longest delay seen so far if that is more.
_LOOKAHEAD_US = 200_000

_NEVER, _FOREVER = -(2**62), 2**62


class Feed:
    """Iterates over events and frames of a stream of packets in time order, once.

    A frame counts at its mid-exposure, which lies before its arrival: events are
    held back until the next frame is known or cannot act on them any more.  With
    `by_arrival` a frame counts when its readout ends, after the events of that
    microsecond, and nothing is held back.

    Parameters
    ----------
    packets : iterator of Packet
    after_us : int, optional
        Up to this time, inclusive, events are left out.
    frames_after_us : int, optional
        Leave out the frames whose mid-exposure is not after this.
    by_arrival : bool
        Frames by ``available_us`` rather than by ``mid_us``.
    has_frames : bool
        False if it is known that there is no frame.
    stop_us : int, optional
        One past the last sample, where that is known.
    reached_us : int, optional
        A sample at or after this time is known to exist: `reached_us` of another Feed.
    clock_us : int
        Added to the frames' exposure times.  With `by_arrival` frames are handed out as
        they are, when they would arrive with it; it may be changed on the way.
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
        self._events: deque[NDArray[Any]] = deque()
        self._frames: deque[ApsFrame] = deque()
        self._reached_us = _NEVER if reached_us is None else reached_us
        self._last_us = _NEVER          # everything before it has been read
        self._last_mid_us = _NEVER      # of the latest frame read
        self._given_us = _NEVER if after_us is None else after_us  # handed out
        self._done = False
        self._wait_us = _LOOKAHEAD_US if has_frames and not by_arrival else 0
        self._stop_us = stop_us

    def first_us(self) -> int | None:
        """Mid-exposure of the first frame, to be asked before anything is handed out.

        Time of the first event if no frame comes within `LONGEST_DELAY_US` of the first
        sample; None if there is neither.
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

    def until(self, t_us: int | None) -> Iterator[ApsFrame | NDArray[Any]]:
        """Yield what has not been handed out yet, up to t_us inclusive.

        Parameters
        ----------
        t_us : int or None
            None = to the end of the recording.

        Yields
        ------
        ApsFrame or ndarray of EVENT_DTYPE
        """
        target = _FOREVER if t_us is None else t_us
        # Hand out while reading, so that a jump over a long time stays flat in memory.
        while not self._knows(target) and self._read():
            yield from self._release(min(self._settled_us(), target))
        yield from self._release(target)

    def frame_mid(self, after_us: int) -> int | None:
        """Mid-exposure of the first frame after after_us among those read so far."""
        return next((frame.mid_us for frame in self._frames
                     if frame.mid_us > after_us), None)

    def read_on(self) -> int | None:
        """Read some more; return up to when no later frame can act, None at the end."""
        if not self._read():
            return None
        return self._last_us - 1 - max(self._wait_us, LONGEST_DELAY_US)

    @property
    def reached_us(self) -> int:
        """Time up to which the stream is known to go on."""
        return max(self._reached_us, self._last_us)

    def reaches(self, t_us: int) -> bool:
        """Tell whether the recording has a sample at or after t_us."""
        if self._stop_us is not None:
            return t_us < self._stop_us
        while self.reached_us < t_us:
            if not self._read():
                return False
        return True

    def _time(self, frame: ApsFrame) -> int:
        return (frame.moved(self.clock_us).available_us if self._by_arrival
                else frame.mid_us)

    def _knows(self, t_us: int) -> bool:
        """Tell whether nothing unread lies at or before t_us."""
        return self._done or (t_us < self._last_us and t_us <= self._settled_us())

    def _settled_us(self) -> int:
        """Time up to which, inclusive, no unread sample can act."""
        settled = self._last_us - 1 - self._wait_us
        if not self._by_arrival:
            # Exposures do not overlap: the next frame comes after the last known.
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
        if self._time(frame) <= self._given_us:
            warnings.warn(
                f"the frame exposed at {frame.mid_us} us arrived {delay} us later, "
                f"more than the {self._wait_us} us that events wait: left out",
                ExposureWarning, stacklevel=2)
            return
        if not self._by_arrival:
            self._wait_us = max(self._wait_us, 4 * delay)
        self._last_mid_us = max(self._last_mid_us, frame.mid_us)
        self._frames.append(frame)

    def _release(self, t_us: int) -> Iterator[ApsFrame | NDArray[Any]]:
        while self._frames and self._time(self._frames[0]) <= t_us:
            frame = self._frames.popleft()
            yield from self._release_events(self._time(frame) - (not self._by_arrival))
            yield frame
        yield from self._release_events(t_us)
        self._given_us = max(t_us, self._given_us)

    def _release_events(self, t_us: int) -> Iterator[NDArray[Any]]:
        while self._events:
            events = self._events[0]
            if events["t"][-1] <= t_us:
                yield self._events.popleft()
                continue
            n = bisect_right(events["t"], t_us)    # searchsorted would copy the column
            if n:
                self._events[0] = events[n:]
                yield events[:n]
            return
