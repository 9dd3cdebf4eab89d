"""Read force and displacement of a test frame from its CSV file."""
from __future__ import annotations

import csv
import io
import itertools
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._remote import as_path

FloatArray = NDArray[np.float64]
_SEARCHED = 1_000
"""Lines, and columns, among which the names are; a choice."""

_UNITS = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
    "force": {"n": 1.0, "mn": 1e-3, "kn": 1e3, "gf": 9.80665e-3, "lbf": 4.4482216},
    "displacement": {"mm": 1.0, "um": 1e-3, "\N{MICRO SIGN}m": 1e-3,
                     "\N{GREEK SMALL LETTER MU}m": 1e-3, "m": 1e3, "in": 25.4},
    "trigger": {"": 1.0, "v": 1.0, "mv": 1e-3},
}
_SPELLED = {
    "time": "s, ms, us, min", "force": "N, mN, kN, gf, lbf",
    "displacement": "mm, um, m, in", "trigger": "V, mV or none",
}
_WORDS = {
    "time": ("time", "elapsed", "timestamp", "zeit", "t"),
    "force": ("force", "load", "kraft", "f"),
    "displacement": ("displacement", "position", "extension", "stroke", "disp", "weg",
                     "x"),
    "trigger": ("trigger", "ttl", "sync"),
}
"""Beginnings of the columns' names; a single letter is the whole name."""


@dataclass(frozen=True, eq=False)
class LoadTrace:
    """Data of a test frame, on its own clock.

    Parameters
    ----------
    t_s : ndarray of float64, shape (N,)
        Increasing seconds.
    force_n : ndarray of float64, shape (N,), optional
        Newtons.
    displacement_mm : ndarray of float64, shape (N,), optional
        Millimetres.
    trigger : ndarray of float64, shape (N,), optional
        Level of a trigger line.
    gaps : tuple of (float, float)
        Intervals without samples, seconds.
    dropped : int
        Number of rows without numbers.
    """

    t_s: FloatArray
    force_n: FloatArray | None = None
    displacement_mm: FloatArray | None = None
    trigger: FloatArray | None = None
    gaps: tuple[tuple[float, float], ...] = field(default=())
    dropped: int = 0

    @property
    def primary(self) -> FloatArray:
        """Force, or displacement if there is no force."""
        values = self.force_n if self.force_n is not None else self.displacement_mm
        assert values is not None
        return values

    def trigger_times(self) -> FloatArray:
        """Return the times at which the trigger rises through half its range, s."""
        if self.trigger is None:
            raise ValueError("the load file has no trigger column")
        high, low = float(self.trigger.max()), float(self.trigger.min())
        if high <= low:
            return np.empty(0)
        level = (high + low) / 2
        after = np.flatnonzero(
            (self.trigger[1:] >= level) & (self.trigger[:-1] < level)) + 1
        a, b = self.trigger[after - 1], self.trigger[after]
        part = (level - a) / (b - a)
        return np.asarray(
            self.t_s[after - 1] + part * (self.t_s[after] - self.t_s[after - 1]))

    def inside_gap(self, t_s: FloatArray) -> NDArray[np.bool_]:
        """Return which times lie in a gap or outside the trace."""
        bad = (t_s < self.t_s[0]) | (t_s > self.t_s[-1])
        for start, stop in self.gaps:
            bad |= (t_s > start) & (t_s < stop)
        return np.asarray(bad, np.bool_)


def read_load(path: str | Path) -> LoadTrace:
    """Read the CSV of a test frame.

    The header names the columns: time, force, displacement, trigger, other words for
    them, German ones, or t, F, x.  The unit follows the name in brackets or after an
    underscore, or is in the row below.

    Parameters
    ----------
    path : str or Path
        Columns are separated by commas, semicolons or tabs (decimal commas are
        recognised with the latter two); lines that start with ``#`` are comments.

    Returns
    -------
    LoadTrace

    Raises
    ------
    ValueError
        If a column or a unit is missing or unknown, or time runs backward; the
        message names the file, and the column or the line.
    OSError
        If the file cannot be read.
    """
    path = as_path(path)
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        text = path.read_text("latin-1")
    lines = ((number, line) for number, line in enumerate(io.StringIO(text), 1)
             if line.strip() and not line.lstrip().startswith("#"))
    begin = [*itertools.islice(lines, _SEARCHED)]
    delimiter = max(";\t,", key=lambda mark: sum(mark in line for _, line in begin[:5]))
    decimal_comma = delimiter != ","
    rows = ((number, next(csv.reader([line], delimiter=delimiter)))
            for number, line in itertools.chain(begin, lines))
    try:
        return _table(path, rows, decimal_comma)
    except csv.Error as error:
        raise ValueError(f"{path}: not a table, {error}") from None


