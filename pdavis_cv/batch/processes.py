"""A process pool whose processes end when their parent does."""
from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from pdavis_cv._workers import deaf


class ProcessPool(ProcessPoolExecutor):
    """A process pool that can be stopped at once, and stops when its parent dies.

    A thread of each process waits for the end of a pipe whose other end only the parent
    holds; the system closes it even if the parent is killed.  Processes are started
    afresh, never forked from a parent that may have threads, so a script needs
    ``if __name__ == "__main__"`` around its call.
    """

    def __init__(self, workers: int) -> None:
        methods = multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context(
            "forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            context.set_forkserver_preload(["pdavis_cv.batch.works"])
        self._child_end, self._parent_end = context.Pipe(duplex=False)
        super().__init__(workers, mp_context=context, initializer=_prepare_worker,
                         initargs=(self._child_end,))

    def submit(self, *call: Any, **named: Any) -> Future[Any]:
        """Submit a call; processes that are started for it never get Ctrl-C."""
        with deaf():
            return super().submit(*call, **named)

    def __exit__(self, kind: object, *rest: object) -> None:
        self.close(at_once=kind is not None)

    def close(self, at_once: bool) -> None:
        """End the processes; `at_once` without waiting for the jobs in work."""
        if at_once:
            self._parent_end.close()
        self.shutdown(wait=True, cancel_futures=at_once)
        self._parent_end.close()
        self._child_end.close()


def _prepare_worker(parent: Connection) -> None:
    """Prepare a worker: ignore Ctrl-C, which the parent handles; end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def wait() -> None:
        with contextlib.suppress(EOFError, OSError):
            parent.recv_bytes()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
