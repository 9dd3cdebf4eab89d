"""Draw a small strip chart for videos: traces up to now, with error bands."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._opencv import opencv
from pdavis_cv.render.colours import Picture
from pdavis_cv.render.legends import caption, text_width

_LEFT, _BOTTOM, _TOP = 44, 22, 20


@dataclass(frozen=True, eq=False)
class Line:
    """One trace of a chart.

    Parameters
    ----------
    t_s, values : array_like of float, shape (N,)
        Times in seconds, and values; NaN interrupt the line.
    colour : (int, int, int)
        BGR.
    label : str
        ASCII.
    se : array_like of float, shape (N,), optional
        Half width of a band.
    dots : bool
        Whether samples are marked.
    """

    t_s: ArrayLike
    values: ArrayLike
    colour: tuple[int, int, int]
    label: str = ""
    se: ArrayLike | None = None
    dots: bool = False


def chart(
    lines: Sequence[Line], size: tuple[int, int], *, span_s: tuple[float, float],
    limits: tuple[float, float], now_s: float | None = None, title: str = "",
    zoom: int = 1,
) -> Picture:
    """Draw traces.

    Parameters
    ----------
    lines : sequence of Line
        Drawn in this order.
    size : (int, int)
        (height, width) in pixels.
    span_s, limits : (float, float)
        Ends of the time axis in seconds and of the value axis.
    now_s : float, optional
        Later samples are not drawn; a cursor marks this time.
    title : str
        ASCII, above the chart.
    zoom : int
        Size of text and lines; see `Style`.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR.

    Raises
    ------
    ValueError
        If an axis is empty.
    """
    cv2 = opencv()
    height, width = size
    (t0, t1), (low, high) = span_s, limits
    if not (t1 > t0 and high > low):
        raise ValueError(f"axes must not be empty, got {span_s} s and {limits}")
    picture = np.zeros((height, width, 3), np.uint8)
    x0, y0 = _LEFT * zoom, _TOP * zoom
    plot_width, plot_height = width - x0 - 8 * zoom, height - y0 - _BOTTOM * zoom

    def place(t: ArrayLike, v: ArrayLike) -> NDArray[np.int32]:
        x = x0 + (np.asarray(t, np.float64) - t0) / (t1 - t0) * plot_width
        y = y0 + (high - np.asarray(v, np.float64)) / (high - low) * plot_height
        y = np.clip(np.nan_to_num(y), y0, y0 + plot_height)
        return np.rint(np.stack((x, y), axis=-1)).astype(np.int32)

    frame = (x0, y0), (x0 + plot_width, y0 + plot_height)
    cv2.rectangle(picture, *frame, (90, 90, 90), zoom)
    for value in (low, high):
        text = f"{value:.3g}"
        caption(picture, text, x0 - 6 * zoom - text_width(text, zoom),
                int(place(t0, value)[1]) + 5 * zoom, 180, zoom)
    for end, text in ((t0, f"{t0:.3g}"), (t1, f"{t1:.3g} s")):
        caption(picture, text, min(int(place(end, low)[0]),
                                   width - text_width(text, zoom)),
                height - 7 * zoom, 180, zoom)
    caption(picture, title, x0, 14 * zoom, zoom=zoom)
    x = x0 + text_width(title, zoom) + 20 * zoom
    for line in lines:
        t, v = np.asarray(line.t_s, np.float64), np.asarray(line.values, np.float64)
        seen = (t >= t0) & (t <= (t1 if now_s is None else min(now_s, t1)))
        if line.se is not None:
            se = np.asarray(line.se, np.float64)
            whole = seen & np.isfinite(v) & np.isfinite(se)
            if np.count_nonzero(whole) > 1:
                band = np.concatenate((place(t[whole], v[whole] + se[whole]),
                                       place(t[whole], v[whole] - se[whole])[::-1]))
                shade = picture.copy()
                cv2.fillPoly(shade, [band], line.colour)
                picture = cv2.addWeighted(shade, 0.35, picture, 0.65, 0)
        finite = seen & np.isfinite(v)
        edges = np.flatnonzero(np.diff(finite, prepend=False, append=False))
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            if end - first > 1:
                points = place(t[first:end], v[first:end])
                cv2.polylines(picture, [points], False, line.colour, zoom, cv2.LINE_AA)
        if line.dots:
            for point in place(t[finite], v[finite]):
                cv2.circle(picture, tuple(int(c) for c in point), 2 * zoom,
                           line.colour, -1)
        if line.label:
            cv2.line(picture, (x, 10 * zoom), (x + 14 * zoom, 10 * zoom), line.colour,
                     2 * zoom)
            x += 34 * zoom + caption(
                picture, line.label, x + 18 * zoom, 14 * zoom, zoom=zoom)
    if now_s is not None and t0 <= now_s <= t1:
        top, bottom = place((now_s, now_s), (high, low))
        cv2.line(picture, tuple(int(c) for c in top), tuple(int(c) for c in bottom),
                 (200, 200, 200), zoom)
    return np.asarray(picture, np.uint8)
