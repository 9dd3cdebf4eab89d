"""Estimation of the camera's parameters again and again while a stream passes."""
from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from pdavis_cv._types import State
from pdavis_cv.fusion.learning import Learning
from pdavis_cv.reconstruct.stream_clock import checked_bandwidth
from pdavis_cv.selfcal import Bandwidth, CameraEstimate
from pdavis_cv.selfcal.refractory import Refractory

__all__ = ["FIRST_LOOK_S", "OnlineLearning"]

FIRST_LOOK_S = 0.5
"""Time of the first estimate from a passing stream, in s of stream time after the first
frame; the next ones follow at twice, four times ... that."""

_DELAY = 1 / 8
"""An estimate from the first T seconds is applied after T / 8 more, as it is computed
while the stream goes on.  The later, the worse: left-out frames of `davis346.aedat4`
are predicted with an error of 0.359 if it is applied at T + T / 8, of 0.358 at T and of
0.366 at T + T / 4."""

_AGAIN_US = 20_000
"""Stream time after which an estimate that is not there is asked for again, us."""

_WORTHWHILE = 0.05
"""Least change of a parameter that is applied: of the ln of the corner frequency, or
relative to the refractory period."""

_LEVELS = np.array([1.0, 10.0])
"""Intensities at which bandwidths are compared, relative to `Bandwidth.at_intensity`:
dim light, and a bright pixel's."""

_SIGMAS = 3.0
"""Least change of the refractory period that is applied, in standard errors."""

class OnlineLearning:
    """Re-estimates the parameters while a stream passes.

    The estimator is fed the same data as the method.  At a look, the estimate from the
    data so far is started in a thread, and it is applied after an eighth of their time
    more.  The method's state then continues with the new tuning: past data are not
    processed again.

    Parameters
    ----------
    learning : Learning
        Which parameters are estimated.
    waits : bool
        Whether an estimate that is not there in time is waited for, so that all images
        depend on the stream alone.  Otherwise they go on without it, and it is applied
        when it is there.

    Attributes
    ----------
    tuning : Tuning
        Parameters that apply now.
    camera : SelfCalibration
        What events, frames and the lamp's flicker are added to.
    next_us : int or None
        Time at which `look` is due.
    """

    def __init__(self, learning: Learning, *, waits: bool = True) -> None:
        self._learning, self._waits = learning, waits
        self.tuning = learning.prior
        self.camera = learning.estimator()
        self.next_us: int | None = None
        self._start_us: int | None = None
        self._looks = 0
        self._pending: Future[CameraEstimate] | None = None

    def begin(self, start_us: int, now_us: int) -> None:
        """Count the time of the looks from start_us, if this is the first call.

        It is the middle of the first frame that passes, or the time of the first event
        if frames are not used.
        """
        if self._start_us is None:
            self._start_us = start_us
            self._look_from(now_us)

    def _look_from(self, t_us: int) -> None:
        """Let the next look be the first one at t_us or later."""
        assert self._start_us is not None
        while True:
            self.next_us = self._start_us + round(
                1e6 * FIRST_LOOK_S * 2.0 ** self._looks)
            if self.next_us >= t_us:
                return
            self._looks += 1

    def look(self) -> dict[str, Any]:
        """Do what is due at `next_us`; return the parameters that change.

        Either starts an estimate from the data so far, or applies one that was started.
        """
        assert self.next_us is not None
        assert self._start_us is not None
        before = self.tuning
        if self._pending is None:
            self._pending = self._started()
            self.next_us += round(_DELAY * (self.next_us - self._start_us))
            return {}
        if not (self._waits or self._pending.done()):
            self.next_us += _AGAIN_US
            return {}
        estimate, self._pending = self._pending.result(), None
        clock = estimate.clock_offset
        if clock is not None and clock.ambiguous:
            estimate = dataclasses.replace(estimate, bandwidth=None)
        if clock is not None and clock.sigma_us > before.clock.sigma_us:
            estimate, clock = dataclasses.replace(estimate, clock_offset=None), None
        if estimate.refractory is not None and not _differs(
                estimate.refractory, before.parameters.get("refractory_us", 0.0)):
            estimate = dataclasses.replace(estimate, refractory=None)
        moved = clock is not None and clock.applied_us != before.clock_us
        # A bandwidth that was estimated with other time stamps is outdated.
        known = before.parameters.get("bandwidth")
        if (estimate.bandwidth is not None and known is not None and not moved
                and not _is_better(estimate.bandwidth, checked_bandwidth(known))):
            estimate = dataclasses.replace(estimate, bandwidth=None)
        self.tuning = self._learning.tuned(before, estimate)
        self._look_from(self.next_us + 1)
        return self.tuning.changes(before)

    def _started(self) -> Future[CameraEstimate]:
        """Start an estimate from the data so far, in a thread."""
        passed, before = self.camera.state(), self.tuning

        def estimated() -> CameraEstimate:
            """Estimate from a copy, as the original is fed meanwhile."""
            camera = self._learning.estimator()
            camera.restore(passed)
            return self._learning.estimate(camera, before)

        one = ThreadPoolExecutor(1, "pdavis-learning")
        future = one.submit(estimated)
        one.shutdown(wait=False)
        return future

    def state(self) -> State:
        """Return the state; its arrays are never changed in place."""
        return {"tuning": self.tuning, "next_us": self.next_us,
                "start_us": self._start_us, "looks": self._looks,
                "pending": None if self._pending is None else self._pending.result(),
                "camera": self.camera.state()}

    def restore(self, state: State) -> None:
        """Return to what `state` returned."""
        self.tuning, self.next_us = state["tuning"], state["next_us"]
        self._start_us, self._looks = state["start_us"], state["looks"]
        self._pending = None
        if state["pending"] is not None:
            self._pending = Future()
            self._pending.set_result(state["pending"])
        self.camera.restore(state["camera"])


def _is_better(found: Bandwidth, known: Sequence[float]) -> bool:
    """Return whether a bandwidth is better known than before, and worth applying.

    It is if it differs by more than `_WORTHWHILE`, or halves the standard error.
    """
    if found.sigma > known[2]:
        return False
    level = found.at_intensity * _LEVELS
    change = np.log((found.hz + found.hz_per_intensity * level)
                    / (known[0] + known[1] * level))
    return bool(np.abs(change).max() > _WORTHWHILE
                or found.sigma < known[2] / 2)


def _differs(found: Refractory, known_us: float) -> bool:
    """Return whether a refractory period differs significantly from the known one."""
    return abs(found.us - known_us) > max(
        _SIGMAS * found.sigma_us if found.us else 0.0, _WORTHWHILE * known_us)
