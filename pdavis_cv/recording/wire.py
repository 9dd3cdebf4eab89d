"""Samples and facts as JSON, with arrays in shared memory.

What is read makes objects by their constructors only, so that nothing that another
process writes is executed.
"""
from __future__ import annotations

import dataclasses
import json
import math
import mmap
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    TRIGGER_DTYPE,
    ApsFrame,
    Problem,
    RecordingInfo,
)
from pdavis_cv.recording.packetise import Batch
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.sensor import Layout, Sensor

_MADE: dict[str, Any] = {one.__name__: one for one in (
    ApsFrame, Batch, Layout, Problem, RecordingInfo, Sensor)}
_FIELDS = {name: {one.lstrip("_"): one for one in (
    ApsFrame.__slots__ if kind is ApsFrame else
    [one.name for one in dataclasses.fields(kind)])} for name, kind in _MADE.items()}
_DTYPES = [EVENT_DTYPE, IMU_DTYPE, TRIGGER_DTYPE, *map(np.dtype, (
    "?", "u1", "u2", "u4", "i1", "i2", "i4", "i8", "f4", "f8"))]
_NUMBERS = {dtype: number for number, dtype in enumerate(_DTYPES)}
_TEXT = json.JSONEncoder(check_circular=False, separators=(",", ":"))
ROOM = 32 << 20
"""Bytes in which events are decoded.  A choice; those of a chunk may take 20 MB."""


class Shared(Scratch):
    """Shared memory; of two parts for events one is read while one is filled."""

    def __init__(self, memory: mmap.mmap) -> None:
        super().__init__()
        self.bytes = np.frombuffer(memory, np.uint8)
        self.end = len(self.bytes) - 2 * ROOM   # of what is copied
        self._first, self._end = self.bytes.ctypes.data, 0
        self.turn()

    def room(self, count: int) -> NDArray[Any]:
        """Return an array of EVENT_DTYPE after those kept, or elsewhere."""
        end = self._begin + count * EVENT_DTYPE.itemsize
        return super().room(count) if end > self._end else self.bytes[
            self._begin:end].view(EVENT_DTYPE)

    def keep(self, events: NDArray[Any]) -> None:
        """Leave events as they are until the part is used again."""
        if (at := self.place(events)) is not None:
            self._begin = at + events.nbytes

    def whole(self, parts: list[NDArray[Any]]) -> NDArray[Any] | None:
        """Return events as one array if they are all that was kept, without gaps."""
        kept = self.bytes[self._end - ROOM:self._begin].view(EVENT_DTYPE)
        inside = all(self.place(part) is not None for part in parts)
        return kept if inside and sum(map(len, parts)) == len(kept) else None

    def turn(self) -> None:
        """Go on in the other part."""
        self._begin = self.end + (self._end == self.end + ROOM) * ROOM
        self._end = self._begin + ROOM

    def place(self, array: NDArray[Any]) -> int | None:
        """Return where an array lies, None if elsewhere."""
        inside = array.size and array.base is self.bytes and array.flags.c_contiguous
        return array.ctypes.data - self._first if inside else None


def written(value: Any, shared: Shared) -> bytes:
    """Return a value as text, whose arrays lie in shared memory, or MemoryError.

    Anything else than numbers, texts, arrays, sequences, mappings and the objects of
    recordings is written as its text.  Arrays that were copied there before are lost.
    """
    end = 0

    def placed(array: NDArray[Any]) -> int:
        nonlocal end
        if (at := shared.place(array)) is None:
            at, end = end, end + array.nbytes
            if end > shared.end:
                raise MemoryError
            shared.bytes[at:end] = np.ravel(array).view(np.uint8)
        return at

    def plain(value: Any) -> Any:
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, np.ndarray):
            return {"array": [_NUMBERS[value.dtype], value.shape, placed(value),
                              value.flags.writeable]}
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
    """Return what `written` wrote; arrays are copies.

    Any exception means that it is something else.
    """
    def made(value: dict[str, Any]) -> Any:
        [(kind, rest)] = value.items()
        if kind == "array":
            which, shape, at, writeable = rest
            if (count := math.prod(shape)) < 0:
                raise ValueError("arrays have no negative size")
            size = count * _DTYPES[which].itemsize
            array = np.frombuffer(memory, np.uint8, size, at).copy().view(
                _DTYPES[which]).reshape(shape)
            array.flags.writeable = writeable
            return array
        if kind == "tuple":
            return tuple(rest)
        if kind == "dict":
            return dict(rest)
        one = _MADE[kind](**dict(zip(_FIELDS[kind], rest, strict=True)))
        if kind == "Batch" and not (isinstance(one.complete_us, int) and all(
                isinstance(frame, ApsFrame) for frame in one.frames) and all(
                array is None or (array.dtype, array.ndim) == (dtype, 1)
                for array, dtype in zip((one.events, one.imu, one.triggers), _DTYPES,
                                        strict=False))):
            raise TypeError("these are no samples")
        return one

    return json.loads(text, object_hook=made)
