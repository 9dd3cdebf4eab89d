"""run(): hands jobs to an executor and sees that each one ends in a row."""
from __future__ import annotations

import contextlib
import os
import platform
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    wait,
)
from dataclasses import dataclass
from typing import Any

from pdavis_cv.batch.jobs import Job, Work
from pdavis_cv.batch.pools import Pool, maker_of
from pdavis_cv.batch.results import DONE, FAILED, Claim, Results, results_at
from pdavis_cv.batch.table import Table
from pdavis_cv.batch.worker import Row, failed_row, perform
from pdavis_cv.batch.works import work_of
from pdavis_cv.errors import PdavisWarning
from pdavis_cv.fusion.options import FusionOptions

__all__ = ["plan", "run"]

_PER_WORKER = 2     # jobs submitted for each worker: the next one waits at its side
_LOOK_S = 0.5       # how often the run looks round while nothing happens
_PATIENCE_S = 10.0  # for what a broken executor still has to say
_TELL_S = 1.0       # how often it says how far it is


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
) -> Table:
    """Do a work with every recording and every set of options.

    What was done before is not done again, whether this run or another one did it:
    results have names made of the recording's content, the options, the work and the
    version.  So an interrupted run is called again to go on, and two at once share
    the jobs.  A job that fails, or brings its process down, is a row with its error;
    the next run tries it again.

    Parameters
    ----------
    recordings : iterable of path
        Read when it is their turn; an iterator may be long.
    jobs : FusionOptions, or iterable of FusionOptions
        Each recording is fused with each.
    out : path
        Folder of the results, or with a scheme their place in object storage; all
        workers must see it.  Holds ``NAME/`` and ``NAME.json`` for each job,
        ``summary.csv`` and ``index.html``.
    work : str or Work
        One of ``WORKS`` or a function of your own module:
        ``(recording, options, folder)`` writes files into `folder` and returns
        figures for the table, or None.
    executor : str, Executor or callable, optional
        ``"process"`` (default), ``"loky"``, ``"dask"`` (a cluster of this machine),
        ``"dask:tcp://HOST:PORT"``, ``"MODULE:FUNCTION"``; any
        `concurrent.futures.Executor`; or a function that makes one, called again
        should it break.
    workers : int, optional
        Default: one per core, or what the executor has.
    retries : int
        How often a job that failed is tried again; not after errors that the same
        input will meet again, such as a damaged header.
    timeout_s : float, optional
        Of each job, seconds.
    progress : bool, optional
        Show it on standard error; default: if that is a terminal.

    Returns
    -------
    Table
        A row per job, in their order.

    Raises
    ------
    ValueError
        If `work` or `executor` is another word, or a number is out of range.
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
    batch = _Batch(results, maker_of(executor, workers), retries, timeout_s)
    with _shown(total, progress) as show:
        batch.go(_planned(recordings, every, results, work_of(work)),
                 _Told(results, total, show))
    table = Table(results, batch.names, batch.unwritten)
    try:
        table.write()
    except OSError as error:
        warnings.warn(f"{error.filename}: the table was not written: {error.strerror}",
                      PdavisWarning, stacklevel=2)
    return table


def plan(
    recordings: Iterable[str | os.PathLike[str]],
    jobs: FusionOptions | Iterable[FusionOptions],
    out: str | os.PathLike[str],
    *,
    work: str | Work = "export",
) -> Iterator[tuple[Job, bool]]:
    """Yield each job that `run` would have, and whether it is done already.

    Parameters
    ----------
    recordings, jobs, out, work
        As for `run`; nothing is written.

    Yields
    ------
    (Job, bool)
    """
    results = results_at(out)
    every = [jobs] if isinstance(jobs, FusionOptions) else list(jobs)
    for job in _planned(recordings, every, results, work_of(work)):
        yield job, results.is_done(job.name)


def _planned(
    recordings: Iterable[str | os.PathLike[str]], jobs: list[FusionOptions],
    results: Results, work: Work,
) -> Iterator[Job]:
    opens = getattr(work, "opens", True)
    for recording in recordings:
        path = os.fspath(recording)
        identity = results.identity(path) if opens else path
        for options in jobs:
            yield Job(path, identity, options, work)


@dataclass(eq=False)
class _Attempt:
    """A job that is being done.

    Attributes
    ----------
    alone : bool
        Among those that were there when a process died; done singly, it shows
        whether it was the one.
    """

    job: Job
    claim: Claim
    number: int = 1
    alone: bool = False


class _Batch:
    """The jobs that are in an executor's hands, and those that have to go back there.

    Parameters
    ----------
    results : Results
    make : callable
        Makes a pool.
    retries : int
    timeout_s : float or None

    Attributes
    ----------
    names : list of str
        Of the jobs so far, in their order.
    unwritten : dict of str to Row
        Rows whose marker could not be written, by name.
    """

    def __init__(
        self, results: Results, make: Callable[[], Pool], retries: int,
        timeout_s: float | None,
    ) -> None:
        self._results, self._make = results, make
        self._retries, self._timeout_s = retries, timeout_s
        self.names: list[str] = []
        self.unwritten: dict[str, Row] = {}
        self._pool: Pool | None = None
        self._pending: dict[Future[tuple[Row, bool]], _Attempt] = {}
        self._again: deque[_Attempt] = deque()
        self._suspects: deque[_Attempt] = deque()
        self._elsewhere: list[Job] = []     # claimed by another run

    def go(self, plan: Iterator[Job], told: _Told) -> None:
        """Do every job of a plan."""
        fresh = self._fresh(plan, told)
        try:
            while True:
                self._fill(fresh)
                if self._pending:
                    finished, _ = wait(
                        self._pending, _LOOK_S, return_when=FIRST_COMPLETED)
                    for future in [one for one in self._pending if one in finished]:
                        self._settle(future, told)
                elif self._elsewhere:
                    time.sleep(_LOOK_S)
                    fresh = self._fresh(iter(self._elsewhere), told, listed=True)
                    self._elsewhere = []
                else:
                    break
                told.now(len(self._pending))
        except BaseException:
            self._close(at_once=True)
            raise
        else:
            self._close(at_once=False)
        finally:
            for attempt in (*self._pending.values(), *self._again, *self._suspects):
                attempt.claim.release()
            told.end()

    def _fresh(
        self, plan: Iterator[Job], told: _Told, *, listed: bool = False
    ) -> Iterator[_Attempt]:
        """Yield those that are neither done nor in the hands of another run."""
        known = set(self.names)
        for job in plan:
            if not listed:
                if job.name in known:
                    told.count(DONE)    # the same content twice
                    continue
                known.add(job.name)
                self.names.append(job.name)
            claim = None if self._results.is_done(job.name) else (
                self._results.claim(job.name))
            # Another run may have done it just before it let go.
            if claim is None and not self._results.is_done(job.name):
                self._elsewhere.append(job)
            elif claim is None or self._results.is_done(job.name):
                if claim is not None:
                    claim.release()
                told.count(DONE)
            else:
                self._results.clean(job.name)
                yield _Attempt(job, claim)

    def _fill(self, fresh: Iterator[_Attempt]) -> None:
        """Submit as many as there is room for; suspects one at a time."""
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

    def _settle(self, future: Future[tuple[Row, bool]], told: _Told) -> None:
        attempt = self._pending.pop(future, None)
        if attempt is None:
            return                      # `_recover` has taken it back
        try:
            row, again = future.result()
        except BrokenExecutor as error:
            if attempt.alone or not self._pending:
                self._guilty(attempt, error, told)
            else:
                self._suspects.append(attempt)
            self._recover()
            return
        except Exception as error:      # of the executor: it could not be sent, ...
            row = failed_row(attempt.job, attempt.number,
                             f"{type(error).__name__}: {error}")
            again = not isinstance(error, TypeError | AttributeError)
            self._mark(row)
        if row["state"] == FAILED and again and attempt.number <= self._retries:
            attempt.number += 1
            self._again.append(attempt)
            return
        self._end(attempt, row, told)

    def _end(self, attempt: _Attempt, row: Row, told: _Told) -> None:
        name = attempt.job.name
        found = self._results.marker(name)
        if found is None or found["row"]["state"] != row["state"]:
            self.unwritten[name] = row
        attempt.claim.release()
        told.count(row["state"])

    def _guilty(self, attempt: _Attempt, error: Exception, told: _Told) -> None:
        """Note that a process died of this job, which had it for itself."""
        if attempt.number <= self._retries:
            attempt.number, attempt.alone = attempt.number + 1, True
            self._suspects.append(attempt)
            return
        row = failed_row(
            attempt.job, attempt.number,
            "the process that did it died: killed, out of memory, or crashed")
        self._mark(row)
        self._end(attempt, row, told)

    def _mark(self, row: Row) -> None:
        with contextlib.suppress(OSError):
            self._results.mark(row["name"], {"row": row, "provenance": {}})

    def _recover(self) -> None:
        """Take back what a broken executor held; each is to be done singly."""
        finished, _ = wait(self._pending, _PATIENCE_S)
        kept = {future: self._pending[future] for future in finished
                if not isinstance(_failure(future), BrokenExecutor)}
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


def _failure(future: Future[Any]) -> BaseException | None:
    return None if future.cancelled() else future.exception()


# ---- how far it is ---------------------------------------------------------------


class _Told:
    """Says how far a run is: to `show`, and in a file to `batch.status`."""

    def __init__(
        self, results: Results, total: int | None, show: Callable[[int, int], None]
    ) -> None:
        self._show, self._total = show, total
        host = platform.node()
        self._results, self._run = results, f"{host}-{os.getpid()}-{id(self):x}"
        self._done = self._failed = 0
        self._told_s = 0.0
        self._facts = {"host": host, "pid": os.getpid(), "total": total,
                       "started_s": time.time()}
        self.now(0)

    def count(self, state: str) -> None:
        """Count a job that has ended."""
        self._done += state == DONE
        self._failed += state != DONE
        self._show(self._done, self._failed)

    def now(self, running: int) -> None:
        """Say it, unless it was said a moment ago."""
        if time.monotonic() - self._told_s < _TELL_S:
            return
        self._told_s = time.monotonic()
        with contextlib.suppress(OSError):
            self._results.tell(self._run, {
                **self._facts, "done": self._done, "failed": self._failed,
                "running": running, "seen_s": time.time()})

    def end(self) -> None:
        """Say no more."""
        with contextlib.suppress(OSError):
            self._results.forget(self._run)


@contextlib.contextmanager
def _shown(
    total: int | None, wanted: bool | None
) -> Iterator[Callable[[int, int], None]]:
    from tqdm import tqdm

    with tqdm(total=total, unit=" jobs", leave=False,
              disable=None if wanted is None else not wanted) as bar:
        def show(done: int, failed: int) -> None:
            bar.update(done + failed - bar.n)
            if failed:
                bar.set_postfix_str(f"{failed} failed", refresh=False)
            bar.refresh()   # jobs may be long, and the clock shall go on

        yield show
