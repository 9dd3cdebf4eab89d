"""Recent events, and of each pixel the sums of those that are older."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, Records, State

EVENT_DTYPE = np.dtype([
    ("t", "<i8"), ("light", "<f8", 2), ("count", "<f8", 2), ("before", "<f4"),
    ("before2", "<f4"), ("prev", "<i4"), ("next", "<i4"), ("pixel", "<i4"),
    ("sign", "i1"), ("context", "i1"), ("run", "i1"), ("run_before", "i1")])
PIXEL_DTYPE = np.dtype([
    ("at", EVENT_DTYPE), ("newest", EVENT_DTYPE),
    ("quiet_t", "<i8"), ("at_index", "<i4"), ("newest_index", "<i4"),
    ("next", "<i4")], align=True)
"""Records of _kernels/_increments.pxd, which says what their fields are."""

_LEAST = 1 << 14
"""Initial capacity in events; it doubles when it is full."""


class EventStore:
    """Events that are pushed, and committed once they precede every later read.

    For a sensor (height, width) there are `pixels`, PIXEL_DTYPE (H, W): each one's last
    committed event, with its sums, and links to the next ones; `due`, int64 (H, W), as
    in `increments_move`; and `awake`, int32, of which `woken` are pixels that are not
    quiet: see `increments_rest`.  `events`, EVENT_DTYPE, are those that are not
    committed, from the index `committed` to `stop`, after some that are; `first_us` is
    the time of the first event ever.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.pixels: Records = np.zeros(shape, PIXEL_DTYPE)
        for name in ("at_index", "newest_index", "next"):
            self.pixels[name] = -1
        self.events: Records = np.zeros(_LEAST, EVENT_DTYPE)
        self.committed = self.stop = 0
        self.first_us: int | None = None
        self.due = np.zeros(shape, np.int64)    # no pixel is quiet
        self.awake, self.woken = np.empty(0, np.int32), 0

    def push(
        self, events: Events, last_us: int, numbers: NDArray[np.float64],
        keep_us: Callable[[], int] | None = None,
    ) -> int:
        """Append events, counted as `PixelModel.numbers` says; return how many.

        Events are taken up to the first one that is out of order or off the sensor.
        Where room is needed, committed ones go, but those from keep_us() on.
        """
        if not len(events):
            return 0
        if self.first_us is None:
            self.first_us = int(events["t"][0])
        self._make_room(len(events), keep_us)
        taken: int
        taken, self.woken = _kernels.increments_push(
            events, last_us, self.first_us, self.stop, self.events, self.pixels,
            numbers, self.due, self.awake, self.woken)
        self.stop += taken
        return taken

    @property
    def waiting_us(self) -> int | None:
        """Time of the first event that is not committed, None if there is none."""
        return (int(self.events["t"][self.committed])
                if self.committed < self.stop else None)

    def commit(self, until_us: int) -> None:
        """Commit all events up to until_us, inclusive."""
        self.committed, self.woken = _kernels.increments_commit(
            self.events, self.committed, self.stop, until_us, self.pixels, self.due,
            self.awake, self.woken)

    def _make_room(self, n: int, keep_us: Callable[[], int] | None) -> None:
        if self.stop + n <= len(self.events):
            return
        drop = self.committed
        if keep_us is not None and drop:
            drop = int(np.searchsorted(self.events["t"][:drop], keep_us(), "left"))
        kept = as_bytes(self.events[drop:self.stop]).copy()
        self.stop -= drop
        self.committed -= drop
        # Half of the capacity stays free, so that events are rarely moved.
        room = max(len(self.events), 2 * (self.stop + n))
        if room > len(self.events):
            self.events = np.empty(room, EVENT_DTYPE)
        as_bytes(self.events)[:kept.size] = kept
        if drop:
            _kernels.increments_drop(self.events, self.stop, drop, self.pixels)

    def state(self) -> State:
        """Return copies of everything, but of what `due` and `awake` say."""
        return {"first_us": self.first_us, "pixels": as_bytes(self.pixels).copy(),
                "events": as_bytes(self.events[:self.stop]).copy(),
                "committed": self.committed}

    def restore(self, state: State) -> None:
        """Return to what `state` returned, which is copied."""
        self.first_us, self.committed = state["first_us"], state["committed"]
        as_bytes(self.pixels)[:] = state["pixels"]
        stored = state["events"]
        self.stop = stored.size // EVENT_DTYPE.itemsize
        if self.stop > len(self.events):
            self.events = np.empty(self.stop, EVENT_DTYPE)
        as_bytes(self.events)[:stored.size] = stored


def as_bytes(records: Records) -> NDArray[np.uint8]:
    """Return records viewed as bytes, which are copied ten times as fast."""
    # NumPy copies unaligned records field by field.
    return records.view(np.uint8)
