"""The table of all jobs, as a sequence of rows, CSV or a web page."""
from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any

import pdavis_cv
from pdavis_cv._beside import write_beside
from pdavis_cv._text import page_text
from pdavis_cv.batch.results import DONE, Results
from pdavis_cv.batch.stored import results_at
from pdavis_cv.batch.worker import Row
from pdavis_cv.export.tables import write_csv

_LAST = ("problems", "warnings", "attempt", "wall_s", "cpu_s", "peak_mib", "started",
         "host", "version", "name")
_FIRST = ("recording", "state")
_NOT_SHOWN = ("name", "version", "host", "started")
_PICTURE = ".png"


class Table(Sequence[Row]):
    """A sequence of one row per job, read from its marker on access.

    It needs no more memory than the names of the jobs.

    Parameters
    ----------
    results : Results
    names : sequence of str
        Names of the jobs, in order.
    unwritten : mapping of str to Row, optional
        Rows of jobs whose marker could not be written.
    """

    def __init__(
        self, results: Results, names: Sequence[str],
        unwritten: Mapping[str, Row] | None = None,
    ) -> None:
        self._results, self._names = results, list(names)
        self._unwritten = dict(unwritten or {})

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: Any) -> Any:
        """Return a row, or a list of rows."""
        if isinstance(index, slice):
            return [self._row(name) for name in self._names[index]]
        return self._row(self._names[index])

    def __iter__(self) -> Iterator[Row]:
        return map(self._row, self._names)

    def _row(self, name: str) -> Row:
        if name in self._unwritten:
            return self._unwritten[name]
        found = self._results.marker(name)
        if found is None:
            raise KeyError(f"{name}: the marker has been removed")
        row: Row = found["row"]
        return row

    @property
    def failed(self) -> list[Row]:
        """Rows of jobs that are not done."""
        return [row for row in self if row["state"] != DONE]

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns: recording, state, error, options, figures, others."""
        options: dict[str, None] = {}
        figures: dict[str, None] = {}
        error = False
        for row in self:
            options |= dict.fromkeys(row["options"])
            figures |= dict.fromkeys(row["figures"])
            error |= bool(row["error"])
        fixed = (*_FIRST, *_LAST, "error")
        middle = dict.fromkeys((*options, *figures))
        return (*_FIRST, *(("error",) if error else ()),
                *(name for name in middle if name not in fixed), *_LAST)

    @staticmethod
    def cells(row: Row, columns: Sequence[str]) -> list[Any]:
        """Return the values of a row; a figure hides an option of the same name."""
        values = {**row["options"], **row["figures"],
                  **{name: row[name] for name in (*_FIRST, *_LAST, "error")}}
        return [_cell(values.get(name)) for name in columns]

    def write(self) -> None:
        """Write ``summary.csv`` and ``index.html`` beside the results."""
        with self._results.written("summary.csv") as path:
            self.write_csv(path)
        with self._results.written("index.html") as path:
            self.write_page(path)

    def write_csv(self, path: Any) -> None:
        """Write all rows as CSV.

        Parameters
        ----------
        path : path
        """
        columns = self.columns
        write_csv(path, columns, (self.cells(row, columns) for row in self))

    def write_page(self, path: Any) -> None:
        """Write all rows as a web page with sortable columns and pictures.

        Parameters
        ----------
        path : path
            In the folder of the results, to which the pictures' links are relative.
        """
        template = Template(
            files("pdavis_cv.batch").joinpath("page.html").read_text("utf-8"))
        shown = [name for name in self.columns if name not in _NOT_SHOWN]
        before, after = template.safe_substitute(
            columns="".join(f"<th>{page_text(name)}</th>" for name in shown),
            count=len(self), version=pdavis_cv.__version__).split("$rows")
        with write_beside(path) as part, part.open("w", encoding="utf-8") as file:
            file.write(before)
            for row in self:
                file.write(_html_row(row, self.cells(row, shown)))
            file.write(after)


def status(out: str | os.PathLike[str]) -> Table:
    """Return the rows of the jobs of a folder of results that have ended.

    Parameters
    ----------
    out : path
        As given to `run`.

    Returns
    -------
    Table
        Also while a run is under way; those that are done and those that failed.

    Raises
    ------
    FileNotFoundError
        If there are no results.
    """
    results = results_at(out)
    return Table(results, results.names())


def _cell(value: Any) -> Any:
    """Return a value that a cell of a table can hold."""
    if isinstance(value, list | dict):
        return "; ".join(map(str, value)) if isinstance(value, list) and all(
            isinstance(part, str) for part in value) else json.dumps(value)
    return value


def _html_row(row: Row, cells: Sequence[Any]) -> str:
    name = row["name"]
    picture = next((file for file in map(str, row["files"])
                    if file.endswith(_PICTURE)), None)
    shown = "" if picture is None else (
        f'<a href="{page_text(name)}/{page_text(picture)}"><img loading="lazy" '
        f'alt="" src="{page_text(name)}/{page_text(picture)}"></a>')
    rest = "".join(f"<td>{page_text(text)}</td>" for text in (
        "" if one is None else f"{one:.6g}" if isinstance(one, float) else one
        for one in cells))
    return f'<tr class="{row["state"]}"><td>{shown}</td>{rest}</tr>\n'
