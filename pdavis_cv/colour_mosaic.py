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

COLOUR_REACH = {"bilinear": 2, "guided": 24}
"""Distance up to which `colour_mosaics` depends on other pixels.

Guided: 2 of a guide and 4 of a mean, twice; then 2 and 12."""

# Taps along rows and along columns.  Those of the guide leave nothing of the periods of
# colours (4) and of polarizers (2); those of means weigh all places of a cell alike.
_CELL = np.array([1, 2, 2, 2, 1], np.float32) / np.float32(8)
_NEAR = np.array([1, 3, 6, 9, 10, 9, 6, 3, 1], np.float32) / np.float32(48)
_FAR = np.array([1, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2, 1], np.float32) / np.float32(49)
_NEXT = np.array([1, 2, 1], np.float32)
_FLOOR = 0.02
"""Smallest ratio of a colour or channel to the mean of all: below is noise."""


def colour_mosaics(
    mosaic: Image, layout: Layout, method: str, valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Return what pixels would measure behind each of `COLOURS`, float32 (3, H, W).

    ``"bilinear"`` takes a colour from its nearest samples behind the same polarizer.
    ``"guided"`` multiplies the pixel's own sample by the ratio of two colours in its
    surroundings, so that the detail of the image is that of all pixels.  The ratio is
    that of colours whatever the polarizer, from near by, times that of the colours'
    polarization, from farther off.  Own samples are kept.

    The mosaic is (H, W), sides of at least 4, behind a layout with colours; samples
    that are not `valid` do not count.
    """
    image = np.ascontiguousarray(mosaic, np.float32)
    cell = np.array(["RGB".index(c) for c in layout.colours or ()], np.uint8)
    cell = cell.reshape(4, 4)

    usable = np.ones_like(image) if valid is None else valid.astype(np.float32)

    def means(image: Image, guide: Image, taps: Image, step: int = 1,
              cell: NDArray[np.uint8] = cell, count: int = 3) -> Image:
        out = np.empty((count, *image.shape), np.float32)
        ends = (len(taps) - 1) * step
        _kernels.colour_means(
            image, guide, cell, taps, step,
            np.empty(26 * (image.shape[1] + ends), np.float32), out)
        return out

    def guide(image: Image) -> Image:
        """Return the local mean of usable samples, 0 at the others."""
        mean: Image = means(image, usable, _CELL, 1, np.zeros_like(cell), 1)[0] * usable
        return mean

    def own(planes: Image) -> Image:
        """Return of each pixel the plane of its colour."""
        out = np.empty_like(image)
        for k, c in enumerate(cell.flat):
            out[k // 4::4, k % 4::4] = planes[c, k // 4::4, k % 4::4]
        return out

    if method == "bilinear":
        out = means(image, usable, _NEXT, 2)
        for k, c in enumerate(cell.flat):
            out[c, k // 4::4, k % 4::4] = image[k // 4::4, k % 4::4]
        return out
    light = guide(image)
    tint = means(image, light, _NEAR)
    # What the window blurs is in the residual: it is fitted once more.
    tint += means(image - own(tint) * light, light, _NEAR)
    np.maximum(tint, _FLOOR, out=tint)
    grey = image / own(tint)
    out = means(grey, guide(grey), _FAR, 2)
    np.maximum(out, _FLOOR, out=out)
    grey /= own(out)
    out *= tint
    out *= grey
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
