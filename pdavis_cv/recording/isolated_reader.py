"""The process of an `IsolatedRecording`, which reads the file."""
from __future__ import annotations

import contextlib
import math
import mmap
import os
import pickle
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pdavis_cv.recording import sandbox, wire
from pdavis_cv.recording.base import Packet, Problem, Recording
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.open import open_recording

_FULL = 2 << 20
"""Bytes of arrays from which packets are sent.  A choice."""
_MORE_BYTES = 512 << 20
"""Memory beside that of `Limits`: what libraries take."""
_HERE = Path(__file__).resolve().parents[2]


class _Window:
    """Packets of a window, some of which are read before they are asked for."""

    def __init__(self, packets: Iterator[Packet]) -> None:
        self._packets, self._ready = packets, list[Packet]()
        self._error: Exception | None = None

    def prepare(self) -> None:
        """Read until packets are worth an answer."""
        size = 0
        try:
            while size < _FULL and (packet := next(self._packets, None)) is not None:
                self._ready.append(packet)
                size += packet.events.nbytes + packet.imu.nbytes + sum(
                    4 * math.prod(frame.shape) for frame in packet.frames)
        except Exception as error:
            self._error = error

    def take(self) -> list[Packet]:
        """Return the packets that are ready, none at the end."""
        if not self._ready:
            self.prepare()
        if not self._ready and self._error is not None:
            raise self._error
        found, self._ready = self._ready, []
        return found


def serve(most: int, hears: int, says: int, shared: int) -> None:
    """Read a recording for another process, until that ends.

    Parameters
    ----------
    most : int
        Size of the shared memory.
    hears, says, shared : int
        Descriptors of pipes and of the shared memory.
    """
    memory = mmap.mmap(shared, most)
    ask, say, said = open(hears, "rb"), open(says, "wb"), list[tuple[str, str]]()
    warnings.simplefilter("always")
    warnings.showwarning = lambda text, kind, *_: said.append(
        (kind.__name__, str(text)))
    windows: dict[int, _Window] = {}
    recording: Recording | None = None
    budget, seconds = Budget(""), 0.0

    def problems() -> tuple[Problem, ...]:
        return () if recording is None else tuple(recording.problems)

    def answer(question: Any) -> Any:
        nonlocal recording, budget, seconds
        if recording is None:
            folders, seconds, source, options = question
            budget = Budget(source, options.limits)
            sandbox.enter((*sys.path, sys.prefix, sys.base_prefix, _HERE, *folders),
                          os.environ["TMPDIR"], most + _MORE_BYTES)
            sandbox.more_time(seconds)
            recording = open_recording(source, options)
            return recording.name, recording.info
        sandbox.more_time(seconds)
        what, number, *window = question
        if what == "window":
            windows[number] = _Window(recording.packets(*window))
        elif what == "end":
            windows.pop(number, None)
        else:
            return windows[number].take()
        return None

    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            question = pickle.loads(wire.receive(ask))
            try:
                text = wire.written((answer(question), None, problems(), said), memory)
            except Exception as error:
                lacks = isinstance(error, MemoryError) or "memory alloc" in str(error)
                known = budget.over("memory", "its reader") if lacks else error
                text = wire.written((
                    None, (type(known).__name__, str(known)), problems(), said),
                    memory)
            said.clear()
            wire.send(say, text)
            if question[0] == "next":
                windows[question[1]].prepare()
