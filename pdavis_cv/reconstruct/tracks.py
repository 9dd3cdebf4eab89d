"""Store of recent events, and a reader of states that skips pixels at rest."""
from __future__ import annotations

from bisect import bisect_right
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, Records, State
from pdavis_cv._workers import Workers
from pdavis_cv.reconstruct.model import (
    GAP_DTYPE,
    LANE_VALUES,
    LANES,
    NO_GAP,
    REST_PLANES,
    SMOOTH_PLANES,
    STORED_DTYPE,
    TRACK_DTYPE,
)

__all__ = ["Reader", "Tracks", "as_bytes"]

LOOKAHEAD_US = 50_000
"""Default look-ahead, us: how long to wait for each pixel's next event."""

LONG_AGO = -(2**62)
"""A time in us before all stamps; differences to it fit into 64 bits."""
SWEEP_US = 100_000
"""Interval in stream time, us, at which the reader looks for pixels come to rest."""

_LISTED_NS, _REST_NS = 18.0, 1.2
"""Time that showing a pixel that may be moving, and one at rest, takes, ns (measured
on davis346.aedat4, where 2,300 of 89,960 pixels may be moving)."""

NO_GAPS = np.zeros((0, 0), GAP_DTYPE)
_LINE = 64
"""Bytes of a cache line, or a multiple of them."""
_LEAST = 1 << 14
"""Initial capacity in events; it doubles when it is full."""


