"""Store of recent events, and a summary of the older ones of each pixel."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, Records, State
from pdavis_cv.reconstruct.model import NO_GAP, STORED_DTYPE, TRACK_DTYPE

__all__ = ["LONG_AGO", "LOOKAHEAD_US", "Tracks", "as_bytes"]

LOOKAHEAD_US = 50_000
"""Default look-ahead, us: how long to wait for each pixel's next event."""

LONG_AGO = -(2**62)
"""A time in us before all stamps; differences to it fit into 64 bits."""

_LINE = 64
"""Bytes of a cache line, or a multiple of them."""
_LEAST = 1 << 14
"""Initial capacity in events; it doubles when it is full."""


class Tracks:
    """Store of the recent events, and a summary of the older ones of each pixel.

    An event is pushed, and committed once it precedes every later read.

    Parameters
    ----------
    shape : (int, int)
        (height, width).

    Attributes
    ----------
    tracks : ndarray of TRACK_DTYPE, shape (H, W)
        Last events and counts of each pixel over the committed events.
    store : ndarray of STORED_DTYPE, shape (capacity,)
        Events; once `chain` was asked for, those that are not committed are linked by
        pixel: records of `tracks` hold the first, events the next one.
    committed : int
        Index of the first event that is not committed.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.tracks = _no_events(shape)
        self.store = np.zeros(_LEAST, STORED_DTYPE)
        self.committed = self._stop = 0
        self._chained: tuple[int, int] | None = None

    @property
    def chain(self) -> tuple[Records, Records]:
        """The store chained to `tracks`, and `tracks`."""
        span = self.committed, self._stop
        if self._chained != span:
            self._unchain()
            _kernels.store_link(self.store, *span, self.tracks)
            self._chained = span
        return self.store, self.tracks

    def push(self, events: Events, last_us: int) -> int:
        """Append events; return how many.

        Events are taken up to the first one that is out of order or off the sensor.
        """
        self._make_room(len(events))
        taken = _kernels.store_push(
            events, last_us, self._stop, self.store, *self.tracks.shape)
        self._stop += taken
        return taken

    @property
    def waiting_us(self) -> int | None:
        """Time of the first event that is not committed, None if there is none."""
        return (int(self.store["t"][self.committed])
                if self.committed < self._stop else None)

    def commit(self, until_us: int) -> None:
        """Commit all events up to until_us, inclusive."""
        if self.committed < self._stop:
            self.committed = _kernels.store_commit(
                self.store, self.committed, self._stop, until_us, self.tracks)

    def _unchain(self) -> None:
        """Remove the chains, whose indices a move of the store would invalidate."""
        if self._chained is not None:
            _kernels.store_unlink(self.store, *self._chained, self.tracks)
            self._chained = None

    def _make_room(self, n: int) -> None:
        if self._stop + n <= len(self.store):
            return
        self._unchain()
        # Half of the capacity stays free, so that the store is rarely moved.
        room = max(len(self.store), 2 * (self._stop - self.committed + n))
        old = as_bytes(self.store[self.committed:self._stop])
        if room > len(self.store):
            self.store = np.empty(room, STORED_DTYPE)
        as_bytes(self.store)[:old.size] = old
        self._stop -= self.committed
        self.committed = 0

    def assign(self, other: Tracks) -> None:
        """Copy the state of an equal object."""
        self.restore(other.state())

    def state(self) -> State:
        """Return copies of everything."""
        self._unchain()
        return {"tracks": as_bytes(self.tracks).copy(),
                "store": as_bytes(self.store[self.committed:self._stop]).copy()}

    def restore(self, state: State) -> None:
        """Return to what `state` returned, which is copied."""
        self._unchain()
        as_bytes(self.tracks)[:] = state["tracks"]
        stored = state["store"]
        n = stored.size // STORED_DTYPE.itemsize
        if n > len(self.store):
            self.store = np.empty(2 * n, STORED_DTYPE)
        as_bytes(self.store)[:stored.size] = stored
        self.committed, self._stop = 0, n


def _no_events(shape: tuple[int, int]) -> Records:
    """Return tracks of pixels without events, each within one cache line."""
    record = TRACK_DTYPE.itemsize
    # A record viewed as void is copied at once, not field by field.
    none = np.array((2 * LONG_AGO, 0, 0, NO_GAP, -1), TRACK_DTYPE).view(f"V{record}")
    size = shape[0] * shape[1] * record
    room = np.zeros(size + _LINE, np.uint8)
    begin = -room.ctypes.data % _LINE
    tracks = room[begin:begin + size].view(TRACK_DTYPE)
    tracks.view(none.dtype)[:] = none
    return tracks.reshape(shape)


def as_bytes(events: Events) -> NDArray[np.uint8]:
    """Return records viewed as bytes, which are copied ten times as fast."""
    # NumPy copies unaligned records field by field.
    return events.view(np.uint8)
