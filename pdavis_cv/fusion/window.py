"""The part of the sensor that a region's result depends on, and what belongs to it."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.mosaic import HALF_SIZE, REACH

__all__ = ["checked_roi", "events_of", "part_of", "window_of"]


def checked_roi(
    roi: tuple[int, int, int, int] | None, size: tuple[int, int], demosaic: str
) -> tuple[int, int, int, int]:
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


def window_of(
    roi: tuple[int, int, int, int], size: tuple[int, int], demosaic: str, margin: int
) -> tuple[slice, slice]:
    """Return the rows and columns that the roi's result depends on, cells whole."""
    x, y, w, h = roi
    margin += REACH[demosaic]
    margin += margin % 2

    def side(start: int, length: int, limit: int) -> slice:
        lo, hi = start - start % 2 - margin, start + length + margin
        return slice(max(lo, 0), min(hi + hi % 2, limit))

    return side(y, h, size[0]), side(x, w, size[1])


def part_of(
    theta: NDArray[np.float32] | float, rows: slice, columns: slice
) -> NDArray[np.float32] | float:
    """Return the part of thresholds that belongs to a window."""
    return theta if isinstance(theta, float) else np.ascontiguousarray(
        theta[rows, columns])


def events_of(
    events: NDArray[Any], window: tuple[slice, slice], size: tuple[int, int]
) -> NDArray[Any]:
    """Return the events of a window of a sensor, in its coordinates."""
    (rows, columns), (height, width) = window, size
    if (rows.start, rows.stop, columns.start, columns.stop) == (0, height, 0, width):
        return events
    x, y = events["x"], events["y"]
    inside: NDArray[Any] = events[(x >= columns.start) & (x < columns.stop)
                                  & (y >= rows.start) & (y < rows.stop)]
    inside["x"] -= columns.start
    inside["y"] -= rows.start
    return inside