def _table(path: Path, rows: Iterator[tuple[int, list[str]]],
           decimal_comma: bool) -> LoadTrace:
    titles = next((row for _, row in itertools.islice(rows, _SEARCHED)
                   if _classify(row)), None)
    if titles is None:
        names = "; ".join(f"{kind}: {', '.join(_WORDS[kind])} ({_SPELLED[kind]})"
                          for kind in ("time", "force", "displacement"))
        raise ValueError(
            f"{path}: no header line with a time column and a force or displacement "
            f"column; names and units that are known: {names}")
    kinds = _classify(titles)
    header, below = [cell.strip() for cell in titles], list[str]()
    for number, row in itertools.islice(rows, 1):
        if any(_number(cell, decimal_comma) is not None for cell in row):
            rows = itertools.chain([(number, row)], rows)
        else:
            below = [cell.strip().strip("()[]") for cell in row]
    scales = {kind: _scale(path, kind, header[i], below[i] if i < len(below) else "")
              for kind, i in kinds.items()}
    numbers, values, dropped = array("q"), array("d"), 0
    for number, row in rows:
        cells = [_number(row[i], decimal_comma) if i < len(row) else None
                 for i in kinds.values()]
        found = [cell for cell in cells if cell is not None and np.isfinite(cell)]
        if len(found) < len(cells):
            dropped += 1
            continue
        numbers.append(number)
        values.extend(found)
    if len(numbers) < 2:
        raise ValueError(f"{path}: fewer than two rows of numbers")
    with np.errstate(over="ignore"):
        table = np.frombuffer(values).reshape(len(numbers), -1) * np.array(
            [scales[kind] for kind in kinds])
    if not np.isfinite(table).all():
        raise ValueError(f"{path}: numbers must be finite in N, mm and s")
    column = dict(zip(kinds, table.T, strict=True))
    t = np.ascontiguousarray(column["time"])
    step = np.diff(t)
    back = np.flatnonzero(step <= 0)
    if back.size:
        raise ValueError(
            f"{path}: line {numbers[int(back[0]) + 1]}: time must increase, got "
            f"{t[back[0] + 1]:g} s after {t[back[0]]:g} s")
    wide = np.flatnonzero(step > 5 * np.median(step))
    gaps = tuple((float(t[i]), float(t[i + 1])) for i in wide)
    return LoadTrace(
        t, column.get("force"), column.get("displacement"), column.get("trigger"),
        gaps, dropped)


def _classify(row: list[str]) -> dict[str, int]:
    """Return the column of each kind in a header; empty if the row is not one."""
    kinds: dict[str, int] = {}
    for i, cell in enumerate(row[:_SEARCHED]):
        name = cell.strip().lower()
        for kind, words in _WORDS.items():
            starts = "|".join(
                rf"{word}(?![^\W_])" if len(word) == 1 else word for word in words)
            if kind not in kinds and re.match(rf"\W*({starts})", name):
                kinds[kind] = i
                break
    return kinds if "time" in kinds and kinds.keys() & {"force", "displacement"} else {}


def _scale(path: Path, kind: str, name: str, below: str) -> float:
    bracketed = re.search(r"[(\[]\s*([^)\]]*?)\s*[)\]]", name)
    suffix = re.search(r"_([A-Za-z\u00b5\u03bc]+)$", name)
    unit = bracketed.group(1) if bracketed else suffix.group(1) if suffix else below
    known = _UNITS[kind]
    if unit.lower() not in known or unit == "MN":
        said = f"got {unit!r}" if unit else "the header names none"
        raise ValueError(
            f"{path}: column {name!r}: the unit must be one of {_SPELLED[kind]}, "
            f"{said}")
    return known[unit.lower()]


def _number(cell: str, decimal_comma: bool) -> float | None:
    cell = cell.strip()
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return None
