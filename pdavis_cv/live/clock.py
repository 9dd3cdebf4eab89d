"""The device's clock: packets in order of time, and the offset to the host's clock."""
from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator

from pdavis_cv._types import Events, Records
from pdavis_cv.events import FAR
from pdavis_cv.live.inbox import Flood
from pdavis_cv.recording.base import Packet
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.timeline import SEGMENT_US, Timeline

WINDOW_S = 10.0
"""Window in which the smallest delay is searched, s; the window before it counts too.
A crystal that is 50 ppm off drifts by 0.5 ms in it, less than the jitter of USB."""

_OUT_OF_REACH = "packets were dropped because no clock reaches their time"


class HostClock:
    """Relates the device's clock to the host's, by the smallest delay seen.

    A packet arrives after it was sent, so the packet with the least delay measures the
    offset of the clocks best: the running minimum of host time minus device time.
    Clocks drift, so only the last two windows of `window_s`, 10 to 20 s, are used.
    """

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_s = window_s
        self._first: tuple[float, float] | None = None    # host time, difference
        self._before: float | None = None
        self._now: float | None = None
        self._since_s = 0.0
        self._host_s = 0.0

    def saw(self, device_us: int, host_s: float) -> None:
        """Note that a sample with stamp device_us had arrived at host_s.

        `host_s` is of a clock that never jumps, such as ``time.monotonic``.
        """
        difference = host_s - device_us * 1e-6
        if self._now is None or host_s - self._since_s > self._window_s:
            if self._now is not None and self._first is None:
                self._first = host_s, self._now
            self._before, self._now, self._since_s = self._now, difference, host_s
        self._now = min(self._now, difference)
        self._host_s = host_s

    @property
    def difference_s(self) -> float | None:
        """Host time minus device time, s; None before the first sample."""
        if self._now is None or self._before is None:
            return self._now
        return min(self._now, self._before)

    @property
    def drift_ppm(self) -> float | None:
        """Rate by which the device's clock is slower than the host's, in ppm.

        None before two windows have passed.
        """
        if self._first is None or self._now is None:
            return None
        host_s, difference = self._first
        passed = self._host_s - host_s
        if passed < self._window_s:
            return None
        return 1e6 * (self._now - difference) / passed

    def host_s(self, device_us: int) -> float | None:
        """Return the host's time when the device's clock showed device_us, s."""
        difference = self.difference_s
        return None if difference is None else device_us * 1e-6 + difference


def in_order(packets: Iterator[Packet], log: ProblemLog) -> Iterator[Packet]:
    """Yield packets whose times never run backward.

    A step back by more than a second means that the clock was reset: the later packets
    are shifted in time to follow the earlier ones, as a new segment.  Samples that are
    late by less, or too many for their time, are dropped.  The log notes all.
    """
    timeline, flood = Timeline(), Flood(log)
    jumps = offset = 0
    last: int | None = None
    for packet in packets:
        first = packet.until_us if packet.start_us is None else packet.start_us
        if first is None:
            continue
        if first <= -FAR:       # what it would be moved by does not fit 64 bits
            log.add("backward time", None, _OUT_OF_REACH)
            continue
        if last is not None and last - first - offset > SEGMENT_US:
            offset += timeline.move(jumps, last - first - offset)
            jumps += 1
            log.add("segment", None, "the device's clock was reset: what follows is "
                    "moved to follow what came before", start_us=last)
        times = (packet.start_us, packet.stop_us, packet.until_us,
                 *(frame.available_us for frame in packet.frames))
        if max(t for t in times if t is not None) + offset >= FAR:
            log.add("backward time", None, _OUT_OF_REACH)
            continue
        if offset:
            packet = moved(packet, offset)
        if last is not None and packet.start_us is not None and packet.start_us < last:
            packet, late = _after(packet, last)
            log.add("backward time", None, "samples that came late were dropped",
                    count=late, start_us=last)
        ends = [t for t in (last, packet.until_us) if t is not None]
        if packet.stop_us is not None:
            ends.append(packet.stop_us - 1)
        last = max(ends)
        yield flood.passed(packet, last)


def moved(packet: Packet, offset_us: int) -> Packet:
    """Return a packet with offset_us added to every time; its arrays are copies."""
    copies = [samples.copy() for samples in (
        packet.events, packet.imu, packet.triggers)]
    for samples in copies:
        samples["t"] += offset_us
    frames = tuple(frame.replace(
        exposure_start_us=frame.exposure_start_us + offset_us,
        exposure_end_us=frame.exposure_end_us + offset_us,
        available_us=frame.available_us + offset_us) for frame in packet.frames)
    until = None if packet.until_us is None else packet.until_us + offset_us
    return Packet(copies[0], frames, copies[1], copies[2], until)


def _after(packet: Packet, last_us: int) -> tuple[Packet, int]:
    """Return a packet's part from last_us on, and the number of samples dropped."""
    late = 0

    def kept(samples: Records) -> Events:
        nonlocal late
        n = bisect_left(samples["t"], last_us)
        late += n
        return samples[n:]

    frames = tuple(f for f in packet.frames if f.available_us >= last_us)
    late += len(packet.frames) - len(frames)
    return Packet(kept(packet.events), frames, kept(packet.imu), kept(packet.triggers),
                  packet.until_us), late
