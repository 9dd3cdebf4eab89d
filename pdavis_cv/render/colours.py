"""Colour maps for polarization, and their legends.

The colour of a pixel depends only on its own value, not on the rest of the image, so
that pictures and frames of a video can be compared.  Only text needs OpenCV.
"""
from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._opencv import opencv

__all__ = [
    "DARK",
    "FULL_COLOUR_DOLP",
    "INVALID",
    "LIGHT",
    "Picture",
    "Style",
    "aop_bgr",
    "aop_legend",
    "bar_legend",
    "caption",
    "dolp_bgr",
    "even",
    "fade",
    "grey_bgr",
    "opencv",
    "panel",
    "stack",
    "tile",
]

Picture = NDArray[np.uint8]

INVALID = (96, 96, 96)
"""Colour of pixels that are not valid, BGR."""


class Style(NamedTuple):
    """Grey values of background and text around pictures, 0..255."""

    ground: int
    ink: int


DARK = Style(0, 235)
"""Light text on black, for screens."""
LIGHT = Style(255, 20)
"""Dark text on white, for print and slides."""

FULL_COLOUR_DOLP = 0.25
"""DoLP from which on a faded AoP has its full colour; chosen for tissue and sky."""

# Number of different uint8 colours of full saturation and value.
_HUES = 6 * 255
AOP_SCALE = _HUES / np.pi

# matplotlib's viridis (CC0) at 16 intervals, RGB; interpolated, within 6 of 255.
_VIRIDIS = np.array([
    (68, 1, 84), (72, 24, 106), (71, 45, 123), (66, 64, 134), (59, 82, 139),
    (51, 99, 141), (44, 114, 142), (38, 130, 142), (33, 145, 140), (31, 160, 136),
    (40, 174, 128), (63, 188, 115), (94, 201, 98), (132, 212, 75), (173, 220, 48),
    (216, 226, 25), (253, 231, 37)], np.float64)


def _hue_table() -> Picture:
    step = np.arange(_HUES)[:, None]
    phase = (step - np.array([4, 2, 0]) * 255) % _HUES  # distance past B, G, R
    off = np.minimum(phase, _HUES - phase)  # 0 at the pure colour, 3 * 255 opposite
    table: Picture = np.clip(2 * 255 - off, 0, 255).astype(np.uint8)
    return table


def table_of(
    colours: NDArray[np.uint8], none: tuple[int, int, int] = INVALID,
    invalid: tuple[int, int, int] = INVALID,
) -> NDArray[np.uint8]:
    """Return a table of colours for the kernels.

    Parameters
    ----------
    colours : ndarray of uint8, shape (N, 3)
        BGR.
    none, invalid : (int, int, int)
        Colours of NaN and of pixels that are not valid.

    Returns
    -------
    ndarray of uint8, shape (N + 2, 4)
        The last byte of each colour is unused.
    """
    table = np.zeros((len(colours) + 2, 4), np.uint8)
    table[:-2, :3], table[-2, :3], table[-1, :3] = colours, none, invalid
    return table


_GREYS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
HUE_TABLE = table_of(_hue_table())
GREY_TABLE = table_of(_GREYS)
SEEN_TABLE = table_of(_GREYS, invalid=(255, 255, 255))
DOLP_TABLE = table_of(np.stack([
    np.rint(np.interp(np.linspace(0, 16, 256), np.arange(17), _VIRIDIS[:, c]))
    for c in (2, 1, 0)], axis=1).astype(np.uint8))


def aop_bgr(
    aop: ArrayLike, valid: NDArray[np.bool_] | None = None,
    out: Picture | None = None,
) -> Picture:
    """Colour an angle of polarization: hue = AoP / 180 degrees of a full turn.

    Parameters
    ----------
    aop : array_like of float, shape (H, W)
        Radians; red at 0 and at pi, yellow-green at 45 degrees, cyan at 90, violet
        at 135.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False become `INVALID`.
    out : ndarray of uint8, shape (H, W, 3), optional
        Overwritten and returned; may be a part of a larger picture.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR at full saturation and value.
    """
    return through_table(
        _kernels.hue_bgr, aop, valid, AOP_SCALE, HUE_TABLE, out=out)


