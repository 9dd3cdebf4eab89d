"""Recent events, linked by pixel, for methods that look a little ahead or back."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE

__all__ = ["LONG_AGO", "TRACK_DTYPE", "Tracks"]

TRACK_DTYPE = np.dtype([
    ("t_old", "<i8"), ("t_prev", "<i8"), ("t_last", "<i8"), ("n_off", "<i4"),
    ("n_on", "<i4"), ("first", "<i4"), ("next", "<i4"), ("tail", "<i4"),
    ("p_old", "u1"), ("p_prev", "u1"), ("p_last", "u1"), ("unused", "u1")])
"""A pixel's place in the store; fields as in _kernels/_tracks.pxd."""

LONG_AGO = -(2**62)
_LEAST = 1 << 14


class Tracks:
    """Store of the events of the last moments, and each pixel's place in it.

    An event is first pushed, then committed (it belongs to the past of every later
    read), then, `keep_us` later, dropped.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    keep_us : int
        How long committed events are kept.

    Attributes
    ----------
    tracks : ndarray of TRACK_DTYPE, shape (H, W)
    store : ndarray of EVENT_DTYPE, shape (capacity,)
    link : ndarray of int32, shape (capacity,)
        Next event of the same pixel, -1 for none.
    """

    def __init__(self, shape: tuple[int, int], keep_us: int) -> None:
        self.tracks = np.zeros(shape, TRACK_DTYPE)
        for name in ("t_old", "t_prev", "t_last"):
            self.tracks[name] = LONG_AGO
        for name in ("first", "next", "tail"):
            self.tracks[name] = -1
        self.store = np.zeros(_LEAST, EVENT_DTYPE)
        self.link = np.full(_LEAST, -1, np.int32)
        self.keep_us = int(keep_us)
        self._committed = self._stop = 0

    def push(self, events: NDArray[Any], last_us: int) -> int:
        """Append events; return how many were taken (see `track_push`)."""
        self._make_room(len(events))
        taken = _kernels.track_push(
            events, last_us, self._stop, self.store, self.link, self.tracks)
        self._stop += taken
        return taken

    def commit(self, until_us: int) -> None:
        """Commit all events up to until_us, inclusive."""
        if self._committed == self._stop:
            return
        self._committed = _kernels.track_commit(
            self.store, self.link, self._committed, self._stop, until_us, self.tracks)

    def _make_room(self, n: int) -> None:
        if self._stop + n <= len(self.store):
            return
        if self._committed:
            recent = int(self.store["t"][self._committed - 1]) - self.keep_us
            drop = int(np.searchsorted(
                self.store["t"][:self._committed], recent))
            if drop:
                self._drop(drop)
        # Half of the room is left for what comes, so that moving stays rare.
        wanted = 2 * (self._stop + n)
        if wanted > len(self.store):
            for name in ("store", "link"):
                old = getattr(self, name)
                new = np.zeros(wanted, old.dtype)
                new[:self._stop] = old[:self._stop]
                setattr(self, name, new)

    def _drop(self, drop: int) -> None:
        stop = self._stop
        _kernels.track_drop(self.store, self.link, drop, stop, self.tracks)
        for array in (self.store, self.link):
            array[:stop - drop] = array[drop:stop].copy()
        self._stop -= drop
        self._committed -= drop

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything."""
        return {"tracks": self.tracks.copy(), "store": self.store[:self._stop].copy(),
                "link": self.link[:self._stop].copy(), "committed": self._committed}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over copies of what `state` returned."""
        stop = len(state["store"])
        self.tracks = state["tracks"].copy()
        self._committed, self._stop = state["committed"], stop
        if stop > len(self.store):
            self.store = np.zeros(2 * stop, EVENT_DTYPE)
            self.link = np.full(2 * stop, -1, np.int32)
        self.store[:stop] = state["store"]
        self.link[:stop] = state["link"]
