"""How often light turns from brighter to darker, told by events."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Turns"]

_WINDOWS = 32
_LEAST_EVENTS = 8
_PER_WINDOW = 0.25
_MOST_EVENTS = 200_000


class Turns:
    """Tells when windows exceed an eighth of the period of what pixels see.

    A pixel whose light swings once per period turns twice: from ON to OFF events and
    back.  More than a quarter of a turn per window, as the median over pixels with
    events enough, is a period below eight windows.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.int64]] = []
        self._kept = 0
        self._windows = 0
        self._told = False

    def add(self, events: NDArray[Any]) -> None:
        """Take events of the window that is being filled."""
        if self._told or self._kept > _MOST_EVENTS:
            return
        x, y = events["x"].astype(np.int64), events["y"]
        # One pixel in each cell says as much as four, and on a sensor some cells do.
        self._parts.append(((x << 16 | y) << 1 | events["p"])[(x & 1 | y & 1) == 0])
        self._kept += len(self._parts[-1])

    def exceed(self, windows: int) -> bool:
        """Note that so many windows ended; True once, when they are too long."""
        self._windows += windows
        if self._told or self._windows < _WINDOWS or not self._parts:
            return False
        coded = np.concatenate(self._parts)
        pixel, p = coded >> 1, coded & 1
        order = np.argsort(pixel, kind="stable")
        pixel, p = pixel[order], p[order]
        turned = (pixel[1:] == pixel[:-1]) & (p[1:] != p[:-1])
        _, first, count = np.unique(pixel, return_index=True, return_counts=True)
        busy = count >= _LEAST_EVENTS
        full, span = self._kept <= _MOST_EVENTS, self._windows
        self._parts, self._kept, self._windows = [], 0, 0
        if not full or not busy.any():
            return False
        sums = np.concatenate(([0], np.cumsum(np.append(turned, False))))
        turns = sums[first + count] - sums[first]
        self._told = bool(np.median(turns[busy]) > _PER_WINDOW * span)
        return self._told

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything."""
        return {"parts": [part.copy() for part in self._parts], "kept": self._kept,
                "windows": self._windows, "told": self._told}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over copies of what `state` returned."""
        self._parts = [part.copy() for part in state["parts"]]
        self._kept, self._windows = state["kept"], state["windows"]
        self._told = state["told"]
