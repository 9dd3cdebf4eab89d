"""Bounded windows of a stream's data, kept for self-calibration."""
from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, Records
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.lamp import Lamplight, Wave
from pdavis_cv.reconstruct.tracks import as_bytes
from pdavis_cv.recording.base import ApsFrame, joined
from pdavis_cv.selfcal.uncertainty import PixelActivity

__all__ = ["USABLE_DN", "CellWindow", "Interval", "Item", "PixelWindow",
           "SensorWindow"]

MAX_PIXELS = 16_384
"""Most pixels that are kept; the busy ones among them are enough to fit a camera."""

MAX_FRAMES, MAX_US, MAX_EVENTS = 100, 10_000_000, 1_000_000
"""Upper bounds of a `PixelWindow`: frames, time, events (13 MB)."""

MAX_CELLS, MAX_CELL_EVENTS, _CELL_PARTS = 1024, 100_000, 32
"""Upper bounds of a `CellWindow`: macropixels, events (1.3 MB); and about in how many
arrays they are kept."""

SENSOR_MAX_US, SENSOR_MAX_EVENTS = 10_000_000, 5_000_000
"""Upper bounds of a `SensorWindow`: time, events (65 MB)."""

USABLE_DN = 8
"""Least DN of a usable sample of a busy pixel."""

LIT_SHARE = 0.25
"""Greatest share of blocks in which flicker that was found counts as a false alarm: a
lamp is seen in nearly all, but light that turned fast was taken for one in one of 15.
Engineering choice."""

_EVER = -(2**62), 2**62
"""Times in us before and after all stamps; their sums fit into 64 bits."""

_LEAST_SECONDS = 1e-9
"""Lower bound of a divisor, so that a rate without events is finite; numerical."""

Item = ApsFrame | Wave | NDArray[Any]


@dataclass(frozen=True, eq=False)
class Interval:
    """A frame of the kept pixels, and their events since the frame before.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        The events; ``x`` is the index among the kept pixels.
    counts : ndarray of int32, shape (2, 1, K)
        Number of OFF and ON events of each pixel.
    dn : ndarray of float32, shape (K,)
        The frame's values.
    usable : ndarray of bool, shape (K,)
        Whether each value is usable.
    exposure_us : ndarray of int64, shape (3, W)
        Begin, middle and end of the exposure, by column of the sensor.
    known_us : int
        End of the frame's exposure in all columns.
    """

    events: Events
    counts: NDArray[np.int32]
    dn: NDArray[np.float32]
    usable: NDArray[np.bool_]
    exposure_us: NDArray[np.int64]
    known_us: int

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return (self.events.nbytes + self.counts.nbytes + self.dn.nbytes
                + self.usable.nbytes + self.exposure_us.nbytes)


