"""Simulated faults between a device and the host."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from pdavis_cv.errors import DeviceError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.live.base import LiveSource
from pdavis_cv.live.clock import moved
from pdavis_cv.recording.base import Packet

BURST_HZ = 30e6
"""Rate of a burst, events per second: more than a DAVIS346 sends (12 Mev/s on USB), and
as much as data sheets of its contemporaries state."""
BURST_S = 0.1


class FaultySource(LiveSource):
    """A source that passes on another one's packets with faults.

    Parameters
    ----------
    source : LiveSource
        The device; closed with this one.
    drop : float
        Fraction of packets that are lost, 0 to 1.
    unplug, reset, burst, dark : float
        Time in s after the first sample at which the device is unplugged, its clock
        restarts at 0, pixels fire at random for 0.1 s, only the time is sent.
    """

    def __init__(self, source, *, drop=0.0, unplug=math.inf, reset=math.inf,
                 burst=math.inf, dark=math.inf):
        super().__init__(source.info, source.name)
        self.realtime, self.speed = source.realtime, source.speed
        self._source, self.drop = source, drop
        self.unplug, self.reset, self.burst, self.dark = unplug, reset, burst, dark

    def _arrivals(self) -> Iterator[Packet]:
        rng = np.random.default_rng(2)
        first: int | None = None
        for packet in self._source.packets():
            ends = [t for t in (packet.until_us, packet.stop_us) if t is not None]
            first = min(ends) if first is None else first
            passed = (max(ends) - first) * 1e-6
            if passed >= self.unplug:
                raise DeviceError(
                    f"{self.name}: the device is gone: plug it in and open it again")
            if passed >= self.dark:
                packet = Packet(until_us=max(ends))
            elif self.drop and packet.start_us is not None:
                packet = (Packet(until_us=max(ends)) if rng.random() < self.drop
                          else packet)
            if self.burst <= passed < self.burst + BURST_S:
                packet = _burst(packet, self.info.sensor_size, rng)
            if passed >= self.reset:
                packet = moved(packet, -(first + int(1e6 * self.reset)))
            yield packet

    def close(self) -> None:
        """Stop, and close the device."""
        super().close()
        self._source.close()


def _burst(
    packet: Packet, size: tuple[int, int], rng: np.random.Generator
) -> Packet:
    """Return a packet whose events are random, at `BURST_HZ` over the whole sensor."""
    start, stop = packet.start_us, packet.stop_us
    if start is None or stop is None:
        return packet
    count = round(BURST_HZ * 1e-6 * (stop - start))
    events = np.empty(count, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(start, stop, count))
    events["y"], events["x"] = (rng.integers(0, side, count) for side in size)
    events["p"] = rng.integers(0, 2, count)
    return dataclasses.replace(packet, events=events)
