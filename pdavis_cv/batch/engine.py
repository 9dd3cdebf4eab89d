"""run(): submit jobs to an executor; each one ends as a row of a table."""
from __future__ import annotations

import contextlib
import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass
from typing import Any

from pdavis_cv.batch.jobs import Job, Work
from pdavis_cv.batch.pools import Pool, pool_factory
from pdavis_cv.batch.results import DONE, FAILED, Claim, Results
from pdavis_cv.batch.stored import results_at
from pdavis_cv.batch.table import Table
from pdavis_cv.batch.worker import Row, failed_row, perform
from pdavis_cv.batch.works import work_of
from pdavis_cv.errors import PdavisWarning
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.recording.options import SourceOptions

_PER_WORKER = 2     # submitted jobs per worker: one in work, one that waits
_POLL_S = 0.5       # interval at which the run polls while nothing finishes
_BROKEN_WAIT_S = 10.0   # time given to a broken executor's jobs to end


def run(
    recordings: Iterable[str | os.PathLike[str]],
    jobs: FusionOptions | Iterable[FusionOptions],
    out: str | os.PathLike[str],
    *,
    work: str | Work = "export",
    executor: str | Executor | Callable[[], Executor] | None = None,
    workers: int | None = None,
    retries: int = 1,
    timeout_s: float | None = None,
    progress: bool | None = None,
    stated: SourceOptions | None = None,
) -> Table:
    """Do a work for every recording with every set of options.

    Jobs that are done are not done again: the name of a result is made of the
    recording's content, the options, the work and the version.  So an interrupted run
    continues when it is called again, and two runs at the same time share the jobs.  A
    job that fails or crashes its process becomes a row with its error; the next run
    tries it again.

    Parameters
    ----------
    recordings : iterable of path
        Paths; an iterator is consumed as jobs are submitted.
    jobs : FusionOptions, or iterable of FusionOptions
        Every recording is processed with each of them.
    out : path
        Folder for the results, or a URL in object storage, which all workers must be
        able to reach.  It receives ``NAME/`` and ``NAME.json`` for each job,
        ``summary.csv`` and ``index.html``.
    work : str or Work
        One of ``WORKS``, or a function ``(recording, options, folder)`` of a module of
        your own, which writes files into `folder` and returns figures for the table,
        or None.
    executor : str, Executor or callable, optional
        ``"process"`` (default), ``"dask:tcp://HOST:PORT"`` or ``"MODULE:FUNCTION"``; a
        `concurrent.futures.Executor`; or a function that makes one, which is called
        again if it breaks.
    workers : int, optional
        Number of workers; default: one per core, or what the executor has.
    retries : int
        Number of further attempts at a job that failed.  Errors that would come again,
        such as a damaged header, are not retried.
    timeout_s : float, optional
        Time limit of each job, seconds; in processes only, not in threads.
    progress : bool, optional
        Show progress on standard error; default: only on a terminal.
    stated : SourceOptions, optional
        What is stated about every recording.

    Returns
    -------
    Table
        One row per job, in the order of the jobs.

    Raises
    ------
    ValueError
        If `work` or `executor` is unknown, or a number is out of range.
    OSError
        If the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pdavis_cv import FusionOptions, batch
    >>> from pdavis_cv.data import example_recording
    >>> with tempfile.TemporaryDirectory() as out:
    ...     table = batch.run(
    ...         [example_recording()], [FusionOptions(method="cf", layout="pdavis")],
    ...         out, work=batch.Trace(stop_s=0.1), workers=1)
    ...     [row["state"] for row in table]
    ['done']
    """
    if retries < 0 or (workers is not None and workers < 1):
        raise ValueError(
            f"retries must be at least 0 and workers at least 1, got {retries} and "
            f"{workers}")
    if timeout_s is not None and not timeout_s > 0:
        raise ValueError(f"timeout_s must be positive, got {timeout_s}")
    results = results_at(out)
    results.begin()
    every = [jobs] if isinstance(jobs, FusionOptions) else list(jobs)
    total = (len(recordings) * len(every)  # type: ignore[arg-type]
             if hasattr(recordings, "__len__") else None)
    from tqdm import tqdm

    with tqdm(total=total, unit=" jobs", leave=False,
              disable=None if progress is None else not progress) as bar:
        batch = _Batch(
            results, pool_factory(executor, workers), retries, timeout_s, bar)
        batch.run(_planned(recordings, every, results, work_of(work), stated))
    table = Table(results, batch.names, batch.unwritten)
    try:
        table.write()
    except OSError as error:
        warnings.warn(f"{error.filename}: the table was not written: {error.strerror}",
                      PdavisWarning, stacklevel=3)
    return table


