"""Colour maps for polarization.

The colour of a pixel depends only on its own value, not on the rest of the image, so
that pictures and frames of a video can be compared.

The lightness of HSV hues differs by a factor of three, which shows edges where there
are none.  In the even map equal differences of angle look equal: its colours are a
circle in Oklab (Bjorn Ottosson, 2020, public domain).  The circle is tilted, so that
lightness goes round once, from CIELAB 51 to 79: in grey, and for eyes that do not tell
red from green, two angles 30 degrees apart still differ.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import fitting, positive, real_number, whole_number
from pdavis_cv.polarimetry import PolarFrame

Picture = NDArray[np.uint8]
Mark = tuple[int, int, int] | tuple[tuple[int, int, int], tuple[int, int, int]]

INVALID = ((64, 32, 32), (108, 76, 72))
"""The colours, BGR, of the stripes that mark pixels that are not valid.

Stripes, because faded data have any quiet colour; slate blue, so that a single pixel is
neither a grey nor a colour of DoLP.
"""

MASKED = (96, 96, 96)
"""Colour of valid pixels whose AoP the user does not want to see, BGR."""

FULL_COLOUR_DOLP = 0.25
"""DoLP from which on a faded AoP has its full colour; chosen for tissue and sky."""

MOST_PIXELS = 8192
"""Longest side of a picture that is drawn."""
# matplotlib's viridis (CC0) at 16 intervals, RGB; interpolated, within 6 of 255.
_VIRIDIS = np.array([
    (68, 1, 84), (72, 24, 106), (71, 45, 123), (66, 64, 134), (59, 82, 139),
    (51, 99, 141), (44, 114, 142), (38, 130, 142), (33, 145, 140), (31, 160, 136),
    (40, 174, 128), (63, 188, 115), (94, 201, 98), (132, 212, 75), (173, 220, 48),
    (216, 226, 25), (253, 231, 37)], np.float64)
_STEPS = 1024
_LIGHTNESS, _RADIUS = 0.70, 0.15    # the largest radius that fits into sRGB
_TILT = 0.8                         # radians
_LIGHTEST = np.deg2rad(160)         # Oklab hue: green, so that red is dark
_START = np.deg2rad(29)             # Oklab hue of sRGB red, as HSV has it at 0


def table_of(
    colours: NDArray[np.uint8], none: Mark = INVALID, invalid: Mark = INVALID,
) -> NDArray[np.uint8]:
    """Return a table of colours, BGR, for the kernels, uint8 (N + 4, 4).

    `none` and `invalid` are those of NaN and of pixels that are not valid; of two
    colours, stripes.  The last byte of each colour is unused.
    """
    table = np.zeros((len(colours) + 4, 4), np.uint8)
    table[:-4, :3], table[-4::2, :3], table[-3::2, :3] = colours, none, invalid
    return table


def _even_hues() -> NDArray[np.uint8]:
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


def _hsv_hues() -> NDArray[np.uint8]:
    """Return all colours of full saturation and value, shape (1530, 3), BGR."""
    count = 6 * 255
    step = np.arange(count)[:, None]
    phase = (step - np.array([4, 2, 0]) * 255) % count  # distance past B, G, R
    off = np.minimum(phase, count - phase)  # 0 at the pure colour, 3 * 255 opposite
    table: NDArray[np.uint8] = np.clip(2 * 255 - off, 0, 255).astype(np.uint8)
    return table


_GREYS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
_HUES = {"even": table_of(_even_hues()), "hsv": table_of(_hsv_hues())}
HUE_TABLE = _HUES["even"]
AOP_SCALE = (len(HUE_TABLE) - 4) / np.pi
GREY_TABLE = table_of(_GREYS)
SEEN_TABLE = table_of(_GREYS, invalid=(255, 255, 255))
DOLP_TABLE = table_of(np.stack([
    np.rint(np.interp(np.linspace(0, 16, 256), np.arange(17), _VIRIDIS[:, c]))
    for c in (2, 1, 0)], axis=1).astype(np.uint8))


def aop_bgr(
    aop: ArrayLike, valid: NDArray[np.bool_] | None = None, *, colours: str = "even",
) -> Picture:
    """Colour an angle of polarization; 180 degrees are a full turn of hue.

    Parameters
    ----------
    aop : array_like of float, shape (H, W)
        Radians; reddish brown at 0 and at pi, yellow-green at 45 degrees, light blue
        at 90, violet at 135.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False are hatched; see `INVALID`.
    colours : {"even", "hsv"}
        Equal steps of angle look equal, or hues of full saturation and value.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.

    Raises
    ------
    ValueError
        If there is no such map, or `aop` is not one plane or not in radians.
    """
    if colours not in _HUES:
        raise ValueError(f"colours must be one of {', '.join(_HUES)}, got {colours!r}")
    plane = one_plane("aop", aop)
    beyond = (np.abs(plane) > 2 * np.pi) & np.isfinite(plane)
    if beyond.any():
        raise ValueError(f"aop must be in radians, got {plane[beyond][0]:.4g}; see "
                         "np.radians")
    table = _HUES[colours]
    return through_table(
        _kernels.hue_bgr, plane, valid, (len(table) - 4) / np.pi, table)


def dolp_bgr(
    dolp: ArrayLike, valid: NDArray[np.bool_] | None = None, *, top: float = 1.0,
) -> Picture:
    """Colour a degree of linear polarization, dark blue at 0 to yellow at `top`.

    Parameters
    ----------
    dolp : array_like of float, shape (H, W)
        Values outside 0..top have the colour of the nearer end.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False are hatched; see `INVALID`.
    top : float
        DoLP of the brightest colour.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.

    Raises
    ------
    ValueError
        If `top` is not positive, or `dolp` is not one plane.
    """
    if not top > 0:
        raise ValueError(f"top must be positive, got {top}")
    return through_table(
        _kernels.ramp_bgr, one_plane("dolp", dolp), valid, 255 / top, DOLP_TABLE)


def grey_bgr(
    intensity: ArrayLike, white: float, valid: NDArray[np.bool_] | None = None, *,
    saturated: float | None = None,
) -> Picture:
    """Show an intensity in grey, linear from 0 to `white`.

    Parameters
    ----------
    intensity : array_like of float, shape (H, W)
        S0 or the intensity of a channel.
    white : float
        Intensity that becomes 255, in the same unit; above it stays 255.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False are hatched, or white; see `saturated`.
    saturated : float, optional
        Intensity above which pixels that are not valid are taken as saturated and shown
        white: their value is a lower bound and might look darker than its neighbours.
        Below it, they are hatched.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.

    Raises
    ------
    ValueError
        If `white` is not positive.
    """
    if not real_number(white) > 0:
        raise ValueError(f"white must be positive, got {white!r}")
    return through_table(
        _kernels.ramp_bgr, one_plane("intensity", intensity), valid, 255 / white,
        GREY_TABLE if saturated is None else SEEN_TABLE, saturated)


def fade(
    picture: Picture, weight: ArrayLike, valid: NDArray[np.bool_] | None = None, *,
    top: float = FULL_COLOUR_DOLP, ground: int = 0,
) -> None:
    """Fade a picture in place where its colour is not meaningful.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        BGR; pixels of a row must be contiguous.
    weight : array_like of float, shape (H, W)
        `top` and more keep the colour, 0 and NaN are `ground`.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False stay as they are.
    top : float
        Weight of full colour.
    ground : int
        Grey value, 0..255.

    Raises
    ------
    TypeError, ValueError
        If a shape differs, or `picture` is none that can be written to.
    """
    checked_picture(picture)
    if picture.strides[1:] != (3, 1) or not picture.flags.writeable:
        raise ValueError(
            "picture must be writeable, the pixels of a row contiguous, got strides "
            f"{picture.strides}, writeable {picture.flags.writeable}")
    kept: NDArray[np.uint8] = (
        np.empty((0, 0), np.uint8) if valid is None
        else np.ascontiguousarray(fitting(
            "valid", np.asarray(valid, np.bool_), picture.shape[:2])).view(np.uint8))
    plane = fitting("weight", one_plane("weight", weight), picture.shape[:2])
    _kernels.fade_bgr(
        np.ascontiguousarray(plane, np.float32), kept, 1 / positive("top", top),
        whole_number("ground", ground, 0, 255), picture)


def hatch(height: int, width: int) -> Picture:
    """Return a picture of pixels that are not valid, as in a legend."""
    size = [whole_number(name, side, 0, MOST_PIXELS) for name, side in (
        ("height", height), ("width", width))]
    return grey_bgr(np.full(size, np.nan, np.float32), 1.0)


def checked_picture(value: Any) -> Picture:
    """Return a picture; raise TypeError or ValueError unless it is BGR of uint8."""
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
        raise TypeError("picture must be uint8, got "
                        f"{getattr(value, 'dtype', type(value).__name__)}")
    if value.ndim != 3 or value.shape[2] != 3 or not value.size:
        raise ValueError(f"picture must have shape (H, W, 3), got {value.shape}")
    return value


def one_plane(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return values as an array, or raise an error that says what they are instead."""
    if isinstance(values, PolarFrame):
        raise TypeError(f"{name} must be one plane of the image, such as image.aop, "
                        "image.dolp or image.s0, got the whole PolarFrame")
    plane = np.asarray(values)
    if plane.dtype.kind not in "biuf":
        raise TypeError(f"{name} must be real numbers, got {plane.dtype}")
    if plane.ndim > 2:
        raise ValueError(f"{name} must have shape (H, W), got {plane.shape}; "
                         "PolarFrame(quad) makes AoP and DoLP of four intensities")
    return plane


