"""Several experiments at once, on all cores."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import as_completed
from pathlib import Path
from time import perf_counter

from pdavis_cv._workers import usable_cores
from pdavis_cv.batch.processes import ProcessPool
from pdavis_cv.tools._progress import QUIET, progress

from .print_style import journal
from .run import Row, Settings

Make = Callable[[str, Path, Settings], tuple[str, list[Row]]]


def made(
    stems: Mapping[str, Path], settings: Settings, make: Make
) -> dict[str, list[Row]]:
    """Make experiments, each in a process, and return their rows.

    Parameters
    ----------
    stems : mapping of str to Path
        Name of the experiment -> what its files begin with.
    settings : Settings
    make : callable
        (name, stem, settings) -> (page, rows); a function of a module, since it
        travels to the processes.

    Returns
    -------
    dict of str to list of Row
        In the order of `stems`.
    """
    rows = {}
    workers = min(usable_cores(), len(stems))
    with ProcessPool(workers) as executor:
        waiting = {executor.submit(_quietly, make, name, stem, settings): name
                   for name, stem in stems.items()}
        for future in progress(as_completed(waiting), len(waiting), "experiments"):
            rows[waiting[future]], seconds = future.result()
            print(f"{waiting[future]}: {seconds:.0f} s")
    return {name: rows[name] for name in stems}


def _quietly(make: Make, name: str, stem: Path, settings: Settings
             ) -> tuple[list[Row], float]:
    """Make one in a process of its own, whose bars would cover each other."""
    start = perf_counter()
    QUIET.set(True)
    with journal():
        return make(name, stem, settings)[1], perf_counter() - start
