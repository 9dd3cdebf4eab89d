"""Detection of windows that are too long, from the reversals of events' polarity."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Events, State

_WINDOWS = 32           # windows per test
_LEAST_EVENTS = 8       # of a pixel that takes part in the test
_PER_WINDOW = 0.25      # reversals at a period of eight windows
_MOST_EVENTS = 200_000  # kept per test; with more, the test is left out


class Turns:
    """Test whether windows exceed an eighth of the period of the light on pixels.

    The events of a pixel reverse their polarity twice per period.  More than a quarter
    of a reversal per window, as the median over pixels with enough events, means that
    the period is shorter than eight windows.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.int64]] = []
        self._kept = 0
        self._windows = 0
        self._warned = False

    def add(self, events: Events) -> None:
        """Add events of the current window."""
        if self._warned or self._kept > _MOST_EVENTS:
            return
        x, y = events["x"].astype(np.int64), events["y"]
        # One pixel per macropixel is enough, and costs a quarter.
        self._parts.append(((x << 16 | y) << 1 | events["p"])[(x & 1 | y & 1) == 0])
        self._kept += len(self._parts[-1])

    def exceed(self, windows: int) -> bool:
        """Count windows that ended; return True at the first test they fail, once."""
        self._windows += windows
        if self._warned or self._windows < _WINDOWS or not self._parts:
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
        self._warned = bool(np.median(turns[busy]) > _PER_WINDOW * span)
        return self._warned

    def state(self) -> State:
        """Return copies of everything."""
        return {"parts": [part.copy() for part in self._parts], "kept": self._kept,
                "windows": self._windows, "warned": self._warned}

    def restore(self, state: State) -> None:
        """Take over copies of what `state` returned."""
        self._parts = [part.copy() for part in state["parts"]]
        self._kept, self._windows = state["kept"], state["windows"]
        self._warned = state["warned"]
