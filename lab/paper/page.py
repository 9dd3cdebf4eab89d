"""Tables and pages of `python -m lab.paper`: one writer for every experiment."""
from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv._beside import write_beside
from pdavis_cv.export import write_csv

from .print_style import beside_stem
from .run import SHOWN, Row

# Columns of the tables, and how their numbers are written.
FORMATS = {
    "aop_error_deg": "{:.2f}", "dolp_error": "{:.3f}", "aop_error_roi_deg": "{:.2f}",
    "dolp_error_roi": "{:.3f}", "dolp_roi": "{:.3f}", "aop_range_deg": "{:.0f}",
    "aop_coverage": "{:.2f}", "dolp_coverage": "{:.2f}", "valid": "{:.2f}",
    "events_per_pixel_s": "{:.1f}", "median_interval_us": "{:.0f}",
}


def mean(rows: Iterable[Row], column: str) -> float:
    """Return the mean of a column, NaN left out; NaN if nothing is left."""
    values = np.array([getattr(row, column) for row in rows], np.float64)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def cell(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Return the means of some columns as text, ``-`` where there is none."""
    values = [(mean(rows, column), FORMATS[column]) for column in columns]
    return " / ".join("-" if np.isnan(v) else text.format(v) for v, text in values)


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """Return a Markdown table as lines, and an empty one after it."""
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head),
            *("| " + " | ".join(line) + " |" for line in lines), ""]


def pivot(
    rows: Sequence[Row], across: str, columns: Sequence[str], *,
    label: Callable[[float], str] = "{:g}".format, title: str = "method",
    average: bool = True,
) -> list[str]:
    """Return a table of methods against a setting.

    Parameters
    ----------
    rows : sequence of Row
        Averaged where several share method and setting.
    across : str
        Column that gives the table's columns.
    columns : sequence of str
        What each cell shows, with slashes between; methods without any are left out.
    label : callable
        Names a setting.
    title : str
        Head of the first column.
    average : bool
        Add the mean over the settings.

    Returns
    -------
    list of str
    """
    settings = sorted({getattr(row, across) for row in rows})
    lines = []
    for name in SHOWN:
        mine = [row for row in rows if row.method == name]
        if all(np.isnan(mean(mine, column)) for column in columns):
            continue
        cells = [cell([row for row in mine if getattr(row, across) == value], columns)
                 for value in settings]
        lines.append([name, *cells, *([cell(mine, columns)] if average else [])])
    head = [title, *map(label, settings), *(["mean"] if average else [])]
    return table(head, lines)


# Heading -> experiment, what a row must have, columns, and how rows are joined:
# "mean", or "worst" of the means at each speed or irradiance.
_SUMMARY: tuple[tuple[str, str, dict[str, Any], tuple[str, ...], str], ...] = (
    ("polarizer", "fig2", {}, ("aop_error_deg", "dolp_error"), "mean"),
    ("rotating plate", "fig3", {"scene": "rotating plate"},
     ("aop_error_deg", "dolp_error"), "mean"),
    ("polarizer before a plate", "fig3", {"scene": "rotating polarizer"},
     ("aop_error_deg", "dolp_error"), "mean"),
    ("fan 200 RPM, dark / bright half", "fig4a", {"rpm": 200.0}, ("halves",), "mean"),
    ("fan 1000 RPM", "fig4a", {"rpm": 1000.0}, ("halves",), "mean"),
    ("120 dB, worst level, super-pixels / region", "dr", {"scene": "polarizer"},
     ("aop_error_deg", "aop_error_roi_deg"), "worst"),
    ("same through a rotating plate", "dr", {"scene": "rotating plate"},
     ("aop_error_deg", "aop_error_roi_deg"), "worst"),
)


def summary(rows: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return the Markdown of everything in one table per event camera.

    Parameters
    ----------
    rows : mapping of str to sequence of Row
        Experiment -> its rows.

    Returns
    -------
    list of str
    """
    lines = ["# All figures", "",
             "AoP error in degrees (/ DoLP error) of super-pixels, mean over specimens "
             "and speeds unless said otherwise.", ""]
    cameras = {row.camera for each in rows.values() for row in each
               if "Sony" not in row.method}
    for camera in sorted(cameras):
        found = {name: [row for row in each if row.camera == camera
                        or "Sony" in row.method] for name, each in rows.items()}
        heads = [entry for entry in _SUMMARY
                 if any(row.camera == camera for row in found.get(entry[1], ()))]
        table_lines = []
        for method in SHOWN:
            cells = [
                _summed([row for row in found[name] if row.method == method and all(
                    getattr(row, key) == value for key, value in having.items())],
                    columns, join)
                for _, name, having, columns, join in heads]
            if set(cells) != {"-"}:
                table_lines.append([method, *cells])
        lines += [f"## `{camera}` camera", "",
                  *table(["method", *(entry[0] for entry in heads)], table_lines)]
    return lines


def _summed(rows: Sequence[Row], columns: Sequence[str], join: str) -> str:
    if not rows:
        return "-"
    if columns == ("halves",):
        return " / ".join(
            cell([row for row in rows if row.region == half], ("aop_error_deg",))
            for half in ("dark half", "bright half"))
    if join == "mean":
        return cell(rows, columns)
    levels = {(row.rpm, row.irradiance_uw_cm2) for row in rows}
    return " / ".join(FORMATS[column].format(max(
        mean([row for row in rows if (row.rpm, row.irradiance_uw_cm2) == level], column)
        for level in levels)) for column in columns)


def write_rows(stem: Path, rows: Iterable[Any], facts: Mapping[str, Any],
               kind: type = Row, ending: str = "") -> None:
    """Write STEM-ending.csv: a line for each of some dataclasses of one kind."""
    write_csv(beside_stem(stem, f"{ending}.csv"),
              [field.name for field in dataclasses.fields(kind)],
              map(dataclasses.astuple, rows), facts)


def write_page(stem: Path, lines: Sequence[str]) -> str:
    """Write STEM.md and return its text."""
    text = "\n".join(lines).rstrip() + "\n"
    with write_beside(beside_stem(stem, ".md")) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return text
