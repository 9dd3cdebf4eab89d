"""Outputs of retrieve(): float planes, and pictures with a fixed scale."""
from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.capture.outputs import Output
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.render import ToneCurve, fade_aop, quantity_bgr

WHITE_WITHOUT_FRAMES = 2.0
"""Intensity shown as white if there are no frames; it then starts from 1."""


def first_frame(recording: Recording) -> ApsFrame | None:
    """Return the first frame of a recording, None if it has none."""
    if recording.info.frame_count == 0:
        return None
    return next((frame for packet in recording.packets() for frame in packet.frames),
                None)


def white_level(uses_frames: bool, frame: ApsFrame | None) -> float:
    """Return the intensity that is shown as white: full scale of the converter.

    It is in the unit of S0 / 2: DN per ms of exposure, or DN if the exposure is
    unknown.  A method without frames has a scale of its own; the first frame tells the
    converter's range and the exposure.
    """
    if frame is None or not uses_frames:
        return WHITE_WITHOUT_FRAMES
    return frame.full_scale_dn / (frame.exposure_ms or 1.0)


def tone(white: float, gain: float, gamma: float, log: bool) -> ToneCurve:
    """Return the curve from S0 / 2 to grey.

    At gain 1, `white` is white; gain and gamma must be positive.  `log` is logarithmic
    over three decades instead of linear.
    """
    for name, value in (("gain", gain), ("gamma", gamma)):
        if isinstance(value, bool) or not isinstance(
                value, (int, float, np.integer, np.floating)):
            raise TypeError(f"{name} must be a number, got {type(value).__name__}")
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive, got {value}")
    return ToneCurve(white / float(gain), gamma=float(gamma), log=bool(log))


def plane(frame: PolarFrame, output: Output) -> NDArray[Any]:
    """Return the numbers of an output, not of events; of a picture, those it shows.

    A new array, (H, W) or (H, W, channels), of float32 or the quantity's dtype.  For
    the picture of an intensity it is divided by the greatest part of the converter's
    full scale that it can reach: S0 / 2.  What the method does not provide is a
    ValueError.
    """
    planes = [one.of(frame) for one in output.quantities]
    if len(planes) > 1:
        return np.stack(planes, axis=-1)
    if output.picture and output.quantity.light:
        return planes[0] * np.float32(1 / output.quantity.range[1])
    return np.array(planes[0])


def colour(frame: PolarFrame, output: Output, curve: ToneCurve) -> NDArray[np.uint8]:
    """Return the picture of an output, not of events, uint8 (H, W, 3), BGR.

    Intensities go through the curve of `tone`.  Pixels that are not valid are hatched,
    and of intensities, which stay grey for detectors, black.  What the method does not
    provide is a ValueError.
    """
    one = output.quantity
    if one.light:
        return curve.bgr(plane(frame, output), invalid=(0, 0, 0))
    made = quantity_bgr(one, frame, *one.ends(curve.white))
    if output.faded:
        fade_aop(made, frame)
    return made


def event_counts(
    parts: Iterable[NDArray[Any]], roi: tuple[int, int, int, int], step: int,
) -> NDArray[np.float32]:
    """Return the number of ON minus OFF events of each pixel of a region, float32.

    The region is (x, y, width, height); `step` is the side of the squares of sensor
    pixels over which counts are summed.
    """
    x0, y0, width, height = roi
    columns = width // step
    out: NDArray[np.float64] = np.zeros(height // step * columns)
    for events in parts:
        x = (events["x"].astype(np.int64) - x0) // step
        y = (events["y"].astype(np.int64) - y0) // step
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < height // step)
        sign = 2.0 * events["p"][inside] - 1
        out += np.bincount(y[inside] * columns + x[inside], sign, out.size)
    return out.reshape(-1, columns).astype(np.float32)


def events_bgr(counts: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the picture of event counts: grey 128 plus 42 for each ON event."""
    grey = np.rint(np.clip(128 + 42 * counts, 0, 255)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
