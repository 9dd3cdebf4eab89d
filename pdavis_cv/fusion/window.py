"""The part of the sensor that a region's result depends on."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import Layout

__all__ = ["Window", "checked_roi", "window_of"]

Roi = tuple[int, int, int, int]


@dataclass(frozen=True)
class Window:
    """Rows and columns of a sensor that are computed, polarizer cells whole.

    Parameters
    ----------
    rows, columns : slice
        With start and stop.
    size : (int, int)
        (height, width) of the sensor.
    """

    rows: slice
    columns: slice
    size: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the window."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def layout(self, whole: Layout) -> Layout:
        """Return the layout of the window."""
        return whole.crop(self.columns.start, self.rows.start)

    def events(self, events: NDArray[Any]) -> NDArray[Any]:
        """Return the events of the window, in its coordinates."""
        if self.shape == self.size:
            return events
        y = events["y"]
        wanted = (y >= self.rows.start) & (y < self.rows.stop)
        if self.shape[1] < self.size[1]:
            x = events["x"]
            wanted &= (x >= self.columns.start) & (x < self.columns.stop)
        inside: NDArray[Any] = events[wanted]
        inside["x"] -= self.columns.start
        inside["y"] -= self.rows.start
        return inside

    def frame(self, frame: ApsFrame) -> ApsFrame:
        """Return the frame of the window."""
        return frame.cropped(self.rows, self.columns)

    def plane(self, value: Any) -> Any:
        """Return the window of an array over the sensor; anything else as it is."""
        if isinstance(value, np.ndarray) and value.shape[-2:] == self.size:
            return np.ascontiguousarray(value[..., self.rows, self.columns])
        return value

    def planes(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the windows of those values that are arrays over the sensor."""
        return {name: self.plane(value) for name, value in values.items()}

    def part(self, roi: Roi) -> tuple[slice, slice]:
        """Return the rows and columns of the window that a region is."""
        x, y, width, height = roi
        top, left = y - self.rows.start, x - self.columns.start
        return slice(top, top + height), slice(left, left + width)

    def crop_of(self, roi: Roi, demosaic: str) -> tuple[slice, slice] | None:
        """Return the part of the window's image that a region is; None = all of it."""
        rows, columns = self.part(roi)
        if (rows, columns) == (slice(0, self.shape[0]), slice(0, self.shape[1])):
            return None
        scale = 2 if demosaic in HALF_SIZE else 1
        return (slice(rows.start // scale, rows.stop // scale),
                slice(columns.start // scale, columns.stop // scale))


def checked_roi(roi: Roi | None, size: tuple[int, int], demosaic: str) -> Roi:
    """Return (x, y, width, height) if it lies inside the sensor."""
    height, width = size
    if roi is None:
        roi = (0, 0, width, height)
    x, y, w, h = roi
    if x < 0 or y < 0 or w < 1 or h < 1 or x + w > width or y + h > height:
        raise ValueError(
            f"roi (x, y, width, height) must lie inside the {width}x{height} sensor, "
            f"got {(x, y, w, h)}")
    if demosaic in HALF_SIZE and any(value % 2 for value in (x, y, w, h)):
        raise ValueError(
            f"roi must hold even numbers for demosaic={demosaic!r}, got {(x, y, w, h)}")
    return x, y, w, h


def window_of(roi: Roi, size: tuple[int, int], margin: int) -> Window:
    """Return the window that the roi's result depends on.

    Parameters
    ----------
    roi : (int, int, int, int)
        (x, y, width, height).
    size : (int, int)
        (height, width) of the sensor.
    margin : int
        Pixels around a pixel that its result depends on: the method's, and what
        demosaicing reaches.
    """
    x, y, w, h = roi
    margin += margin % 2

    def side(start: int, length: int, limit: int) -> slice:
        lo, hi = start - start % 2 - margin, start + length + margin
        return slice(max(lo, 0), min(hi + hi % 2, limit))

    return Window(side(y, h, size[0]), side(x, w, size[1]), size)
