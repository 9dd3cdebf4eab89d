"""Stages and bars of progress, on a terminal or where --progress asks for them."""
from __future__ import annotations

import argparse
import contextlib
import sys
import threading
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from typing import Any, ClassVar

__all__ = ["AlwaysProgress", "asked_for", "no_progress", "own_progress", "progress",
           "progress_in_time", "stage"]

_ALWAYS: ContextVar[bool] = ContextVar("_ALWAYS", default=False)
"""Whether --progress was given to this command, or to one that runs it."""
_NEVER: ContextVar[bool] = ContextVar("_NEVER", default=False)
_EVERY_S = 4    # a choice: nobody waits longer for a sign of life


class AlwaysProgress(argparse.Action):
    """Notes --progress at once: stages and bars ask for it wherever they are."""

    def __call__(self, *_: Any) -> None:
        _ALWAYS.set(True)


@contextlib.contextmanager
def own_progress() -> Iterator[None]:
    """Let --progress hold for one command, and for those that it runs."""
    before = _ALWAYS.set(_ALWAYS.get())
    try:
        yield
    finally:
        _Stage.end()
        _ALWAYS.reset(before)


@contextlib.contextmanager
def no_progress() -> Iterator[None]:
    """Show no stages and bars: the process that asked for the work shows its own."""
    before = _NEVER.set(True)
    try:
        yield
    finally:
        _NEVER.reset(before)


def asked_for() -> bool:
    """Return whether --progress was given."""
    return _ALWAYS.get()


def _shown(**options: Any) -> dict[str, Any]:
    """Return tqdm's options: it shows itself on a terminal, or after --progress."""
    if _NEVER.get():
        return {"disable": True, **options}
    if _ALWAYS.get():
        return {"disable": False, "mininterval": 1.0, **options}
    return {"disable": None, **options}


def progress(items: Iterable[Any], total: int | None, unit: str) -> Iterator[Any]:
    """Show how many are done and the time left, on a terminal or after --progress."""
    from tqdm import tqdm
    for item in tqdm(items, **_shown(total=total, unit=f" {unit}", leave=False)):
        _Stage.end()
        yield item


def progress_in_time(
    packets: Iterable[Any], start_us: int | None, stop_us: int | None
) -> Iterator[Any]:
    """Pass packets on; show which second of the recording they have reached.

    Parameters
    ----------
    packets : iterable of Packet
    start_us, stop_us : int or None
        Ends of the recording; the time left is not known without the second.
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
    """What goes on before there is progress: says every few seconds for how long."""

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
    """Say, where `progress` shows, what takes a while before it can."""
    _Stage.end()
    if _NEVER.get():
        return
    if _ALWAYS.get() or (sys.stderr is not None and sys.stderr.isatty()):
        print(f"pdavis: {what} ...", file=sys.stderr, flush=True)
        _Stage.now = _Stage(what)
