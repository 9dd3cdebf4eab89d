"""The colours of an angle: cyclic maps.

The lightness of HSV hues differs by a factor of three, which shows edges where there
are none.  In the even map equal differences of angle look equal: its colours are a
circle in Oklab (Bjorn Ottosson, 2020, public domain).  The circle is tilted, so that
lightness goes round once, from CIELAB 51 to 79: in grey, and for eyes that do not tell
red from green, two angles 30 degrees apart still differ.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STEPS = 1024
_LIGHTNESS, _RADIUS = 0.70, 0.15    # the largest radius that fits into sRGB
_TILT = 0.8                         # radians
_LIGHTEST = np.deg2rad(160)         # Oklab hue: green, so that red is dark
_START = np.deg2rad(29)             # Oklab hue of sRGB red, as HSV has it at 0


def even_hues() -> NDArray[np.uint8]:
    """Return the even map from 0 to a half turn, shape (1024, 3), BGR."""
    turn = _START - _LIGHTEST + 2 * np.pi * np.arange(_STEPS) / _STEPS
    along, across = _RADIUS * np.cos(turn), _RADIUS * np.sin(turn)
    flat = np.cos(_TILT) * along
    lightness = _LIGHTNESS + np.sin(_TILT) * along
    a = flat * np.cos(_LIGHTEST) - across * np.sin(_LIGHTEST)
    b = flat * np.sin(_LIGHTEST) + across * np.cos(_LIGHTEST)
    root = np.stack((
        lightness + 0.3963377774 * a + 0.2158037573 * b,
        lightness - 0.1055613458 * a - 0.0638541728 * b,
        lightness - 0.0894841775 * a - 1.2914855480 * b))
    blue_green_red = np.array([
        [-0.0041960863, -0.7034186147, 1.7076147010],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [4.0767416621, -3.3077115913, 0.2309699292]])
    linear = np.clip(blue_green_red @ root**3, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear,
                       1.055 * np.power(linear, 1 / 2.4) - 0.055)
    table: NDArray[np.uint8] = np.rint(255 * encoded.T).astype(np.uint8)
    return table


def hsv_hues() -> NDArray[np.uint8]:
    """Return all colours of full saturation and value, shape (1530, 3), BGR."""
    count = 6 * 255
    step = np.arange(count)[:, None]
    phase = (step - np.array([4, 2, 0]) * 255) % count  # distance past B, G, R
    off = np.minimum(phase, count - phase)  # 0 at the pure colour, 3 * 255 opposite
    table: NDArray[np.uint8] = np.clip(2 * 255 - off, 0, 255).astype(np.uint8)
    return table