def dolp_bgr(
    dolp: ArrayLike, valid: NDArray[np.bool_] | None = None, *, top: float = 1.0,
    out: Picture | None = None,
) -> Picture:
    """Colour a degree of linear polarization, dark blue at 0 to yellow at `top`.

    Parameters
    ----------
    dolp : array_like of float, shape (H, W)
        Values outside 0..top have the colour of the nearer end.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False become `INVALID`.
    top : float
        DoLP of the brightest colour.
    out : ndarray of uint8, shape (H, W, 3), optional
        As for `aop_bgr`.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.
    """
    return through_table(
        _kernels.ramp_bgr, dolp, valid, 255 / top, DOLP_TABLE, out=out)


def grey_bgr(
    intensity: ArrayLike, white: float, valid: NDArray[np.bool_] | None = None, *,
    saturated: float | None = None, out: Picture | None = None,
) -> Picture:
    """Show an intensity in grey, linear from 0 to `white`.

    Parameters
    ----------
    intensity : array_like of float, shape (H, W)
        S0 or the intensity of a channel.
    white : float
        Intensity that becomes 255, in the same unit; above it stays 255.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that are False become `INVALID`, unless `saturated` is given.
    saturated : float, optional
        Intensity above which pixels that are not valid are taken as saturated and shown
        white: their value is a lower bound and might look darker than its neighbours.
        Below it, they are too dark and shown in grey.
    out : ndarray of uint8, shape (H, W, 3), optional
        As for `aop_bgr`.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.

    Raises
    ------
    ValueError
        If `white` is not positive.
    """
    if not white > 0:
        raise ValueError(f"white must be positive, got {white}")
    return through_table(
        _kernels.ramp_bgr, intensity, valid, 255 / white,
        GREY_TABLE if saturated is None else SEEN_TABLE, saturated, out)


def aop_legend(
    radius: int, background: int = 0, *,
    colours: Callable[[ArrayLike], Picture] = aop_bgr, faded: bool = False,
) -> Picture:
    """Draw the half-turn wheel that explains `aop_bgr`.

    Parameters
    ----------
    radius : int
        Outer radius in pixels; the ring is half as wide.
    background : int
        Grey value around the ring, 0..255.
    colours : callable
        Maps angles to colours.
    faded : bool
        Show DoLP too, as a disc that fades to the background in the middle.

    Returns
    -------
    ndarray of uint8, shape (radius, 2 * radius, 3)
        BGR; a pixel of the ring in direction a, seen from the middle of the bottom edge
        and counted counter-clockwise from the right, has the colour of AoP a.
    """
    across, up, distance = _wheel_places(radius)
    picture = np.full((radius, 2 * radius, 3), background, np.uint8)
    ring = (distance <= radius) & (faded | (distance >= radius / 2))
    wheel = colours(np.arctan2(up, across))
    if faded:
        fade(wheel, distance, top=radius, ground=background)
    picture[ring] = wheel[ring]
    return picture


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
    ValueError
        If a shape differs.
    """
    kept: NDArray[np.uint8] = (
        np.empty((0, 0), np.uint8) if valid is None
        else np.ascontiguousarray(valid, np.bool_).view(np.uint8))
    _kernels.fade_bgr(
        np.ascontiguousarray(weight, np.float32), kept, 1 / top, ground, picture)


def _wheel_places(
    radius: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return pixel centres relative to the middle of the bottom edge.

    They are the offsets to the right and up, and the distance.
    """
    place = np.mgrid[:radius, :2 * radius].astype(np.float64)
    up, across = radius - 0.5 - place[0], place[1] - radius + 0.5
    return across, up, np.hypot(across, up)


def bar_legend(width: int, height: int, *, kind: str = "dolp") -> Picture:
    """Draw the bar that explains `dolp_bgr` or `grey_bgr`, from 0 to its end.

    Parameters
    ----------
    width, height : int
        Size in pixels.
    kind : {"dolp", "grey"}
        Which colours to show.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        BGR.
    """
    ramp = np.broadcast_to(np.linspace(0, 1, width), (height, width))
    return dolp_bgr(ramp) if kind == "dolp" else grey_bgr(ramp, 1.0)


