"""Faults: offset of the frames' stamps, jitter and loss of events, threshold drift."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdavis_cv._types import Events
from pdavis_cv.simulation import noise
from pdavis_cv.simulation.checks import FRACTION, Checked, ruled, that, whole, within

_MOST_OFFSET_US = 10_000_000
_DRIFT = within(-0.5, 0.5)
"""Rule of the relative drift of the thresholds over a recording."""


@dataclass(frozen=True, kw_only=True)
class Faults(Checked):
    """Faults of stamps and streams; the defaults are none.

    Parameters
    ----------
    frame_offset_us : int
        Added to the frames' exposure stamps, not to ``available_us``.  In a DAVIS346
        events trail frames by 4 to 7 ms, an offset below 0.  At most the read-out
        time, since a frame cannot arrive before its stated exposure ends, and within
        10 s of 0.
    jitter_us : float
        Standard deviation of the noise on the events' stamps; below 1000 under usual
        light (Hu et al., CVPR Workshops 2021).  Events are sorted by the noisy stamps,
        which are kept within their piece of 10 ms.  At most a second.
    lost : float
        Fraction of the events that are lost, at random.
    drift_on, drift_off : float
        Relative change of the thresholds from the beginning of the recording to its
        end, linear in time; within .5 of 0.
    """

    frame_offset_us: int = ruled(0, whole(-_MOST_OFFSET_US, _MOST_OFFSET_US))
    jitter_us: float = ruled(0.0, within(0, 1e6))
    lost: float = ruled(0.0, FRACTION, that(lambda lost: lost < 1, "be below 1"))
    drift_on: float = ruled(0.0, _DRIFT)
    drift_off: float = ruled(0.0, _DRIFT)

    def threshold_factors(self, part: float) -> tuple[float, float]:
        """Return the factors on ON and OFF thresholds at a fraction of the duration."""
        return 1 + self.drift_on * part, 1 + self.drift_off * part


class EventFaults:
    """Jitter and loss of one recording's events, piece by piece in order of time."""

    def __init__(self, faults: Faults, seed: int) -> None:
        self.faults, self._seed, self._count = faults, seed, 0

    def pass_on(self, events: Events, start_us: int, stop_us: int) -> Events:
        """Apply loss and jitter to the events with start_us <= t <= stop_us."""
        index = np.arange(self._count, self._count + len(events), dtype=np.uint64)
        self._count += len(events)
        if self.faults.lost:
            kept = noise.uniform(self._seed, "lost", index) >= self.faults.lost
            events, index = events[kept], index[kept]
        if self.faults.jitter_us and len(events):
            shift_us = self.faults.jitter_us * noise.normal(self._seed, "jitter", index)
            events = events.copy()
            events["t"] = np.clip(
                events["t"] + np.rint(shift_us).astype(np.int64), start_us, stop_us)
            events = events[np.argsort(events["t"], kind="stable")]
        return events
