"""Estimation of the camera's parameters again and again while a stream passes."""
from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from pdavis_cv._types import State
from pdavis_cv.fusion.learning import Learned, Learning

FIRST_LOOK_S = 0.1
"""Time of the first estimate from a passing stream, in s of stream time after the first
frame; the next ones follow at 1.4 times, twice, 2.8 times ... that.  Engineering
choice: two or three frames of the paper's cameras (lab.studies.constants).  At 1.19
times or twice, AoP errs by x .994 or 1.002 (five cells, seeds 1001, 1002)."""

_DELAY = 1 / 8
"""An estimate from the first T seconds is applied after T / 8 more, as it is computed
while the stream goes on.  Engineering choice (lab.studies.constants)."""

_AGAIN_US = 20_000
"""Stream time after which an estimate that is not there is asked for again, us."""


class OnlineLearning:
    """Re-estimates the parameters while a stream passes.

    A sample is fed the same data as the method.  At a look, the estimate from the
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
    sample : PixelSample
        What events and frames are added to.
    next_us : int or None
        Time at which `look` is due.
    """

    def __init__(self, learning: Learning, *, waits: bool = True) -> None:
        self._learning, self._waits = learning, waits
        self.tuning = learning.prior
        self.sample = learning.sample()
        self.next_us: int | None = None
        self._start_us: int | None = None
        self._looks = 0
        self._pending: Future[Learned] | None = None

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
                1e6 * FIRST_LOOK_S * 2.0 ** (self._looks / 2))
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
        found, self._pending = self._pending.result(), None
        self.tuning = self._learning.tuned(before, found)
        self._look_from(self.next_us + 1)
        return self.tuning.changes(before)

    def _started(self) -> Future[Learned]:
        """Start an estimate from the data so far, in a thread."""
        passed, before = self.sample.state(), self.tuning

        def estimated() -> Learned:
            """Estimate from a copy, as the original is fed meanwhile."""
            sample = self._learning.sample()
            sample.restore(passed)
            return self._learning.estimate(sample, before)

        one = ThreadPoolExecutor(1, "pdavis-learning")
        future = one.submit(estimated)
        one.shutdown(wait=False)
        return future

    def state(self) -> State:
        """Return the state; its arrays are never changed in place."""
        return {"tuning": self.tuning, "next_us": self.next_us,
                "start_us": self._start_us, "looks": self._looks,
                "pending": None if self._pending is None else self._pending.result(),
                "sample": self.sample.state()}

    def restore(self, state: State) -> None:
        """Return to what `state` returned."""
        self.tuning, self.next_us = state["tuning"], state["next_us"]
        self._start_us, self._looks = state["start_us"], state["looks"]
        self._pending = None
        if state["pending"] is not None:
            self._pending = Future()
            self._pending.set_result(state["pending"])
        self.sample.restore(state["sample"])
