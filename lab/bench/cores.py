"""Where the system has put two busy threads, and what two threads gain there."""
from __future__ import annotations

import threading
from collections.abc import Callable
from statistics import median

import numpy as np

from pdavis_cv._workers import usable_cores

from .floor import compiled

PARTS = 5
"""Parts of a measurement of the way between cores: .1 ms."""

PLACES = ((40, "on one core"), (120, "with a common cache"), (np.inf, "further apart"))
"""Two threads, by the longest time that a value takes between them, ns.  On a virtual
machine with Zen 4 it takes 25, 55 or 245."""


def between_cores() -> float:
    """Return the time that a value takes from a busy thread to another, ns.

    Raises
    ------
    ImportError
        If the library was installed from a wheel.
    """
    pass_value = compiled().pass_value
    places = np.zeros(32, np.int64)
    other = threading.Thread(target=pass_value, args=(places, PARTS, False))
    other.start()
    try:
        return float(pass_value(places, PARTS, True))
    finally:
        other.join()


def _place() -> str:
    if usable_cores() < 2:
        return PLACES[0][1]
    try:
        way = between_cores()
    except ImportError:
        return "somewhere"
    return next(name for most, name in PLACES if way < most)


class Placed:
    """Timings with one thread and with two, and where these were meanwhile.

    The host of a virtual machine moves its cores at will: between the threads of a
    core, which two threads share, and between cores with and without a common cache.

    Parameters
    ----------
    one, two : callable
        Do the same with one thread and with two; return the seconds that it took.
    """

    def __init__(self, one: Callable[[], float], two: Callable[[], float]) -> None:
        self._one, self._two = one, two
        self._alone = 0.0
        self._gains: dict[str, list[float]] = {}

    def floor(self) -> float:
        """Time one thread."""
        self._alone = self._one()
        return self._alone

    def candidate(self) -> float:
        """Time two threads, and note their place."""
        before = _place()
        took = self._two()
        place = _place()
        if place != before:
            place = "moved"
        self._gains.setdefault(place, []).append(self._alone / took)
        return took

    def remark(self) -> str:
        """Return the gain by place, and how much of the time that was."""
        total = sum(map(len, self._gains.values()))
        return "; ".join(
            f"{median(gains):.2f} {place} ({100 * len(gains) / total:.0f} %)"
            for place, gains in sorted(
                self._gains.items(), key=lambda item: -len(item[1])))
