"""Mosaics of colours and polarizers: one mosaic of polarizers for each colour.

Each colour filter covers 2x2 pixels, which stand behind the four polarizers.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Image
from pdavis_cv.sensor import Layout

COLOURS = ("red", "green", "blue")
"""The colours in the order of an array's planes."""

COLOUR_METHODS = ("bilinear", "guided")
"""Methods of demosaicing for a layout with colours."""

COLOUR_REACH = {"bilinear": 6, "guided": 30}
"""Distance up to which the mosaics of colours depend on other pixels.

Guided: 4 of a slope, 12 of a window of cells, 4 of grey, 6 of interpolation to pixels.
Both: 4 where a sample is replaced."""

_CELL = "RRGGRRGGGGBBGGBB"


def colour_channels(
    mosaic: Image, layout: Layout, method: str, clean: NDArray[np.uint8],
    constants: NDArray[np.void], out: NDArray[np.float32], gain: float = 1,
) -> NDArray[np.float32]:
    """Return out (3, 4, H, W) with what pixels would measure behind each of `COLOURS`.

    ``"bilinear"`` takes a colour from its nearest samples behind the same polarizer.
    ``"guided"`` divides each sample by what its colour is, behind its polarizer, in
    parts of the grey around it, and multiplies the channels of that grey mosaic by what
    each colour is; S0, angle and degree if out is (3, 3, H, W), with `stokes_gain`.
    The mosaic has usable samples only; `clean` and `constants` are those of the kernel
    of guided demosaicing.
    """
    places = np.array(layout.places, np.intp)
    spare = np.empty(144 * (mosaic.shape[1] + 40) + 32, np.float32)
    if method == "bilinear":
        planes = np.empty((3, *mosaic.shape), np.float32)
        cell = np.array(["RGB".index(c) for c in layout.colours or ()], np.uint8)
        _kernels.colour_bilinears(mosaic, cell.reshape(4, 4), spare, planes)
        for plane, one in zip(planes, out, strict=True):
            _kernels.bilinear(plane, places, False, spare, one)
        return out
    # Whole cells that begin with red; what lacks at borders is repeated.
    top, left = next((y, x) for y, x in np.ndindex(4, 4)
                     if layout.crop(-x, -y).colours == _CELL)
    y, x = (np.arange(-first, n + -(first + n) % 4)
            for first, n in zip((top, left), mosaic.shape, strict=True))
    planes = out
    if (len(y), len(x)) != mosaic.shape:
        around = np.ix_(*(np.where(i < 0, i + 4, np.where(i < n, i, i - 4))
                          for i, n in zip((y, x), mosaic.shape, strict=True)))
        mosaic, clean = mosaic[around], clean[around] if clean.size else clean
        planes = np.empty((*out.shape[:2], *mosaic.shape), np.float32)
    places = np.array(layout.crop(-left, -top).places, np.intp)
    h, w = (n // 4 for n in mosaic.shape)
    quad = planes[1] if out.shape[1] == 4 else np.empty((4, 4 * h, 4 * w), np.float32)
    grey = planes[0, 0]     # before it is what it shall be
    grey[:] = mosaic
    tints = np.empty((3, 2 * h, 2 * w), np.float32)
    parts = np.empty((3, 8, h, w), np.float32)
    _kernels.colour_ratios(grey, spare, tints, parts)
    _kernels.grey_mosaic(tints, parts, spare, grey)
    _kernels.guided(grey, clean, np.empty((0, 0), np.float32), places, constants, spare,
                    quad)
    _kernels.colour_planes(quad, places, tints, parts, gain, spare, planes)
    if planes is not out:
        out[:] = planes[..., top:top + out.shape[2], left:left + out.shape[3]]
    return out


def joint(quads: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return what three colours, each (4, H, W), say together of polarization.

    The mean of all samples, of which half are green.  Where light is counted in
    electrons, that weights degree and angle of each colour by their inverse variance.
    """
    out: NDArray[np.float32] = quads[0] + quads[2]
    out *= np.float32(0.25)
    out += np.float32(0.5) * quads[1]
    return out
