"""The table as Markdown, and where a method is better than the default."""
from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lab.paper.page import table
from pdavis_cv import __version__

from .run import AHEAD, DEFAULTS, Row

ERRORS = {"aop_deg": ("AoP", "{:.2f}"), "dolp": ("DoLP", "{:.3f}"),
          "moving": ("moving", "{:.3f}"), "in_cell": ("in cell", "{:.3f}")}
"""Column of `Row` -> its name, and how it is written."""

_COVERAGES = ("aop_covered", "dolp_covered", "ln_covered", "moving_covered",
              "in_cell_covered")
_BETTER, _WORSE = 0.9, 1.5    # the second is a choice

Cell = tuple[str, str]
Values = Mapping[str, float]


class Beaten(NamedTuple):
    """A cell in which a method is better than the default: see `beaten`."""

    cell: Cell
    column: str
    default: str
    error: float
    best: str
    best_error: float


def means(rows: Iterable[Row]) -> dict[Cell, dict[str, dict[str, float]]]:
    """Return the mean over seeds of each column, by cell and method."""
    found: dict[Cell, dict[str, list[Row]]] = {}
    for row in rows:
        found.setdefault((row.case, row.preset), {}).setdefault(
            row.method, []).append(row)
    columns = [*ERRORS, *_COVERAGES, "ln", "valid"]
    return {cell: {method: {
        column: _mean([getattr(row, column) for row in mine]) for column in columns}
        for method, mine in methods.items()} for cell, methods in found.items()}


def _mean(values: Sequence[float]) -> float:
    kept = [value for value in values if not math.isnan(value)]
    return float(np.mean(kept)) if kept else math.nan


def beaten(rows: Sequence[Row]) -> Iterator[Beaten]:
    """Compare the default with every method that knows no more of what follows.

    A method is better if one of its errors is more than 10 % less and the other at most
    half as large again: a held frame has the degree of a polarizer that turns, and none
    of its angles.
    """
    rank = {row.method: AHEAD.index(row.ahead) for row in rows}
    for cell, methods in means(rows).items():
        for level, default in enumerate(DEFAULTS.values()):
            if default not in methods:
                continue
            mine = methods[default]
            for column in ERRORS:
                if math.isnan(mine[column]):
                    continue
                errors = {name: values[column] for name, values in methods.items()
                          if rank[name] <= level and not math.isnan(values[column])
                          and not any(values[other] > _WORSE * mine[other]
                                      for other in ERRORS)}
                best = min(errors, key=errors.__getitem__)
                if errors[best] < _BETTER * mine[column]:
                    yield Beaten(cell, column, default, mine[column], best,
                                 errors[best])


def page(rows: Sequence[Row], seeds: Sequence[int]) -> list[str]:
    """Return the Markdown: errors, coverage, and where the default is beaten."""
    found = means(rows)
    names = list(dict.fromkeys(row.method for row in rows))
    lost = list(beaten(rows))
    compared = sum(
        not math.isnan(values[column]) for methods in found.values()
        for name, values in methods.items() if name in DEFAULTS.values()
        for column in ERRORS)
    lines = [
        "# Evidence", "",
        "Every method, and two estimates that need no library (the last frame held, a "
        "straight line in ln intensity from frame to frame), on cases of their own. "
        "`python -m lab.evidence -o STEM` writes a page like this one; `--help` names "
        "cases and cameras. Numbers in names are turns per minute or pixels per "
        "second, then DoLP. Methods are told what a maker would state of the camera, "
        "and learn the rest.", "",
        f"pdavis_cv {__version__}, seeds {', '.join(map(str, seeds))}. "
        "AoP error in degrees / DoLP error, mean over seeds; of real "
        "recordings RMSE of ln DN of left-out frames, where pixels move / in their "
        "cells. The least error of a line is bold, each kind by itself.", "",
        *table(("case", "camera", *names), (
            [*cell, *_errors(methods, names)] for cell, methods in found.items())),
        "## Where the default is beaten", "",
        "A method that knows no more of what follows has one error more than 10 % "
        "less, and the other at most half as large again, than "
        f"{', '.join(map('`{}`'.format, DEFAULTS.values()))} in {len(lost)} of "
        f"{compared} comparisons, in {len({one.cell for one in lost})} of {len(found)} "
        "cells.", ""]
    if lost:
        lines += table(("case", "camera", "error of", "default", "error", "best", ""), (
            [*one.cell, ERRORS[one.column][0], one.default,
             _text(one.column, one.error), one.best, _text(one.column, one.best_error)]
            for one in lost))
    stating = [name for name in names if any(
        not math.isnan(methods[name][column]) for methods in found.values()
        if name in methods for column in _COVERAGES)]
    if stating:
        lines += [
            "## Coverage", "",
            "Part of the errors within one sigma (0.68 if sigmas are right) of AoP / "
            "DoLP / ln I, or where pixels move / in their cells; and valid "
            "super-pixels.", "",
            *table(("case", "camera", *stating), (
                [*cell, *(_coverage(methods.get(name)) for name in stating)]
                for cell, methods in found.items()))]
    return lines


def _text(column: str, value: float) -> str:
    return "-" if math.isnan(value) else ERRORS[column][1].format(value)


def _errors(methods: Mapping[str, Values], names: Sequence[str]) -> Iterator[str]:
    shown = [column for column in ERRORS if any(
        not math.isnan(values[column]) for values in methods.values())]
    least = {column: min(values[column] for values in methods.values()
                         if not math.isnan(values[column])) for column in shown}
    for name in names:
        values = methods.get(name)
        yield "-" if values is None else " / ".join(
            f"**{_text(column, values[column])}**" if values[column] == least[column]
            else _text(column, values[column]) for column in shown)


def _coverage(values: Values | None) -> str:
    if values is None:
        return "-"
    texts = [f"{values[column]:.2f}" for column in _COVERAGES
             if not math.isnan(values[column])]
    valid = values["valid"]
    return (" / ".join(texts) or "-") + (
        "" if math.isnan(valid) else f", {valid:.2f} valid")