class Tracks:
    """Store of the recent events, and a summary of the older ones of each pixel.

    An event goes through three stages.  It is pushed; it is committed once it precedes
    every later read; it is passed once it precedes every later frame's exposure.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    keep_us : int
        How long committed events are kept for a frame at least, us.
    late : bool
        Keep a second summary for a reader that lags behind (the smoother's).

    Attributes
    ----------
    tracks : ndarray of TRACK_DTYPE, shape (H, W)
        Last events and counts of each pixel over the committed events.
    late : ndarray of TRACK_DTYPE, shape (H, W), or (0, 0)
        The same over the events that `commit_late` has committed; its counts are never
        reset.
    old : ndarray of TRACK_DTYPE, shape (H, W)
        The same over the passed events.
    store : ndarray of STORED_DTYPE, shape (capacity,)
        Events that continue one of the three, which was chained last: its records hold
        each pixel's first event, and events hold the pixel's next one.
    committed : int
        Index of the first event that is not committed.
    refractory_us : float
        How long a pixel is held in reset after an event; counts include the loss.
    """

    def __init__(
        self, shape: tuple[int, int], keep_us: int, *, late: bool = False
    ) -> None:
        self.tracks, self.old, self.late = (
            _no_events(size) for size in (shape, shape, shape if late else (0, 0)))
        self.store = np.zeros(_LEAST, STORED_DTYPE)
        self.keep_us, self.refractory_us = int(keep_us), 0.0
        self.committed = self._passed = self._late = self._stop = 0
        self._chained: tuple[Records, int, int] | None = None

    @property
    def _all(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        return self.tracks, self.old, self.late

    @property
    def chain(self) -> tuple[Records, Records]:
        """The store chained to `tracks`, and `tracks`, as a reader takes them."""
        self._chain(self.tracks, self.committed, self._stop)
        return self.store, self.tracks

    def late_chain(
        self, until_us: int, reader: Reader
    ) -> tuple[Records, Records]:
        """Return the store chained to `late` up to until_us, and `late`.

        The pixels of these events are added to the reader's list.
        """
        self.chain_late(until_us)
        assert self._chained is not None
        _, start, stop = self._chained
        reader.n = _kernels.store_mark(
            self.store, start, stop, reader.pixels, reader.n, reader.flags)
        return self.store, self.late

    def push(self, events: Events, last_us: int, reader: Reader) -> int:
        """Append events and list their pixels with the reader; return how many.

        Events are taken up to the first one that is out of order or off the sensor.
        """
        self._make_room(len(events))
        taken, reader.n = _kernels.store_push(
            events, last_us, self._stop, self.store, reader.pixels, reader.n,
            reader.flags)
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
                self.store, self.committed, self._stop, until_us,
                self.refractory_us, self.tracks)

    def commit_late(self, until_us: int) -> None:
        """Commit all events up to until_us, inclusive, for the lagging reader."""
        if self._late < self._stop:
            self._late = _kernels.store_commit(
                self.store, self._late, self._stop, until_us, self.refractory_us,
                self.late)

    def chain_since(self, t_us: int) -> None:
        """Pass the committed events up to t_us, and chain the others to `old`."""
        self._passed = _kernels.store_commit(
            self.store, self._passed, self.committed, t_us, self.refractory_us,
            self.old)
        self._chain(self.old, self._passed, self._stop)

    def chain_pending(self) -> None:
        """Chain the events that are not committed yet to `tracks`."""
        self._chain(self.tracks, self.committed, self._stop)

    def chain_late(self, until_us: int) -> None:
        """Chain the events up to until_us that `late` does not include to `late`."""
        stop = bisect_right(self.store["t"], until_us, self._late, self._stop)
        self._chain(self.late, self._late, stop)

    def _chain(self, tracks: Records, start: int, stop: int) -> None:
        old = self._chained
        if old is not None and old[0] is tracks and old[1:] == (start, stop):
            return
        self.unchain()
        _kernels.store_link(self.store, start, stop, tracks)
        self._chained = tracks, start, stop

    def unchain(self) -> None:
        """Remove the chains, whose indices a move of the store would invalidate."""
        if self._chained is not None:
            tracks, start, stop = self._chained
            _kernels.store_unlink(self.store, start, stop, tracks)
            self._chained = None

    def _make_room(self, n: int) -> None:
        if self._stop + n <= len(self.store):
            return
        self.unchain()
        if self.committed:
            recent = int(self.store["t"][self.committed - 1]) - self.keep_us
            self._passed = _kernels.store_commit(
                self.store, self._passed, self.committed, recent, self.refractory_us,
                self.old)
        drop = self._begin
        # Half of the capacity stays free, so that the store is rarely moved.
        room = max(len(self.store), 2 * (self._stop - drop + n))
        old = as_bytes(self.store[drop:self._stop])
        if room > len(self.store):
            self.store = np.empty(room, STORED_DTYPE)
        as_bytes(self.store)[:old.size] = old
        self._stop -= drop
        self._passed -= drop
        self.committed -= drop
        self._late -= drop

    @property
    def _begin(self) -> int:
        """Index of the first event that is still needed."""
        return min(self._passed, self._late) if self.late.size else self._passed

    def assign(self, other: Tracks) -> None:
        """Copy the state of an equal object."""
        self.unchain()
        other.unchain()
        for mine, theirs in zip(self._all, other._all, strict=True):
            np.copyto(as_bytes(mine), as_bytes(theirs))
        self.keep_us = other.keep_us
        begin = other._begin
        self._take(as_bytes(other.store[begin:other._stop]),
                   (other._passed, other.committed, other._late), begin)

    def state(self) -> State:
        """Return copies of everything."""
        self.unchain()
        begin = self._begin
        return {"tracks": [as_bytes(tracks).copy() for tracks in self._all],
                "keep_us": self.keep_us, "store": as_bytes(
                    self.store[begin:self._stop]).copy(),
                "places": (self._passed - begin, self.committed - begin,
                           self._late - begin)}

    def restore(self, state: State) -> None:
        """Return to what `state` returned, which is copied."""
        self.unchain()
        for mine, kept in zip(self._all, state["tracks"], strict=True):
            as_bytes(mine)[:] = kept
        self.keep_us = state["keep_us"]
        self._take(state["store"], state["places"], 0)

    def _take(
        self, stored: NDArray[np.uint8], places: tuple[int, int, int], begin: int
    ) -> None:
        n = stored.size // STORED_DTYPE.itemsize
        if n > len(self.store):
            self.store = np.empty(2 * n, STORED_DTYPE)
        as_bytes(self.store)[:stored.size] = stored
        self._stop = n
        self._passed, self.committed, self._late = (at - begin for at in places)


def _no_events(shape: tuple[int, int]) -> Events:
    """Return tracks of pixels without events, each within one cache line."""
    record = TRACK_DTYPE.itemsize
    # A record viewed as void is copied at once, not field by field.
    none = np.array((2 * LONG_AGO, 0, 0, NO_GAP, -1), TRACK_DTYPE).view(f"V{record}")
    tracks = _aligned(shape[0] * shape[1] * record).view(TRACK_DTYPE)
    tracks.view(none.dtype)[:] = none
    return tracks.reshape(shape)


