"""Packets and facts as JSON, with arrays in shared memory.

What is read makes objects by their constructors only, so that nothing that another
process writes is executed.
"""
from __future__ import annotations

import dataclasses
import json
import math
import mmap
import struct
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    TRIGGER_DTYPE,
    ApsFrame,
    Packet,
    Problem,
    RecordingInfo,
)
from pdavis_cv.sensor import Layout, Sensor

_MADE: dict[str, Any] = {one.__name__: one for one in (
    ApsFrame, Layout, Problem, RecordingInfo, Sensor)}
_FIELDS = {name: {one.lstrip("_"): one for one in (
    ApsFrame.__slots__ if kind is ApsFrame else
    [one.name for one in dataclasses.fields(kind)])} for name, kind in _MADE.items()}
_KINDS = {"events": EVENT_DTYPE, "imu": IMU_DTYPE, "triggers": TRIGGER_DTYPE}
_DTYPES = [np.dtype(one) for one in (
    "?", "u1", "u2", "u4", "i1", "i2", "i4", "i8", "f4", "f8")]
_NUMBERS = {dtype: number for number, dtype in enumerate(_DTYPES)}
_TEXT = json.JSONEncoder(check_circular=False, separators=(",", ":"))
_SIZE = struct.Struct("<q")


def send(pipe: BinaryIO, data: bytes) -> None:
    """Write a message."""
    pipe.write(_SIZE.pack(len(data)) + data)
    pipe.flush()


def receive(pipe: BinaryIO, most: int = 1 << 62) -> bytes:
    """Return a message.

    Raises
    ------
    EOFError, OSError
        If the pipe ends before, or the message is larger than `most`.
    """
    head = pipe.read(_SIZE.size)
    if len(head) < _SIZE.size:
        raise EOFError
    size, = _SIZE.unpack(head)
    if not 0 <= size <= most or len(data := pipe.read(size)) < size:
        raise EOFError
    return data


def written(value: Any, memory: mmap.mmap) -> bytes:
    """Return a value as text, whose arrays are written to the shared memory.

    Parameters
    ----------
    value : object
        Anything else than numbers, texts, arrays, sequences, mappings and the objects
        of recordings is written as its text.
    memory : mmap
        What it held before is lost.

    Raises
    ------
    MemoryError
        If the arrays do not fit.
    """
    memory.seek(0)

    def placed(arrays: Iterable[NDArray[Any]]) -> int:
        at = memory.tell()
        for array in arrays:
            if array.nbytes > len(memory) - memory.tell():
                raise MemoryError
            memory.write(np.ascontiguousarray(array))   # type: ignore[arg-type]
        return at

    def plain(value: Any) -> Any:
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, np.ndarray):
            return {"array": [_NUMBERS[value.dtype], value.shape, placed([value]),
                              value.flags.writeable]}
        if isinstance(value, list) and value and isinstance(value[0], Packet):
            return {"packets": [
                [[len(one.events), len(one.imu), len(one.triggers),
                  plain(one.until_us), [*map(plain, one.frames)]] for one in value],
                placed(getattr(one, kind) for kind in _KINDS for one in value)]}
        if (kind := type(value).__name__) in _MADE:
            return {kind: [plain(getattr(value, field))
                           for field in _FIELDS[kind].values()]}
        if isinstance(value, np.generic):
            return plain(value.item())
        if isinstance(value, list):
            return [plain(one) for one in value]
        if isinstance(value, tuple):
            return {"tuple": [plain(one) for one in value]}
        if isinstance(value, Mapping):
            return {"dict": [[plain(name), plain(one)] for name, one in value.items()]}
        return str(value)

    return _TEXT.encode(plain(value)).encode()


def read(text: bytes, memory: memoryview) -> Any:
    """Return what `written` wrote; arrays are copies, one for all packets of a list.

    Raises
    ------
    ValueError, TypeError, LookupError, ArithmeticError, RecursionError, MemoryError
        If it is something else.
    """
    def copied(count: int, dtype: np.dtype[Any], at: int) -> NDArray[Any]:
        if count < 0:
            raise ValueError("arrays have no negative size")
        return np.frombuffer(
            memory, np.uint8, count * dtype.itemsize, at).copy().view(dtype)

    def packets(rows: list[Any], at: int) -> Iterator[Packet]:
        columns = []
        for i, dtype in enumerate(_KINDS.values()):
            columns.append(copied(sum(row[i] for row in rows), dtype, at))
            at += columns[-1].nbytes
        (events, imu, triggers), e, i, t = columns, 0, 0, 0
        for n_events, n_imu, n_triggers, until_us, frames in rows:
            yield Packet(events[e:(e := e + n_events)], tuple(frames),
                         imu[i:(i := i + n_imu)],
                         triggers[t:(t := t + n_triggers)], until_us)

    def made(value: dict[str, Any]) -> Any:
        [(kind, rest)] = value.items()
        if kind == "packets":
            return [*packets(*rest)]
        if kind == "array":
            which, shape, at, writeable = rest
            array = copied(math.prod(shape), _DTYPES[which], at).reshape(shape)
            array.flags.writeable = writeable
            return array
        if kind == "tuple":
            return tuple(rest)
        if kind == "dict":
            return dict(rest)
        return _MADE[kind](**dict(zip(_FIELDS[kind], rest, strict=True)))

    return json.loads(text, object_hook=made)
