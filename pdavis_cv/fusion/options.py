"""What `fuse` is asked for, checked."""
from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np

from pdavis_cv.calibration.model import Calibration
from pdavis_cv.errors import LayoutError
from pdavis_cv.reconstruct.base import Reconstructor
from pdavis_cv.recording.base import Source
from pdavis_cv.sensor import Layout, Sensor, resolve_layout

__all__ = ["check_layout_fits", "checked_calibration", "chosen_layout", "denoising",
           "resolved_extinction_ratio"]

# A recording that warned about its layout once does not do so again.
_warned: weakref.WeakSet[Source] = weakref.WeakSet()


def chosen_layout(
    layout: Layout | None, calibration: Calibration | None, recording: Source
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


def check_layout_fits(method: Reconstructor, layout: Layout) -> None:
    """Raise LayoutError if the method was made for other layouts."""
    i0, _, i90, _ = layout.places
    if method.needs.crossed_diagonal and i0 + i90 != 3:
        raise LayoutError(
            f"method {method.method!r} needs a layout in which 0 and 90 degrees lie "
            f"diagonally, got {layout}")


def checked_calibration(
    calibration: Calibration | None, recording: Source
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


def denoising(value: bool | Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the parameters of an `EventDenoiser`, None for none."""
    if isinstance(value, Mapping):
        return dict(value)
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(
            "denoise must be a bool or a mapping of parameters of EventDenoiser, got "
            f"{type(value).__name__}")
    return {} if value else None
