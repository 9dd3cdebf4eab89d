"""The state of a method as a stream passes: one, or with ``causal`` two."""
from __future__ import annotations

import warnings
from bisect import bisect_left
from collections import deque
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.errors import ExposureWarning
from pdavis_cv.fusion.feed import LONGEST_DELAY_US
from pdavis_cv.fusion.window import Window
from pdavis_cv.reconstruct.base import Reconstructor, Snapshot
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.selfcal import SelfCalibration

__all__ = ["AsItArrives", "InOrder"]


class InOrder:
    """One state, fed in order of time; frames at their mid-exposure.

    Parameters
    ----------
    method : Reconstructor
        Of the window.
    window : Window
    camera : SelfCalibration, optional
        Looks on: is fed the same, of the whole sensor.
    """

    def __init__(
        self, method: Reconstructor, window: Window, camera: SelfCalibration | None
    ) -> None:
        self.method, self.window, self.camera = method, window, camera
        self.fed_us: int | None = None

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events of the whole sensor."""
        if self.camera is not None:
            self.camera.add_events(events)
        inside = self.window.events(events)
        if len(inside):
            self.method.add_events(inside)

    def add_frame(self, frame: ApsFrame, clock_us: int = 0) -> None:
        """Take a frame of the whole sensor, corrected.

        Parameters
        ----------
        frame : ApsFrame
            Of which the camera learns as it is.
        clock_us : int
            Added to its exposure times for the method.
        """
        if self.camera is not None:
            self.camera.add_frame(frame)
        self.method.add_frame(self.window.frame(frame.moved(clock_us)))

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers."""
        if self.camera is not None:
            self.camera.add_wave(wave)
        self.method.add_wave(wave)

    def passed(self, t_us: int) -> None:
        """Note that everything up to t_us, inclusive, has been there."""
        self.fed_us = t_us if self.fed_us is None else max(self.fed_us, t_us)

    def settle(self, t_us: int) -> None:
        """Do what is due when everything up to t_us, inclusive, has been there."""
        self.method.settle(t_us)

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Go on from t_us with other parameters of the method."""
        self.method.retune(**learned)

    def snapshot(self) -> Snapshot:
        """Return the state after everything up to `fed_us`."""
        return self.method.snapshot()

    def restore(self, snapshot: Snapshot, fed_us: int | None) -> None:
        """Return to what `snapshot` returned."""
        self.method.restore(snapshot)
        self.fed_us = fed_us


class AsItArrives:
    """Two states, of which one stays behind at the last frame's mid-exposure.

    When a frame arrives, the state behind is advanced to its mid-exposure and takes
    it; the current one continues from there with the events that followed.  So the
    current state is at all times a function of the one behind, its parameters and the
    events since.

    Parameters
    ----------
    behind : InOrder
        Fed in order of time, `LONGEST_DELAY_US` or less behind what has arrived.
    method : Reconstructor
        The current state; equal to that of `behind`.

    Attributes
    ----------
    clock_us : int
        Added to the exposure times of frames that arrive.
    """

    def __init__(self, behind: InOrder, method: Reconstructor) -> None:
        self.behind, self.method, self.clock_us = behind, method, 0
        self._since: deque[NDArray[Any]] = deque()   # events after the state behind

    @property
    def fed_us(self) -> int | None:
        """Time up to which, inclusive, the state behind has been fed."""
        return self.behind.fed_us

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events of the whole sensor."""
        self._take(events)
        self._since.append(events)
        self._advance(int(events["t"][-1]) - LONGEST_DELAY_US)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame of the whole sensor, corrected, when it has arrived."""
        mid = frame.mid_us + self.clock_us
        late = frame.available_us - mid > LONGEST_DELAY_US
        if late or (self.fed_us is not None and mid <= self.fed_us):
            warnings.warn(
                f"the frame exposed at {mid} us arrived more than "
                f"{LONGEST_DELAY_US} us later, or after a later one: left out",
                ExposureWarning, stacklevel=2)
            return
        self._advance(mid)
        self.behind.fed_us = mid - 1
        self.behind.add_frame(frame, self.clock_us)
        self._catch_up()

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers."""
        self.method.add_wave(wave)
        self.behind.add_wave(wave)

    def passed(self, t_us: int) -> None:
        """Note that everything that arrived up to t_us has been there."""

    def settle(self, t_us: int) -> None:
        """Do what is due when everything up to t_us, inclusive, has been there."""
        self.method.settle(t_us)

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Go on from t_us with other parameters of the method.

        They hold from where the state behind is: at a place that the stream alone
        determines, not the packets that it came in.
        """
        self._advance(t_us - LONGEST_DELAY_US)
        self.behind.method.retune(**learned)
        self.method.retune(**learned)
        self._catch_up()

    def snapshot(self) -> Snapshot:
        """Return the state behind, after everything up to `fed_us`."""
        return self.behind.snapshot()

    def restore(self, snapshot: Snapshot, fed_us: int | None) -> None:
        """Return to what `snapshot` returned; what followed is to be fed again."""
        self.behind.restore(snapshot, fed_us)
        self._since.clear()
        self._catch_up()

    def _take(self, events: NDArray[Any]) -> None:
        inside = self.behind.window.events(events)
        if len(inside):
            self.method.add_events(inside)

    def _catch_up(self) -> None:
        self.method.assign(self.behind.method)
        for events in self._since:
            self._take(events)

    def _advance(self, before_us: int) -> None:
        """Feed the events before before_us to the state behind."""
        while self._since and self._since[0]["t"][0] < before_us:
            events = self._since.popleft()
            n = bisect_left(events["t"], before_us)
            self.behind.add_events(events[:n])
            self.behind.fed_us = before_us - 1
            if n < len(events):
                self._since.appendleft(events[n:])
