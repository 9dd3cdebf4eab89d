"""Packets and facts as JSON, with arrays in shared memory.

What is read makes objects by their constructors only, so that nothing that another
process writes is executed.
"""
from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

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

__all__ = ["read", "written"]

_MADE: dict[str, Any] = {one.__name__: one for one in (
    ApsFrame, Layout, Packet, Problem, RecordingInfo, Sensor)}
_DTYPES = [EVENT_DTYPE, IMU_DTYPE, TRIGGER_DTYPE,
           *(np.dtype(one) for one in ("?", "u1", "u2", "u4", "i1", "i2", "i4", "i8",
                                       "f4", "f8"))]


def written(value: Any, memory: memoryview) -> str:
    """Return a value as text, and write its arrays into memory.

    Parameters
    ----------
    value : object
        Anything else than numbers, texts, arrays, sequences, mappings and the objects
        of recordings is written as its text.
    memory : memoryview

    Raises
    ------
    MemoryError
        If the arrays do not fit.
    """
    end = 0

    def plain(value: Any) -> Any:
        nonlocal end
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, np.generic):
            return plain(value.item())
        if isinstance(value, list | tuple):
            return {type(value).__name__: [plain(one) for one in value]}
        if isinstance(value, Mapping):
            return {"dict": [[plain(name), plain(one)] for name, one in value.items()]}
        if isinstance(value, np.ndarray):
            at, end = end, end + value.nbytes
            if end > len(memory):
                raise MemoryError
            np.frombuffer(memory, np.uint8, value.nbytes, at)[:] = (
                np.ascontiguousarray(value).reshape(-1).view(np.uint8))
            return {"array": [_DTYPES.index(value.dtype), value.shape, at,
                              value.flags.writeable]}
        if isinstance(value, ApsFrame):
            return {"ApsFrame": {name.lstrip("_"): plain(getattr(value, name))
                                 for name in value.__slots__}}
        if type(value).__name__ in _MADE:
            return {type(value).__name__: {
                one.name: plain(getattr(value, one.name))
                for one in dataclasses.fields(value)}}
        return str(value)

    return json.dumps(plain(value))


def read(text: bytes, memory: memoryview) -> Any:
    """Return what `written` wrote; arrays are copies.

    Raises
    ------
    ValueError, TypeError, KeyError, IndexError
        If it is something else.
    """
    def made(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        [(kind, rest)] = value.items()
        if kind == "list":
            return [made(one) for one in rest]
        if kind == "tuple":
            return tuple(made(one) for one in rest)
        if kind == "dict":
            return {made(name): made(one) for name, one in rest}
        if kind == "array":
            which, shape, at, writeable = rest
            dtype = _DTYPES[which]
            data = np.frombuffer(
                memory, np.uint8, math.prod(shape) * dtype.itemsize, at)
            array = np.empty(shape, dtype)
            array.reshape(-1).view(np.uint8)[:] = data
            array.flags.writeable = writeable
            return array
        return _MADE[kind](**{name: made(one) for name, one in rest.items()})

    return made(json.loads(text))
