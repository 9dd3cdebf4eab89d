"""Figures for print: pictures in a file of a physical size, with text as text."""
from __future__ import annotations

import math
import os
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from pdavis_cv._beside import write_beside
from pdavis_cv._checks import MOST_SIDE, positive, some, whole_number
from pdavis_cv._packages import package
from pdavis_cv._text import shown
from pdavis_cv._types import Facts
from pdavis_cv.export.embedded import embed_png, to_json
from pdavis_cv.render import (
    FULL_COLOUR_DOLP,
    LIGHT,
    Panel,
    Style,
    aop_legend,
    bar_legend,
    hatch,
)
from pdavis_cv.render.colours import Picture, checked_picture

FIGURES = (".pdf", ".svg", ".png")
_MM = 25.4          # per inch
_MARGIN, _GAP = 1.0, 2.0            # mm
_LINE, _WHEEL, _BAR = 3.4, 5.0, 2.0  # mm: a line of text, the wheel's radius, a bar
_POINTS = 7.0       # size of text; smaller where a line must fit its panel
_NARROWEST, _WIDEST = 5.0, 5000.0    # mm, of a picture and a figure; PDF ends there
_MOST = 1 << 28     # pixels of a PNG: a gigabyte to draw it
_FINE = 200         # pixels of a legend's radius or height, smooth at any zoom


