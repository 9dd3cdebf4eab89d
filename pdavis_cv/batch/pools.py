"""What runs the jobs: processes of our own, or anybody's Executor."""
from __future__ import annotations

import importlib
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from pdavis_cv._workers import usable_cores

__all__ = ["EXECUTORS", "Pool", "maker_of"]

EXECUTORS = "process, loky, dask, dask:tcp://HOST:PORT or MODULE:FUNCTION"
"""What `maker_of` takes, in words."""
_UNKNOWN = 32
"""Workers that an executor is taken to have, if it does not say."""


@dataclass(frozen=True)
class Pool:
    """An executor at work.

    Parameters
    ----------
    executor : Executor
    workers : int
        How many jobs it does at a time.
    close : callable
        Called with whether to end at once, in the middle of jobs.
    """

    executor: Executor
    workers: int
    close: Callable[[bool], None]


def maker_of(
    executor: str | Executor | Callable[[], Executor] | None, workers: int | None
) -> Callable[[], Pool]:
    """Return what makes a pool, and another one when that has broken.

    Parameters
    ----------
    executor : str, Executor or callable, optional
        One of `EXECUTORS`; an Executor, which stays its owner's to shut down and is
        followed by a process pool should it break; or a function that makes one.
    workers : int, optional
        How many, of what is made here; default: one per core.
    """
    count = workers or usable_cores()
    if executor is None or executor == "process":
        return lambda: _own(count)
    if isinstance(executor, Executor):
        given: list[Pool] = [Pool(
            executor, workers or _workers_of(executor), lambda at_once: None)]
        return lambda: given.pop() if given else _own(count)
    if callable(executor):
        return lambda: _foreign(executor(), workers)
    if executor == "loky":
        return lambda: _loky(count)
    if executor == "dask":
        return lambda: _dask(None, count)
    kind, _, rest = executor.partition(":")
    if kind == "dask":
        return lambda: _dask(rest, workers)
    if not rest:
        raise ValueError(f"executor must be {EXECUTORS}, got {executor!r}")
    try:
        function = getattr(importlib.import_module(kind), rest)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"executor must be {EXECUTORS}, got {executor!r}: {error}") from None
    return lambda: _foreign(function(), workers)


def _own(count: int) -> Pool:
    # Loads what talks to processes: a run that finds everything done needs none.
    from pdavis_cv.batch.processes import ProcessPool

    pool = ProcessPool(count)
    return Pool(pool, count, pool.close)


def _workers_of(executor: Executor) -> int:
    return int(getattr(executor, "_max_workers", None) or _UNKNOWN)


def _foreign(executor: Executor, workers: int | None) -> Pool:
    def close(at_once: bool) -> None:
        executor.shutdown(wait=not at_once, cancel_futures=at_once)

    return Pool(executor, workers or _workers_of(executor), close)


def _loky(count: int) -> Pool:
    try:
        loky: Any = importlib.import_module("loky")
    except ImportError as error:
        raise ImportError(
            "executor loky needs the extra [batch]: pip install loky") from error
    executor: Executor = loky.get_reusable_executor(max_workers=count, reuse=False)

    def close(at_once: bool) -> None:
        executor.shutdown(wait=True, kill_workers=at_once)  # type: ignore[call-arg]

    return Pool(executor, count, close)


def _dask(address: str | None, workers: int | None) -> Pool:
    """Return a pool on the cluster at an address, or on one of this machine's own."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise ImportError(
            "executor dask needs the extra [batch]: pip install 'dask[distributed]'"
        ) from error
    cluster = distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address=None
    ) if address is None else None
    client = distributed.Client(address if cluster is None else cluster)
    # With pure=True it would hand out rows that it remembers.
    executor = client.get_executor(pure=False)
    count = workers or sum(client.ncores().values()) or _UNKNOWN

    def close(at_once: bool) -> None:
        executor.shutdown(wait=not at_once)
        client.close()
        if cluster is not None:
            cluster.close()

    return Pool(executor, count, close)
