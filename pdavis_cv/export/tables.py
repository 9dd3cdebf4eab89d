"""Write traces as CSV, with units in the header or in jAER's dialect."""
from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdavis_cv._beside import all_or_none, write_beside
from pdavis_cv._text import table_text
from pdavis_cv._types import Facts
from pdavis_cv.export.embedded import to_json

if TYPE_CHECKING:
    from pdavis_cv.analysis import Traces

JAER_HEADER = ("lastTimestamp(s)", "ROINumPixels", "f0", "f45", "f90", "f135",
               "AoP(deg)", "AoPStd(deg)", "DoLP", "DoLPStd")
"""Columns of the ROI file of jAER's PolarizationComplementaryFilter."""


def write_csv(
    path: str | os.PathLike[str], header: Sequence[str], rows: Iterable[Sequence[Any]],
    facts: Facts | None = None, *, decimal: str = ".", digits: int = 17,
) -> None:
    """Write a table; facts go into a JSON file beside it.

    Parameters
    ----------
    path : path
        File to write; appears when it is complete.  It holds only the table, as
        ``pandas.read_csv(path)`` expects.
    header : sequence of str
        Names of the columns, which include units.
    rows : iterable of sequence
        Values; NaN is an empty cell.
    facts : mapping of str to object, optional
        Written to the path with ``.json`` added, if there are any.
    decimal : {".", ","}
        With commas, as spreadsheets of many countries expect them, columns are
        separated by semicolons.
    digits : int
        Most significant digits of a float.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    with all_or_none(), write_beside(path) as part, part.open(
            "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter=";" if decimal == "," else ",",
                            lineterminator="\n")
        writer.writerow(map(table_text, header))
        for row in rows:
            writer.writerow([_cell(value, decimal, digits) for value in row])
        if facts:
            with write_beside(f"{os.fspath(path)}.json") as other:
                other.write_text(to_json(facts) + "\n", encoding="utf-8")


def _cell(value: Any, decimal: str, digits: int) -> Any:
    if isinstance(value, float | np.floating):
        if not np.isfinite(value):
            return ""
        text = repr(float(value) if digits >= 17 else float(f"{value:.{digits}g}"))
        return text.replace(".", decimal)
    return table_text(value) if isinstance(value, str) else value


_DIGITS = 7
"""Significant digits of values that come from images of float32."""


_COLUMNS = (
    ("pixels", "pixels", None), ("s0_dn_per_ms", "s0", None),
    ("s0_se_dn_per_ms", "s0_se", None), ("dolp", "dolp", None),
    ("dolp_se", "dolp_se", None), ("dolp_sd", "dolp_sd", None),
    ("aop_deg", "aop", np.rad2deg), ("aop_se_deg", "aop_se", np.rad2deg),
    ("aop_sd_deg", "aop_sd", np.rad2deg), ("event_rate_hz", "event_rate", None),
    ("event_rate_se_hz", "event_rate_se", None), ("i0_dn_per_ms", "i0", None),
    ("i45_dn_per_ms", "i45", None), ("i90_dn_per_ms", "i90", None),
    ("i135_dn_per_ms", "i135", None))


def write_traces(
    path: str | os.PathLike[str], traces: Traces, *, origin_us: int = 0,
    facts: Facts | None = None,
    extra: Facts | None = None, decimal: str = ".",
) -> None:
    """Write traces as a long table, one row per region and time.

    Parameters
    ----------
    path : path
        File to write; appears when it is complete.
    traces : Traces
        Traces of `analysis.TraceRecorder`.
    origin_us : int
        Time of ``t_s`` 0.
    facts : mapping of str to object, optional
        Written to a JSON file next to it; default: the traces' provenance.
    extra : mapping of str to array_like of shape (T,) or (R, T), optional
        Further columns.
    decimal : {".", ","}
        As in `write_csv`.

    Raises
    ------
    ValueError
        If an extra column has the wrong shape.
    OSError
        If it cannot be written.
    """
    table = traces.table
    columns: dict[str, Any] = {}
    for name, source, convert in _COLUMNS:
        columns[name] = table[source] if convert is None else convert(table[source])
    for name, values in (extra or {}).items():
        array = np.asarray(values)
        if array.shape not in (table.shape, table.shape[1:]):
            raise ValueError(
                f"{name} must be {table.shape} or {table.shape[1:]}, got {array.shape}")
        columns[name] = np.broadcast_to(array, table.shape)

    def rows() -> Iterable[Sequence[Any]]:
        for r, roi in enumerate(traces.rois):
            for i, t in enumerate(traces.t_us.tolist()):
                yield [roi.name, repr((t - origin_us) / 1e6).replace(".", decimal), t,
                       *(values[r, i] for values in columns.values())]

    write_csv(path, ("roi", "t_s", "t_us", *columns), rows(),
              traces.provenance if facts is None else facts, decimal=decimal,
              digits=_DIGITS)


@all_or_none()
def write_jaer_csv(
    path: str | os.PathLike[str], traces: Traces, *, origin_us: int = 0,
    facts: Facts | None = None,
) -> list[Path]:
    """Write traces with the header of jAER's ROI files, one file per region.

    Parameters
    ----------
    path : path
        File to write; with several regions ``-NAME`` goes before the suffix.
    traces : Traces
        Traces of `analysis.TraceRecorder`.
    origin_us : int
        Time of timestamp 0.
    facts : mapping of str to object, optional
        Written to a JSON file next to it; default: the traces' provenance.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    written = []
    for roi, table in zip(traces.rois, traces.table, strict=True):
        target = Path(path)
        if len(traces.rois) > 1:
            safe = "".join(c if c.isalnum() or c in "-_" else "_" for c in roi.name)
            target = target.with_stem(f"{target.stem}-{safe}")
        rows = ([(int(row["t_us"]) - origin_us) / 1e6, int(row["pixels"]),
                 row["i0"], row["i45"], row["i90"], row["i135"],
                 np.rad2deg(row["aop"]), np.rad2deg(row["aop_sd"]), row["dolp"],
                 row["dolp_sd"]] for row in table)
        write_csv(target, JAER_HEADER, rows,
                  traces.provenance if facts is None else facts)
        written.append(target)
    return written