def write_figure(
    path: str | os.PathLike[str], pictures: Sequence[Picture],
    panels: Sequence[Panel], *, width_mm: float, columns: int, title: str = "",
    style: Style = LIGHT, dpi: float = 300, facts: Facts | None = None,
) -> None:
    """Write pictures with titles and legends as a figure of a given width.

    In PDF and SVG the pictures keep their own pixels, and text stays text.

    Parameters
    ----------
    path : path
        ``.pdf``, ``.svg`` or ``.png``; appears when it is complete.
    pictures : sequence of ndarray of uint8, shape (H, W, 3)
        BGR, all of one shape.
    panels : sequence of Panel
        Title and legend of each.
    width_mm : float
        Width of the figure, millimetres; its height follows.
    columns : int
        Number of pictures per row.
    title : str
        A line above all.
    style : Style
        Of background and text.
    dpi : float
        Pixels per inch of a PNG.
    facts : mapping of str to object, optional
        Provenance to embed.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If the suffix is another, pictures or panels are none or not as many, or a
        number is out of range.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in FIGURES:
        raise ValueError(f"figure must end in {', '.join(FIGURES)}, got {suffix!r}")
    matplotlib = package(
        "matplotlib", "a figure needs matplotlib: pip install matplotlib")
    if len(panels) != len(some("pictures", pictures)):
        raise ValueError(f"panels must be as many as pictures, {len(pictures)}, got "
                         f"{len(panels)}")
    shapes = {checked_picture(one).shape for one in pictures}
    if len(shapes) > 1:
        raise ValueError(f"pictures must have one shape, got {sorted(shapes)}")
    page = _Page(pictures, width_mm,
                 whole_number("columns", columns, 1, MOST_SIDE), title, style)
    pixels = [side / _MM * positive("dpi", dpi) for side in page.size]
    if not 1 <= min(pixels) <= max(pixels) < MOST_SIDE or math.prod(pixels) > _MOST:
        raise ValueError(f"dpi must give 1..{MOST_SIDE - 1} pixels a side, {_MOST} in "
                         f"all, got {dpi!r} for {page.size[0]:g} x {page.size[1]:g} mm")
    for i, (picture, panel) in enumerate(zip(pictures, panels, strict=True)):
        page.panel(i, picture, panel)
    with write_beside(path) as part, matplotlib.rc_context({
            "pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "pdavis_cv"}):
        text = "" if facts is None else to_json(facts)
        drawn = BytesIO()   # matplotlib's own errors would hide that of a full disk
        page.figure.savefig(
            drawn, format=suffix[1:], dpi=dpi, facecolor=page.ground, metadata={
                ".pdf": {"Creator": "pdavis_cv", "Subject": text, "CreationDate": None},
                ".svg": {"Creator": "pdavis_cv", "Description": text, "Date": None},
                ".png": {}}[suffix])
        data = drawn.getvalue()
        part.write_bytes(embed_png(data, facts) if suffix == ".png" and facts else data)


class _Page:
    """A figure that is filled in millimetres from the top left."""

    def __init__(self, pictures: Sequence[Picture], width_mm: float, columns: int,
                 title: str, style: Style) -> None:
        from matplotlib.figure import Figure
        self.style = style
        self.ground, self.ink = (str(grey / 255) for grey in (style.ground, style.ink))
        self.columns = min(columns, len(pictures))
        least = 2 * _MARGIN - _GAP + self.columns * (_GAP + _NARROWEST)
        if not least <= width_mm <= _WIDEST:
            raise ValueError(f"width_mm must lie in {least:g}..{_WIDEST:g} for "
                             f"{self.columns} columns, got {width_mm!r}")
        self.width = (width_mm - 2 * _MARGIN + _GAP) / self.columns - _GAP
        height, width = pictures[0].shape[:2]
        self.tall = self.width * height / width
        self.top = _MARGIN + (_LINE if title else 0)
        self.step = _LINE + self.tall + 0.8 + _LINE + _WHEEL + 2 * _LINE + _GAP
        rows = -(-len(pictures) // self.columns)
        self.size = (width_mm, self.top + rows * self.step - _GAP + _MARGIN)
        self.figure = Figure(figsize=(self.size[0] / _MM, self.size[1] / _MM))
        if title:
            self._text(title, _MARGIN, _MARGIN, width_mm - 2 * _MARGIN)

    def panel(self, place: int, picture: Picture, panel: Panel) -> None:
        """Draw a picture, its title above and its legend below."""
        row, column = divmod(place, self.columns)
        left = _MARGIN + column * (self.width + _GAP)
        top = self.top + row * self.step
        self._text(panel.title, left, top, self.width)
        self._image(picture, left, top + _LINE, self.width, self.tall)
        below = top + _LINE + self.tall + 0.8
        if panel.legend in ("aop", "faded", "hsv"):
            below = self._wheel(panel, left, below)
        elif panel.legend is not None:
            bar = min(self.width, 25.0)
            self._image(bar_legend(_FINE * 4, _FINE // 4, kind=panel.legend),
                        left, below, bar, _BAR)
            self._text(panel.start, left, below + _BAR, bar / 3)
            self._text(panel.end or "1", left + bar, below + _BAR, bar * 2 / 3,
                       align="right")
            below += _BAR + _LINE
        self._image(hatch(10, 10), left, below + 0.7, _BAR, _BAR)
        self._text("not valid", left + _BAR + 0.7, below, self.width - _BAR)

    def _wheel(self, panel: Panel, left: float, top: float) -> float:
        middle, side = left + _WHEEL + 6, top + _LINE
        self._image(aop_legend(
            _FINE, self.style.ground, faded=panel.legend != "aop",
            colours="hsv" if panel.legend == "hsv" else "even"),
            middle - _WHEEL, side, 2 * _WHEEL, _WHEEL)
        for text, x, y, align in (
                ("180°", middle - _WHEEL - 0.5, side + _WHEEL - _LINE, "right"),
                ("90°", middle, top, "center"),
                ("0°", middle + _WHEEL + 0.5, side + _WHEEL - _LINE, "left")):
            self._text(text, x, y, 6, align=align)
        if panel.legend != "aop":
            end = panel.end or f"{FULL_COLOUR_DOLP:g}"
            self._text(f"DoLP {end} at the rim", left, side + _WHEEL, self.width)
        return side + _WHEEL + _LINE

    def _image(self, picture: Picture, left: float, top: float, width: float,
               height: float) -> None:
        across, down = self.size
        axes = self.figure.add_axes(
            (left / across, 1 - (top + height) / down, width / across, height / down))
        axes.set_axis_off()
        axes.imshow(picture[..., ::-1], interpolation="none", aspect="auto")

    def _text(self, text: str, left: float, top: float, room: float, *,
              align: str = "left") -> None:
        across, down = self.size
        drawn = self.figure.text(
            left / across, 1 - (top + _LINE / 2) / down, shown(text), size=_POINTS,
            ha=align, va="center_baseline", color=self.ink, parse_math=False)
        wide = drawn.get_window_extent().width / self.figure.dpi * _MM
        if wide > room:
            drawn.set_fontsize(_POINTS * room / wide)
