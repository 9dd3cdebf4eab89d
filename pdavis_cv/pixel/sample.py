"""A bounded window of a stream, for learning: some of the pixels, the last seconds."""
from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, State
from pdavis_cv.recording.base import ApsFrame

MAX_PIXELS, PATCH = 32_768, 8
"""Most pixels that are kept, in squares of this side: whole macropixels, most of whose
neighbours are kept as well."""

MAX_FRAMES, MAX_US, MAX_EVENTS = 100, 10_000_000, 1_000_000
"""Upper bounds of the window: frames, time, events (13 MB)."""

LEAST_US, LEAST_PATCHES = 1_000_000, 16
"""Time that the window holds if need be of half the squares, a quarter ..., and the
fewest of them: some twenty frames tell more than all pixels of two."""

PAST_DTYPE = np.dtype([
    ("t", "<i8"), ("total", "<f4", 10), ("before", "<f4"), ("weight", "<f4"),
    ("sign", "i1"), ("context", "i1"), ("run", "i1"), ("spare", "i1"),
    ("spare2", "<f4")])
"""An event of a sampled pixel: see _learning.pyx."""

_PLACES = ((0, 0), (0, 1), (1, 0), (1, 1)), ((-2, 0), (2, 0), (0, -2), (0, 2))


@dataclass(frozen=True, eq=False)
class SampledFrame:
    """A frame of the sampled pixels.

    Parameters
    ----------
    dn : ndarray of float64, shape (K,)
    usable : ndarray of bool, shape (K,)
    exposure : ndarray of int64, shape (2, K)
        Begin and end, us.
    """

    dn: NDArray[np.float64]
    usable: NDArray[np.bool_]
    exposure: NDArray[np.int64]

    @property
    def middle_us(self) -> int:
        """Middle of the exposure, of the mean pixel."""
        return int(self.exposure.mean())


@dataclass(frozen=True, eq=False)
class Sampled:
    """Frames and events of the sampled pixels, as learning takes them.

    Parameters
    ----------
    frames : list of SampledFrame
        In order of time.
    events : ndarray of PAST_DTYPE, shape (N,)
        By pixel, then by time; only ``t`` and ``sign`` are set before `with_past`.
    start : ndarray of int64, shape (K + 1,)
        Index of each pixel's first event, and N.
    pixel : ndarray of int32, shape (N,)
        Pixel of each event in order of time, and ``t`` its time, us.
    places : ndarray of int32, shape (K, 8)
        Each pixel, the others of its macropixel, and its four nearest neighbours with
        the same polarizer; -1: not sampled.
    """

    frames: list[SampledFrame]
    events: NDArray[np.void]
    start: NDArray[np.int64]
    pixel: NDArray[np.int32]
    t: NDArray[np.int64]
    places: NDArray[np.int32]

    def with_past(self, camera: NDArray[np.float64]) -> Sampled:
        """Return the same, with what the events before say of each; see _learning.pyx.

        camera is `PixelModel.numbers`, of which the dead time counts.
        """
        events = self.events.copy()
        first = np.full(len(self.start) - 1, self.t[0] if len(self.t) else 0, np.int64)
        _kernels.learning_past(events, self.start, first, camera)
        return replace(self, events=events)


