"""Packets and facts as JSON, with arrays in shared memory.

What is read makes objects by their constructors only, so that nothing that another
process writes is executed.
"""
from __future__ import annotations

import bisect
import dataclasses
import json
import struct
import weakref
from collections.abc import Mapping
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
    ApsFrame, Layout, Packet, Problem, RecordingInfo, Sensor)}
_FIELDS = {name: [(one.lstrip("_"), one) for one in (
    ApsFrame.__slots__ if kind is ApsFrame else
    [one.name for one in dataclasses.fields(kind)])] for name, kind in _MADE.items()}
_DTYPES = [EVENT_DTYPE, IMU_DTYPE, TRIGGER_DTYPE,
           *(np.dtype(one) for one in ("?", "u1", "u2", "u4", "i1", "i2", "i4", "i8",
                                       "f4", "f8"))]
_NUMBERS = {dtype: number for number, dtype in enumerate(_DTYPES)}
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


class Room:
    """Memory for arrays, which is free again when no array is left in it.

    Parameters
    ----------
    memory : memoryview
        Shared with the process that reads the arrays.
    """

    def __init__(self, memory: memoryview) -> None:
        self._memory, self._start = memory, np.frombuffer(memory, np.uint8).ctypes.data
        self._parts: list[tuple[int, int, weakref.ref[NDArray[Any]]]] = []

    def new(self, size: int, stop: int) -> NDArray[np.uint8] | None:
        """Return the first free part of a size, None if there is none before `stop`."""
        at, self._parts = 0, [one for one in self._parts if one[2]() is not None]
        for begin, end, _ in self._parts:
            if at + size <= begin:
                break
            at = end
        if at + size > stop:
            return None
        got = np.frombuffer(self._memory, np.uint8, size, at)
        bisect.insort(
            self._parts, (at, at + size, weakref.ref(got)), key=lambda one: one[0])
        return got

    def put(self, array: NDArray[Any]) -> tuple[int, NDArray[Any]]:
        """Return the place of an array, which is copied if it lies elsewhere, and it.

        Raises
        ------
        MemoryError
            If it does not fit.
        """
        if not array.size:
            return 0, array
        at = array.ctypes.data - self._start
        if 0 <= at < len(self._memory) and array.flags.c_contiguous:
            return at, array
        if (got := self.new(array.nbytes, len(self._memory))) is None:
            raise MemoryError
        got[:] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        return self.put(got)


def written(value: Any, room: Room, kept: list[NDArray[Any]]) -> bytes:
    """Return a value as text.

    Parameters
    ----------
    value : object
        Anything else than numbers, texts, arrays, sequences, mappings and the objects
        of recordings is written as its text.
    room : Room
    kept : list of ndarray
        Gets the arrays, which must be kept until the text was read.

    Raises
    ------
    MemoryError
        If the arrays do not fit.
    """
    def plain(value: Any) -> Any:
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, np.ndarray):
            at, array = room.put(value)
            kept.append(array)
            return {"array": [_NUMBERS[value.dtype], value.shape, at,
                              value.flags.writeable]}
        if isinstance(value, Packet) and value.until_us is None and not (
                value.frames or len(value.imu) or len(value.triggers)):
            at, array = room.put(value.events)      # most packets, to be fast
            kept.append(array)
            return {"events": [len(value.events), at]}
        if (kind := type(value).__name__) in _MADE:
            return {kind: [(name, plain(getattr(value, field)))
                           for name, field in _FIELDS[kind]]}
        if isinstance(value, np.generic):
            return plain(value.item())
        if isinstance(value, list):
            return [plain(one) for one in value]
        if isinstance(value, tuple):
            return {"tuple": [plain(one) for one in value]}
        if isinstance(value, Mapping):
            return {"dict": [[plain(name), plain(one)] for name, one in value.items()]}
        return str(value)

    return json.dumps(plain(value)).encode()


def read(text: bytes, memory: memoryview) -> Any:
    """Return what `written` wrote; arrays are copies.

    Raises
    ------
    ValueError, TypeError, LookupError, RecursionError, MemoryError
        If it is something else.
    """
    def made(value: dict[str, Any]) -> Any:
        [(kind, rest)] = value.items()
        if kind == "events":
            return Packet(made({"array": [0, *rest, True]}))
        if kind == "array":
            which, shape, at, writeable = rest
            dtype = _DTYPES[which]
            array = np.empty(shape, dtype)
            array.reshape(-1).view(np.uint8)[:] = np.frombuffer(
                memory, np.uint8, array.nbytes, at)
            array.flags.writeable = writeable
            return array
        if kind == "tuple":
            return tuple(rest)
        return dict(rest) if kind == "dict" else _MADE[kind](**dict(rest))

    return json.loads(text, object_hook=made)
