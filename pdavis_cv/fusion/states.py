"""The state of a method while a stream is fed to it, in one of three orders.

`InOrderState` is fed in time order.  The other two are fed in the order of arrival, in
which a frame comes after events that it acts on: `ArrivalState` for methods that take
late frames themselves, `ReplayState` for all others.
"""
from __future__ import annotations

import warnings
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from pdavis_cv._types import Events
from pdavis_cv.errors import ExposureWarning
from pdavis_cv.fusion.feed import LONGEST_DELAY_US, together
from pdavis_cv.fusion.window import Window
from pdavis_cv.pixel.sample import PixelSample
from pdavis_cv.reconstruct.base import Reconstructor, Snapshot, feed_events
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame

_SMALL = 4096
"""Most events that are joined before they are fed in time order.  To feed a packet
costs as much as a thousand events."""


class _MethodState:
    """A method, the window that it computes, and the sample to learn from.

    The method is for the size of the window; the sample is fed the same events and
    frames, of the whole sensor.
    """

    def __init__(
        self, method: Reconstructor, window: Window, sample: PixelSample | None
    ) -> None:
        self.method, self.window, self.sample = method, window, sample
        self.fed_us: int | None = None

    def add_wave(self, wave: Wave) -> None:
        """Add the lamp's flicker."""
        self.method.add_wave(wave)

    def mark_fed(self, t_us: int) -> None:
        """Note that everything up to t_us, inclusive, has been fed."""
        self.fed_us = t_us if self.fed_us is None else max(self.fed_us, t_us)

    def settle(self, t_us: int) -> None:
        """Let the method do what is due when all data up to t_us have been fed."""
        self.method.settle(t_us)

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Change parameters of the method, given for the whole sensor, from t_us on."""
        self.method.retune(**self.window.planes(learned))

    def snapshot(self) -> Snapshot:
        """Return the method's state after everything up to `fed_us`."""
        return self.method.snapshot()

    def _feed(self, method: Reconstructor, events: Events) -> None:
        """Feed events of the whole sensor, where any lie in the window."""
        inside = self.window.events(events)
        if len(inside):
            feed_events(method, inside)


class InOrderState(_MethodState):
    """A method that is fed in time order, each frame at its mid-exposure."""

    def add_events(self, events: Events) -> None:
        """Add events of the whole sensor."""
        if self.sample is not None:
            self.sample.add_events(events)
        self._feed(self.method, events)

    def add_frame(self, frame: ApsFrame, clock_us: int = 0) -> None:
        """Add a corrected frame of the whole sensor.

        `clock_us` is added to its exposure times for the method; the sample tells the
        clock's offset and gets the frame unchanged.
        """
        if self.sample is not None:
            self.sample.add_frame(frame)
        self.method.add_frame(self.window.frame(frame.moved(clock_us)))

    @property
    def committed_us(self) -> int | None:
        """The same as `fed_us`: in time order, nothing that follows acts before it."""
        return self.fed_us

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, committed_us: int | None
    ) -> None:
        """Restore what `snapshot` returned."""
        self.method.restore(snapshot)
        self.fed_us = fed_us

    def set_clock(self, clock_us: int) -> None:
        """Do nothing: the Feed has already moved the frames."""


