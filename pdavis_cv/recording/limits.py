"""Limits, and the Budget from which the reader of one file takes memory and work."""
from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

from pdavis_cv._remote import RemotePath, as_path
from pdavis_cv.errors import RecordingError
from pdavis_cv.events import FAR

_SLACK = 16 << 20
"""Bytes of one piece that no ratio limits: an empty image compresses without end."""
_LEAST_WORK = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a file may make its reader take; no known recording comes near.

    Parameters
    ----------
    memory : int
        Bytes: one packet, chunk or image may unpack to half of it, and samples of all
        streams may take half of it until they are in order.
    ratio : float
        Bytes of samples per byte of the file, beyond half of `memory`, and of a packet,
        chunk or message per byte that it is stored in, beyond 16 MB.
    work_per_byte : float
        Bytes that may be searched for packets in a damaged file, per byte of it.
    time_span : int
        Largest difference of times in a recording, us; by default any.

    Raises
    ------
    TypeError, ValueError
        If a limit is no number above 0.
    """

    memory: int = 512 << 20
    ratio: float = 100
    work_per_byte: float = 2
    time_span: int = 2 * FAR

    def __post_init__(self) -> None:
        for one in dataclasses.fields(self):
            value = getattr(self, one.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise TypeError(
                    f"{one.name} must be a number, got {type(value).__name__}")
            if not value > 0:
                raise ValueError(f"{one.name} must be above 0, got {value}")


class Budget:
    """What the reader of one file may still take."""

    def __init__(self, path: Any, limits: Limits | None = None) -> None:
        self._path, self.limits = path, limits or Limits()
        self._half = self.limits.memory // 2    # what is read is copied once
        self._first, self._taken = 1 << 62, 0

    @functools.cached_property
    def size(self) -> int:
        """Bytes of the file, or of all files in a folder."""
        path = as_path(self._path)
        if not isinstance(path, RemotePath) and path.is_dir():
            return sum(one.stat().st_size for one in path.rglob("*"))
        return int(path.stat().st_size)

    def over(self, limit: str, what: str) -> RecordingError:
        """Return the error that something passes a limit, a field of `Limits`."""
        most = getattr(self.limits, limit)
        return RecordingError(
            f"{self._path}: {what}: more than the limit {limit}={most:g} allows; "
            f"if the file is to be trusted, Limits({limit}=...) raises it, on the "
            f"command line --limits {limit}=...")

    def most(self, packed: int) -> int:
        """Return how many bytes a piece that takes `packed` in the file may have."""
        return int(min(self._half, self.limits.ratio * packed + _SLACK))

    def piece(self, size: int, what: str, packed: int | None = None) -> None:
        """Raise RecordingError if a piece takes too many bytes.

        `packed` are the bytes that it takes in the file, if it is unpacked.
        """
        if size > self._half:
            raise self.over("memory", f"{what} of {size} bytes, which are copied")
        if packed is not None and size > self.most(packed):
            raise self.over("ratio", f"{what} of {packed} bytes unpacks to {size}")

    def unpacked(self, unpack: Any, data: bytes, what: str) -> bytes:
        """Return what a decompressor like those of `bz2` makes of data."""
        most = self.most(len(data)) + 1
        parts = [unpack.decompress(data, min(most, _SLACK))]
        while (size := sum(map(len, parts))) < most and not (
                unpack.eof or unpack.needs_input):
            parts.append(unpack.decompress(b"", min(most - size, _SLACK)))
        self.piece(size, what, len(data))
        return b"".join(parts)

    def total(self, size: int) -> None:
        """Raise RecordingError if the file gives more bytes of samples than it may."""
        free = self._half
        if size > free and size > self.limits.ratio * self.size + free:
            raise self.over("ratio", f"samples of {size} bytes from {self.size}")

    def take(self, size: int) -> None:
        """Add to what a reading gives, which `total` bounds."""
        self._taken += size
        self.total(self._taken)

    def waiting(self, size: int) -> None:
        """Raise RecordingError if too much waits for samples of another stream."""
        if size > self._half:
            raise self.over("memory", f"{size} bytes of samples that wait for earlier "
                            "ones of other streams")

    def searched(self, size: int) -> None:
        """Raise RecordingError if one reading has searched too many bytes."""
        if size > self.limits.work_per_byte * self.size + _LEAST_WORK:
            raise self.over("work_per_byte", f"{size} bytes searched for packets")

    def time(self, t_us: int) -> int:
        """Raise RecordingError if a time is too far from the first one.

        The last time that is not is returned.
        """
        self._first = min(self._first, t_us)
        if t_us - self._first > self.limits.time_span:
            raise self.over("time_span", f"times {self._first} to {t_us} us")
        return self._first + self.limits.time_span
