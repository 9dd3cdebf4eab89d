"""Pass arrays between processes of one machine through shared memory.

A process pool pickles a value into one block, sends the block through a pipe and
unpickles it.  Each array is copied about five times, each time into newly mapped pages,
which cost more than the copying itself.  Here, arrays are written to a file in memory
(`/dev/shm`) whose pages are used again for the next value.  A state is written once and
used where it lies (`share`, `load_shared`).  The planes of images, of which there are
many, are written one by one and read straight to where they belong (`ArrayWriter`,
`ArrayReader`).
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

__all__ = ["ArrayReader", "ArrayWriter", "SharedArray", "SharedValue", "load_shared",
           "share", "shared_folder"]

_MEMORY = Path("/dev/shm")     # Linux's file system in memory
_PREFIX, _LOCK = "pdavis-", "lock"

_ALIGN = 64        # bytes: every array begins at a cache line


class SharedValue(NamedTuple):
    """A value whose arrays are in a file; made by `share`.

    Parameters
    ----------
    path : str
        The file that holds the arrays.
    spans : tuple of (int, int)
        First byte and size in bytes of each array.
    pickled : bytes
        The value without its arrays (pickle protocol 5, out-of-band buffers).
    """

    path: str
    spans: tuple[tuple[int, int], ...]
    pickled: bytes


class SharedArray(NamedTuple):
    """The location of an array in a file; made by `ArrayWriter.put`.

    Parameters
    ----------
    path : str
        The file.
    start : int
        First byte of the array in it.
    shape : tuple of int
    dtype : str
    """

    path: str
    start: int
    shape: tuple[int, ...]
    dtype: str


class ArrayWriter:
    """Write arrays to a file in memory, one after the other, for another process.

    Parameters
    ----------
    path : str or None
        As for `share`.
    """

    def __init__(self, path: str | None) -> None:
        self._path, self._end = path, 0
        self._file: int | None = None
        if path is not None:
            with contextlib.suppress(OSError):
                self._file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)

    def put(self, array: NDArray[Any]) -> SharedArray | NDArray[Any]:
        """Write an array and return what to send in its place.

        Without a file, or where memory is full, that is the array itself.
        """
        if self._file is None or self._path is None:
            return array
        start = self._end
        raw = np.ascontiguousarray(array)
        try:
            if os.pwrite(self._file, raw.data, start) != raw.nbytes:
                return array
        except OSError:
            return array
        self._end = start + raw.nbytes + -raw.nbytes % _ALIGN
        return SharedArray(self._path, start, raw.shape, raw.dtype.str)

    def close(self) -> None:
        """Close the file; later arrays are returned as they are."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


class ArrayReader:
    """Read arrays that an `ArrayWriter` of another process wrote.

    Files stay open until the context is left.
    """

    def __init__(self) -> None:
        self._files: dict[str, int] = {}

    def __enter__(self) -> ArrayReader:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files.values():
            os.close(file)
        self._files.clear()

    def read_into(self, out: NDArray[Any], sent: SharedArray | NDArray[Any]) -> None:
        """Copy an array that `ArrayWriter.put` returned.

        Parameters
        ----------
        out : ndarray, C-contiguous
            Destination, of the same shape and dtype.
        sent : SharedArray or ndarray

        Raises
        ------
        OSError
            If the file no longer holds the array.
        """
        if not isinstance(sent, SharedArray):
            out[...] = sent
            return
        file = self._files.get(sent.path)
        if file is None:
            file = self._files[sent.path] = os.open(sent.path, os.O_RDONLY)
        if os.preadv(file, [out.data], sent.start) != out.nbytes:
            raise OSError(f"{sent.path} must hold {out.nbytes} bytes at {sent.start}, "
                          "found fewer")


@contextlib.contextmanager
def shared_folder(executor: Executor) -> Iterator[str | None]:
    """Make a folder in memory that this process shares with an executor's workers.

    Parameters
    ----------
    executor : Executor

    Yields
    ------
    str or None
        None where there is no such memory, or where the workers may be threads of this
        process or run on other machines: values are then sent as the executor sends
        them.  The folder is removed on exit; if this process is killed before, the next
        call removes it.
    """
    if not (isinstance(executor, ProcessPoolExecutor) and os.access(_MEMORY, os.W_OK)):
        yield None
        return
    import fcntl  # available wherever /dev/shm is
    for left in _MEMORY.glob(f"{_PREFIX}*/{_LOCK}"):
        with contextlib.suppress(OSError), left.open() as file:
            # The lock can be had only if the process that owned the folder has ended.
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(left.parent, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=_MEMORY))
    try:
        with (folder / _LOCK).open("x") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield str(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def share(value: Any, path: str | None) -> Any:
    """Write the arrays of a value to a file in memory; return what to send instead.

    Parameters
    ----------
    value : object
        Picklable.
    path : str or None
        A file in the folder that `shared_folder` made.  It is overwritten in place, so
        nobody may still use what it held before.

    Returns
    -------
    SharedValue or object
        The value itself where there is no path, or where memory is full.
    """
    if path is None:
        return value
    arrays: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(value, protocol=5, buffer_callback=arrays.append)
    spans = []
    try:
        with open(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
            for one in arrays:
                file.seek(-file.tell() % _ALIGN, os.SEEK_CUR)
                spans.append((file.tell(), file.write(one.raw())))
    except OSError:
        return value
    return SharedValue(path, tuple(spans), pickled)


def load_shared(value: Any) -> Any:
    """Return the value that `share` was given; its arrays are mapped, not copied.

    The mapping is private: arrays may be written to, which the file does not see.
    """
    if not isinstance(value, SharedValue):
        return value
    if not value.spans:
        return pickle.loads(value.pickled)
    with open(value.path, "rb") as file:
        mapped = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
    return pickle.loads(value.pickled, buffers=[
        mapped[start:start + size] for start, size in value.spans])
