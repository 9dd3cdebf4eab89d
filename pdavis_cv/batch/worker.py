"""Do one job, in the process or thread that an executor chooses."""
from __future__ import annotations

import contextlib
import json
import platform
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import pdavis_cv
from pdavis_cv._types import Facts
from pdavis_cv.batch.jobs import Job, changed_options, describe
from pdavis_cv.batch.results import DONE, FAILED
from pdavis_cv.batch.stored import results_at
from pdavis_cv.errors import PdavisError, PdavisWarning
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.facts import assumptions
from pdavis_cv.recording.open import open_recording

Row = dict[str, Any]

_PERMANENT = (PdavisError, TypeError, ValueError, ImportError, NotImplementedError)
"""Errors that would occur again with the same input, so that a retry is useless."""


class _OutOfTimeError(BaseException):
    """Raised inside a work at its time limit.

    It is not an Exception, as a work may catch those.
    """


def perform(
    job: Job, out: str, *, timeout_s: float | None = None, attempt: int = 1
) -> tuple[Row, bool]:
    """Do a job, and write its result and its marker below a folder or URL.

    Returns the row of the table, whose ``state`` is "done" or "failed", and whether
    another attempt may succeed.  The work is interrupted after `timeout_s`; attempts
    are counted from 1.
    """
    results = results_at(out)
    row = _row(job, attempt)
    start, cpu, again = time.perf_counter(), time.process_time(), False
    with contextlib.suppress(OSError):  # the peak of memory, on systems that can
        _CLEAR.write_text("5")
    with _collected_warnings() as collected:
        try:
            with results.part(job.name) as folder:
                with _deadline(timeout_s):
                    row |= _run_work(job, folder)
                row["files"] = sorted(
                    path.relative_to(folder).as_posix()
                    for path in folder.rglob("*") if path.is_file())
                results.publish(job.name, folder)
            row["state"] = DONE
        except _OutOfTimeError:
            row["error"] = f"not done after {timeout_s:g} s"
        except Exception as error:
            row["error"] = _message(error)
            again = not isinstance(error, _PERMANENT)
    row |= {"warnings": [*row["warnings"], *collected],
            "wall_s": round(time.perf_counter() - start, 3),
            "cpu_s": round(time.process_time() - cpu, 3), "peak_mib": _peak_mib()}
    try:
        results.mark(job.name, {"row": row, "provenance": _provenance(job)})
    except OSError as error:
        row |= {"state": FAILED, "error": row["error"] or _message(error)}
        again = True
    return row, again


def failed_row(job: Job, attempt: int, error: str) -> Row:
    """Return the row of a job whose worker returned nothing."""
    return {**_row(job, attempt), "error": error}


def _row(job: Job, attempt: int) -> Row:
    return {
        "name": job.name, "recording": job.source, "state": FAILED, "error": "",
        "options": changed_options(job.options), "figures": {}, "problems": 0,
        "warnings": [], "files": [], "attempt": attempt, "wall_s": None, "cpu_s": None,
        "peak_mib": None, "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(), "version": pdavis_cv.__version__}


def _provenance(job: Job) -> dict[str, Any]:
    return {"recording": job.source, "content": job.identity,
            "options": changed_options(job.options), "work": describe(job.work),
            "pdavis_cv": pdavis_cv.__version__, "numpy": np.__version__,
            "python": platform.python_version(), "machine": platform.platform()}


def _run_work(job: Job, folder: Path) -> Row:
    """Call the work; return figures, what was assumed, and the number of problems."""
    if not getattr(job.work, "opens", True):
        return {"figures": _plain(job.work(job.source, job.options, folder))}
    stated = job.stated
    if stated.known_layout is None:
        stated = stated.replace(layout=job.options.layout)
    source: Recording = open_recording(job.source, stated)
    with source as recording:
        figures = job.work(recording, job.options, folder)
        return {"figures": _plain(figures),
                "warnings": assumptions(recording.info.facts),
                "problems": sum(one.count for one in recording.problems)}


def _plain(figures: Facts | None) -> dict[str, Any]:
    """Return figures as JSON can hold them; numbers that are not finite become None."""
    if figures is not None and not isinstance(figures, Mapping):
        raise TypeError(
            "a work must return a mapping of figures or None, got "
            f"{type(figures).__name__}")
    found: dict[str, Any] = {}
    for name, value in (figures or {}).items():
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, float) and not np.isfinite(value):
            value = None
        if not isinstance(value, bool | int | float | str | None):
            value = json.dumps(describe(value))
        found[str(name)] = value
    return found


def _message(error: BaseException) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, PdavisError | OSError | ValueError | TypeError) and text:
        return text
    last = traceback.extract_tb(error.__traceback__)[-1:]
    place = f" at {Path(last[0].filename).name}:{last[0].lineno}" if last else ""
    return f"{type(error).__name__}{place}: {text}".rstrip(": ")


@contextlib.contextmanager
def _collected_warnings() -> Iterator[list[str]]:
    """Collect this library's warnings as texts, and issue all others again.

    Filters of warnings apply to the whole process, so in other threads than the main
    one nothing is collected.
    """
    collected: list[str] = []
    if threading.current_thread() is not threading.main_thread():
        yield collected
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PdavisWarning)
        yield collected
    ours = [one for one in caught if issubclass(one.category, PdavisWarning)]
    collected += [" ".join(str(one.message).split()) for one in ours]
    for one in caught:
        if one not in ours:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)


# ---- time and memory -------------------------------------------------------------


@contextlib.contextmanager
def _deadline(seconds: float | None) -> Iterator[None]:
    """Raise `_OutOfTimeError` in the block after the given time.

    A signal does so, which also interrupts waits; only a main thread gets one.
    """
    if seconds is None:
        yield
        return
    if not hasattr(signal, "setitimer") or (
            threading.current_thread() is not threading.main_thread()):
        raise ValueError("timeout_s needs jobs in main threads, as the executor "
                         "process has them, and signals, which Windows lacks")

    def ring(*_: Any) -> None:
        raise _OutOfTimeError

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def _peak_mib() -> float | None:
    """Return the process's peak of memory, MiB; None on systems that do not tell."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = _STATUS.read_text().partition("VmHWM:")[2]
        return round(int(text.split()[0]) / 1024, 1)
    with contextlib.suppress(ImportError):
        import resource
        return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)
    return None
