"""Base of formats without an index, which can only be read from the beginning."""
from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.recording.base import Packet
from pdavis_cv.recording.files import FileRecording
from pdavis_cv.recording.packetise import Batch, cell_start, packetise
from pdavis_cv.recording.scratch import Gathering, Scratch
from pdavis_cv.recording.timeline import Clock, Marks, Timeline

__all__ = ["SequentialRecording", "likely_size"]

MARK_PLACES = 1 << 20
"""Smallest distance of two positions where reading can resume, bytes or rows."""
_SIZES = ((260, 346), (480, 640), (720, 1280))
"""(height, width) of usual sensors, for files without a sensor size."""


def likely_size(x: int, y: int) -> tuple[int, int]:
    """Return the (height, width) of the smallest usual sensor that holds a pixel.

    Parameters
    ----------
    x, y : int
        Largest column and row of the events.
    """
    return next(((h, w) for h, w in _SIZES if y < h and x < w), (y + 1, x + 1))


class SequentialRecording(FileRecording):
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
        """Return the events of the chunk at a position, and the next position.

        Parameters
        ----------
        at : int
            Position: a byte or a row.
        clock : Clock
            Clock of the events before; it is updated.
        state : object
            State from `_first`; it is updated.
        memory : Scratch
            Provides memory for the events.

        Returns
        -------
        events : ndarray of EVENT_DTYPE, shape (N,)
        after : int
            Next position; equal to `at` at the end of the file.
        """

    def _triggers(self, at: int, state: Any, after_us: int) -> NDArray[Any] | None:
        """Return the triggers of the chunk that was decoded last, if it has any.

        Parameters
        ----------
        at : int
            Position of the chunk.
        state : object
            State after it.
        after_us : int
            No trigger may be earlier.
        """
        return None

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        batches = (batch for batch, _ in self._pieces(start_us, Scratch()))
        return packetise(batches, start_us, stop_us)

    def events(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> NDArray[Any]:
        """Return the events of start_us <= time < stop_us as one array."""
        memory = Gathering(start_us, stop_us)
        for batch, after in self._pieces(start_us, memory):
            if batch.events is not None and memory.keep(batch.events):
                break
            if start_us is stop_us is None:
                memory.expect((after - self._begin) / (self._end - self._begin))
        return memory.events

    def _pieces(self, start_us: int | None, memory: Scratch
                ) -> Iterator[tuple[Batch, int]]:
        """Yield the samples of each chunk, and the next position."""
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
                return
            yield Batch(events, triggers=self._triggers(at, state, before),
                        complete_us=clock.last), after
            at = after

    @property
    def _marks(self) -> Marks:
        if "_made_marks" not in self.__dict__:
            self._made_marks = Marks(MARK_PLACES)
        return self._made_marks
