"""Threads that share the work on images, and what processes of workers need."""
from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from itertools import pairwise
from typing import Generic, TypeVar

LEAST_ROWS = 16
"""Smallest band, in rows, of work whose cost depends on what the pixels see."""

LEAST_BAND_NS = 400_000
"""Least time of a band, ns.  With shorter ones, two threads of an image that is read
ahead gain 1.4 where they gain 1.5: a hand-over takes about 50,000."""

BANDS = 2
"""Bands per thread: a thread that comes late, or gets no processor, takes fewer."""

Result = TypeVar("Result")


_mine = threading.local()


class Begun(Generic[Result]):
    """Work that a thread of the pool does, or who asks for its result.

    Work that no thread has begun when the result is asked for is done then: so nobody
    waits for a thread that is busy with something else.  It may be done twice, as a
    forked child has none of its parent's threads.
    """

    def __init__(self, work: Callable[[], Result], pool: ThreadPoolExecutor) -> None:
        self._work, self._process = work, os.getpid()
        self._future = pool.submit(work)

    def result(self) -> Result:
        """Return the result of the work, or raise its exception."""
        if self._process != os.getpid() or self._future.cancel():
            return self._work()
        try:
            return self._future.result()
        finally:        # else an exception and the frames it came through keep it
            del self

    def end(self) -> None:
        """Return when no thread is at the work, nor will be."""
        if self._process == os.getpid() and not self._future.cancel():
            wait([self._future])


class Workers:
    """Threads that do the parts of an image's work at the same time; one is the caller.

    This is faster because kernels release the GIL.  The work must give the same result
    however rows are grouped into bands, so that it does not depend on the number of
    threads.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = threads
        self._pool: tuple[int, ThreadPoolExecutor] | None = None

    def begin(self, work: Callable[[], Result]) -> Begun[Result]:
        """Let another thread begin work; there must be two at least."""
        # A forked child has the parent's objects, but not its threads.
        if self._pool is None or self._pool[0] != os.getpid():
            self._pool = os.getpid(), ThreadPoolExecutor(
                self.threads - 1, "pdavis_cv-images", setattr, (_mine, "helps", True))
        return Begun(work, self._pool[1])

    def rows(
        self, height: int, work: Callable[[int, int], object], least: int = LEAST_ROWS,
        row_ns: float | None = None,
    ) -> None:
        """Call work(first, last) for bands that together make up an image's rows.

        Returns when all bands are done; an exception in one of them is raised here.  A
        band has at least `least` rows.  `row_ns` is the time that a row takes, of work
        that costs the same whatever the pixels see: bands then take `LEAST_BAND_NS` at
        least.
        """
        if row_ns is not None:
            least = max(least, math.ceil(LEAST_BAND_NS / row_ns))
        n = min(BANDS * self.threads, height // least)
        if n < 2 or self.threads - getattr(_mine, "helps", False) < 2:
            work(0, height)
            return
        bands = list(pairwise(height * i // n for i in range(n + 1)))
        # This thread goes on from the top, the others from the bottom.
        begun = [self.begin(partial(work, *band)) for band in reversed(bands[1:])]
        try:
            work(*bands[0])
            while begun:
                begun.pop().result()
        finally:
            while begun:    # an exception ends the work on what the caller owns
                begun.pop().end()

    def end(self) -> None:
        """End the threads; what is begun later starts others."""
        pool, self._pool = self._pool, None
        if pool is not None and pool[0] == os.getpid():
            pool[1].shutdown(cancel_futures=True)

    def __reduce__(self) -> tuple[type[Workers], tuple[int]]:
        return Workers, (self.threads,)


@contextlib.contextmanager
def deaf() -> Iterator[None]:
    """Let processes that the block starts never get Ctrl-C, even while they load.

    An interrupt of the block waits for its end: else nobody would know of them.
    """
    if not hasattr(signal, "pthread_sigmask"):      # Windows
        yield
        return
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if (
        threading.current_thread() is threading.main_thread()) else ()
    handlers = {number: signal.signal(number, lambda number, _: came.append(number))
                for number in numbers if callable(signal.getsignal(number))}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for one in came:
            signal.raise_signal(one)


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
