"""Encodings of ROS's EventPacket with a base of time: mono, trigger, libcaer(_cmp).

Written from the documentation of event_camera_msgs and event_camera_codecs.
"""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Columns = tuple[NDArray[np.int64], ...]
"""Times in us, x, y, p; int64."""
_OVERFLOW_US = 1 << 31
"""What is added where libcaer's 32-bit time overflows, us."""
_TIME_HIGH, _TIME_LOW, _X, _Y, _BASE, _VECTOR = range(6)
"""Kinds of words of ``libcaer_cmp``, in bits 12 to 15."""
_HIGH_BITS = 12, 4
"""Bits of the upper part of time; libcaer_driver writes the last four only."""


def mono(data: bytes, base_ns: int) -> Columns:
    """Return the columns of 64-bit words: time in ns, x, y, polarity."""
    word = np.frombuffer(data, "<u8", len(data) // 8)
    return (_time(word, base_ns), *(part.astype(np.int64) for part in (
        word >> 32 & 0xFFFF, word >> 48 & 0x7FFF, word >> 63)))


def trigger(data: bytes, base_ns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return times in us, and 1 for a rising edge."""
    word = np.frombuffer(data, "<u8", len(data) // 8)
    return _time(word, base_ns), (word >> 63).astype(np.int64)


def _time(word: NDArray[np.uint64], base_ns: int) -> NDArray[np.int64]:
    return ((word & 0xFFFFFFFF).astype(np.int64) + base_ns) // 1000


def libcaer(data: bytes, base_ns: int) -> Columns:
    """Return the columns of libcaer's events: a word of data, time in us."""
    word, low = np.frombuffer(data, "<u4", len(data) // 8 * 2).reshape(-1, 2).T
    t = low.view(np.int32).astype(np.int64)
    overflows = np.cumsum(np.diff(t, prepend=t[:1]) < -_OVERFLOW_US // 2)
    t = (base_ns + 1000 * (t + overflows * _OVERFLOW_US)) // 1000
    return t, *(part.astype(np.int64) for part in (
        word >> 17, word >> 2 & 0x7FFF, word >> 1 & 1))


def libcaer_cmp(data: bytes, base_ns: int) -> Columns:
    """Return the columns of 16-bit words, each of which changes a part of the state.

    A vector is up to eight neighbours of a column.
    """
    word = np.frombuffer(data, "<u2", len(data) // 2).astype(np.int64)
    kind, value, place = word >> 12, word & 0xFFF, np.arange(len(word))

    def before(which: int) -> NDArray[np.int64]:
        """Return where the last word of a kind is, -1 before the first."""
        return np.maximum.accumulate(np.where(kind == which, place, -1))

    def at(where: NDArray[np.int64], of: NDArray[np.int64], missing: int
           ) -> NDArray[np.int64]:
        return np.where(where >= 0, of[where], missing)

    high = np.where(kind == _TIME_HIGH, value, 0)
    parts = high[kind == _TIME_HIGH]
    span = 1 << _HIGH_BITS[int(parts.max(initial=0) < 1 << _HIGH_BITS[1])]
    high[kind == _TIME_HIGH] += span * np.cumsum(
        np.diff(parts, prepend=parts[:1]) < -span // 2)
    t = at(before(_TIME_HIGH), high, 0) << 12 | at(before(_TIME_LOW), value, 0)
    x, base = at(before(_X), value & 0x7FF, -1), before(_BASE)
    vectors = np.cumsum(kind == _VECTOR)
    single, vector = np.flatnonzero(kind == _Y), np.flatnonzero(kind == _VECTOR)
    row, bit = np.nonzero(value[vector, None] >> np.arange(8) & 1)
    vector = vector[row]
    found = base[vector]
    y = np.where(found >= 0, (value[found] & 0x7FF) + bit + 8 * (
        vectors[vector] - vectors[found] - 1), -1)
    events = np.concatenate((single, vector))
    order = np.argsort(events, kind="stable")
    events = events[order]
    return ((base_ns + 1000 * t[events]) // 1000, x[events],
            np.concatenate((value[single] & 0x7FF, y))[order],
            np.concatenate((value[single] >> 11, value[found] >> 11))[order])


ENCODINGS: dict[str, Callable[[bytes, int], Columns]] = {
    "mono": mono, "libcaer": libcaer, "libcaer_cmp": libcaer_cmp}
"""Functions from the bytes of a packet and its base of time in ns to its columns."""
