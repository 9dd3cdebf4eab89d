"""The progress of the runs that write to a folder of results."""
from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

from pdavis_cv.batch.results import DONE, FAILED, Results
from pdavis_cv.batch.stored import results_at

__all__ = ["Status", "status"]

_SILENT_S = 30.0    # a run reports every second; one silent for longer has died


@dataclass(frozen=True, kw_only=True)
class Status:
    """Numbers of finished and running jobs of a folder of results.

    Parameters
    ----------
    done, failed : int
        Number of jobs with a marker.
    running : int
        Number of jobs that active runs have submitted.
    runs : int
        Number of active runs.
    total : int or None
        Number of jobs of the active runs; None if unknown.
    left_s : float or None
        Estimated time until they end, s, from the rate so far.
    errors : mapping of str to int
        Number of failed jobs by error.
    """

    done: int
    failed: int
    running: int
    runs: int
    total: int | None
    left_s: float | None
    errors: dict[str, int]


def status(out: str | os.PathLike[str]) -> Status:
    """Return the progress of the jobs of a folder of results.

    Parameters
    ----------
    out : path
        As given to `run`.

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
    active = _active_runs(results)
    totals = [run["total"] for run in active]
    left = [_left_s(run) for run in active]
    known = [value for value in left if value is not None]
    return Status(
        done=counts[DONE], failed=counts[FAILED],
        running=sum(run["running"] for run in active), runs=len(active),
        total=sum(totals) if totals and None not in totals else None,
        left_s=max(known) if known else None, errors=dict(errors.most_common()))


def _active_runs(results: Results) -> list[dict[str, Any]]:
    return [run for run in results.read_progress()
            if time.time() - run["seen_s"] < _SILENT_S]


def _left_s(run: dict[str, Any]) -> float | None:
    ended = run["done"] + run["failed"]
    if run["total"] is None or not ended:
        return None
    each_s: float = (run["seen_s"] - run["started_s"]) / ended
    left: float = (run["total"] - ended) * each_s
    return left
