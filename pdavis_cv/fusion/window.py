"""The part of the sensor that a region's result depends on, and what belongs to it."""
from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analyser import Analyser
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.mosaic import demosaic as demosaic_mosaic
from pdavis_cv.sensor import Layout, Sensor

__all__ = ["analyser_of", "checked_roi", "events_of", "mismatch_of", "part_of",
           "response_of", "window_of"]


def checked_roi(
    roi: tuple[int, int, int, int] | None, size: tuple[int, int], demosaic: str
) -> tuple[int, int, int, int]:
    """Return (x, y, width, height) if it lies inside the sensor."""
    height, width = size
    if roi is None:
        roi = (0, 0, width, height)
    try:
        x, y, w, h = (operator.index(value) for value in roi)
    except (TypeError, ValueError):
        raise TypeError(
            f"roi must be four integers (x, y, width, height), got {roi!r}") from None
    if x < 0 or y < 0 or w < 1 or h < 1 or x + w > width or y + h > height:
        raise ValueError(
            f"roi (x, y, width, height) must lie inside the {width}x{height} sensor, "
            f"got {(x, y, w, h)}")
    if demosaic == "superpixel" and any(value % 2 for value in (x, y, w, h)):
        raise ValueError(
            f"roi must hold even numbers for demosaic='superpixel', got {(x, y, w, h)}")
    return x, y, w, h


def window_of(
    roi: tuple[int, int, int, int], size: tuple[int, int], demosaic: str, margin: int
) -> tuple[slice, slice]:
    """Return the rows and columns that the roi's result depends on, cells whole."""
    x, y, w, h = roi
    # Bilinear needs one pixel around, and three where it extrapolates at a border.
    margin += 4 if demosaic == "bilinear" else 0
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


def mismatch_of(sensor: Sensor | None) -> tuple[float, float, float]:
    """Return the spread of gain, angle (radians) and contrast of a sensor's pixels."""
    sensor = sensor or Sensor.PDAVIS
    gain, angle_deg, ratio = sensor.mismatch
    contrast = 2 * ratio / (sensor.extinction_ratio + 1) ** 2
    return gain, math.radians(angle_deg), contrast


def response_of(
    layout: Layout, calibration: Calibration | None, rows: slice, columns: slice
) -> NDArray[np.float64]:
    """Return how the pixels of a window respond to S0, S1, S2.

    Parameters
    ----------
    layout : Layout
        Of the window.
    calibration : Calibration or None
        Its analyser matrix is used, where it has one.
    rows, columns : slice
        The window.

    Returns
    -------
    ndarray of float64, shape (H, W, 3) or, of ideal polarizers, (2, 2, 3)
    """
    if calibration is not None and calibration.analyser is not None:
        return np.ascontiguousarray(calibration.analyser[rows, columns], np.float64)
    cell = np.empty((4, 3))
    cell[list(layout.places)] = Analyser.ideal().response
    return cell.reshape(2, 2, 3)


def analyser_of(
    calibration: Calibration | None, window: tuple[slice, slice], layout: Layout,
    demosaic: str, crop: tuple[slice, slice] | None,
) -> Analyser | None:
    """Return the channels' responses in the images of a window, None if unknown.

    Parameters
    ----------
    calibration : Calibration or None
    window : (slice, slice)
        Rows and columns of the sensor.
    layout : Layout
        Of the window.
    demosaic : {"bilinear", "superpixel"}
        How the responses are brought to one place, as intensities are.
    crop : (slice, slice) or None
        The part of the window that the image is; None = all of it.
    """
    if calibration is None or calibration.analyser is None:
        return None
    part = calibration.analyser[window]
    response = np.stack([demosaic_mosaic(
        np.ascontiguousarray(part[..., i]), layout, demosaic) for i in range(3)],
        axis=1)
    if crop is not None:
        response = response[:, :, crop[0], crop[1]]
    return Analyser(response)
