"""Simulated faults between a device and the host, for testing live programs."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pdavis_cv.errors import DeviceError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.live.base import LiveSource
from pdavis_cv.live.clock import moved
from pdavis_cv.recording.base import Packet

__all__ = ["FaultySource", "LinkFaults"]

BURST_HZ = 30e6
"""Rate of a burst, events per second: more than a DAVIS346 sends (12 Mev/s on USB), and
as much as data sheets of its contemporaries state."""
BURST_S = 0.1


@dataclass(frozen=True, kw_only=True)
class LinkFaults:
    """Faults between a device and the host; times in s after the first sample.

    Parameters
    ----------
    drop : float
        Fraction of packets that are lost, 0 to 1.
    unplug : float
        Time at which the device is unplugged.
    reset : float
        Time at which the device's clock restarts at 0.
    burst : float
        Time at which pixels begin to fire at random for 0.1 s, at 30 million events
        per second in total.
    dark : float
        Time from which on only the time is sent.
    fault_seed : int
        Seed of the random faults.

    Raises
    ------
    ValueError
        If `drop` does not lie in 0..1 or a time is negative.
    """

    drop: float = 0.0
    unplug: float = math.inf
    reset: float = math.inf
    burst: float = math.inf
    dark: float = math.inf
    fault_seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.drop <= 1:
            raise ValueError(f"drop must lie in 0..1, got {self.drop:g}")
        for name in ("unplug", "reset", "burst", "dark"):
            if not getattr(self, name) >= 0:
                raise ValueError(
                    f"{name} must not be negative, got {getattr(self, name):g}")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of the faults."""
        return tuple(one.name for one in dataclasses.fields(cls))


class FaultySource(LiveSource):
    """A source that passes on another one's packets with faults.

    Parameters
    ----------
    source : LiveSource
        The device; closed with this one.
    faults : LinkFaults
        The faults.
    """

    def __init__(self, source: LiveSource, faults: LinkFaults) -> None:
        super().__init__(source.info, source.name)
        self.realtime, self.speed = source.realtime, source.speed
        self._source, self._faults = source, faults

    def _arrivals(self) -> Iterator[Packet]:
        faults, rng = self._faults, np.random.default_rng(self._faults.fault_seed)
        first: int | None = None
        for packet in self._source.packets():
            ends = [t for t in (packet.until_us, packet.stop_us) if t is not None]
            first = min(ends) if first is None else first
            passed = (max(ends) - first) * 1e-6
            if passed >= faults.unplug:
                raise DeviceError(
                    f"{self.name}: the device is gone: plug it in and open it again")
            if passed >= faults.dark:
                packet = Packet(until_us=max(ends))
            elif faults.drop and packet.start_us is not None:
                packet = (Packet(until_us=max(ends)) if rng.random() < faults.drop
                          else packet)
            if faults.burst <= passed < faults.burst + BURST_S:
                packet = _burst(packet, self.info.sensor_size, rng)
            if passed >= faults.reset:
                packet = moved(packet, -(first + int(1e6 * faults.reset)))
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
