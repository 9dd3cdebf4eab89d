"""The read-out bus: one row at a time, a limited rate, and loss."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdavis_cv._kernels import read_out
from pdavis_cv._types import Events
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.simulation.checks import Checked, ruled, within


@dataclass(frozen=True, kw_only=True)
class Bus(Checked):
    """The DAVIS's word-serial address-event bus (AER, Boahen 2004).

    The arbiter serves rows round robin; all pending requests of a row get one time
    stamp.  An event of a pixel whose last request is still pending is lost.

    Parameters
    ----------
    rate_hz : float
        Events per second within a row, 1 to 1e12; about 10 MHz (Haessig, section S1).
    row_us : float
        Time to switch to the next row, microseconds, at most a second.
    """

    rate_hz: float = ruled(10e6, within(1, 1e12))
    row_us: float = ruled(0.1, within(0, 1e6))


class BusState:
    """The state of a bus between chunks of events, which `pass_on` sends through it.

    `lost` counts the events lost so far; `load` is the fraction of the last chunk's
    time in which the bus was busy, at most 1.
    """

    def __init__(self, bus: Bus, size: tuple[int, int]) -> None:
        self.bus, self.lost, self.load = bus, 0, 0.0
        self._clock = np.zeros(3)
        self._waiting = np.zeros(size[0], np.int32)
        self._queue = np.zeros(size, np.uint16)
        self._pending = np.zeros(size, np.uint8)
        self._until = 0.0

    def pass_on(self, events: Events, until_us: float) -> Events:
        """Return the events that leave the bus before ``until_us``, in time order.

        `events` are the pixels' requests before that time, in time order.
        """
        out = np.empty(len(events) + int(self._clock[2]), EVENT_DTYPE)
        us_per_event = 1e6 / self.bus.rate_hz
        done, lost, _ = read_out(
            events, until_us, us_per_event, self.bus.row_us, self._clock,
            self._waiting, self._queue, self._pending, out)
        self.lost += lost
        out = out[:done]
        bursts = int(np.count_nonzero(np.diff(out["t"]) | np.diff(
            out["y"].astype(np.int32)))) + 1 if done else 0
        busy = done * us_per_event + bursts * self.bus.row_us
        span = until_us - self._until
        self.load = min(1.0, busy / span) if span > 0 else 0.0
        self._until = until_us
        return out
