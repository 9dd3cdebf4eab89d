"""Python's search for cyclic garbage, kept short while live sessions run."""
from __future__ import annotations

import gc
import math
import threading
import time
from types import TracebackType
from typing import Self

__all__ = ["ShortSearches"]

SETTLED_S = 5.0
"""Time after which a session has imported all modules and made all lasting objects, s:
its first estimate of the camera is started at 0.5 s.  Engineering choice."""

_LOCK = threading.Lock()
_running = 0        # blocks of all threads
_ours = False       # whether the objects left out are those of these blocks


class ShortSearches:
    """Leaves lasting objects out of Python's search for cyclic garbage, in a block.

    A full search holds Python's lock for 0.3 to 0.6 us per object: 17 to 37 ms in a
    program with NumPy and SciPy, by which an image would be late.  What becomes cyclic
    garbage among the objects left out is freed after the block.  Nothing is done if the
    program leaves out objects itself (`gc.freeze`).

    Parameters
    ----------
    active : bool
        False: the block does nothing.
    """

    def __init__(self, active: bool = True) -> None:
        self._active = active
        self._due_s = math.inf

    def __enter__(self) -> Self:
        global _running, _ours
        if self._active:
            with _LOCK:
                if not _running:
                    _ours = not gc.get_freeze_count()
                _running += 1
            _leave_out()
            self._due_s = time.monotonic() + SETTLED_S
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        global _running
        if self._active:
            with _LOCK:
                _running -= 1
                if _ours and not _running:
                    gc.unfreeze()

    def go_on(self) -> None:
        """Leave out what has been made since, once the session has settled."""
        if time.monotonic() >= self._due_s:
            self._due_s = math.inf
            _leave_out()


def _leave_out() -> None:
    with _LOCK:
        if _ours:
            gc.collect()        # what is garbage by now is not kept
            gc.freeze()
