"""Bases of readers that go piece by piece, and of formats without an index."""
from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import Packet, joined
from pdavis_cv.recording.files import FileRecording
from pdavis_cv.recording.packetise import Batch, cell_start, packetise
from pdavis_cv.recording.scratch import Gathering, Scratch
from pdavis_cv.recording.timeline import Clock, Marks, Timeline

MARK_PLACES = 1 << 20
"""Smallest distance of two positions where reading can resume, bytes or rows."""


class PiecewiseRecording(FileRecording):
    """A file that is read in pieces; a format implements `_pieces`."""

    @abstractmethod
    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each piece, and the share of the file read by then.

        Samples from ``cell_start(start_us)`` on are needed, None: all; without
        `frames`, only events.  `memory` provides that of the events.
        """

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        return packetise(self.batches(start_us, Scratch()), start_us, stop_us,
                         self._budget, own=True)

    def batches(self, start_us: int | None, memory: Scratch) -> Iterator[Batch]:
        """Return what `packets` divides; `memory` provides that of the events."""
        self._check_open()
        return (batch for batch, _ in self._pieces(start_us, memory))

    def events(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> NDArray[Any]:
        """Return the events of start_us <= time < stop_us as one array."""
        self._check_open()
        memory = Gathering(start_us, stop_us, self._budget)
        for batch, share in self._pieces(start_us, memory, frames=False):
            if batch.events is not None and memory.keep(batch.events):
                break
            if start_us is stop_us is None and share > 0:
                memory.expect(share)
        return memory.events

    def _release(self, batch: Batch, clock: Clock, due_us: int, promised: int, at: int,
                 memory: Scratch) -> None:
        """Add to a batch the events that a clock holds back from before a time.

        Those that came after samples of other streams from later than `promised`, which
        was complete then, are dropped.
        """
        if clock.overdue(due_us):
            parts = [] if batch.events is None else [batch.events.copy()]
            held = self._taken(None, 0, clock, at, memory)
            late = held["t"] < promised
            self._count(at, "late events", int(np.count_nonzero(late)), "events came "
                        "later than what other streams had gone on to")
            batch.events = joined([*parts, held[~late]])

    def _check_open(self) -> None:
        if self._closed:
            raise ValueError(f"{self._path.name}: recording is closed")


class SequentialRecording(PiecewiseRecording):
    """A file of events that is read in chunks; the first reading makes an index.

    A format sets `_begin` and `_end`, the positions of the first chunk and of the end
    of the file, and implements `_next`.
    """

    _begin = 0
    _end: int

    def _first(self) -> Any:
        """Return the decoder's state before the first chunk."""
        return None

    @abstractmethod
    def _next(self, at: int, clock: Clock, state: Any, memory: Scratch
              ) -> tuple[NDArray[Any], int]:
        """Return the events of the chunk at a byte or row, and the next position.

        That is equal to `at` at the end of the file.  The clock of the events before,
        and the state from `_first`, are updated; `memory` provides that of the events.
        """

    def _triggers(self, at: int, clock: Clock, state: Any, after_us: int
                  ) -> NDArray[Any] | None:
        """Return the triggers of the chunk decoded last, which lay at `at`, if any.

        Clock and state are those after it; no trigger may be earlier than `after_us`.
        """
        return None

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each chunk, and the share of the file read by then."""
        at, clock, state = self._begin, Clock(Timeline()), self._first()
        if start_us is not None:
            mark = self._marks.before(cell_start(start_us))
            if mark is not None:
                at, clock, state = mark
        while True:
            before = clock.last
            self._marks.note(at, before, (at, clock, state))
            events, after = self._next(at, clock, state, memory)
            if after == at:
                yield Batch(self._taken(None, 0, clock, at, memory)), 1.0
                return
            yield Batch(events, triggers=self._triggers(at, clock, state, before),
                        complete_us=clock.last), (
                after - self._begin) / (self._end - self._begin)
            at = after

    @cached_property
    def _marks(self) -> Marks:
        return Marks(MARK_PLACES)