def panel(
    picture: Picture, title: str, *, legend: str | None = None, start: str = "0",
    end: str = "1", scale: int = 1, style: Style = DARK,
) -> Picture:
    """Put a title above a picture and the legend of its colours below it.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        BGR.
    title : str
        One line.
    legend : {"aop", "faded", "even", "dolp", "grey"}, optional
        Quantity of the colours; ``"faded"`` and ``"even"`` are AoP by `aop_bgr` and
        `cyclic_bgr`, faded by DoLP.
    start, end : str
        Values at the ends of the bar, e.g. ``"36 DN/ms"``; for a wheel, `end` is the
        DoLP at the rim.
    scale : int
        Each pixel of the picture becomes a square of this side.
    style : Style
        `DARK` or `LIGHT`.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR; W' = scale * W, at least the width that title and legend need.
    """
    if scale != 1:
        picture = picture.repeat(scale, axis=0).repeat(scale, axis=1)
    parts = [_line(title, style), picture]
    if legend in ("aop", "faded", "even"):
        parts.append(_aop_strip(legend, end, style))
    elif legend is not None:
        parts.append(_bar_strip(legend, start, end, style))
    return stack(parts, style=style)


def tile(
    pictures: Sequence[Picture], *, columns: int, title: str = "", gap: int = 8,
    style: Style = DARK,
) -> Picture:
    """Arrange pictures in rows of `columns`, under a common title.

    Parameters
    ----------
    pictures : sequence of ndarray of uint8, shape (H, W, 3)
        BGR; smaller ones are centred in the size of the largest.
    columns : int
        Number of pictures per row.
    title : str
        One line above all pictures.
    gap : int
        Pixels between and around the pictures.
    style : Style
        `DARK` or `LIGHT`.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR; H' and W' are even, as video codecs require.
    """
    height = max(picture.shape[0] for picture in pictures)
    width = max(picture.shape[1] for picture in pictures)
    rows = -(-len(pictures) // columns)
    columns = min(columns, len(pictures))
    sheet = np.full(
        (rows * (height + gap) + gap, columns * (width + gap) + gap, 3), style.ground,
        np.uint8)
    for i, picture in enumerate(pictures):
        row, column = divmod(i, columns)
        top = gap + row * (height + gap)
        left = gap + column * (width + gap) + (width - picture.shape[1]) // 2
        sheet[top:top + picture.shape[0], left:left + picture.shape[1]] = picture
    if title:
        sheet = stack([_line(title, style), sheet], style=style)
    return even(sheet)


def stack(
    pictures: Sequence[Picture], gap: int = 0, *, style: Style = DARK
) -> Picture:
    """Stack pictures vertically, left-aligned.

    Parameters
    ----------
    pictures : sequence of ndarray of uint8, shape (H, W, 3)
        BGR, from top to bottom.
    gap : int
        Pixels between them.
    style : Style
        `DARK` or `LIGHT`.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR; W' is the largest width.
    """
    width = max(picture.shape[1] for picture in pictures)
    height = sum(picture.shape[0] + gap for picture in pictures) - gap
    sheet = np.full((height, width, 3), style.ground, np.uint8)
    top = 0
    for picture in pictures:
        sheet[top:top + picture.shape[0], :picture.shape[1]] = picture
        top += picture.shape[0] + gap
    return sheet


def even(picture: NDArray[Any]) -> NDArray[Any]:
    """Repeat the last row or column of a picture of odd height or width.

    Video codecs silently drop such a row or column.

    Parameters
    ----------
    picture : ndarray, shape (H, W) or (H, W, C)
        Any image.

    Returns
    -------
    ndarray
        The picture itself if both sides are even.
    """
    height, width, *rest = picture.shape
    if height % 2 == width % 2 == 0:
        return picture
    # np.pad takes as long as everything else for a picture.
    padded = np.empty((height + height % 2, width + width % 2, *rest), picture.dtype)
    padded[:height, :width] = picture
    padded[height:, :width] = picture[-1:]
    padded[:, width:] = padded[:, width - 1:width]
    return padded


def caption(picture: Picture, text: str, x: int, y: int, grey: int = 235) -> int:
    """Write text into a picture.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        BGR, C-contiguous; changed.
    text : str
        One line; not every OpenCV draws characters beyond ASCII.
    x, y : int
        Left end of the base line.
    grey : int
        Grey value of the text.

    Returns
    -------
    int
        Width of the text in pixels.
    """
    cv2 = opencv()
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.42
    cv2.putText(picture, text, (x, y), font, size, (grey, grey, grey), 1, cv2.LINE_AA)
    return _text_width(text)


@functools.lru_cache(1024)
def _text_width(text: str) -> int:
    cv2 = opencv()
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)[0][0])


