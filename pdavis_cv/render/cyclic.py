"""A perceptually uniform cyclic colour map of constant lightness and chroma.

The lightness of HSV hues differs by a factor of three, which shows edges where there
are none.  Here equal differences of angle look equal.  Colours form a circle in Oklab
(Bjorn Ottosson, 2020, public domain), with the largest chroma that fits into sRGB at
all hues.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv.render.colours import Picture, table_of, through_table

__all__ = ["cyclic_bgr"]

_STEPS = 1024
_LIGHTNESS, _CHROMA = 0.75, 0.124
_START = np.deg2rad(29.23)  # Oklab hue of sRGB red, as HSV has it at 0


def _table() -> NDArray[np.uint8]:
    hue = _START + 2 * np.pi * np.arange(_STEPS) / _STEPS
    a, b = _CHROMA * np.cos(hue), _CHROMA * np.sin(hue)
    root = np.stack((
        _LIGHTNESS + 0.3963377774 * a + 0.2158037573 * b,
        _LIGHTNESS - 0.1055613458 * a - 0.0638541728 * b,
        _LIGHTNESS - 0.0894841775 * a - 1.2914855480 * b))
    blue_green_red = np.array([
        [-0.0041960863, -0.7034186147, 1.7076147010],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [4.0767416621, -3.3077115913, 0.2309699292]])
    linear = np.clip(blue_green_red @ root**3, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear,
                       1.055 * np.power(linear, 1 / 2.4) - 0.055)
    return table_of(np.rint(255 * encoded.T).astype(np.uint8))


_TABLE = _table()


def cyclic_bgr(
    aop: ArrayLike, valid: NDArray[np.bool_] | None = None,
    out: Picture | None = None,
) -> Picture:
    """Colour an angle of polarization so that equal steps look equal.

    Parameters
    ----------
    aop : array_like of float, shape (H, W)
        Radians; 0 and pi have the same colour, a reddish one.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False become `INVALID`.
    out : ndarray of uint8, shape (H, W, 3), optional
        As for `aop_bgr`.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR of constant lightness.
    """
    return through_table(
        _kernels.hue_bgr, aop, valid, _STEPS / np.pi, _TABLE, out=out)
