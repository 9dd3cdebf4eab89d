"""What processes of one machine hand each other: through its memory, not a pipe.

A pool pickles into one block, sends that through a pipe and unpickles it: each array is
copied about five times, into pages of memory that are new each time, which costs more
than the copying. In a file of memory a state is written once, and used where it lies;
planes of images, of which there are many, are written as they are made, and read to
where they belong, so that on both sides the same pages serve for all.
"""
from __future__ import annotations

import contextlib
import mmap
import os
import pickle
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Handed", "Place", "Reading", "Shelf", "hand_over", "memory_for", "taken"]

_MEMORY = Path("/dev/shm")     # Linux's file system in memory
_PREFIX, _LOCK = "pdavis-", "lock"


_ALIGN = 64        # bytes; no array begins within a cache line


class Handed(NamedTuple):
    """Where a value lies that has been handed over.

    Parameters
    ----------
    slot : str
        A file: what the value is but its arrays, and these.
    places : tuple of (int, int)
        Where each array begins, and its bytes.
    pickled : bytes
    """

    slot: str
    places: tuple[tuple[int, int], ...]
    pickled: bytes


class Place(NamedTuple):
    """Where an array lies that was put on a `Shelf`.

    Parameters
    ----------
    slot : str
        The file.
    start : int
        Its first byte.
    shape : tuple of int
    dtype : str
    """

    slot: str
    start: int
    shape: tuple[int, ...]
    dtype: str


class Shelf:
    """Takes arrays, one after the other, for another process.

    Parameters
    ----------
    slot : str or None
        As for `hand_over`.
    """

    def __init__(self, slot: str | None) -> None:
        self._slot, self._end = slot, 0
        self._file: int | None = None
        if slot is not None:
            with contextlib.suppress(OSError):
                self._file = os.open(slot, os.O_WRONLY | os.O_CREAT, 0o600)

    def put(self, array: NDArray[Any]) -> Place | NDArray[Any]:
        """Return what to send in place of an array: itself without slot or room."""
        if self._file is None or self._slot is None:
            return array
        start = self._end
        raw = np.ascontiguousarray(array)
        try:
            if os.pwrite(self._file, raw.data, start) != raw.nbytes:
                return array
        except OSError:
            return array
        self._end = start + raw.nbytes + -raw.nbytes % _ALIGN
        return Place(self._slot, start, raw.shape, raw.dtype.str)

    def close(self) -> None:
        """Take no more."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


class Reading:
    """Reads what shelves of other processes took; closes their files in the end."""

    def __init__(self) -> None:
        self._files: dict[str, int] = {}

    def __enter__(self) -> Reading:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files.values():
            os.close(file)
        self._files.clear()

    def into(self, out: NDArray[Any], sent: Place | NDArray[Any]) -> None:
        """Copy an array that `Shelf.put` sent.

        Parameters
        ----------
        out : ndarray, C-contiguous
            Of its shape and dtype.
        sent : Place or ndarray

        Raises
        ------
        OSError
            If it does not lie there any more.
        """
        if not isinstance(sent, Place):
            out[...] = sent
            return
        file = self._files.get(sent.slot)
        if file is None:
            file = self._files[sent.slot] = os.open(sent.slot, os.O_RDONLY)
        if os.preadv(file, [out.data], sent.start) != out.nbytes:
            raise OSError(f"{sent.slot} must hold {out.nbytes} bytes at {sent.start}, "
                          "found fewer")


@contextlib.contextmanager
def memory_for(executor: Executor) -> Iterator[str | None]:
    """Give a folder in memory through which the workers of an executor hand over.

    Parameters
    ----------
    executor : Executor

    Yields
    ------
    str or None
        None where there is no such memory, or where workers may be in this process or
        on other machines: then values go as the executor sends them.  The folder is
        removed at the end, by the next call if this process is killed.
    """
    if not (isinstance(executor, ProcessPoolExecutor) and os.access(_MEMORY, os.W_OK)):
        yield None
        return
    import fcntl  # where /dev/shm is, this is too
    for left in _MEMORY.glob(f"{_PREFIX}*/{_LOCK}"):
        with contextlib.suppress(OSError), left.open() as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)    # its owner has gone
            shutil.rmtree(left.parent, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=_MEMORY))
    try:
        with (folder / _LOCK).open("x") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield str(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def hand_over(value: Any, slot: str | None) -> Any:
    """Put the arrays of a value where another process finds them.

    Parameters
    ----------
    value : object
        Picklable.
    slot : str or None
        A file in the folder that `memory_for` gave.  It is overwritten, in the same
        pages of memory: nobody may use what it held any more.

    Returns
    -------
    Handed or object
        To be sent in place of the value; the value where there is no slot, or no room.
    """
    if slot is None:
        return value
    arrays: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(value, protocol=5, buffer_callback=arrays.append)
    places = []
    try:
        with open(os.open(slot, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
            for one in arrays:
                file.seek(-file.tell() % _ALIGN, os.SEEK_CUR)
                places.append((file.tell(), file.write(one.raw())))
    except OSError:
        return value
    return Handed(slot, tuple(places), pickled)


def taken(value: Any) -> Any:
    """Return what `hand_over` was given; its arrays lie in the slot.

    They may be written to, which changes them here alone.
    """
    if not isinstance(value, Handed):
        return value
    if not value.places:
        return pickle.loads(value.pickled)
    with open(value.slot, "rb") as file:
        lying = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
    return pickle.loads(value.pickled, buffers=[
        lying[start:start + size] for start, size in value.places])
