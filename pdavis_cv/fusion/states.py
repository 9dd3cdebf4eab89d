"""The state of a method as a stream passes, and what looks on."""
from __future__ import annotations

import warnings
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.errors import ExposureWarning
from pdavis_cv.fusion.feed import LONGEST_DELAY_US
from pdavis_cv.fusion.window import Window
from pdavis_cv.reconstruct.base import Reconstructor, Snapshot
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.selfcal import SelfCalibration

__all__ = ["AsItArrives", "Held", "InOrder", "Replayed", "Script", "Told", "states_of"]

Told = tuple[str, tuple[Any, ...]]
"""Name of a method of the states, and what it was called with."""


@dataclass(frozen=True, eq=False)
class Held:
    """All that states hold, to go on with elsewhere; picklable.

    Parameters
    ----------
    state : Snapshot
    fed_us, behind_us : int or None
        As of the states.
    since : tuple of ndarray of EVENT_DTYPE
        Events after behind_us.
    clock_us : int
        Added to the exposure times of frames that arrive.
    """

    state: Snapshot
    fed_us: int | None
    behind_us: int | None
    since: tuple[NDArray[Any], ...] = ()
    clock_us: int = 0


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
        """Go on from t_us with other parameters of the method, of the whole sensor."""
        self.method.retune(**self.window.planes(learned))

    def snapshot(self) -> Snapshot:
        """Return the state after everything up to `fed_us`."""
        return self.method.snapshot()

    @property
    def behind_us(self) -> int | None:
        """As `fed_us`: what comes later acts later."""
        return self.fed_us

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, behind_us: int | None
    ) -> None:
        """Return to what `snapshot` returned."""
        self.method.restore(snapshot)
        self.fed_us = fed_us

    def set_clock(self, clock_us: int) -> None:
        """Nothing to do: what feeds it moves the frames."""

    def held(self) -> Held:
        """Return all that is held."""
        return Held(self.snapshot(), self.fed_us, self.behind_us)

    def take(self, held: Held) -> None:
        """Go on from what equal states held."""
        self.restore(held.state, held.fed_us, held.behind_us)


class AsItArrives:
    """The state of a method that `takes_late_frames`, and the camera behind it.

    The method is fed what arrives when it arrives.  The camera is fed the same in order
    of time: it stays behind at the last frame's mid-exposure, and gets the events since
    when the next frame has arrived.

    Parameters
    ----------
    method : Reconstructor
        Of the window.
    window : Window
    camera : SelfCalibration, optional
        Looks on, at the whole sensor.

    Attributes
    ----------
    clock_us : int
        Added to the exposure times of frames that arrive.
    fed_us : int or None
        Time up to which, inclusive, the state has been fed.
    behind_us : int or None
        Time up to which, inclusive, nothing acts any more: the next frame's
        mid-exposure lies after it.  `LONGEST_DELAY_US` or less behind what arrived.
    """

    def __init__(
        self, method: Reconstructor, window: Window, camera: SelfCalibration | None
    ) -> None:
        self.method, self.window, self.camera = method, window, camera
        self.clock_us = 0
        self.fed_us: int | None = None
        self.behind_us: int | None = None
        self._since: deque[NDArray[Any]] = deque()   # events after behind_us

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events of the whole sensor; of those before `fed_us` the camera's part.

        They come again after a `restore`.
        """
        fresh = 0 if self.fed_us is None else bisect_right(events["t"], self.fed_us)
        inside = self.window.events(events[fresh:])
        if len(inside):
            self.method.add_events(inside)
        if self._follows:
            self._since.append(events)
        self._advance(int(events["t"][-1]) - LONGEST_DELAY_US)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame of the whole sensor, corrected, when it has arrived."""
        mid = frame.mid_us + self.clock_us
        late = frame.available_us - mid > LONGEST_DELAY_US
        if late or (self.behind_us is not None and mid <= self.behind_us):
            warnings.warn(
                f"the frame exposed at {mid} us arrived more than "
                f"{LONGEST_DELAY_US} us later, or after a later one: left out",
                ExposureWarning, stacklevel=2)
            return
        self._advance(mid)
        if self.camera is not None:
            self.camera.add_frame(frame)
        self._use(self.window.frame(frame.moved(self.clock_us)))

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers."""
        if self.camera is not None:
            self.camera.add_wave(wave)
        self.method.add_wave(wave)

    def passed(self, t_us: int) -> None:
        """Note that everything that arrived up to t_us, inclusive, has been there."""
        self.fed_us = t_us if self.fed_us is None else max(self.fed_us, t_us)

    def settle(self, t_us: int) -> None:
        """Do what is due when everything up to t_us, inclusive, has been there."""
        self.method.settle(t_us)

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Go on from t_us with other parameters of the method, of the whole sensor."""
        self.method.retune(**self.window.planes(learned))

    def snapshot(self) -> Snapshot:
        """Return the state after everything up to `fed_us`."""
        return self.method.snapshot()

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, behind_us: int | None
    ) -> None:
        """Return to what `snapshot` returned; events after behind_us are fed again."""
        self.method.restore(snapshot)
        self.fed_us, self.behind_us = fed_us, behind_us
        self._since.clear()

    def set_clock(self, clock_us: int) -> None:
        """Add this to the exposure times of the frames to come."""
        self.clock_us = clock_us

    def held(self) -> Held:
        """Return all that is held."""
        return Held(self.snapshot(), self.fed_us, self.behind_us, tuple(self._since),
                    self.clock_us)

    def take(self, held: Held) -> None:
        """Go on from what equal states held."""
        self.restore(held.state, held.fed_us, held.behind_us)
        self._since = deque(held.since)
        self.clock_us = held.clock_us

    @property
    def _follows(self) -> bool:
        """Whether anything is fed in order of time."""
        return self.camera is not None

    def _use(self, frame: ApsFrame) -> None:
        self.method.add_frame(frame)
        # All that its exposure needs has arrived.
        self.method.settle(frame.available_us)

    def _pass(self, events: NDArray[Any]) -> None:
        """Feed events in order of time."""
        if self.camera is not None:
            self.camera.add_events(events)

    def _advance(self, before_us: int) -> None:
        """Pass the events before before_us."""
        while self._since and self._since[0]["t"][0] < before_us:
            events = self._since.popleft()
            n = bisect_left(events["t"], before_us)
            self._pass(events[:n])
            if n < len(events):
                self._since.appendleft(events[n:])
        self.behind_us = before_us - 1 if self.behind_us is None else max(
            self.behind_us, before_us - 1)


