"""The part of the sensor that is computed for a region of interest."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdavis_cv._types import Events
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import Layout

Roi = tuple[int, int, int, int]


@dataclass(frozen=True)
class Window:
    """The rows and columns of a sensor that are computed: whole polarizer cells.

    Both slices have a start and a stop; the size is that of the sensor, (height,
    width).
    """

    rows: slice
    columns: slice
    size: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the window."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def layout(self, whole: Layout) -> Layout:
        """Return the polarizer layout of the window."""
        return whole.crop(self.columns.start, self.rows.start)

    def events(self, events: Events) -> Events:
        """Return the events inside the window, in its coordinates."""
        if self.shape == self.size:
            return events
        y = events["y"]
        wanted = (y >= self.rows.start) & (y < self.rows.stop)
        if self.shape[1] < self.size[1]:
            x = events["x"]
            wanted &= (x >= self.columns.start) & (x < self.columns.stop)
        inside: Events = events[wanted]
        if self.columns.start:
            inside["x"] -= self.columns.start
        if self.rows.start:
            inside["y"] -= self.rows.start
        return inside

    def frame(self, frame: ApsFrame) -> ApsFrame:
        """Return the frame cropped to the window."""
        if self.shape == self.size:
            return frame
        return frame.cropped(self.rows, self.columns)

    def plane(self, value: Any) -> Any:
        """Return an array of the sensor's shape cropped to the window.

        Any other value is returned as it is.
        """
        if isinstance(value, np.ndarray) and value.shape[-2:] == self.size:
            return np.ascontiguousarray(value[..., self.rows, self.columns])
        return value

    def planes(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return all values as `plane` returns them."""
        return {name: self.plane(value) for name, value in values.items()}

    def part(self, roi: Roi) -> tuple[slice, slice]:
        """Return the rows and columns of a region in the window's coordinates."""
        x, y, width, height = roi
        top, left = y - self.rows.start, x - self.columns.start
        return slice(top, top + height), slice(left, left + width)

    def crop_of(self, roi: Roi, demosaic: str) -> tuple[slice, slice] | None:
        """Return the part of the window's image that is a region; None = all of it."""
        rows, columns = self.part(roi)
        if (rows, columns) == (slice(0, self.shape[0]), slice(0, self.shape[1])):
            return None
        scale = 2 if demosaic in HALF_SIZE else 1
        return (slice(rows.start // scale, rows.stop // scale),
                slice(columns.start // scale, columns.stop // scale))


def checked_roi(roi: Roi | None, size: tuple[int, int], demosaic: str) -> Roi:
    """Return the region as (x, y, width, height); raise unless it lies in the sensor.

    None stands for the whole sensor.
    """
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
    """Return the window of a sensor (height, width) that a region (x, y, w, h) needs.

    A pixel's result depends on others up to `margin` pixels away: that of the method
    plus that of demosaicing.
    """
    x, y, w, h = roi
    margin += margin % 2

    def side(start: int, length: int, limit: int) -> slice:
        lo, hi = start - start % 2 - margin, start + length + margin
        return slice(max(lo, 0), min(hi + hi % 2, limit))

    return Window(side(y, h, size[0]), side(x, w, size[1]), size)
