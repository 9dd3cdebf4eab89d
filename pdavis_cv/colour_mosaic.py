"""Mosaics of colours and polarizers: one mosaic of polarizers for each colour.

Each colour filter covers 2x2 pixels, which stand behind the four polarizers.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Image
from pdavis_cv.sensor import Layout

COLOURS = ("red", "green", "blue")
"""The colours in the order of an array's planes."""

COLOUR_METHODS = ("bilinear", "guided")
"""Methods of demosaicing for a layout with colours."""

COLOUR_REACH = {"bilinear": 6, "guided": 26}
"""Distance up to which the mosaics of colours depend on other pixels.

Guided: 4 of a slope, 12 of a window of cells, 6 of interpolation to pixels.  Both: 4
where a sample is replaced."""

_CELL = "RRGGRRGGGGBBGGBB"


def colour_channels(
    mosaic: Image, layout: Layout, method: str, valid: NDArray[np.bool_] | None,
    demosaic: Callable[..., NDArray[np.float32]], out: NDArray[np.float32],
) -> None:
    """Write what pixels would measure behind each of `COLOURS` to out (3, 4, H, W).

    ``"bilinear"`` takes a colour from its nearest samples behind the same polarizer.
    ``"guided"`` divides each sample by what its colour is, behind its polarizer, in
    parts of the grey around it, and multiplies the channels of that grey mosaic by what
    each colour is.  The mosaic has usable samples instead of those not `valid`.
    """
    spare = np.empty(55 * (mosaic.shape[1] + 40) + 32, np.float32)
    if method == "bilinear":
        planes = np.empty((3, *mosaic.shape), np.float32)
        cell = np.array(["RGB".index(c) for c in layout.colours or ()], np.uint8)
        _kernels.colour_bilinears(mosaic, cell.reshape(4, 4), spare, planes)
        for plane, one in zip(planes, out, strict=True):
            demosaic(plane, replace(layout, colours=None), method, one)
        return
    # Whole cells that begin with red; what lacks at borders is repeated.
    top, left = next((y, x) for y, x in np.ndindex(4, 4)
                     if layout.crop(-x, -y).colours == _CELL)
    y, x = (np.arange(-first, n + -(first + n) % 4)
            for first, n in zip((top, left), mosaic.shape, strict=True))
    planes = out
    if (len(y), len(x)) != mosaic.shape:
        around = np.ix_(*(np.where(i < 0, i + 4, np.where(i < n, i, i - 4))
                          for i, n in zip((y, x), mosaic.shape, strict=True)))
        mosaic, valid = mosaic[around], None if valid is None else valid[around]
        planes = np.empty((3, 4, *mosaic.shape), np.float32)
    layout = replace(layout.crop(-left, -top), colours=None)
    h, w = (n // 4 for n in mosaic.shape)
    grey, image = planes[0, :2]     # before they are what they shall be
    image[:] = mosaic
    tints = np.empty((3, 2 * h, 2 * w), np.float32)
    parts = np.empty((2, 3, 3, h, w), np.float32)
    _kernels.colour_ratios(image, spare, tints, parts)
    _kernels.grey_mosaic(image, tints, parts[0], spare, grey)
    demosaic(grey, layout, method, planes[1], valid=valid)
    _kernels.colour_planes(
        np.array(layout.places, np.intp), tints, parts[0], spare, planes)
    if planes is not out:
        out[:] = planes[..., top:top + out.shape[2], left:left + out.shape[3]]


def joint(quads: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return what three colours, each (4, H, W), say together of polarization.

    The mean of all samples, of which half are green.  Where light is counted in
    electrons, that weights degree and angle of each colour by their inverse variance.
    """
    out: NDArray[np.float32] = quads[0] + quads[2]
    out *= np.float32(0.25)
    out += np.float32(0.5) * quads[1]
    return out