class Replayed(AsItArrives):
    """Two states, for a method that takes frames in order of time only.

    One stays behind with the camera.  When a frame arrives it is advanced to the
    frame's mid-exposure and takes it; the current one continues from there with the
    events that followed.  So the current state is at all times a function of the one
    behind, its parameters and the events since.

    Parameters
    ----------
    method, behind : Reconstructor
        The two states, equal to each other.
    window, camera
        As for `AsItArrives`.
    """

    _follows = True

    def __init__(
        self, method: Reconstructor, behind: Reconstructor, window: Window,
        camera: SelfCalibration | None,
    ) -> None:
        super().__init__(method, window, camera)
        self._behind = behind

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers."""
        super().add_wave(wave)
        self._behind.add_wave(wave)

    def passed(self, t_us: int) -> None:
        """Note that everything that arrived up to t_us has been there."""

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Go on from t_us with other parameters of the method, of the whole sensor.

        They hold from where the state behind is: at a place that the stream alone
        determines, not the packets that it came in.
        """
        self._advance(t_us - LONGEST_DELAY_US)
        seen = self.window.planes(learned)
        self._behind.retune(**seen)
        self.method.retune(**seen)
        self._catch_up()

    def snapshot(self) -> Snapshot:
        """Return the state behind; what followed is to be fed again."""
        return self._behind.snapshot()

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, behind_us: int | None
    ) -> None:
        """Return to what `snapshot` returned; events after behind_us are fed again."""
        super().restore(snapshot, None, behind_us)
        self._behind.restore(snapshot)

    def take(self, held: Held) -> None:
        """Go on from what equal states held."""
        super().take(held)
        self._catch_up()

    def _use(self, frame: ApsFrame) -> None:
        self._behind.add_frame(frame)
        self._catch_up()

    def _pass(self, events: NDArray[Any]) -> None:
        super()._pass(events)
        inside = self.window.events(events)
        if len(inside):
            self._behind.add_events(inside)

    def _catch_up(self) -> None:
        self.method.assign(self._behind)
        for events in self._since:
            inside = self.window.events(events)
            if len(inside):
                self.method.add_events(inside)


def states_of(
    made: Callable[[], Reconstructor], window: Window, camera: SelfCalibration | None,
    *, causal: bool,
) -> InOrder | AsItArrives:
    """Return what a stream is fed to.

    Parameters
    ----------
    made : callable
        Makes the method, of the window.
    window, camera
        As for `InOrder`.
    causal : bool
        Whether frames are fed when they arrive, not at their mid-exposure.
    """
    method = made()
    if not (causal and method.needs.frames):
        return InOrder(method, window, camera)
    if method.takes_late_frames:
        return AsItArrives(method, window, camera)
    return Replayed(method, made(), window, camera)


class Script:
    """Notes what states are told, in order, so that others can be told the same.

    Parameters
    ----------
    states : InOrder or AsItArrives
    follow : bool
        Whether these do what they are told; else they only say what their method is.

    Attributes
    ----------
    told : list of Told
        Since it was last emptied.
    """

    def __init__(self, states: InOrder | AsItArrives, *, follow: bool) -> None:
        self.states, self._follow = states, follow
        self.told: list[Told] = []

    @property
    def method(self) -> Reconstructor:
        """The current state."""
        return self.states.method

    @property
    def fed_us(self) -> int | None:
        """Time up to which, inclusive, the states have been fed."""
        return self.states.fed_us

    @property
    def behind_us(self) -> int | None:
        """Time up to which, inclusive, nothing acts any more."""
        return self.states.behind_us

    def add_events(self, events: NDArray[Any]) -> None:
        """Note events of the whole sensor."""
        self._tell("add_events", events)

    def add_frame(self, frame: ApsFrame) -> None:
        """Note a frame of the whole sensor, corrected."""
        self._tell("add_frame", frame)

    def add_wave(self, wave: Wave) -> None:
        """Note how the lamp flickers."""
        self._tell("add_wave", wave)

    def passed(self, t_us: int) -> None:
        """Note that everything up to t_us, inclusive, has been there."""
        self._tell("passed", t_us)

    def settle(self, t_us: int) -> None:
        """Note that what is due can be done."""
        self._tell("settle", t_us)

    def set_clock(self, clock_us: int) -> None:
        """Note by how much the stamps of frames are off."""
        self._tell("set_clock", clock_us)

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Note other parameters of the method."""
        self._tell("retune", t_us, learned)

    def snapshot(self) -> Snapshot:
        """Return the state after everything up to `fed_us`."""
        return self.states.snapshot()

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, behind_us: int | None
    ) -> None:
        """Return to what `snapshot` returned."""
        self.states.restore(snapshot, fed_us, behind_us)

    def _tell(self, name: str, *args: Any) -> None:
        self.told.append((name, args))
        if self._follow:
            getattr(self.states, name)(*args)
