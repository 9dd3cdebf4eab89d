"""Processes of this machine that end when their parent does."""
from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["ProcessPool"]


class ProcessPool(ProcessPoolExecutor):
    """Processes that end when their parent does, or says so, whatever they are doing.

    Each waits, in a thread, for the end of a pipe whose other end the parent alone
    holds: the system closes it even if the parent is killed.  They are started afresh
    and never forked from a parent with threads; so a script needs
    ``if __name__ == "__main__"`` around its call.

    Parameters
    ----------
    workers : int
    """

    def __init__(self, workers: int) -> None:
        methods = multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context(
            "forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            context.set_forkserver_preload(["pdavis_cv.batch.works"])
        self._theirs, self._ours = context.Pipe(duplex=False)
        super().__init__(workers, mp_context=context, initializer=_begin,
                         initargs=(self._theirs,))

    def __exit__(self, kind: object, *rest: object) -> None:
        self.close(at_once=kind is not None)

    def close(self, at_once: bool) -> None:
        """End the processes.

        Parameters
        ----------
        at_once : bool
            Do not wait for the jobs that they are at.
        """
        if at_once:
            self._ours.close()
        self.shutdown(wait=True, cancel_futures=at_once)
        self._ours.close()
        self._theirs.close()


def _begin(parent: Connection) -> None:
    """Prepare a worker: Ctrl-C is the parent's, and its end is ours."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def wait() -> None:
        with contextlib.suppress(EOFError, OSError):
            parent.recv_bytes()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
