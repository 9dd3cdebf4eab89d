"""Checks of what `fuse` is asked for."""
from __future__ import annotations

import math
import operator
import weakref
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.analyser import Analyser
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.errors import LayoutError
from pdavis_cv.mosaic import demosaic as demosaic_mosaic
from pdavis_cv.reconstruct.methods import METHODS
from pdavis_cv.recording.base import Recording
from pdavis_cv.sensor import Layout, Sensor, resolve_layout

# A recording that warned about its layout once does not do so again.
_warned: weakref.WeakSet[Recording] = weakref.WeakSet()


def choose_method(method: str | None, recording: Recording, default: str) -> str:
    """Return the method to use; without one, what fits the recording."""
    if method is None:
        if recording.info.event_count == 0:
            return "frames"
        if recording.info.frame_count == 0:
            return "events"
        return default
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    return method


def chosen_layout(
    layout: Layout | None, calibration: Calibration | None, recording: Recording
) -> Layout:
    """Return the layout to use; warn once per recording if none is known."""
    of_calibration = None if calibration is None else calibration.layout
    if layout is not None and not isinstance(layout, Layout):
        raise TypeError(f"layout must be a Layout, got {type(layout).__name__}")
    known = (layout, of_calibration, recording.info.layout)
    if all(one is None for one in known):
        if recording in _warned:
            return Layout.PDAVIS
        _warned.add(recording)
    return resolve_layout(*known, stacklevel=4)


def check_method_fits(method: str, layout: Layout) -> None:
    """Raise LayoutError if the method was made for other layouts."""
    i0, _, i90, _ = layout.places
    if method == "joint" and i0 + i90 != 3:
        raise LayoutError(
            "method 'joint' needs a layout in which 0 and 90 degrees lie diagonally, "
            f"got {layout}")


def checked_calibration(
    calibration: Calibration | None, recording: Recording
) -> Calibration | None:
    """Return the calibration if it can be of the recording's camera."""
    if calibration is None:
        return None
    if not isinstance(calibration, Calibration):
        raise TypeError(
            f"calibration must be a Calibration, got {type(calibration).__name__}")
    calibration.check_fits(recording.info.sensor_size, recording.info.serial)
    return calibration


def resolved_extinction_ratio(
    value: float | str | None, sensor: Sensor | None
) -> float | None:
    """Return the number that S1 and S2 are corrected for, or None."""
    if value is None:
        return None
    if isinstance(value, str):
        if value != "nominal":
            raise ValueError(
                f"extinction_ratio must be 'nominal', a number or None, got {value!r}")
        return (sensor or Sensor.PDAVIS).extinction_ratio
    if not float(value) > 1:
        raise ValueError(f"extinction_ratio must exceed 1, got {value}")
    return float(value)


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


def denoising(value: bool | Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the parameters of an `EventDenoiser`, None for none."""
    if isinstance(value, Mapping):
        return dict(value)
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(
            "denoise must be a bool or a mapping of parameters of EventDenoiser, got "
            f"{type(value).__name__}")
    return {} if value else None


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


def checked_grid(
    fps: float | None, times_us: ArrayLike | None, start_us: int | None,
    stop_us: int | None,
) -> tuple[Fraction | None, NDArray[np.int64] | None]:
    """Return the rate or the times of the images."""
    for name, value in (("start_us", start_us), ("stop_us", stop_us)):
        if value is not None and not isinstance(value, (int, np.integer)):
            raise TypeError(
                f"{name} must be integer microseconds, got {type(value).__name__}")
    if times_us is not None:
        if any(value is not None for value in (fps, start_us, stop_us)):
            raise TypeError("times_us excludes fps, start_us and stop_us")
        raw = np.asarray(times_us)
        if raw.ndim != 1 or (raw.size and raw.dtype.kind not in "iu"):
            raise TypeError(
                "times_us must be one-dimensional integer microseconds, got "
                f"{raw.dtype} {raw.shape}")
        times = raw.astype(np.int64)
        if np.any(times[1:] <= times[:-1]):
            raise ValueError("times_us must increase")
        return None, times
    if fps is None:
        return None, None
    try:
        rate = Fraction(fps)
    except (TypeError, ValueError, OverflowError):
        rate = Fraction(0)
    if not 0 < rate <= 1_000_000:
        raise ValueError(f"fps must lie in (0, 1000000], got {fps!r}")
    return rate, None
