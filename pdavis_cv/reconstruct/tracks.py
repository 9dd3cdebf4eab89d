"""Recent events, for methods that look a little ahead or back."""
from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE

__all__ = ["TRACK_DTYPE", "Tracks", "as_bytes"]

TRACK_DTYPE = np.dtype(
    [("prev", "<i8"), ("last", "<i8"), ("n_off", "<i4"), ("n_on", "<i4")])
"""Stamps of a pixel's last two events (2 t + p), and counts since a reference."""

LOOKAHEAD_US = 50_000
"""How long a pixel's next event is waited for, unless nothing may be waited for."""

LONG_AGO = -(2**62)
_LEAST = 1 << 14


class Tracks:
    """Store of the events of the last moments, and each pixel's last ones.

    An event is pushed; then committed: it belongs to the past of every later read;
    then passed: the exposure of every later frame begins after it.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    keep_us : int
        How long committed events wait for a frame at least.
    late : bool
        Keep a second account of events, that of a reader who comes later.

    Attributes
    ----------
    tracks : ndarray of TRACK_DTYPE, shape (H, W)
        Of the committed events.
    late : ndarray of TRACK_DTYPE, shape (H, W), or (0, 0)
        Of the events that `commit_late` has committed; counts are never reset.
    old : ndarray of int64, shape (H, W, 2)
        Stamps of the last two events passed.
    store : ndarray of EVENT_DTYPE, shape (capacity,)
    link : ndarray of int32, shape (capacity,)
    first : ndarray of int32, shape (H, W)
        Chains by pixel, valid after `chain` until the next change.
    """

    def __init__(
        self, shape: tuple[int, int], keep_us: int, *, late: bool = False
    ) -> None:
        self.tracks = np.zeros(shape, TRACK_DTYPE)
        self.late = np.zeros(shape if late else (0, 0), TRACK_DTYPE)
        for tracks in (self.tracks, self.late):
            tracks["prev"] = tracks["last"] = 2 * LONG_AGO
        self.old = np.full((*shape, 2), 2 * LONG_AGO, np.int64)
        self.first = np.full(shape, -1, np.int32)
        self.store = np.zeros(_LEAST, EVENT_DTYPE)
        self.link = np.zeros(_LEAST, np.int32)
        self.keep_us = int(keep_us)
        self.committed = self._passed = self._late = self._stop = 0

    def push(self, events: NDArray[Any], last_us: int) -> int:
        """Append events; return how many were taken (see `store_push`)."""
        self._make_room(len(events))
        taken = _kernels.store_push(
            events, last_us, *self.tracks.shape, self._stop, self.store)
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

    def commit_late(self, until_us: int) -> None:
        """Commit all events up to until_us, inclusive, for the later reader."""
        if self._late < self._stop:
            self._late = _kernels.store_commit(
                self.store, self._late, self._stop, until_us, self.late)

    def chain_since(self, t_us: int) -> None:
        """Pass all committed events up to t_us, and chain those after them."""
        self._passed = _kernels.store_pass(
            self.store, self._passed, self.committed, t_us, self.old)
        self._chain(self._passed)

    def chain_pending(self) -> None:
        """Chain the events that are not committed yet."""
        self._chain(self.committed)

    def chain_late(self, until_us: int) -> None:
        """Chain the events not committed late yet, up to until_us and no further."""
        stop = bisect_right(self.store["t"], until_us, self._late, self._stop)
        _kernels.store_link(self.store, self._late, stop, self.link, self.first)

    def _chain(self, start: int) -> None:
        _kernels.store_link(self.store, start, self._stop, self.link, self.first)

    def _make_room(self, n: int) -> None:
        if self._stop + n <= len(self.store):
            return
        if self.committed:
            recent = int(self.store["t"][self.committed - 1]) - self.keep_us
            self._passed = _kernels.store_pass(
                self.store, self._passed, self.committed, recent, self.old)
        drop = self._begin
        # Half of the room is left for what comes, so that moving stays rare.
        room = max(len(self.store), 2 * (self._stop - drop + n))
        old = as_bytes(self.store[drop:self._stop])
        if room > len(self.store):
            self.store = np.empty(room, EVENT_DTYPE)
            self.link = np.zeros(room, np.int32)
        as_bytes(self.store)[:old.size] = old
        self._stop -= drop
        self._shift(-drop)

    @property
    def _begin(self) -> int:
        """Index of the first event that is still of use."""
        return min(self._passed, self._late) if self.late.size else self._passed

    @property
    def _places(self) -> tuple[int, int, int]:
        return self._passed, self.committed, self._late

    def _shift(self, by: int) -> None:
        self._passed += by
        self.committed += by
        self._late += by

    def mark(self) -> Mapping[str, Any]:
        """Return copies of what committing and passing change."""
        return {"tracks": self.tracks.copy(), "late": self.late.copy(),
                "old": self.old.copy(), "keep_us": self.keep_us,
                "places": self._places}

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything."""
        begin = self._begin
        places = tuple(place - begin for place in self._places)
        return {**self.mark(), "places": places,
                "store": as_bytes(self.store[begin:self._stop]).copy()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over copies of what `state`, or `mark` just before, returned."""
        self.tracks[:], self.late[:] = state["tracks"], state["late"]
        self.old[:] = state["old"]
        self._passed, self.committed, self._late = state["places"]
        self.keep_us = state["keep_us"]
        if "store" not in state:
            return
        n = state["store"].size // EVENT_DTYPE.itemsize
        if n > len(self.store):
            self.store = np.empty(2 * n, EVENT_DTYPE)
            self.link = np.zeros(2 * n, np.int32)
        as_bytes(self.store)[:state["store"].size] = state["store"]
        self._stop = n


def as_bytes(events: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a view of records as bytes."""
    # Unaligned records are copied field by field, which takes ten times as long.
    return events.view(np.uint8)
