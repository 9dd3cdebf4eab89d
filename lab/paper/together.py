"""Several experiments at once, on all cores; what is done is not done again."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

import pdavis_cv
from pdavis_cv._workers import usable_cores
from pdavis_cv.export import write_beside

from pdavis_cv.tools._progress import no_progress, progress
from .page import read_rows
from .print_style import beside_stem, journal
from .run import Row, Settings

__all__ = ["made"]

Make = Callable[[str, Path, Settings], tuple[str, list[Row]]]


def made(
    stems: Mapping[str, Path], settings: Settings, make: Make
) -> dict[str, list[Row]]:
    """Make experiments, each in a process, and return their rows.

    ``STEM.done.json`` beside an experiment's files says of which code and options they
    are: where nothing has changed they are kept.

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
    key = _key(settings)
    rows = {name: _kept(stem, key) for name, stem in stems.items()}
    missing = [name for name, found in rows.items() if found is None]
    for name in stems:
        if name not in missing:
            print(f"{name}: kept, nothing has changed")
    workers = min(usable_cores(), len(missing))
    pool: Any = nullcontext()
    if workers > 1:  # "spawn": a fork of a process that has threads may never go on
        pool = ProcessPoolExecutor(workers, get_context("spawn"))
    with pool as executor:
        for name, found, seconds in progress(
                _results(missing, stems, settings, make, executor), len(missing),
                "experiments"):
            rows[name] = found
            _keep(stems[name], key, found)
            print(f"{name}: {seconds:.0f} s")
    return {name: rows[name] or [] for name in stems}


def _results(
    names: list[str], stems: Mapping[str, Path], settings: Settings, make: Make,
    executor: Executor | None,
) -> Iterator[tuple[str, list[Row], float]]:
    if executor is None:
        for name in names:
            yield name, *_one(make, name, stems[name], settings)
        return
    waiting: dict[Future[Any], str] = {
        executor.submit(_quietly, make, name, stems[name], settings): name
        for name in names}
    for future in as_completed(waiting):
        yield waiting[future], *future.result()


def _quietly(make: Make, name: str, stem: Path, settings: Settings
             ) -> tuple[list[Row], float]:
    """Make one in a process of its own, whose bars would cover each other."""
    with no_progress(), journal():
        return _one(make, name, stem, settings)


def _one(make: Make, name: str, stem: Path, settings: Settings
         ) -> tuple[list[Row], float]:
    start = perf_counter()
    _, rows = make(name, stem, settings)
    return rows, perf_counter() - start


# ---- what is kept ----------------------------------------------------------------


def _key(settings: Settings) -> str:
    """Return a digest of the code and of what was asked for."""
    digest = hashlib.sha256(repr((pdavis_cv.__version__, settings)).encode())
    for folder in (Path(pdavis_cv.__file__).parent, Path(__file__).parent,
                   Path(pdavis_cv._kernels.__file__).parent):
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".py", ".so", ".pyd", ".npz"):
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _kept(stem: Path, key: str) -> list[Row] | None:
    """Return the rows of an experiment that is done, None if it must be made."""
    try:
        told = json.loads(beside_stem(stem, ".done.json").read_text(encoding="utf-8"))
        sizes = {name: stem.with_name(name).stat().st_size for name in told["files"]}
        if told["key"] != key or sizes != told["files"]:
            return None
        return list(read_rows(beside_stem(stem, ".csv"))) if told["rows"] else []
    except (OSError, ValueError, KeyError, TypeError):
        return None  # half of it is there, or something else


def _keep(stem: Path, key: str, rows: list[Row] | None) -> None:
    mark = beside_stem(stem, ".done.json")
    files = {path.name: path.stat().st_size for path in sorted(stem.parent.iterdir())
             if path != mark and (path.name.startswith(f"{stem.name}.")
                                  or path.name.startswith(f"{stem.name}-"))}
    with write_beside(mark) as unfinished:
        unfinished.write_text(json.dumps(
            {"key": key, "rows": bool(rows), "files": files}), encoding="utf-8")
