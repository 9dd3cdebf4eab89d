"""How pictures look in print: one style, widths of a journal, PNG, SVG and PDF."""
from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdavis_cv._beside import write_beside
from pdavis_cv.tools._common import can_draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure


COLUMN_IN, PAGE_IN = 89 / 25.4, 183 / 25.4
"""Widths of a column and of a page, as journals print them."""
SUFFIXES = ("png", "svg", "pdf")

# Okabe and Ito's colours, which the colour-blind tell apart, two greys and a dark
# blue; line and marker tell in grey what the colour does not.
_LOOKS: dict[str, tuple[str, Any, str]] = {
    "truth": ("#000000", "-", ""),
    "Sony 50 fps": ("#777777", "--", "s"),
    "Sony 75 fps": ("#AAAAAA", "--", "D"),
    "Sony 50 fps, own times": ("#777777", ":", "s"),
    "frames": ("#E69F00", "--", "v"),
    "frames, own times": ("#E69F00", ":", "v"),
    "events": ("#CC79A7", "-.", "x"),
    "events, redundancy": ("#D55E00", "-.", "+"),
    "cf": ("#009E73", "-", "^"),
    "kalman causal": ("#56B4E9", "-", "d"),
    "kalman": ("#0072B2", "-", "o"),
    "kalman offline": ("#003A5C", "-", "."),
    "firenet": ("#B15928", (0, (3, 1, 1, 1)), "*"),
    "firenet, minimum": ("#B15928", ":", "<"),
    "firenet, table": ("#B15928", "--", ">"),
    "joint": ("#6A3D9A", (0, (3, 1, 1, 1)), "P"),
}


def look(method: str) -> dict[str, Any]:
    """Return colour, line and marker of a method, the same in every picture.

    Parameters
    ----------
    method : str
        A method that the table does not know takes the next colour of the cycle.
    """
    if method not in _LOOKS:
        return {}
    colour, line, marker = _LOOKS[method]
    return {"color": colour, "linestyle": line, "marker": marker}


def journal() -> contextlib.AbstractContextManager[None]:
    """Return a context in which pictures are drawn for print, if they can be drawn."""
    if not can_draw():
        return contextlib.nullcontext()
    from matplotlib import style
    return style.context(Path(__file__).with_name("journal.mplstyle"))


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that fits its content to its size."""
    from matplotlib.figure import Figure
    return Figure(figsize=(width_in, height_in), layout="constrained")


def letters(panels: Iterable[Any]) -> None:
    """Write a, b, c ... above the left corners of some axes."""
    for letter, axes in zip("abcdefghijklmnopqrstuvwxyz", panels, strict=False):
        axes.set_title(letter, loc="left", fontweight="bold")


def beside_stem(stem: Path, ending: str) -> Path:
    """Return the path STEM + ending, dots in the stem kept."""
    return stem.with_name(stem.name + ending)


def save_figure(stem: Path, figure: Figure) -> None:
    """Write STEM.png (300 dpi), STEM.svg and STEM.pdf."""
    for suffix in SUFFIXES:
        picture = io.BytesIO()
        figure.savefig(picture, format=suffix)
        with write_beside(beside_stem(stem, f".{suffix}")) as unfinished:
            unfinished.write_bytes(picture.getvalue())
