"""The process of an `IsolatedRecording`, which reads the file."""
from __future__ import annotations

import contextlib
import math
import mmap
import os
import sys
import warnings
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.recording import sandbox, wire
from pdavis_cv.recording.base import MAX_PACKET_US, Problem, Recording, joined
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.open import open_recording
from pdavis_cv.recording.packetise import END_OF_TIME, Batch, cell_start
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import PiecewiseRecording

_FULL, _TEXT = 2 << 20, 1 << 10
"""Bytes from which samples are sent, and of the text of one.  Choices."""
_MORE_BYTES = 512 << 20
"""Memory beside that of `Limits`: what libraries take."""
_HERE = Path(__file__).resolve().parents[2]


def _answers(recording: Recording, memory: wire.Shared | None, start_us: int | None,
             stop_us: int | None) -> Iterator[list[Batch] | Exception]:
    """Yield samples that are worth an answer; at last none, or what reading raised."""
    end = END_OF_TIME if stop_us is None else cell_start(stop_us) + MAX_PACKET_US
    rest: Iterator[Batch] = (
        recording.batches(start_us, memory or Scratch())
        if isinstance(recording, PiecewiseRecording) else
        (Batch(one.events, [*one.frames], one.imu, one.triggers,
               -END_OF_TIME if one.stop_us is None else one.stop_us - 1)
         for one in recording.packets(start_us, stop_us)))
    last: list[Batch] | Exception = []
    found, size = list[Batch](), 0
    try:
        for one in rest:
            found.append(one)
            size += _TEXT + sum(4 * math.prod(frame.shape) for frame in one.frames)
            size += sum(array.nbytes for array in (one.events, one.imu, one.triggers)
                        if array is not None)
            if memory is not None and one.events is not None:
                memory.keep(one.events)
            if one.complete_us >= end:
                break
            if size >= _FULL:
                yield [_as_one(found, memory)]
                found, size = [], 0
                if memory is not None:
                    memory.turn()
    except Exception as error:
        last = error
    if found:
        yield [_as_one(found, memory)]
    yield last


def _as_one(found: list[Batch], memory: wire.Shared | None) -> Batch:
    """Return samples as one batch: each one costs more than what it holds."""
    def joint(name: str) -> NDArray[Any] | None:
        parts = [part for one in found if (part := getattr(one, name)) is not None
                 and len(part)]
        whole = memory.whole(parts) if memory is not None and name == "events" else None
        return whole if whole is not None else joined(parts) if parts else None

    return Batch(joint("events"), [frame for one in found for frame in one.frames],
                 joint("imu"), joint("triggers"), found[-1].complete_us)


def serve(most: int, asked: int, shared: int) -> None:
    """Read a recording for another process, until that ends.

    Parameters
    ----------
    most : int
        Size of the shared memory beside that for decoding.
    asked, shared : int
        Descriptors of a pipe and of the shared memory.
    """
    memory = wire.Shared(mmap.mmap(shared, most + 2 * wire.ROOM))
    pipe, said = Connection(asked), list[tuple[str, str]]()
    warnings.simplefilter("always")
    warnings.showwarning = lambda text, kind, *_: said.append(
        (kind.__name__, str(text)))
    windows: dict[int, Iterator[list[Batch] | Exception]] = {}
    ready: dict[int, list[Batch] | Exception] = {}
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
            # One window at a time is decoded to shared memory, others are copied.
            windows[number] = _answers(recording, None if windows else memory, *window)
        elif what == "end":
            windows.pop(number, None)
            ready.pop(number, None)
        else:
            found = ready.pop(number, None) or next(windows[number], [])
            if isinstance(found, Exception):
                raise found
            return found
        return None

    with contextlib.suppress(EOFError, OSError):
        while True:
            question = pipe.recv()
            try:
                text = wire.written((answer(question), None, problems(), said), memory)
            except Exception as error:
                lacks = "memory alloc" in str(error) or any(isinstance(
                    one, MemoryError) for one in (error, error.__cause__))
                known = budget.over("memory", "its reader") if lacks else error
                text = wire.written((
                    None, (type(known).__name__, str(known)), problems(), said),
                    memory)
            said.clear()
            pipe.send_bytes(text)
            if question[0] == "next":
                ready[question[1]] = next(windows[question[1]], [])
