"""The table of robustness as a page and as a picture."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from .page import FORMATS, table
from .print_style import PAGE_IN, letters, new_figure
from .robustness import CAUSAL, RECORDED
from .run import Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_ALLOWED = 1.1
"""Times the best other method's error: kalman beyond it has lost the cell."""

_MOST = 1000
"""The largest error that is written out."""

_GROUPS = {"without what comes later": CAUSAL, "on a recording": RECORDED}
_COLUMNS = {"aop_error_deg": "AoP error (degrees)", "dolp_error": "DoLP error"}


@dataclass(frozen=True, order=True)
class Cell:
    """A line of the table: a condition at a speed, on one kind of camera."""

    camera: str
    scene: str
    region: str
    rpm: float

    @property
    def label(self) -> str:
        """What the line is called."""
        return (self.scene + ("" if self.region == "all" else f", {self.region}")
                + (f", {self.rpm:g} RPM" if self.rpm else ""))


@dataclass(frozen=True)
class Against:
    """A kalman method beside the best other method of the same causality.

    Parameters
    ----------
    cell : Cell
    column : str
        Of `Row`: which error.
    method : str
        The kalman method.
    error : float
        Its median over specimens.
    best : str
        The best other method.
    best_error : float
        The median of that.
    """

    cell: Cell
    column: str
    method: str
    error: float
    best: str
    best_error: float

    @property
    def lost(self) -> bool:
        """Whether it is more than 10 % worse."""
        return self.error > _ALLOWED * self.best_error

    @property
    def won(self) -> bool:
        """Whether it is better."""
        return self.error < self.best_error


def cells(rows: Iterable[Row]) -> dict[Cell, dict[str, list[Row]]]:
    """Return rows by cell and method, in the order in which they came."""
    found: dict[Cell, dict[str, list[Row]]] = {}
    for row in rows:
        cell = Cell(row.camera, row.scene, row.region, row.rpm)
        found.setdefault(cell, {}).setdefault(row.method, []).append(row)
    return found


def _quantile(rows: Sequence[Row], column: str, q: float = 0.5) -> float:
    return float(np.quantile([getattr(row, column) for row in rows], q))


def against(rows: Iterable[Row]) -> Iterator[Against]:
    """Compare each kalman method with the best other one, cell by cell."""
    for cell, methods in cells(rows).items():
        for column in _COLUMNS:
            medians = {name: _quantile(mine, column)
                       for name, mine in methods.items()}
            for group in _GROUPS.values():
                others = {name: medians[name] for name in group
                          if name in medians and not name.startswith("kalman")}
                if not others:
                    continue
                best = min(others, key=others.__getitem__)
                for name in group:
                    if name.startswith("kalman") and name in medians:
                        yield Against(cell, column, name, medians[name], best,
                                      others[best])


def robustness_page(rows: Sequence[Row]) -> list[str]:
    """Return the Markdown: errors by condition and method, spread, lost cells."""
    found = cells(rows)
    judged = list(against(rows))
    lost = [one for one in judged if one.lost]
    specimens = sorted({row.seed for row in rows})
    lines = [
        "# robustness", "",
        f"Specimens {', '.join(map(str, specimens))}, each at an angle of its own; "
        "AoP error in degrees / DoLP error, mean over pixels and images of a "
        "recording, median over specimens. Bold: `kalman` is more than 10 % worse "
        "than the best other method of the same causality, in AoP or in DoLP.", "",
        f"Of {len(judged)} comparisons (condition, AoP or DoLP, kind of `kalman`) "
        f"`kalman` is better than the best other method in "
        f"{sum(one.won for one in judged)}, and more than 10 % worse in "
        f"{len(lost)}.", ""]
    bold = {(one.cell, one.method) for one in lost}
    for camera, group in groupby(found, key=lambda cell: cell.camera):
        mine = list(group)
        for title, methods in _GROUPS.items():
            names = [name for name in methods if any(name in found[c] for c in mine)]
            if names:
                lines += [f"## `{camera}`, {title}", "", *_table(
                    found, mine, names, bold)]
    if len(specimens) > 1:
        lines += _spread(found)
    if lost:
        lines += ["## Where `kalman` is more than 10 % worse", "", *table(
            ("condition", "", "method", "error", "best other method", "its error"),
            [(f"{one.cell.label} (`{one.cell.camera}`)",
              _COLUMNS[one.column].split()[0], one.method, _text(one.column, one.error),
              one.best, _text(one.column, one.best_error)) for one in lost])]
    return lines