def through_table(
    kernel: Callable[..., None], value: ArrayLike, valid: NDArray[np.bool_] | None,
    scale: float, table: NDArray[np.uint8], least: float | None = None,
) -> Picture:
    """Colour values, (H, W), with a table, in a kernel ten times as fast as NumPy.

    The kernel is ``hue_bgr``, ``ramp_bgr`` or ``tone_bgr``, and multiplies values by
    `scale`; other types than float32 are converted to float64.  `valid` is bool, or
    uint8 as a mask of cv2.  Pixels that are not valid have the colour `invalid` of
    `table_of` from the value `least` on, by default all, and `none` below.  Returns
    uint8 (H, W, 3), BGR.
    """
    plane = np.asarray(value)
    if plane.dtype != np.float32:
        plane = plane.astype(np.float64, copy=False)
    rows = plane.shape if plane.ndim == 2 else (1, plane.size)
    good: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
    if valid is not None:
        mask = np.asarray(valid)
        if mask.dtype.kind not in "bu":
            raise TypeError(f"valid must be bool, got {mask.dtype}")
        mask = mask.astype(np.bool_, copy=False)
        if mask.shape != plane.shape:
            raise ValueError(f"valid must have shape {plane.shape}, got {mask.shape}")
        good = np.ascontiguousarray(mask).reshape(rows).view(np.uint8)
    picture = np.empty((*plane.shape, 3), np.uint8)
    kernel(np.ascontiguousarray(plane).reshape(rows), good, float(scale),
           -math.inf if least is None else float(least), table,
           picture.reshape(*rows, 3))
    return picture
