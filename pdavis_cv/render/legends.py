"""Legends of the colour maps, text, and arrangements of several pictures.

Only text needs OpenCV.
"""
from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pdavis_cv._checks import some, whole_number
from pdavis_cv._opencv import opencv
from pdavis_cv._text import shown
from pdavis_cv._types import Image
from pdavis_cv.render.colours import (
    FULL_COLOUR_DOLP,
    MOST_PIXELS,
    Picture,
    aop_bgr,
    checked_picture,
    dolp_bgr,
    fade,
    grey_bgr,
    hatch,
)


class Style(NamedTuple):
    """Grey values of background and text around pictures, 0..255, and their size.

    Text, legends and gaps are `zoom` times as large as for a picture of 346 pixels.
    """

    ground: int
    ink: int
    zoom: int = 1

    def sized(self, width: int) -> Style:
        """Return the style whose text suits pictures of a width in pixels."""
        return self._replace(zoom=max(1, round(width / 346)))


DARK = Style(0, 235)
"""Light text on black, for screens."""
LIGHT = Style(255, 20)
"""Dark text on white, for print and slides."""

_LINE = 20   # height of a line of text, at zoom 1


class Panel(NamedTuple):
    """Title and legend of a picture, as `panel` takes them."""

    title: str
    legend: str | None = None
    start: str = "0"
    end: str = ""