def plan(
    recordings: Iterable[str | os.PathLike[str]],
    jobs: FusionOptions | Iterable[FusionOptions],
    out: str | os.PathLike[str],
    *,
    work: str | Work = "export",
    stated: SourceOptions | None = None,
) -> Iterator[tuple[Job, bool]]:
    """Yield each job that `run` would do, and whether it is already done.

    Parameters
    ----------
    recordings, jobs, out, work, stated
        As for `run`; nothing is written.

    Yields
    ------
    (Job, bool)
    """
    results = results_at(out)
    every = [jobs] if isinstance(jobs, FusionOptions) else list(jobs)
    for job in _planned(recordings, every, results, work_of(work), stated):
        yield job, results.is_done(job.name)


def _planned(
    recordings: Iterable[str | os.PathLike[str]], jobs: list[FusionOptions],
    results: Results, work: Work, stated: SourceOptions | None,
) -> Iterator[Job]:
    opens = getattr(work, "opens", True)
    for recording in recordings:
        path = os.fspath(recording)
        identity = results.identity(path) if opens else path
        for options in jobs:
            yield Job(path, identity, options, work, stated or SourceOptions())


@dataclass(eq=False)
class _Attempt:
    """An attempt at a job, `alone` if no other job may run at the same time.

    That is so after a process died while this job was submitted: it shows whether this
    job was the cause.
    """

    job: Job
    claim: Claim
    number: int = 1
    alone: bool = False


