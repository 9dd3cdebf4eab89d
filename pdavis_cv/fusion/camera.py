"""Layout, polarizers and calibration of the camera that a source was recorded with."""
from __future__ import annotations

import weakref

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analyser import Analyser
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.errors import CalibrationError, LayoutError
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.mosaic import demosaic as demosaic_mosaic
from pdavis_cv.reconstruct.base import Reconstructor
from pdavis_cv.recording.base import Source
from pdavis_cv.recording.facts import ASSUMED, CALIBRATION, CALLER, Fact, sensor_of
from pdavis_cv.sensor import Layout, Sensor, resolve_layout

# Sources whose unknown layout has already been warned about.
_warned: weakref.WeakSet[Source] = weakref.WeakSet()


def chosen_layout(
    layout: Layout | str | None, calibration: Calibration | None, source: Source
) -> Layout:
    """Return the polarizer layout to use; warn once per source if none is known."""
    layout = None if layout is None else Layout.of(layout)
    of_calibration = None if calibration is None else calibration.layout
    known = (layout, of_calibration, source.info.layout)
    if all(one is None for one in known):
        if source in _warned:
            return Layout.PDAVIS
        _warned.add(source)
    return resolve_layout(*known, stacklevel=4)


def check_calibration_fits(calibration: Calibration | None, source: Source) -> None:
    """Raise CalibrationError if the calibration belongs to another camera."""
    if calibration is not None:
        calibration.check_fits(source.info.sensor_size, source.info.serial)


def check_layout_fits(method: Reconstructor, layout: Layout) -> None:
    """Raise LayoutError if the method cannot be used with the layout."""
    i0, _, i90, _ = layout.places
    if method.needs.crossed_diagonal and i0 + i90 != 3:
        raise LayoutError(
            f"method {method.method!r} needs a layout in which 0 and 90 degrees lie "
            f"diagonally, got {layout}")


def chosen_sensor(layout: Layout | str | None, source: Source) -> Sensor | None:
    """Return the sensor that the caller's layout or the source names, or None."""
    named = None if layout is None else Layout.of(layout).sensor
    return sensor_of(named, source.info.sensor)


def facts_used(
    source: Source, options: FusionOptions, layout: Layout, sensor: Sensor | None,
    thresholds: Fact | None,
) -> dict[str, Fact]:
    """Return the facts on which fused images rest, each with its origin."""
    known, calibration = source.info.facts, options.calibration
    facts = {name: fact for name, fact in known.items()
             if name not in ("layout", "sensor", "extinction_ratio")}
    of_calibration = calibration is not None and calibration.layout is not None
    origin = (CALLER if options.layout is not None else CALIBRATION if of_calibration
              else known["layout"].origin if "layout" in known else ASSUMED)
    facts["layout"] = Fact(layout, origin)
    if sensor is not None:
        same = source.info.sensor == sensor
        facts["sensor"] = Fact(sensor, known["sensor"].origin if same else CALLER)
    if thresholds is not None:
        facts["thresholds"] = thresholds
    return facts


def resolved_extinction_ratio(
    value: float | str | None, sensor: Sensor | None
) -> float | None:
    """Return the extinction ratio that S1 and S2 are corrected for, or None."""
    if isinstance(value, str):
        return None if sensor is None else sensor.extinction_ratio
    return None if value is None else float(value)


def response_of(
    layout: Layout, calibration: Calibration | None, rows: slice, columns: slice
) -> NDArray[np.float64]:
    """Return the response of each pixel of a window to S0, S1, S2, float64 (H, W, 3).

    It is that of the calibration's analyser matrix; without one, (2, 2, 3) of the cell
    of ideal polarizers of the window's layout.
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
    """Return the channels' responses in the image of a window, None if unknown.

    They are interpolated as `demosaic` interpolates intensities; for ``"guided"``
    bilinearly, after division by the pixels' gain.  The layout is that of the window;
    `crop` is the part of it that the image shows, None = all.
    """
    if calibration is None or calibration.analyser is None:
        return None
    if layout.colours:
        raise CalibrationError(
            "an analyser matrix is for monochrome mosaics, got one for colours")
    part, gain = calibration.analyser[window], gain_of(calibration, window, demosaic)
    if gain is not None:
        part, demosaic = part / gain[..., np.newaxis], "bilinear"
    response = np.stack([demosaic_mosaic(
        np.ascontiguousarray(part[..., i]), layout, demosaic) for i in range(3)],
        axis=1)
    if crop is not None:
        response = response[:, :, crop[0], crop[1]]
    return Analyser(response)


def gain_of(
    calibration: Calibration | None, window: tuple[slice, slice], demosaic: str
) -> NDArray[np.float32] | None:
    """Return the gains by which intensities are divided before demosaicing, or None.

    Guided demosaicing gives images as sharp as the mosaic, so each pixel's calibrated
    gain has to be removed before.  The other methods blur the gains exactly as they
    blur the responses, which `analyser_of` accounts for.
    """
    if demosaic != "guided" or calibration is None or calibration.analyser is None:
        return None
    return np.asarray(2 * calibration.analyser[window][..., 0], np.float32)
