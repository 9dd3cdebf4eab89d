"""Outputs of retrieve(): float planes, and pictures with a fixed scale."""
from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.capture import constants as c
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.render import ToneCurve, aop_bgr, dolp_bgr

__all__ = ["event_counts", "events_bgr", "first_frame", "plane", "tone", "white_level"]

WHITE_WITHOUT_FRAMES = 2.0
"""Intensity shown as white if there are no frames; it then starts from 1."""

_CHANNEL = {c.CAP_PDAVIS_I0: 0, c.CAP_PDAVIS_I45: 1, c.CAP_PDAVIS_I90: 2,
            c.CAP_PDAVIS_I135: 3}
_NAME = {c.CAP_PDAVIS_S0: "s0", c.CAP_PDAVIS_S1: "s1", c.CAP_PDAVIS_S2: "s2",
         c.CAP_PDAVIS_AOP: "aop", c.CAP_PDAVIS_DOLP: "dolp",
         c.CAP_PDAVIS_AOP_BGR: "aop", c.CAP_PDAVIS_DOLP_BGR: "dolp"}


def first_frame(recording: Recording) -> ApsFrame | None:
    """Return the first frame of a recording, None if it has none."""
    if recording.info.frame_count == 0:
        return None
    return next((frame for packet in recording.packets() for frame in packet.frames),
                None)


def white_level(uses_frames: bool, frame: ApsFrame | None) -> float:
    """Return the intensity that is shown as white: full scale of the converter.

    Parameters
    ----------
    uses_frames : bool
        Whether the method uses frames; otherwise it has a scale of its own.
    frame : ApsFrame or None
        The first frame, which has the converter's range and the exposure.

    Returns
    -------
    float
        In the unit of S0 / 2: DN per ms of exposure, or DN if the exposure is unknown.
    """
    if frame is None or not uses_frames:
        return WHITE_WITHOUT_FRAMES
    return frame.full_scale_dn / (frame.exposure_ms or 1.0)


def tone(white: float, gain: float, gamma: float, log: bool) -> ToneCurve:
    """Return the curve from S0 / 2 to grey.

    Parameters
    ----------
    white : float
        Value that is white at gain 1.
    gain, gamma : float
        Positive.
    log : bool
        Logarithmic over three decades instead of linear.

    Returns
    -------
    ToneCurve

    Raises
    ------
    TypeError, ValueError
        If `gain` or `gamma` is not a positive number.
    """
    for name, value in (("gain", gain), ("gamma", gamma)):
        if isinstance(value, bool) or not isinstance(
                value, (int, float, np.integer, np.floating)):
            raise TypeError(f"{name} must be a number, got {type(value).__name__}")
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive, got {value}")
    return ToneCurve(white / float(gain), gamma=float(gamma), log=bool(log))


def plane(frame: PolarFrame, output: int) -> NDArray[Any]:
    """Return the plane of an output; for a picture, the plane that it shows.

    Parameters
    ----------
    frame : PolarFrame
    output : int
        ``CAP_PDAVIS_*``, but not ``CAP_PDAVIS_EVENTS_BGR``.

    Returns
    -------
    ndarray of float32, shape (H, W), or (H, W, 4) for QUAD, (H, W, 3) for STOKES
        A new array with channels last, as in cv2.  VALID is uint8: 0, or 255 = usable.
    """
    if output == c.CAP_PDAVIS_BGR:
        half: NDArray[np.float32] = frame.s0 * np.float32(0.5)
        return half
    if output == c.CAP_PDAVIS_QUAD:
        return np.ascontiguousarray(np.moveaxis(frame.quad, 0, -1))
    if output == c.CAP_PDAVIS_STOKES:
        return np.stack((frame.s0, frame.s1, frame.s2), axis=-1)
    if output in _CHANNEL:
        return np.array(frame.quad[_CHANNEL[output]])
    if output == c.CAP_PDAVIS_VALID:
        return frame.valid.view(np.uint8) * np.uint8(255)
    made: NDArray[np.float32] = getattr(frame, _NAME[output]).copy()
    return made


def colour(frame: PolarFrame, output: int) -> NDArray[np.uint8]:
    """Return the colour picture of AoP or DoLP; invalid pixels are grey."""
    if output == c.CAP_PDAVIS_AOP_BGR:
        return aop_bgr(frame.aop, frame.valid)
    return dolp_bgr(frame.dolp, frame.valid)


def event_counts(
    parts: Iterable[NDArray[Any]], roi: tuple[int, int, int, int], step: int,
) -> NDArray[np.float32]:
    """Return the number of ON minus OFF events of each pixel.

    Parameters
    ----------
    parts : iterable of ndarray of EVENT_DTYPE
    roi : (int, int, int, int)
        (x, y, width, height).
    step : int
        Side of the squares of sensor pixels over which counts are summed.

    Returns
    -------
    ndarray of float32, shape (height // step, width // step)
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
