"""Replay of a recording as a live source, at its own pace and optionally repeated."""
from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Iterator

from pdavis_cv.live.base import HEARTBEAT_S, LiveSource, endless
from pdavis_cv.live.clock import moved
from pdavis_cv.recording.base import Packet, Recording

PIECE_US = 2_000
"""Longest stream time of a piece, us.  Packets are cut as a camera's USB transfers are,
so that nothing arrives later than from a camera."""


class ReplaySource(LiveSource):
    """Sends a recording as a camera would, at its own pace or faster.

    Parameters
    ----------
    recording : Recording
        Closed with the source.
    name : str
        Name for messages.
    speed : float
        Stream time per real time; 0 = as fast as it is read, without losses.
    loop : bool
        Begin again at the end.
    seconds : float
        End after this stream time.

    Raises
    ------
    ValueError
        If `speed` is negative or `seconds` is not positive.
    """

    def __init__(
        self, recording: Recording, name: str, *, speed: float = 1.0,
        loop: bool = False, seconds: float = math.inf,
    ) -> None:
        if not 0 <= speed < math.inf:
            raise ValueError(f"speed must not be negative, got {speed:g}")
        if not seconds > 0:
            raise ValueError(f"seconds must be positive, got {seconds:g}")
        super().__init__(endless(recording.info), name)
        self.realtime, self.speed = speed > 0, speed or 1.0
        self._recording, self._paced, self._loop = recording, speed > 0, loop
        self._seconds = seconds

    def _arrivals(self) -> Iterator[Packet]:
        first: int | None = None
        begun = 0.0
        for packet in self._stream():
            start, stop = packet.start_us, packet.stop_us
            assert start is not None
            assert stop is not None
            if first is None:
                first, begun = start, time.monotonic()
            if start - first >= 1e6 * self._seconds:
                return
            if self._paced:
                yield from self._wait(first, begun, start, stop)
            if self._closed.is_set():
                return
            yield packet

    def _wait(
        self, first_us: int, begun_s: float, start_us: int, stop_us: int
    ) -> Iterator[Packet]:
        """Wait until a packet's last sample is due; report the time meanwhile."""
        due_s = begun_s + (stop_us - first_us) * 1e-6 / self.speed
        while not self._closed.is_set():
            now_s = time.monotonic()
            if now_s >= due_s:
                return
            if self._closed.wait(min(due_s - now_s, HEARTBEAT_S)):
                return
            passed_us = int((time.monotonic() - begun_s) * 1e6 * self.speed)
            if time.monotonic() < due_s:
                yield Packet(until_us=min(first_us + passed_us, start_us))

    def _stream(self) -> Iterator[Packet]:
        """Yield the recording in pieces, shifted by its length at each repetition."""
        offset = 0
        while True:
            first: int | None = None
            stop = 0
            for packet in self._recording.packets():
                for piece in pieces(packet):
                    assert piece.start_us is not None
                    assert piece.stop_us is not None
                    if first is None:
                        first = piece.start_us
                    stop = piece.stop_us
                    yield moved(piece, offset)
            if not self._loop or first is None:
                return
            info = self._recording.info
            if info.start_us is not None and info.stop_us is not None:
                first, stop = info.start_us, info.stop_us
            offset += stop - first

    def close(self) -> None:
        """Stop, and close the recording."""
        super().close()
        self._recording.close()


def pieces(packet: Packet) -> Iterator[Packet]:
    """Yield a packet in pieces of at most `PIECE_US`, whose arrays are views."""
    start, stop = packet.start_us, packet.stop_us
    if start is None or stop is None:
        return
    arrays = (packet.events, packet.imu, packet.triggers)
    times = [samples["t"] for samples in arrays]
    frames, lows = packet.frames, [0, 0, 0]
    next_us: int | None = start
    # Step from sample to sample, as a wrong time stamp may be years away.
    while next_us is not None:
        number = (next_us - start) // PIECE_US
        edge = min(start + (number + 1) * PIECE_US, stop)
        highs = [bisect_left(t, edge, low) for t, low in zip(times, lows, strict=True)]
        events, imu, triggers = (samples[low:high] for samples, low, high in zip(
            arrays, lows, highs, strict=True))
        yield Packet(events, tuple(f for f in frames if f.available_us < edge), imu,
                     triggers)
        frames = tuple(f for f in frames if f.available_us >= edge)
        lows = highs
        next_us = min((
            *(int(t[low]) for t, low in zip(times, lows, strict=True) if low < len(t)),
            *(f.available_us for f in frames)), default=None)