class _Batch:
    """Submit jobs, collect their rows, and resubmit those that have to be repeated.

    `make` makes a Pool; the bar shows how many jobs have ended.  `names` are those of
    the jobs so far, in order; `unwritten` the rows whose marker could not be written,
    by name of the job.
    """

    def __init__(
        self, results: Results, make: Callable[[], Pool], retries: int,
        timeout_s: float | None, bar: Any,
    ) -> None:
        self._results, self._make, self._bar = results, make, bar
        self._failed = 0
        self._retries, self._timeout_s = retries, timeout_s
        self.names: list[str] = []
        self.unwritten: dict[str, Row] = {}
        self._pool: Pool | None = None
        self._pending: dict[Future[tuple[Row, bool]], _Attempt] = {}
        self._again: deque[_Attempt] = deque()
        self._suspects: deque[_Attempt] = deque()
        self._elsewhere: list[Job] = []     # claimed by another run

    def run(self, plan: Iterator[Job]) -> None:
        """Do every job of a plan."""
        fresh = self._claimed(plan)
        try:
            while True:
                self._fill(fresh)
                if self._pending:
                    finished, _ = wait(
                        self._pending, _POLL_S, return_when=FIRST_COMPLETED)
                    for future in [one for one in self._pending if one in finished]:
                        self._collect(future)
                elif self._elsewhere:
                    time.sleep(_POLL_S)
                    fresh = self._claimed(iter(self._elsewhere), listed=True)
                    self._elsewhere = []
                else:
                    break
                self._bar.refresh()     # so that its clock runs between jobs
        except BaseException:
            self._close(at_once=True)
            raise
        else:
            self._close(at_once=False)
        finally:
            for attempt in (*self._pending.values(), *self._again, *self._suspects):
                attempt.claim.release()

    def _claimed(
        self, plan: Iterator[Job], *, listed: bool = False
    ) -> Iterator[_Attempt]:
        """Claim and yield the jobs that are neither done nor claimed by another run."""
        known = set(self.names)
        for job in plan:
            if not listed:
                if job.name in known:
                    self._count(DONE)   # two recordings of equal content
                    continue
                known.add(job.name)
                self.names.append(job.name)
            claim = None if self._results.is_done(job.name) else (
                self._results.claim(job.name))
            # Another run may have finished the job just before it released its claim.
            if claim is None and not self._results.is_done(job.name):
                self._elsewhere.append(job)
            elif claim is None or self._results.is_done(job.name):
                if claim is not None:
                    claim.release()
                self._count(DONE)
            else:
                self._results.clean(job.name)
                yield _Attempt(job, claim)

    def _fill(self, fresh: Iterator[_Attempt]) -> None:
        """Submit jobs until all workers are busy; suspects one at a time."""
        while True:
            if self._suspects:
                if self._pending:
                    return
                attempt = self._suspects.popleft()
            elif any(one.alone for one in self._pending.values()):
                return
            elif self._pool is not None and (
                    len(self._pending) >= _PER_WORKER * self._pool.workers):
                return
            else:
                found = self._again.popleft() if self._again else next(fresh, None)
                if found is None:
                    return
                attempt = found
            self._submit(attempt)

    def _submit(self, attempt: _Attempt) -> None:
        if self._pool is None:
            self._pool = self._make()
        try:
            future = self._pool.executor.submit(
                perform, attempt.job, str(self._results.out),
                timeout_s=self._timeout_s, attempt=attempt.number)
        except BrokenExecutor:
            self._suspects.append(attempt)
            self._recover()
        else:
            self._pending[future] = attempt

    def _collect(self, future: Future[tuple[Row, bool]]) -> None:
        """Take the row of a finished future, or arrange for another attempt."""
        attempt = self._pending.pop(future, None)
        if attempt is None:
            return                      # `_recover` has already removed it
        try:
            row, again = future.result()
        except BrokenExecutor:
            if attempt.alone or not self._pending:
                self._blame(attempt)
            else:
                self._suspects.append(attempt)
            self._recover()
            return
        except Exception as error:      # of the executor, e.g. while pickling the job
            row = failed_row(attempt.job, attempt.number,
                             f"{type(error).__name__}: {error}")
            again = not isinstance(error, TypeError | AttributeError)
            self._mark(row)
        if row["state"] == FAILED and again and attempt.number <= self._retries:
            attempt.number += 1
            self._again.append(attempt)
            return
        self._end(attempt, row)

    def _end(self, attempt: _Attempt, row: Row) -> None:
        name = attempt.job.name
        found = self._results.marker(name)
        if found is None or found["row"]["state"] != row["state"]:
            self.unwritten[name] = row
        attempt.claim.release()
        self._count(row["state"])

    def _count(self, state: str) -> None:
        """Count a job that has ended."""
        self._failed += state != DONE
        if self._failed:
            self._bar.set_postfix_str(f"{self._failed} failed", refresh=False)
        self._bar.update()
        self._bar.refresh()

    def _blame(self, attempt: _Attempt) -> None:
        """Record that a process died while it did this job and no other."""
        if attempt.number <= self._retries:
            attempt.number, attempt.alone = attempt.number + 1, True
            self._suspects.append(attempt)
            return
        row = failed_row(
            attempt.job, attempt.number,
            "the process that did it died: killed, out of memory, or crashed")
        self._mark(row)
        self._end(attempt, row)

    def _mark(self, row: Row) -> None:
        with contextlib.suppress(OSError):
            self._results.mark(row["name"], {"row": row, "provenance": {}})

    def _recover(self) -> None:
        """Take back the jobs of a broken executor; each is repeated alone."""
        finished, _ = wait(self._pending, _BROKEN_WAIT_S)
        kept = {future: self._pending[future] for future in finished
                if future.cancelled() or not isinstance(
                    future.exception(), BrokenExecutor)}
        self._suspects += [attempt for future, attempt in self._pending.items()
                           if future not in kept]
        for attempt in self._suspects:
            attempt.alone = True
            self._results.clean(attempt.job.name)
        self._pending = kept
        self._close(at_once=True)

    def _close(self, at_once: bool) -> None:
        pool, self._pool = self._pool, None
        if at_once:
            for future in self._pending:
                future.cancel()
        if pool is not None:
            pool.close(at_once)