class PixelSample:
    """The recent past of some of the pixels; the oldest data are dropped.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        height, width = shape
        rows, columns = -(-height // PATCH), -(-width // PATCH)
        number = max(MAX_PIXELS // PATCH**2, 1)
        # The same patches each time; all of them on a small sensor.
        self._chosen = np.random.default_rng(0).permutation(rows * columns)[:number]
        self._choose(len(self._chosen))
        self._frames: deque[SampledFrame] = deque()
        self._events: deque[tuple[NDArray[np.int64], NDArray[np.int32],
                                  NDArray[np.int8]]] = deque()
        self._count = 0
        self.full = False

    def _choose(self, number: int) -> None:
        """Sample the pixels of the first squares."""
        height, width = self.shape
        rows, columns = -(-height // PATCH), -(-width // PATCH)
        self._patches = number
        kept = np.zeros((rows, columns), np.bool_)
        kept.ravel()[self._chosen[:number]] = True
        mask = np.repeat(np.repeat(kept, PATCH, 0), PATCH, 1)[:height, :width]
        self.pixels = np.flatnonzero(mask)
        self._index = np.full(height * width, -1, np.int32)
        self._index[self.pixels] = np.arange(len(self.pixels), dtype=np.int32)
        self._columns = self.pixels % width

    def _halve(self) -> None:
        """Sample half of the squares, and forget what was kept of the others."""
        before = self.pixels
        self._choose(self._patches // 2)
        now, stays = self._index[before], self._index[before] >= 0
        self._frames = deque(SampledFrame(
            frame.dn[stays], frame.usable[stays], frame.exposure[:, stays])
            for frame in self._frames)
        events = ((t, now[pixel], sign) for t, pixel, sign in self._events)
        self._events = deque(
            (t[pixel >= 0], pixel[pixel >= 0], sign[pixel >= 0])
            for t, pixel, sign in events if np.any(pixel >= 0))
        self._count = sum(len(t) for t, _, _ in self._events)

    def add_events(self, events: Events) -> None:
        """Take events of the whole sensor, later than all before."""
        index = self._index[events["y"].astype(np.intp) * self.shape[1] + events["x"]]
        mine = index >= 0
        if not mine.any():
            return
        sign = np.where(events["p"][mine] > 0, 1, -1).astype(np.int8)
        self._events.append((events["t"][mine], index[mine], sign))
        self._count += len(sign)
        self._forget()

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a corrected frame of the whole sensor."""
        exposure = np.stack([np.broadcast_to(edge, frame.shape[1:]) for edge in (
            frame.exposure_start_us, frame.exposure_end_us)]).astype(np.int64)
        # Mostly all pixels have the same, which is kept once: 50 MB of 100 frames.
        exposure = exposure[:, self._columns] if np.ptp(exposure, 1).any() else (
            np.broadcast_to(exposure[:, :1], (2, len(self.pixels))))
        dn = frame.dn.ravel()[self.pixels].astype(np.float64)
        usable = np.ones(len(dn), np.bool_) if frame.valid is None else (
            frame.valid.ravel()[self.pixels])
        self._frames.append(SampledFrame(dn, usable, exposure))
        self._forget()

    def _forget(self) -> None:
        while (self._count > MAX_EVENTS and self._patches >= 2 * LEAST_PATCHES
               and self._events[-1][0][-1] - self._events[0][0][0] < LEAST_US):
            self._halve()
        while self._events and (self._count > MAX_EVENTS or (
                self._events[-1][0][-1] - self._events[0][0][0] > MAX_US)):
            self._count -= len(self._events.popleft()[0])
            self.full = True
        first = self._events[0][0][0] if self._events else None
        while len(self._frames) > MAX_FRAMES or (
                first is not None and self.full and self._frames
                and self._frames[0].middle_us < first):
            self._frames.popleft()
            self.full = True

    def sampled(self) -> Sampled:
        """Return the data kept."""
        parts = list(self._events) or [(
            np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.int8))]
        t, pixel, sign = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.argsort(pixel, kind="stable")
        events = np.zeros(len(t), PAST_DTYPE)
        events["t"], events["sign"] = t[order], sign[order]
        start = np.searchsorted(pixel[order], np.arange(len(self.pixels) + 1))
        return Sampled(list(self._frames), events, start.astype(np.int64), pixel, t,
                       self._places())

    def _places(self) -> NDArray[np.int32]:
        height, width = self.shape
        y, x = np.divmod(self.pixels, width)
        out = np.full((len(self.pixels), 8), -1, np.int32)
        out[:, 0] = np.arange(len(self.pixels))
        steps = [(np.where(y % 2, -dy, dy), np.where(x % 2, -dx, dx))
                 for dy, dx in _PLACES[0][1:]]
        steps += [(np.full(y.shape, dy), np.full(x.shape, dx)) for dy, dx in _PLACES[1]]
        for i, (dy, dx) in enumerate(steps):
            there = (y + dy >= 0) & (y + dy < height) & (x + dx >= 0) & (x + dx < width)
            at = np.where(there, (y + dy) * width + x + dx, 0)
            out[:, i + 1] = np.where(there, self._index[at], -1)
        return out

    def state(self) -> State:
        """Return the data kept; they are never changed in place."""
        return {"frames": tuple(self._frames), "events": tuple(self._events),
                "count": self._count, "full": self.full, "patches": self._patches}

    def restore(self, state: State) -> None:
        """Return to what `state` returned."""
        self._frames, self._events = deque(state["frames"]), deque(state["events"])
        self._count, self.full = state["count"], state["full"]
        self._choose(state["patches"])