def _aligned(size: int) -> NDArray[np.uint8]:
    """Return bytes that are 0 and begin at a cache line."""
    room = np.zeros(size + _LINE, np.uint8)
    begin = -room.ctypes.data % _LINE
    return room[begin:begin + size]


class Reader:
    """Reads states at a time and caches the pixels that have not changed since.

    The cache only saves time: it never changes what is read.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    smooth : bool
        Frames after the time read are used as well (offline mode).

    Attributes
    ----------
    pixels : ndarray of int32, shape (H * W,)
        Its first `n` elements list the pixels that may be moving, by flat index.
    n : int
        Length of the list.
    flags : ndarray of uint8, shape (H, W)
        Sum of 1 = in the list, 2 = changed since it was read, 4 = came to rest, 8 =
        not listed by events, as it is hot or has no sample, 16 = its state has changed
        as well.
    """

    def __init__(self, shape: tuple[int, int], *, smooth: bool = False) -> None:
        size = shape[0] * shape[1]
        self.n = self._ordered = size
        self.pixels = np.arange(size, dtype=np.int32)
        self.flags = np.full(shape, 3, np.uint8)
        groups = -(-size // LANES)
        self._lanes = _aligned(4 * groups * LANE_VALUES * LANES).view(
            np.float32).reshape(groups, LANE_VALUES, LANES)
        self._planes = np.zeros(
            (SMOOTH_PLANES if smooth else REST_PLANES, *shape), np.float32)
        self._swept_us: int | None = None

    def forget(self) -> None:
        """Invalidate the cache, because any state may have changed."""
        self._swept_us = None

    def read(
        self, t_us: int, known_us: int, rest_us: int, epoch_us: int,
        chain: tuple[Records, Records], states: Records,
        model: tuple[NDArray[Any], NDArray[Any]],
        shown: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]],
        workers: Workers, gaps: NDArray[Any] = NO_GAPS,
    ) -> None:
        """Write log intensity, variance and validity at t_us.

        Parameters
        ----------
        t_us, known_us : int
            Time to read; time up to which events are known.
        rest_us : int
            Lower bound of the times of all later reads.
        epoch_us : int
            Reference time of variances, at or after the time of every state; it must
            depend on the stream alone, not on packets or calls.
        chain : (ndarray of STORED_DTYPE, ndarray of TRACK_DTYPE, shape (H, W))
            Store, and the tracks that it is chained to.
        states : ndarray of STATE_DTYPE, shape (H, W)
            States of the filter.
        model : (ndarray of TUNING_DTYPE, shape (1,), ndarray of WAVE_DTYPE)
            Noise and bandwidth; waves of the lamp.
        shown : (ndarray of float32, ndarray of float32, ndarray of uint8)
            Receive log intensity, variance, validity; shape (H, W).
        workers : Workers
            Threads that share the rows.
        gaps : ndarray of GAP_DTYPE, shape (H, W), optional
            Estimates from the frames on both sides, for a `smooth` reader.
        """
        tuning, waves = model

        def each(first: int, last: int) -> None:
            if len(gaps):
                rows = slice(first, last)
                _kernels.smooth_read(
                    t_us, known_us, (chain[0], chain[1][rows]), model, gaps[rows],
                    states[rows], (shown[0][rows], shown[1][rows], shown[2][rows]))
            else:
                _kernels.kalman_read(
                    t_us, known_us, epoch_us, chain, model, states, (first, last),
                    shown)

        if len(waves):      # under a flickering lamp no pixel is at rest
            workers.rows(len(states), each)
            return
        if self._swept_us is None or rest_us - self._swept_us >= SWEEP_US:
            self.n = self._ordered = _kernels.kalman_rest(
                rest_us, epoch_us, self._swept_us is None, tuning, chain[1], states,
                gaps, (self.pixels, self.flags), self._planes)
            self._swept_us = rest_us
        listing = (self.pixels[:self.n], self._ordered, self.flags, self._lanes)
        ns = _LISTED_NS * self.n + _REST_NS * states.size
        workers.rows(len(states), lambda first, last: _kernels.kalman_show(
            t_us, known_us, epoch_us, chain, tuning, states, gaps, listing,
            self._planes, (first, last), shown), row_ns=ns / len(states))


def as_bytes(events: Events) -> NDArray[np.uint8]:
    """Return records viewed as bytes, which are copied ten times as fast."""
    # NumPy copies unaligned records field by field.
    return events.view(np.uint8)