class PixelWindow:
    """The recent past of a random subset of the pixels; the oldest data are dropped.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.

    Attributes
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    pixels : ndarray of intp, shape (K,)
        Flat indices of the kept pixels on the sensor.
    last_us : int
        Time of the last item fed.
    full : bool
        Whether anything was dropped.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape, size = shape, shape[0] * shape[1]
        # The same pixels each time; all of them on a small sensor.
        self.pixels = np.sort(np.random.default_rng(0).permutation(size)[:MAX_PIXELS])
        self._place = np.full(shape, -1, np.int32)
        self._place.flat[self.pixels] = np.arange(len(self.pixels))
        self.last_us, self.full = _EVER[0], False
        self._first_us: int | None = None
        self._intervals: deque[Interval] = deque()
        self._pending: list[Events] = []
        self._chosen = np.empty(0, EVENT_DTYPE)     # scratch
        self._counts = np.zeros((2, 1, len(self.pixels)), np.int32)
        self._events = self._pending_events = 0
        self._lamp = Lamplight()

    def add_events(self, events: Events) -> None:
        """Take events of the whole sensor."""
        if not len(events):
            return
        self.last_us = int(events["t"][-1])
        if self._first_us is None:
            self._first_us = int(events["t"][0])
        # If no frame comes, the first events since the last one are kept, a rule that
        # does not depend on how the stream is cut into packets.
        room = MAX_EVENTS - self._pending_events
        if len(self._chosen) < len(events):
            self._chosen = np.empty(len(events), EVENT_DTYPE)
        n = _kernels.sample_events(events, self._place, self._chosen[:room])
        mine = as_bytes(self._chosen[:n]).copy().view(EVENT_DTYPE)
        _kernels.count(mine, *_EVER, self._counts)
        self._pending.append(mine)
        self._pending_events += len(mine)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame of the whole sensor; it closes an interval."""
        self.last_us = max(self.last_us, frame.mid_us)
        exposure = np.empty((3, self.shape[1]), np.int64)
        exposure[0], exposure[2] = frame.exposure_start_us, frame.exposure_end_us
        exposure[1] = frame.column_mid_us
        exposure[2] = np.maximum(exposure[2], exposure[0] + 1)
        dn = frame.dn.ravel().take(self.pixels)
        usable = dn >= 1
        if frame.valid is not None:
            usable &= frame.valid.ravel().take(self.pixels)
        pending = self._take_pending()
        self._events, self._pending_events = self._events + len(pending), 0
        self._intervals.append(Interval(
            pending, self._counts, dn, usable, exposure,
            int(exposure[2].max())))
        self._counts = np.zeros_like(self._counts)
        self._drop_oldest()

    def add_wave(self, wave: Wave) -> None:
        """Take the lamp's wave in a block of time."""
        self._lamp.add(wave)

    def _take_pending(self) -> Events:
        pending, self._pending = self._pending, []
        return joined(pending) if pending else np.empty(0, EVENT_DTYPE)

    def _drop_oldest(self) -> None:
        all_of_it = self._intervals
        latest = int(all_of_it[-1].exposure_us[1].max())
        while len(all_of_it) > 1 and (
                len(all_of_it) > MAX_FRAMES or self._events > MAX_EVENTS
                or latest - int(all_of_it[0].exposure_us[1].max()) > MAX_US):
            self._events -= len(all_of_it.popleft().events)
            self.full = True
            self._lamp.forget(int(all_of_it[0].exposure_us[0].min()))

    @property
    def full_without_frames(self) -> bool:
        """Whether all events that are kept without any frame have come."""
        return self._pending_events >= MAX_EVENTS or (
            self._first_us is not None and self.last_us - self._first_us > MAX_US)

    @property
    def intervals(self) -> list[Interval]:
        """The intervals kept, in order of time."""
        return list(self._intervals)

    @property
    def events(self) -> Events:
        """All events kept, including those after the last frame."""
        self._pending = [self._take_pending()]
        return joined([*(each.events for each in self._intervals), *self._pending])

    @property
    def waves(self) -> Records:
        """The lamp's waves, a record per block (WAVE_DTYPE)."""
        return self._lamp.waves

    @property
    def flickers(self) -> bool:
        """Whether a lamp flickers in more than `LIT_SHARE` of the blocks."""
        return bool(len(self.waves)) and (
            float(np.mean(self.waves["turns_per_us"] > 0)) > LIT_SHARE)

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept."""
        return (self.pixels.nbytes + self._place.nbytes + self._counts.nbytes
                + sum(each.nbytes for each in self._intervals)
                + sum(part.nbytes for part in self._pending) + self._lamp.waves.nbytes)

    def state(self) -> tuple[Any, ...]:
        """Return what is kept; never changed later."""
        return (tuple(self._intervals), tuple(self._pending), self._counts.copy(),
                self._events, self._pending_events, self.last_us, self.full,
                self._lamp.state(), self._first_us)

    def restore(self, state: tuple[Any, ...]) -> None:
        """Take over what `state` returned."""
        (intervals, pending, counts, self._events, self._pending_events, self.last_us,
         self.full, lamp, self._first_us) = state
        self._intervals, self._pending = deque(intervals), list(pending)
        self._counts = counts.copy()
        self._lamp.restore(lamp)


class CellWindow:
    """The last events of a random subset of the macropixels.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.

    Attributes
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    cells : ndarray of intp, shape (2, N)
        Rows and columns of the macropixels that are kept.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        rows, columns = (side // 2 for side in shape)
        # The same each time; all of them on a small sensor.
        number = np.random.default_rng(0).permutation(rows * columns)[:MAX_CELLS]
        self.cells = np.stack(np.divmod(np.sort(number), max(columns, 1)))
        self._place = np.full(shape, -1, np.int32)
        for i, (y, x) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            self._place[2 * self.cells[0] + y, 2 * self.cells[1] + x] = (
                4 * np.arange(len(number)) + i)
        self._parts: deque[NDArray[Any]] = deque()
        self._count = 0
        self._chosen = np.empty(0, EVENT_DTYPE)     # scratch

    def add_events(self, events: Events) -> None:
        """Take events of the whole sensor."""
        if len(self._chosen) < len(events):
            self._chosen = np.empty(len(events), EVENT_DTYPE)
        n = _kernels.sample_events(events, self._place, self._chosen)
        mine = as_bytes(self._chosen[:n]).copy().view(EVENT_DTYPE)
        # Small packets are joined: a quiet stream would fill memory with empty ones.
        if self._parts and len(self._parts[-1]) + n <= MAX_CELL_EVENTS // _CELL_PARTS:
            mine = joined([self._parts.pop(), mine])
        self._parts.append(mine)
        self._count += n
        while self._count - len(self._parts[0]) >= MAX_CELL_EVENTS:
            self._count -= len(self._parts.popleft())

    @property
    def events(self) -> Events:
        """The last events; ``x`` is 4 i + j for pixel j of macropixel i, row by row.

        Which they are does not depend on how the stream is cut into packets.
        """
        if not self._parts:
            return np.empty(0, EVENT_DTYPE)
        return joined(list(self._parts))[-MAX_CELL_EVENTS:]

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept."""
        return (self.cells.nbytes + self._place.nbytes
                + sum(part.nbytes for part in self._parts))

    def state(self) -> tuple[NDArray[Any], ...]:
        """Return what is kept; never changed later."""
        return tuple(self._parts)

    def restore(self, state: tuple[NDArray[Any], ...]) -> None:
        """Take over what `state` returned."""
        self._parts, self._count = deque(state), sum(map(len, state))


class SensorWindow:
    """All data from the first item on, up to a bound, to estimate all thresholds.

    Attributes
    ----------
    items : list of Item
        Frames, events and the lamp's waves in order of time.
    full : bool
        Whether the bound is reached; later items are ignored.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self.items: list[Item] = []
        self.full = False
        self._begin_us: int | None = None
        self._events = 0

    def add(self, item: Item) -> None:
        """Take the next item; of events, those up to the bound."""
        if isinstance(item, Wave):
            t = item.start_us
        else:
            t = item.mid_us if isinstance(item, ApsFrame) else int(item["t"][0])
        self._begin_us = t if self._begin_us is None else self._begin_us
        self.full |= (t - self._begin_us > SENSOR_MAX_US
                      or self._events >= SENSOR_MAX_EVENTS)
        if self.full:
            return
        if isinstance(item, np.ndarray):
            # What is kept does not depend on how the stream is cut into packets.
            n = min(bisect_right(item["t"], self._begin_us + SENSOR_MAX_US),
                    SENSOR_MAX_EVENTS - self._events)
            self.full = n < len(item)
            item = item[:n]
            self._events += n
        self.items.append(item)

    def activity(self) -> PixelActivity:
        """Return the activity of each pixel."""
        interval, total = np.zeros((2, 2, *self._shape), np.int32)
        squares = np.zeros(self._shape, np.int64)
        min_dn = np.full(self._shape, np.inf, np.float32)
        max_dn = np.zeros(self._shape, np.float32)
        mids: list[int] = []

        def end_interval() -> None:
            """Add the counts since the last frame to the sums."""
            both = np.add(interval[0], interval[1], dtype=np.int64)
            np.add(squares, both * both, out=squares)
            np.add(total, interval, out=total)
            interval.fill(0)

        for item in self.items:
            if isinstance(item, ApsFrame):
                np.minimum(min_dn, item.dn, out=min_dn)
                np.maximum(max_dn, item.dn, out=max_dn)
                mids.append(item.mid_us)
                end_interval()
            elif isinstance(item, np.ndarray):
                _kernels.count(item, *_EVER, interval)
        end_interval()
        seconds = max(mids[-1] - mids[0], 1) / 1e6 / max(len(mids) - 1, 1)
        return PixelActivity(
            squares / np.maximum(total.sum(0) * seconds, _LEAST_SECONDS), min_dn,
            max_dn)

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept."""
        return sum(
            item.dn.nbytes + (0 if item.valid is None else item.valid.nbytes)
            if isinstance(item, ApsFrame) else
            0 if isinstance(item, Wave) else item.nbytes for item in self.items)

    def state(self) -> tuple[Any, ...]:
        """Return what is kept; never changed later."""
        return tuple(self.items), self._begin_us, self._events, self.full

    def restore(self, state: tuple[Any, ...]) -> None:
        """Take over what `state` returned."""
        items, self._begin_us, self._events, self.full = state
        self.items = list(items)
