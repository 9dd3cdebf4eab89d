"""Reusable memory for one pass over a file of events.

The system maps fresh memory page by page, which costs about as much as decoding the
events that are stored there.
"""
from __future__ import annotations

from bisect import bisect_left
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.limits import Budget

_LEAST_ROOM = 1 << 16
_SPARE = 1.05
"""Memory to reserve, relative to the size predicted from the first chunk."""


class Scratch:
    """A reusable buffer for a file's bytes; memory for events is new each time."""

    def __init__(self) -> None:
        self._bytes = np.empty(0, np.uint8)

    def read(self, reader: FileReader, at: int, size: int) -> NDArray[np.uint8]:
        """Return up to size bytes of a file, valid until the next call.

        Raises as `FileReader.read_into` does.
        """
        if len(self._bytes) < size:
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:reader.read_into(at, self._bytes[:size].data)]

    def room(self, count: int) -> NDArray[Any]:
        """Return an array of EVENT_DTYPE, shape (count,), to be filled."""
        return np.empty(count, EVENT_DTYPE)

    def reserve(self, count: int) -> None:
        """Prepare for more events; `room` needs no such preparation here."""


class Gathering(Scratch):
    """A Scratch that collects the events of all chunks in one array.

    They are those in [start_us, stop_us), by default all; their memory is taken from
    the budget.
    """

    def __init__(self, start_us: int | None, stop_us: int | None, budget: Budget
                 ) -> None:
        super().__init__()
        self._budget = budget
        self._start, self._stop = start_us, stop_us
        self._all = np.empty(0, EVENT_DTYPE)
        self._first = self._end = 0

    def room(self, count: int) -> NDArray[Any]:
        """Return the part of the array after the events that were kept."""
        self.reserve(count)
        return self._all[self._end:self._end + count]

    def reserve(self, count: int) -> None:
        """Reserve memory for more events; pages never written take no memory."""
        if self._end + count > len(self._all):
            more = np.empty(max(self._end + count, 2 * len(self._all), _LEAST_ROOM),
                            EVENT_DTYPE)
            copy_rows(self._all[:self._end], more[:self._end])
            self._all = more

    def expect(self, share: float) -> None:
        """Reserve memory for the whole file, a fraction of which has been kept."""
        if self._end > share * len(self._all):  # otherwise it would soon move again
            # The share may be a damaged one.
            most = self._budget.limits.ratio * self._budget.size / EVENT_DTYPE.itemsize
            self.reserve(int(min((_SPARE / share - 1) * self._end, most)))

    def keep(self, events: NDArray[Any]) -> bool:
        """Keep the next events inside the interval; return whether its end is reached.

        They lie in memory from `room`, or elsewhere.
        """
        lo = 0 if self._start is None else bisect_left(events["t"], self._start)
        hi = (len(events) if self._stop is None
              else bisect_left(events["t"], self._stop))
        if lo < hi:
            self._budget.total((self._end + hi) * events.itemsize)
            self.reserve(hi)
            if events.base is not self._all:
                copy_rows(events[:hi], self._all[self._end:self._end + hi])
            if self._first == self._end:
                self._first += lo
            self._end += hi
        return hi < len(events)

    @property
    def events(self) -> NDArray[Any]:
        """The events that were kept, EVENT_DTYPE, shape (N,)."""
        events = self._all[self._first:self._end]
        for t_us in events["t"][[0, -1]].tolist() if len(events) else ():
            self._budget.time(t_us)
        return events


def copy_rows(events: NDArray[Any], out: NDArray[Any]) -> None:
    """Copy by bytes, as NumPy copies packed structures field by field."""
    np.frombuffer(out, np.uint8)[:] = np.frombuffer(events, np.uint8)
