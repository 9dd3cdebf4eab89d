"""Threads that share the rows of an image."""
from __future__ import annotations

import contextlib
import math
import os
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

from pdavis_cv._kernels import ImageQueue

__all__ = ["LEAST_BAND_NS", "SpareTime", "Workers", "take_turn", "usable_cores",
           "yield_to_others"]

LEAST_ROWS = 16
"""Smallest band, in rows, of work whose cost depends on what the pixels see."""

LEAST_BAND_NS = 300_000
"""Least time of a band, ns: three times what passes until a waiting thread works and
its end is noticed (65,000 to 130,000 were measured on two virtual cores)."""


_LOW = 10
"""Nice value of threads whose work can wait.  Engineering choice.  With Linux's policy
SCHED_IDLE in its place, live images come more regularly on a quiet machine (at most 40
to 50 ms after each other, not 50 to 70), but up to 1 s late beside a busy program: the
thread then holds Python's lock and does not get to run."""

_PATIENCE = 4.0
"""Longest wait for spare time, relative to what the work before it took, so that work
that can wait gets a fifth of a core at least.  Engineering choice."""

_mine = threading.local()

Item = TypeVar("Item")


class Workers:
    """Threads that process bands of an image's rows in parallel.

    This is faster because kernels release the GIL.  The work must give the same result
    however rows are grouped into bands, so that it does not depend on the number of
    threads.

    Parameters
    ----------
    threads : int
        1 = the calling thread only.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = threads
        self._pool: tuple[int, ThreadPoolExecutor] | None = None
        self._queue: tuple[int, ImageQueue] | None = None
        self._end: Callable[[], object] = _nothing

    @property
    def queue(self) -> ImageQueue | None:
        """Queue of the second of two threads, which is started if there is none.

        None for one thread and for more than two.  The thread stays in compiled code
        and never asks for Python's lock.  Under Linux it is kept off the core of the
        thread that it helps.
        """
        if self.threads != 2:
            return None
        # A forked child has the parent's objects, but not its threads.
        if self._queue is not None and self._queue[0] != os.getpid():
            self._queue[1].finish_here()
            self._queue = None
        if self._queue is None:
            queue = ImageQueue()
            thread = threading.Thread(
                target=queue.serve, name="pdavis_cv-images", daemon=True)
            thread.start()
            self._queue = os.getpid(), queue
            self._end = weakref.finalize(self, _end, queue, thread)
        return self._queue[1]

    def wait(self, queue: ImageQueue, number: int) -> None:
        """Return when the image of a number, posted to `queue`, has been finished."""
        if self._queue is not None and self._queue[0] != os.getpid():
            queue.finish_here()
        queue.wait(number)

    def end(self) -> None:
        """End the queue's thread; it may still finish images that nobody waits for."""
        self._end()
        self._queue = None

    def rows(
        self, height: int, work: Callable[[int, int], object], least: int = LEAST_ROWS,
        row_ns: float | None = None,
    ) -> None:
        """Call work(first, last) for bands that together make up an image's rows.

        Returns when all bands are done; an exception in one of them is raised here.

        Parameters
        ----------
        height : int
            Height of the image.
        work : callable
            Processes the rows first <= row < last.
        least : int
            Smallest number of rows per band.
        row_ns : float, optional
            Time that a row takes, ns, of work that costs the same whatever the pixels
            see: bands then take `LEAST_BAND_NS` at least.
        """
        if row_ns is not None:
            least = max(least, math.ceil(LEAST_BAND_NS / row_ns))
        n = min(self.threads, height // least)
        if n < 2:
            work(0, height)
            return
        (_, own), *others = pairwise(height * i // n for i in range(n + 1))
        pool = self._started()
        waiting = [pool.submit(work, first, last) for first, last in others]
        try:
            work(0, own)
        finally:
            try:
                for one in waiting:
                    one.result()
            finally:        # else an exception and what it came through keep each other
                del waiting, one

    def shared(
        self, height: int, work: Callable[[int, int, tuple[int, bool]], object],
        least: int = LEAST_ROWS, row_ns: float | None = None,
    ) -> None:
        """Do as `rows`; of two threads, the second one is that of `queue`.

        Parameters
        ----------
        work : callable
            Receives first, last, and the kernel's argument ``team``.
        height, least, row_ns
            As for `rows`.
        """
        if self.threads == 2:
            self.together(lambda team: work(0, height, team),
                          None if row_ns is None else height * row_ns)
        else:
            self.rows(height, lambda first, last: work(first, last, (0, False)), least,
                      row_ns)

    def together(
        self, work: Callable[[tuple[int, bool]], Item], ns: float | None = None
    ) -> Item:
        """Return work(team) of a kernel that cannot be called for bands.

        Parameters
        ----------
        work : callable
            Receives the kernel's argument ``team``.
        ns : float, optional
            Time that it takes, ns, if it is known.
        """
        queue = self.queue
        return work((0, False) if queue is None else (
            queue.team, ns is None or ns > 2 * LEAST_BAND_NS))

    def _started(self) -> ThreadPoolExecutor:
        # A forked child has the parent's objects, but not its threads.
        if self._pool is None or self._pool[0] != os.getpid():
            self._pool = os.getpid(), ThreadPoolExecutor(
                self.threads - 1, "pdavis_cv-rows")
        return self._pool[1]

    def __reduce__(self) -> tuple[type[Workers], tuple[int]]:
        return Workers, (self.threads,)


def _nothing() -> None:
    """Do what there is to do before a thread has been started."""


def _end(queue: ImageQueue, thread: threading.Thread) -> None:
    queue.end()
    if thread is not threading.current_thread():
        thread.join()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SpareTime:
    """The time in which a thread waits for data, left to threads whose work can wait.

    Without it they take cores, caches and Python's lock in turns with that thread,
    whatever their priority.
    """

    def __init__(self) -> None:
        self._spare = threading.Event()
        self._spare.set()

    def of(self, items: Iterator[Item]) -> Iterator[Item]:
        """Iterate over items: it is spare time while the next one is waited for."""
        try:
            while True:
                self._spare.set()
                item = next(items, None)
                self._spare.clear()
                if item is None:
                    return
                yield item
        finally:
            self.end()

    def end(self) -> None:
        """Make all time spare from now on."""
        self._spare.set()

    def wait(self, longest_s: float) -> None:
        """Wait for spare time, at most for longest_s."""
        self._spare.wait(longest_s)


def yield_to_others(spare: SpareTime | None = None) -> None:
    """Let all other threads go first on busy cores, where threads have a priority.

    Parameters
    ----------
    spare : SpareTime, optional
        Of the thread that matters most; `take_turn` then waits for it.
    """
    _mine.spare, _mine.resumed_s = spare, time.perf_counter()
    if sys.platform == "linux":
        with contextlib.suppress(OSError):      # a sandbox may forbid it
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOW)


def take_turn() -> None:
    """Wait for spare time before the next piece of work, in a thread that yields."""
    spare = getattr(_mine, "spare", None)
    if spare is not None:
        spare.wait(_PATIENCE * (time.perf_counter() - _mine.resumed_s))
        _mine.resumed_s = time.perf_counter()
