"""Show stages and progress bars, on a terminal or with --progress."""
from __future__ import annotations

import argparse
import contextlib
import sys
import threading
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from typing import Any, ClassVar

ALWAYS: ContextVar[bool] = ContextVar("ALWAYS", default=False)
"""Whether --progress was given to this command or to the one that calls it."""
QUIET: ContextVar[bool] = ContextVar("QUIET", default=False)
_EVERY_S = 4    # interval of messages during a stage; a choice


class AlwaysProgress(argparse.Action):
    """Store --progress in `ALWAYS`, which stages and bars read."""

    def __call__(self, *_: Any) -> None:
        ALWAYS.set(True)


@contextlib.contextmanager
def own_progress() -> Iterator[None]:
    """Limit the effect of --progress to one command and those that it calls."""
    before = ALWAYS.set(ALWAYS.get())
    try:
        yield
    finally:
        _Stage.end()
        ALWAYS.reset(before)


def _shown(**options: Any) -> dict[str, Any]:
    """Return tqdm's options, to show bars on a terminal or with --progress."""
    if QUIET.get():
        return {"disable": True, **options}
    if ALWAYS.get():
        return {"disable": False, "mininterval": 1.0, **options}
    return {"disable": None, **options}


def progress(items: Iterable[Any], total: int | None, unit: str) -> Iterator[Any]:
    """Show the progress of an iteration, on a terminal or with --progress."""
    from tqdm import tqdm
    for item in tqdm(items, **_shown(total=total, unit=f" {unit}", leave=False)):
        _Stage.end()
        yield item


def progress_in_time(
    packets: Iterable[Any], start_us: int | None, stop_us: int | None
) -> Iterator[Any]:
    """Yield packets and show the time that they have reached.

    Without `stop_us`, the recording's end, the remaining time is unknown.
    """
    from tqdm import tqdm
    start, total = start_us, None
    if start_us is not None and stop_us is not None:
        total = round((stop_us - start_us) / 1e6, 3)
    with tqdm(**_shown(total=total, unit=" s", leave=False)) as bar:
        for packet in packets:
            yield packet
            start = packet.start_us if start is None else start
            bar.update(max((packet.start_us - start) / 1e6 - bar.n, 0.0))


class _Stage:
    """A stage before there is progress; prints its duration every few seconds."""

    now: ClassVar[_Stage | None] = None

    def __init__(self, what: str) -> None:
        self._what, self._over = what, threading.Event()
        threading.Thread(target=self._tell, name="stage", daemon=True).start()

    def _tell(self) -> None:
        seconds = 0
        while not self._over.wait(_EVERY_S):
            seconds += _EVERY_S
            print(f"pdavis: {self._what}: {seconds} s", file=sys.stderr, flush=True)

    @classmethod
    def end(cls) -> None:
        """End the stage under way, if there is one."""
        if cls.now is not None:
            cls.now._over.set()
            cls.now = None


def stage(what: str) -> None:
    """Show the name of a stage, where `progress` would show a bar."""
    _Stage.end()
    if QUIET.get():
        return
    if ALWAYS.get() or (sys.stderr is not None and sys.stderr.isatty()):
        print(f"pdavis: {what} ...", file=sys.stderr, flush=True)
        _Stage.now = _Stage(what)
