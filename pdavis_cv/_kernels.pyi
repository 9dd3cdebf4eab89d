"""The whole Python/C boundary, one line per kernel."""
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "DEBUG",
    "cf_frame",
    "cf_frame_literal",
    "check_events",
    "floor_sum",
    "leak_events",
    "leak_events_map",
    "leak_read",
    "log_frame",
]

DEBUG: bool

_F32 = NDArray[np.float32]
_U8 = NDArray[np.uint8]

def cf_frame(
    sample: _F32, valid: _U8, log_8bit: _F32, age: _F32, t: float, rate: float,
    floor: float, held: _F32, cells: NDArray[Any],
) -> None: ...
def cf_frame_literal(
    sample: _F32, valid: _U8, t: float, rate: float, floor: float, log_scale: float,
    cells: NDArray[Any],
) -> None: ...
def check_events(events: NDArray[Any], last: int, h: int, w: int) -> int: ...
def floor_sum(events: NDArray[Any], step: _F32, out: _F32) -> int: ...
def leak_events(
    events: NDArray[Any], step: _F32, last: int, cells: NDArray[Any]
) -> int: ...
def leak_events_map(
    events: NDArray[Any], step: _F32, last: int, cells: NDArray[Any]
) -> int: ...
def leak_read(cells: NDArray[Any], base: _F32, t: float, out: _F32) -> None: ...
def log_frame(
    dn: _F32, usable: _U8, log_exposure: _F32, out: _F32, valid: _U8
) -> None: ...
