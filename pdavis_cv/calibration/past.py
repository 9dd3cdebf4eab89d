"""What may be known at a time of photoreceptors and noise: what the past tells."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv._feed import first_time
from pdavis_cv.calibration.insitu import receptors
from pdavis_cv.calibration.known import noise_of, stated_bandwidth
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.reconstruct.stream_clock import checked_bandwidth
from pdavis_cv.recording.base import Recording
from pdavis_cv.selfcal import TYPICAL_BANDWIDTH, Bandwidth

__all__ = ["LOOKS_S", "Past"]

LOOKS_S = (0.5, 1.0, 2.0, 4.0, 8.0)
"""When the past is looked at, seconds after the first frame."""

# A corner frequency that is off by less, of its log, is not worth beginning again for.
_WORTHWHILE = 0.05


class Past:
    """Parameters of ``kalman`` that are learned as a recording goes on.

    At a few times, ever further apart, the bandwidth of the photoreceptors and the
    noise of their events are estimated from what had arrived by then, as
    `bandwidth_in_situ` does; until the first of them the bandwidth is the calibration's
    or the usual one, with the uncertainty that this has.  So what holds at t depends on
    t alone.

    Parameters
    ----------
    recording : Recording
    thresholds : (on, off)
        Expected contrast thresholds, natural-log units, scalars or (H, W).
    calibration : Calibration or None
        Applied to the frames.
    parameters : mapping of str to object
        Of `KalmanFilter`.  A ``bandwidth`` that is "in-situ" is learned, and the
        events' noise unless ``noise`` is given.
    """

    def __init__(
        self, recording: Recording, thresholds: tuple[ArrayLike, ArrayLike],
        calibration: Calibration | None, parameters: Mapping[str, Any],
    ) -> None:
        self._recording, self._thresholds = recording, thresholds
        self._calibration = calibration
        first = dict(parameters)
        self._asked = isinstance(first.get("bandwidth"), str)
        self._noise_too = "noise" not in first
        first.setdefault("noise", noise_of(calibration))
        self._stated = stated_bandwidth(calibration)
        if self._asked:
            first["bandwidth"] = self._stated or TYPICAL_BANDWIDTH
        self._known: list[dict[str, Any]] = [first]
        self._looks: tuple[int, ...] | None = None

    def parameters_at(self, t_us: int) -> dict[str, Any]:
        """Return the parameters that hold at t_us; the same object while they do."""
        if self._looks is None:
            self._looks = self._times()
        looked = sum(look <= t_us for look in self._looks)
        while len(self._known) <= looked:
            self._known.append(
                self._look(self._looks[len(self._known) - 1], self._known[-1]))
        return self._known[looked]

    def _times(self) -> tuple[int, ...]:
        if self._recording.info.frame_count == 0 or not (
                self._asked or self._noise_too):
            return ()
        start = first_time(self._recording)
        return () if start is None else tuple(
            start + round(1e6 * seconds) for seconds in LOOKS_S)

    def _look(self, t_us: int, before: dict[str, Any]) -> dict[str, Any]:
        known = checked_bandwidth(before.get("bandwidth"))
        found, noise = receptors(
            self._recording, self._thresholds, self._calibration,
            None if self._asked else known, by_us=t_us)
        now = dict(before)
        if found is not None and _is_news(found, known):
            now["bandwidth"] = (*found.law, found.sigma)
        if self._noise_too and noise is not None:
            now["noise"] = noise_of(self._calibration, noise)
        return before if now == before else now


def _is_news(found: Bandwidth, known: Sequence[float]) -> bool:
    """Tell whether a bandwidth is better known than before, and another one."""
    if found.sigma > known[2]:
        return False
    level = found.at_intensity * np.array([1.0, 10.0])
    change = np.log((found.hz + found.hz_per_intensity * level)
                    / (known[0] + known[1] * level))
    return bool(np.abs(change).max() > _WORTHWHILE
                or found.sigma < known[2] / 2)
