"""The picture of any quantity."""
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pdavis_cv.colour_mosaic import COLOURS
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import Quantity
from pdavis_cv.render.colours import Picture, aop_bgr, dolp_bgr, grey_bgr


def quantity_bgr(
    quantity: Quantity, frame: PolarFrame, low: float, high: float, *,
    saturated: float = math.inf,
) -> Picture:
    """Draw a quantity of an image in its colours.

    Parameters
    ----------
    quantity : Quantity
        One of an image, not ``events``.
    frame : PolarFrame
    low, high : float
        Values at the ends of the colours; a hue goes round and has none.
    saturated : float
        Of an intensity, as for `grey_bgr`.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.
    """
    if quantity.colours == "hue":
        return aop_bgr(quantity.of(frame), frame.valid)
    values, width = quantity.of(frame) - np.float32(low), high - low
    if quantity.colours == "viridis":
        return dolp_bgr(values, frame.valid, top=width)
    if quantity.light:
        return grey_bgr(values, width, frame.valid, saturated=saturated - low)
    known = None if quantity.dtype is np.uint8 else frame.valid     # `valid` itself
    return grey_bgr(values, width, known)


def colour_bgr(
    frame: PolarFrame, white: float, balance: Sequence[float] = (1.0, 1.0, 1.0), *,
    saturated: float = math.inf,
) -> Picture:
    """Draw S0 of a colour sensor in colour, linear from 0 to `white`.

    Parameters
    ----------
    frame : PolarFrame
        With `PolarFrame.colours`.
    white : float
        Intensity that becomes 255.
    balance : (float, float, float)
        White balance: what red, green and blue are multiplied by before.
    saturated : float
        As for `grey_bgr`.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.
    """
    if not frame.colours:
        raise ValueError("frame must be of a colour sensor, got one without colours")
    parts = [grey_bgr(frame.colours[name].s0, white / gain, frame.valid,
                      saturated=saturated)
             for name, gain in zip(COLOURS, balance, strict=True)]
    return np.stack([parts[2 - i][..., i] for i in range(3)], axis=-1)
