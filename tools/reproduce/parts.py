"""``pdavis batch --work reproduce``: the experiments as jobs, and their rows joined."""
from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdavis_cv import FusionOptions
from pdavis_cv.batch import Table

from .._common import UsageError
from . import robustness
from .command import EXPERIMENTS, PAPER, settings_of
from .page import read_rows, summary, write_page, write_rows
from .robustness_page import robustness_page
from .run import Row, Settings

__all__ = ["Part", "join", "parts"]

_TABLES = (*PAPER, "robustness")


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of an experiment as a work of `batch.run`; what it is, its source says.

    Parameters
    ----------
    quick : bool
        Fewer and shorter cases.
    seeds : tuple of int
        Which specimens; empty for those of the experiment.
    seconds : float, optional
        Length of each recording, more than 1.1.
    """

    quick: bool = False
    seeds: tuple[int, ...] = ()
    seconds: float | None = None

    opens = False

    def settings(self, figure: str) -> Settings:
        """Return what ``pdavis reproduce`` would be told."""
        given = ["--quick"] * self.quick
        if self.seeds:
            given += ["--seeds", *map(str, self.seeds)]
        if self.seconds is not None:
            given += ["--seconds", str(self.seconds)]
        return settings_of([figure, "-o", figure, *given])

    def __call__(
        self, source: str, options: FusionOptions, folder: Path
    ) -> Mapping[str, Any]:
        """Write ``rows.csv``, and of a figure its page and pictures."""
        figure, number = source.rsplit("-", 1)
        settings = self.settings(figure)
        if figure == "robustness":
            rows = robustness.case_rows(settings, int(number))
        else:
            one = dataclasses.replace(settings, seeds=(int(number),))
            _, rows = EXPERIMENTS[figure][1](figure, folder / figure, one)
        write_rows(folder / "rows", rows, {"part": source})
        return {"figure": figure, "rows": len(rows)}


def parts(figures: Sequence[str], work: Part) -> Iterator[str]:
    """Yield the parts of experiments: each specimen, or each case of the robustness.

    Parameters
    ----------
    figures : sequence of str
        Of fig2, fig3, fig4a, dr, flicker, robustness; ``all`` for the first five.
    work : Part
    """
    for figure in [name for asked in figures
                   for name in (PAPER if asked == "all" else (asked,))]:
        if figure not in _TABLES:
            raise UsageError(
                f"--work reproduce does all, {', '.join(_TABLES)}, got {figure!r}")
        settings = work.settings(figure)
        numbers = (range(len(robustness.robustness_cases(settings)))
                   if figure == "robustness" else settings.seeds)
        for number in numbers:
            yield f"{figure}-{number}"


def join(table: Table, out: Path) -> list[str]:
    """Write FIGURE.csv of all parts that are done, and the pages made of them.

    Parameters
    ----------
    table : Table
        Rows of the jobs.
    out : Path
        Where their results are.

    Returns
    -------
    list of str
        Names of what was written.
    """
    found: dict[str, list[Row]] = {}
    for job in table:
        if job["files"]:
            found.setdefault(job["figures"]["figure"], []).extend(
                read_rows(out / job["name"] / "rows.csv"))
    for figure, rows in found.items():
        write_rows(out / figure, rows, {"figure": figure})
    written = [f"{figure}.csv" for figure in found]
    if hard := found.pop("robustness", None):
        write_page(out / "robustness", robustness_page(hard))
        written.append("robustness.md")
    if found:
        write_page(out / "figures", summary(found))
        written.append("figures.md")
    return written
