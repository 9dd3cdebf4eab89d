"""The picture of any quantity."""
from __future__ import annotations

import math

import numpy as np

from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import Quantity
from pdavis_cv.render.colours import Picture, aop_bgr, dolp_bgr, grey_bgr

__all__ = ["quantity_bgr"]


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
