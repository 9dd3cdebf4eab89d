"""How far the jobs of a folder are, for whoever asks while they are done."""
from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

from pdavis_cv.batch.results import DONE, FAILED, Results, results_at

__all__ = ["Status", "status"]

_SILENT_S = 30.0    # a run says something every second


@dataclass(frozen=True, kw_only=True)
class Status:
    """How far the jobs of a folder are.

    Parameters
    ----------
    done, failed : int
        Jobs with a marker.
    running : int
        Jobs in the hands of runs that live.
    runs : int
        Runs that live.
    total : int or None
        Jobs of these runs; None where one does not know.
    left_s : float or None
        Seconds that they still need, at the pace so far.
    errors : mapping of str to int
        How often each error occurs among the failed ones.
    """

    done: int
    failed: int
    running: int
    runs: int
    total: int | None
    left_s: float | None
    errors: dict[str, int]


def status(out: str | os.PathLike[str]) -> Status:
    """Return how far the jobs of a folder are.

    Parameters
    ----------
    out : path
        As `run` was given it.

    Returns
    -------
    Status

    Raises
    ------
    FileNotFoundError
        If there are no results.
    """
    results = results_at(out)
    counts: Counter[str] = Counter()
    errors: Counter[str] = Counter()
    names = results.names()
    for name in names:
        found = results.marker(name)
        if found is None:
            continue
        row = found["row"]
        counts[row["state"]] += 1
        if row["state"] == FAILED:
            errors[row["error"]] += 1
    alive = _alive(results)
    totals = [run["total"] for run in alive]
    left = [_left_s(run) for run in alive]
    known = [value for value in left if value is not None]
    return Status(
        done=counts[DONE], failed=counts[FAILED],
        running=sum(run["running"] for run in alive), runs=len(alive),
        total=sum(totals) if totals and None not in totals else None,
        left_s=max(known) if known else None, errors=dict(errors.most_common()))


def _alive(results: Results) -> list[dict[str, Any]]:
    return [run for run in results.told() if time.time() - run["seen_s"] < _SILENT_S]


def _left_s(run: dict[str, Any]) -> float | None:
    ended = run["done"] + run["failed"]
    if run["total"] is None or not ended:
        return None
    each_s: float = (run["seen_s"] - run["started_s"]) / ended
    left: float = (run["total"] - ended) * each_s
    return left