class ArrivalState(_MethodState):
    """A method that takes late frames, fed in the order of arrival.

    Only the sample to learn from is fed in time order: the events since the last
    frame's mid-exposure are kept, and passed to it when the next frame has arrived.

    `clock_us` is added to the exposure times of frames that arrive.  The method has
    been fed up to `fed_us`, inclusive; up to `committed_us` no later frame can act: the
    next frame's mid-exposure lies after it, at most `LONGEST_DELAY_US` before the last
    arrival.
    """

    def __init__(
        self, method: Reconstructor, window: Window, sample: PixelSample | None
    ) -> None:
        super().__init__(method, window, sample)
        self.clock_us = 0
        self.committed_us: int | None = None
        self._pending: deque[Events] = deque()   # events after committed_us

    def add_events(self, events: Events) -> None:
        """Add events of the whole sensor.

        After `restore`, events between `committed_us` and `fed_us` come again.  The
        method has them already, so that only the sample gets them.
        """
        fresh = 0 if self.fed_us is None else bisect_right(events["t"], self.fed_us)
        self._feed(self.method, events[fresh:])
        if self._keeps_events:
            self._pending.append(events)
        self._commit(int(events["t"][-1]) - LONGEST_DELAY_US)

    def add_frame(self, frame: ApsFrame) -> None:
        """Add a corrected frame of the whole sensor at its arrival."""
        mid = frame.mid_us + self.clock_us
        late = frame.available_us - mid > LONGEST_DELAY_US
        if late or (self.committed_us is not None and mid <= self.committed_us):
            warnings.warn(
                f"the frame exposed at {mid} us arrived more than "
                f"{LONGEST_DELAY_US} us later, or after a later one: left out",
                ExposureWarning, stacklevel=2)
            return
        self._commit(mid)
        if self.sample is not None:
            self.sample.add_frame(frame)
        self._apply_frame(self.window.frame(frame.moved(self.clock_us)))

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, committed_us: int | None
    ) -> None:
        """Restore what `snapshot` returned; later events have to be fed again."""
        self.method.restore(snapshot)
        self.fed_us, self.committed_us = fed_us, committed_us
        self._pending.clear()

    def set_clock(self, clock_us: int) -> None:
        """Set what is added to the exposure times of the frames to come."""
        self.clock_us = clock_us

    @property
    def _keeps_events(self) -> bool:
        """Whether events must be kept because something is fed in time order."""
        return self.sample is not None

    def _apply_frame(self, frame: ApsFrame) -> None:
        self.method.add_frame(frame)
        # All events of its exposure have arrived.
        self.method.settle(frame.available_us)

    def _feed_in_order(self, events: Events) -> None:
        """Feed events to what is fed in time order."""
        if self.sample is not None:
            self.sample.add_events(events)

    def _feed_together(self, parts: list[NDArray[Any]]) -> None:
        for events in together(parts):
            self._feed_in_order(events)

    def _commit(self, before_us: int) -> None:
        """Feed the pending events before before_us in time order and drop them."""
        due: list[Events] = []
        room = _SMALL
        while self._pending and self._pending[0]["t"][0] < before_us:
            events = self._pending.popleft()
            n = bisect_left(events["t"], before_us)
            if n > room:
                self._feed_together(due)
                due, room = [], _SMALL
            due.append(events[:n])
            room -= n
            if n < len(events):
                self._pending.appendleft(events[n:])
        self._feed_together(due)
        self.committed_us = before_us - 1 if self.committed_us is None else max(
            self.committed_us, before_us - 1)


class ReplayState(ArrivalState):
    """A method that takes frames in time order only, fed in the order of arrival.

    It needs two equal states.  The committed one stays at the last frame's
    mid-exposure.  When a frame arrives, it is advanced to that frame's mid-exposure and
    takes the frame.  The current one is then made from it by replaying the events
    since.  So the current state depends on the committed state, the parameters and the
    events since, and on nothing else.
    """

    _keeps_events = True

    def __init__(
        self, method: Reconstructor, committed: Reconstructor, window: Window,
        sample: PixelSample | None,
    ) -> None:
        super().__init__(method, window, sample)
        self._committed = committed

    def add_wave(self, wave: Wave) -> None:
        """Add the lamp's flicker."""
        super().add_wave(wave)
        self._committed.add_wave(wave)

    def mark_fed(self, t_us: int) -> None:
        """Do nothing: `fed_us` stays None, as `restore` needs all events again."""

    def retune(self, t_us: int, learned: dict[str, Any]) -> None:
        """Change parameters of the method, given for the whole sensor.

        They apply from the committed state on, which is advanced to at least a fixed
        delay before t_us first: the stream alone determines that time, not its packets.
        """
        self._commit(t_us - LONGEST_DELAY_US)
        parameters = self.window.planes(learned)
        self._committed.retune(**parameters)
        self.method.retune(**parameters)
        self._replay()

    def snapshot(self) -> Snapshot:
        """Return the committed state; the events since have to be fed again."""
        return self._committed.snapshot()

    def restore(
        self, snapshot: Snapshot, fed_us: int | None, committed_us: int | None
    ) -> None:
        """Restore what `snapshot` returned; later events have to be fed again."""
        super().restore(snapshot, None, committed_us)
        self._committed.restore(snapshot)

    def _apply_frame(self, frame: ApsFrame) -> None:
        self._committed.add_frame(frame)
        self._replay()

    def _feed_in_order(self, events: Events) -> None:
        super()._feed_in_order(events)
        self._feed(self._committed, events)

    def _replay(self) -> None:
        """Make the current state from the committed one and the pending events."""
        self.method.assign(self._committed)
        if self.method.denoiser is not None and self._committed.denoiser is not None:
            self.method.denoiser.restore(self._committed.denoiser.state())
        for events in self._pending:
            self._feed(self.method, events)


def make_state(
    make_method: Callable[[], Reconstructor], window: Window,
    sample: PixelSample | None, *, causal: bool,
) -> InOrderState | ArrivalState:
    """Return a state that feeds the method in the order it needs.

    `make_method` makes one of the window's size; with `causal` frames are fed at their
    arrival instead of their mid-exposure.  See `InOrderState`.
    """
    method = make_method()
    if not (causal and method.needs.frames):
        return InOrderState(method, window, sample)
    if method.takes_late_frames:
        return ArrivalState(method, window, sample)
    return ReplayState(method, make_method(), window, sample)
