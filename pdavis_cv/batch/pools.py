"""Pools that run the jobs: processes started here, or any Executor."""
from __future__ import annotations

import importlib
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from pdavis_cv._packages import package
from pdavis_cv._workers import usable_cores

EXECUTORS = "process, dask:tcp://HOST:PORT or MODULE:FUNCTION"
"""The texts that `pool_factory` accepts, for error messages."""
_UNKNOWN = 32
"""Number of workers assumed for an executor that does not tell it."""


@dataclass(frozen=True)
class Pool:
    """A running executor, which runs so many jobs at a time.

    `close` shuts it down; called with True, it stops running jobs as well.
    """

    executor: Executor
    workers: int
    close: Callable[[bool], None]


def pool_factory(
    executor: str | Executor | Callable[[], Executor] | None, workers: int | None
) -> Callable[[], Pool]:
    """Return a function that makes a pool; it is called again if the pool breaks.

    An Executor that is given is not shut down here, and is replaced by a process pool
    if it breaks; a function makes one; a text is one of `EXECUTORS`.  A pool that is
    made here has a worker per core, or `workers`.
    """
    count = workers or usable_cores()
    if executor is None or executor == "process":
        return lambda: _process_pool(count)
    if isinstance(executor, Executor):
        given: list[Pool] = [Pool(
            executor, workers or _workers_of(executor), lambda at_once: None)]
        return lambda: given.pop() if given else _process_pool(count)
    if callable(executor):
        return lambda: _executor_pool(executor(), workers)
    kind, _, rest = executor.partition(":")
    if not rest:
        raise ValueError(f"executor must be {EXECUTORS}, got {executor!r}")
    if kind == "dask":
        return lambda: _dask_pool(rest, workers)
    try:
        function = getattr(importlib.import_module(kind), rest)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"executor must be {EXECUTORS}, got {executor!r}: {error}") from None
    return lambda: _executor_pool(function(), workers)


def _process_pool(count: int) -> Pool:
    # Imported late: a run that finds every job done needs no processes.
    from pdavis_cv.batch.processes import ProcessPool

    pool = ProcessPool(count)
    return Pool(pool, count, pool.close)


def _workers_of(executor: Executor) -> int:
    return int(getattr(executor, "_max_workers", None) or _UNKNOWN)


def _executor_pool(executor: Executor, workers: int | None) -> Pool:
    def close(at_once: bool) -> None:
        executor.shutdown(wait=not at_once, cancel_futures=at_once)

    return Pool(executor, workers or _workers_of(executor), close)


def _dask_pool(address: str, workers: int | None) -> Pool:
    """Return a pool on the cluster at an address."""
    distributed = package("distributed", "executor dask needs the extra [batch]: pip "
                          "install 'dask[distributed]'")
    client = distributed.Client(address)
    # With pure=True, Dask would return cached rows instead of repeating a job.
    executor = client.get_executor(pure=False)
    count = workers or sum(client.ncores().values()) or _UNKNOWN

    def close(at_once: bool) -> None:
        executor.shutdown(wait=not at_once)
        client.close()

    return Pool(executor, count, close)