def aop_legend(
    radius: int, background: int = 0, *,
    colours: str = "even", faded: bool = False,
) -> Picture:
    """Draw the half-turn wheel that explains `aop_bgr`.

    Parameters
    ----------
    radius : int
        Outer radius in pixels; the ring is half as wide.
    background : int
        Grey value around the ring, 0..255.
    colours : {"even", "hsv"}
        As for `aop_bgr`.
    faded : bool
        Show DoLP too, as a disc that fades to the background in the middle.

    Returns
    -------
    ndarray of uint8, shape (radius, 2 * radius, 3)
        BGR; a pixel of the ring in direction a, seen from the middle of the bottom edge
        and counted counter-clockwise from the right, has the colour of AoP a.
    """
    radius = whole_number("radius", radius, 1, MOST_PIXELS // 4)
    background = whole_number("background", background, 0, 255)
    # Pixel centres relative to the middle of the bottom edge.
    place = np.mgrid[:radius, :2 * radius].astype(np.float64)
    up, across = radius - 0.5 - place[0], place[1] - radius + 0.5
    distance = np.hypot(across, up)
    picture = np.full((radius, 2 * radius, 3), background, np.uint8)
    ring = (distance <= radius) & (faded | (distance >= radius / 2))
    wheel = aop_bgr(np.arctan2(up, across), colours=colours)
    if faded:
        fade(wheel, distance, top=radius, ground=background)
    picture[ring] = wheel[ring]
    return picture


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
    width = whole_number("width", width, 1, MOST_PIXELS)
    height = whole_number("height", height, 1, MOST_PIXELS)
    ramp = np.broadcast_to(np.linspace(0, 1, width), (height, width))
    return dolp_bgr(ramp) if kind == "dolp" else grey_bgr(ramp, 1.0)


def panel(
    picture: Picture, title: str, *, legend: str | None = None, start: str = "0",
    end: str = "", scale: int = 1, style: Style = DARK,
) -> Picture:
    """Put a title above a picture and the legend of its colours below it.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        BGR.
    title : str
        One line.
    legend : {"aop", "faded", "hsv", "dolp", "grey"}, optional
        Quantity of the colours; ``"faded"`` and ``"hsv"`` are AoP in the even colours
        and in those of HSV, faded by DoLP.
    start, end : str
        Values at the ends of the bar, e.g. ``"36 DN/ms"``; for a wheel, `end` is the
        DoLP at the rim.  Default 1, and that of `fade` for a wheel.
    scale : int
        Each pixel of the picture becomes a square of this side.
    style : Style
        `DARK` or `LIGHT`.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR; W' = scale * W, at least the width that title and legend need.
    """
    picture, scale = checked_picture(picture), whole_number("scale", scale, 1, 64)
    if scale != 1:
        picture = picture.repeat(scale, axis=1).repeat(scale, axis=0)
    parts = [_line(title, style), picture]
    if legend in ("aop", "faded", "hsv"):
        parts.append(_aop_strip(legend, end or f"{FULL_COLOUR_DOLP:g}", style))
    elif legend is not None:
        parts.append(_bar_strip(legend, start, end or "1", style))
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
        Pixels between and around the pictures, at zoom 1.
    style : Style
        `DARK` or `LIGHT`.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR; H' and W' are even, as video codecs require.
    """
    columns = whole_number("columns", columns, 1, MOST_PIXELS)
    gap = whole_number("gap", gap, 0, MOST_PIXELS)
    height, width = (max(checked_picture(one).shape[axis]
                         for one in some("pictures", pictures)) for axis in (0, 1))
    rows = -(-len(pictures) // columns)
    columns = min(columns, len(pictures))
    gap *= style.zoom
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


def stack(pictures: Sequence[Picture], gap: int = 0, *, style: Style = DARK) -> Picture:
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
    gap = whole_number("gap", gap, 0, MOST_PIXELS)
    width = max(checked_picture(one).shape[1] for one in some("pictures", pictures))
    height = sum(picture.shape[0] + gap for picture in pictures) - gap
    sheet = np.full((height, width, 3), style.ground, np.uint8)
    top = 0
    for picture in pictures:
        sheet[top:top + picture.shape[0], :picture.shape[1]] = picture
        top += picture.shape[0] + gap
    return sheet


def even(picture: Image) -> Image:
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
    if np.ndim(picture) not in (2, 3):
        raise ValueError(f"picture must have two or three axes, got {np.ndim(picture)}")
    height, width, *rest = picture.shape
    if height % 2 == width % 2 == 0:
        return picture
    # np.pad takes as long as everything else for a picture.
    padded = np.empty((height + height % 2, width + width % 2, *rest), picture.dtype)
    padded[:height, :width] = picture
    padded[height:, :width] = picture[-1:]
    padded[:, width:] = padded[:, width - 1:width]
    return padded


def caption(picture: Picture, text: str, x: int, y: int, grey: int = 235,
            zoom: int = 1) -> int:
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
    zoom : int
        Its size; see `Style`.

    Returns
    -------
    int
        Width of the text in pixels.
    """
    cv2 = opencv()
    zoom = whole_number("zoom", zoom, 1, 64)
    x, y, grey = (whole_number(name, value, -MOST_PIXELS, MOST_PIXELS)
                  for name, value in (("x", x), ("y", y), ("grey", grey)))
    cv2.putText(checked_picture(picture), shown(text), (x, y), cv2.FONT_HERSHEY_SIMPLEX,
                0.42 * zoom, (grey, grey, grey), zoom, cv2.LINE_AA)
    return text_width(text, zoom)


@functools.lru_cache(1024)
def text_width(text: str, zoom: int = 1) -> int:
    """Return the width of a line of text in pixels."""
    cv2 = opencv()
    return int(cv2.getTextSize(
        shown(text), cv2.FONT_HERSHEY_SIMPLEX, 0.42 * zoom, zoom)[0][0])


def _line(text: str, style: Style, left: int = 4) -> Picture:
    zoom = style.zoom
    widest = re.sub(r"\d", "0", text)    # a time that passes leaves the width
    strip = np.full((_LINE * zoom, text_width(widest, zoom) + (left + 4) * zoom, 3),
                    style.ground, np.uint8)
    caption(strip, text, left * zoom, 14 * zoom, style.ink, zoom)
    return strip


def _swatch(style: Style) -> Picture:
    """Return the line that explains the mark of pixels that are not valid."""
    zoom = style.zoom
    strip = _line("not valid", style, 20)
    strip[5 * zoom:15 * zoom, 4 * zoom:14 * zoom] = hatch(
        10, 10).repeat(zoom, axis=0).repeat(zoom, axis=1)
    return strip


@functools.lru_cache
def _aop_strip(kind: str, end: str, style: Style) -> Picture:
    zoom = style.zoom
    radius, margin = 30 * zoom, 9 * zoom + text_width("0 deg", zoom)
    middle = 16 * zoom + radius
    words = "" if kind == "aop" else f"DoLP 0 .. {end} at the rim"
    strip = np.full(
        (radius + 20 * zoom, 2 * (radius + margin), 3), style.ground, np.uint8)
    strip[16 * zoom:middle, margin:margin + 2 * radius] = aop_legend(
        radius, style.ground, colours="hsv" if kind == "hsv" else "even",
        faded=kind != "aop")
    # where each text ends, is centred or begins: the versions of OpenCV differ in width
    for text, x, y, share in (("180", -6, 46, 1), ("135", 6, 24, 1), ("90", 30, 12, .5),
                              ("45", 60, 24, 0), ("0 deg", 64, 46, 0)):
        caption(strip, text, margin + x * zoom - int(share * text_width(text, zoom)),
                y * zoom, style.ink, zoom)
    lines = [_line(words, style)] if words else []
    return stack([strip, *lines, _swatch(style)], style=style)


@functools.lru_cache
def _bar_strip(kind: str, start: str, end: str, style: Style) -> Picture:
    zoom = style.zoom
    left, width = 10 * zoom + text_width(start, zoom), 120 * zoom
    right = left + width + 6 * zoom
    strip = np.full(
        (50 * zoom, right + 6 * zoom + text_width(end, zoom), 3), style.ground,
        np.uint8)
    strip[20 * zoom:34 * zoom, left:left + width] = bar_legend(
        width, 14 * zoom, kind=kind)
    caption(strip, start, 4 * zoom, 31 * zoom, style.ink, zoom)
    caption(strip, end, right, 31 * zoom, style.ink, zoom)
    return stack([strip, _swatch(style)], style=style)