def _text(column: str, value: float) -> str:
    # DoLP has no bound where S0 vanishes: what is beyond says no more than that.
    return f"> {_MOST}" if value > _MOST else FORMATS[column].format(value)


def _table(
    found: dict[Cell, dict[str, list[Row]]], mine: Sequence[Cell],
    names: Sequence[str], bold: set[tuple[Cell, str]],
) -> list[str]:
    lines = []
    for cell in mine:
        texts = []
        for name in names:
            rows = found[cell].get(name, [])
            text = " / ".join(_text(column, _quantile(rows, column))
                              for column in _COLUMNS) if rows else "-"
            texts.append(f"**{text}**" if (cell, name) in bold else text)
        lines.append([cell.label, *texts])
    return table(("condition", *names), lines)


def _spread(found: dict[Cell, dict[str, list[Row]]]) -> list[str]:
    """Return 5 and 95 % of the specimens, of the kalman methods."""
    names = [name for group in _GROUPS.values() for name in group
             if name.startswith("kalman")]
    lines = []
    for cell, methods in found.items():
        texts = [" / ".join(" .. ".join(
            _text(column, _quantile(methods[name], column, q)) for q in (0.05, 0.95))
            for column in _COLUMNS) if name in methods else "-" for name in names]
        lines.append([f"{cell.label} (`{cell.camera}`)", *texts])
    return ["## Spread: 5 .. 95 % of the specimens", "",
            *table(("condition", *names), lines)]


def robustness_figure(rows: Sequence[Row]) -> Figure:
    """Draw error over the best of the same causality, a line per condition.

    Framed: `kalman` is more than 10 % worse than the best other method.
    """
    from matplotlib.patches import Rectangle

    found = cells(rows)
    bold = {(one.cell, one.column, one.method) for one in against(rows) if one.lost}
    names = [name for group in _GROUPS.values() for name in group
             if any(name in methods for methods in found.values())]
    divide = sum(name in CAUSAL for name in names)
    drawing = new_figure(PAGE_IN, 1.9 + 0.126 * len(found))
    panels = drawing.subplots(1, 2, sharey=True)
    letters(panels)
    for axes, (column, title) in zip(panels, _COLUMNS.items(), strict=True):
        errors = np.array([[
            _quantile(methods[name], column) if name in methods else np.nan
            for name in names] for methods in found.values()])
        ratio = np.full(errors.shape, np.nan)
        for part in (slice(0, divide), slice(divide, None)):
            if errors[:, part].size:
                ratio[:, part] = errors[:, part] / np.nanmin(
                    errors[:, part], axis=1, keepdims=True)
        picture = axes.imshow(np.log10(ratio), cmap="YlOrBr", vmin=0, vmax=1.5,
                              aspect="auto")
        for y, cell in enumerate(found):
            for x, name in enumerate(names):
                if np.isfinite(errors[y, x]):
                    dark = np.log10(ratio[y, x]) > 0.9
                    axes.text(x, y, _text(column, errors[y, x]), ha="center",
                              va="center", fontsize=5.5,
                              color="white" if dark else "black")
                if (cell, column, name) in bold:
                    axes.add_patch(Rectangle((x - 0.47, y - 0.44), 0.94, 0.88,
                                             fill=False, edgecolor="tab:blue",
                                             linewidth=0.9))
        axes.axvline(divide - 0.5, color="black", linewidth=1)
        axes.set_title(title)
        axes.grid(visible=False)
        axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=6,
                        rotation_mode="anchor")
        axes.set_yticks(range(len(found)), [
            f"{cell.label} ({cell.camera})" for cell in found], fontsize=5.5)
    bar = drawing.colorbar(picture, ax=panels, shrink=0.5, aspect=40, location="bottom",
                           ticks=np.log10([1, 2, 5, 10, 30]))
    bar.ax.set_xticklabels(["1", "2", "5", "10", "30"])
    bar.set_label("error over the least one of the same causality;\nframed: kalman "
                  "more than 10 % worse than the best other method", fontsize=6.5)
    return drawing