def through_table(
    kernel: Callable[..., None], value: ArrayLike, valid: NDArray[np.bool_] | None,
    scale: float, table: NDArray[np.uint8], least: float | None = None,
    out: Picture | None = None,
) -> Picture:
    """Colour values with a table, in a kernel ten times as fast as NumPy.

    Parameters
    ----------
    kernel : callable
        ``hue_bgr``, ``ramp_bgr`` or ``tone_bgr``.
    value : array_like of float, shape (H, W)
        Other types than float32 are converted to float64.
    valid : ndarray of bool, shape (H, W), or None
        True = usable.
    scale : float
        Factor by which the kernel multiplies values.
    table : ndarray of uint8, shape (N + 2, 4)
        See `table_of`.
    least : float, optional
        Pixels that are not valid and below it have the colour of their value; default:
        none.
    out : ndarray of uint8, shape (H, W, 3), optional
        Overwritten and returned; pixels of a row must be contiguous.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.

    Raises
    ------
    TypeError
        If `out` is not uint8.
    ValueError
        If `valid` or `out` has another shape, or `out` cannot be written to.
    """
    plane = np.asarray(value)
    if plane.dtype != np.float32:
        plane = plane.astype(np.float64, copy=False)
    rows = plane.shape if plane.ndim == 2 else (1, plane.size)
    good: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
    if valid is not None:
        mask = np.asarray(valid, np.bool_)
        if mask.shape != plane.shape:
            raise ValueError(
                f"valid must have shape {plane.shape}, got {mask.shape}")
        good = np.ascontiguousarray(mask).reshape(rows).view(np.uint8)
    picture = canvas(out, (*plane.shape, 3))
    kernel(np.ascontiguousarray(plane).reshape(rows), good, float(scale),
           -math.inf if least is None else float(least), table,
           picture.reshape(*rows, 3))
    return picture


def canvas(out: Picture | None, shape: tuple[int, ...]) -> Picture:
    """Return `out` after checking it, or a new picture if it is None."""
    if out is None:
        return np.empty(shape, np.uint8)
    if out.dtype != np.uint8:
        raise TypeError(f"out must be uint8, got {out.dtype}")
    if out.shape != shape or len(shape) != 3:
        raise ValueError(f"out must have shape {shape}, (H, W, 3), got {out.shape}")
    if out.strides[1:] != (3, 1) or not out.flags.writeable:
        raise ValueError(
            "out must be writeable, the pixels of a row contiguous, got strides "
            f"{out.strides}, writeable {out.flags.writeable}")
    return out


LINE = 20
"""Height of a line of text."""


def _line(text: str, style: Style = DARK) -> Picture:
    strip = np.full((LINE, _text_width(text) + 8, 3), style.ground, np.uint8)
    caption(strip, text, 4, 14, style.ink)
    return strip


@functools.lru_cache
def _aop_strip(kind: str, end: str, style: Style, radius: int = 30) -> Picture:
    margin, middle = 40, 16 + radius
    words = "" if kind == "aop" else f"DoLP 0 .. {end} at the rim"
    width = max(2 * (radius + margin), _text_width(words) + 8)
    strip = np.full(
        (radius + 20 + (LINE if words else 0), width, 3), style.ground, np.uint8)
    if kind == "even":
        from pdavis_cv.render.cyclic import cyclic_bgr as colours
    else:
        colours = aop_bgr
    strip[16:middle, margin:margin + 2 * radius] = aop_legend(
        radius, style.ground, colours=colours, faded=kind != "aop")
    for text, x, y in (("180", margin - 28, middle), ("135", 24, 24),
                       ("90", margin + radius - 7, 12), ("45", 100, 24),
                       ("0 deg", margin + 2 * radius + 4, middle),
                       (words, 4, middle + LINE - 2)):
        caption(strip, text, x, y, style.ink)
    return strip


@functools.lru_cache
def _bar_strip(
    kind: str, start: str, end: str, style: Style, width: int = 120
) -> Picture:
    left = 10 + _text_width(start)
    strip = np.full(
        (50, left + width + 12 + _text_width(end), 3), style.ground, np.uint8)
    strip[20:34, left:left + width] = bar_legend(width, 14, kind=kind)
    caption(strip, start, 4, 31, style.ink)
    caption(strip, end, left + width + 6, 31, style.ink)
    return strip
