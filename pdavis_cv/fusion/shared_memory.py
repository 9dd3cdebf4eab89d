"""Pass arrays between processes of one machine through shared memory.

A process pool pickles a value into one block, sends the block through a pipe and
unpickles it.  Each array is copied about five times, each time into newly mapped pages,
which cost more than the copying itself.  Here, arrays are written to files in memory.
Every process maps them once and uses them as long as the pool exists, so that no new
pages are needed.  A state, or the calls of a task, are used where they lie (`share`,
`load_shared`).  The planes of images, of which there are many, are written one by one
and copied straight to where they belong (`ArrayWriter`).

The files have no name: workers open them through `/proc`.  So nothing is left of them
when the processes end, however they end.
"""
from __future__ import annotations

import contextlib
import itertools
import mmap
import os
import pickle
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["ArrayWriter", "SharedFile", "SharedFiles", "SharedValue", "load_shared",
           "share", "shared_files"]

_KEPT = 192 << 20
"""Most bytes that are kept for a pool between two recordings.  In two stripes of a
DAVIS346, `frames` uses 32 MiB and `cf` 96; `kalman`, in one, 168."""

_MOST_FILES = 128
"""For one recording.  A file takes two of a process's descriptors, of which there often
are 1024, and a stripe two files; what further stripes need is sent by the executor."""

_ALIGN = 64        # bytes: every array begins at a cache line
_GROWTH = 8 << 20  # bytes by which a file grows: each time, it has to be mapped again

_number = itertools.count()


class SharedFile:
    """A file in memory that this process has mapped, as others may.

    Parameters
    ----------
    file : int
        Its descriptor, which is closed when the object is gone.
    key : str
        What `open` in another process needs.
    """

    _opened: dict[str, SharedFile] = {}     # noqa: RUF012  # by this process, by key

    def __init__(self, file: int, key: str) -> None:
        self.key, self._file = key, file
        self._bytes = memoryview(b"")
        weakref.finalize(self, os.close, file)

    @classmethod
    def create(cls) -> SharedFile | None:
        """Return a new, empty file; None where there is no such memory."""
        folder = f"/proc/{os.getpid()}/fd"
        try:
            # After a change of user, a process's files are closed to its children.
            if os.stat(folder).st_uid != os.geteuid():
                return None
            # Builds of Python for old systems lack memfd_create.
            file = (os.memfd_create("pdavis_cv") if hasattr(os, "memfd_create") else
                    os.open("/dev/shm", os.O_TMPFILE | os.O_RDWR, 0o600))
        except (OSError, AttributeError):
            return None
        # A descriptor may be that of another file later: the number tells them apart.
        return cls(file, f"{folder}/{file}#{next(_number)}")

    @classmethod
    def open(cls, key: str) -> SharedFile:
        """Return a file that another process created; it is opened once."""
        found = cls._opened.get(key)
        if found is None:
            path = key.rpartition("#")[0]
            found = cls._opened[key] = cls(os.open(path, os.O_RDWR), key)
        return found

    @property
    def size(self) -> int:
        """Bytes of memory that it takes."""
        return os.fstat(self._file).st_size

    def reserve(self, stop: int) -> int:
        """Make it hold at least `stop` bytes; return how many it holds then.

        Raises
        ------
        OSError
            If memory is full.
        """
        size = self.size
        if stop > size:
            more = stop - size + -(stop - size) % _GROWTH
            # Not ftruncate: to write where no memory is left would end the process.
            os.posix_fallocate(self._file, size, more)
            size += more
        return size

    def empty(self) -> None:
        """Give its memory back; it can be used again."""
        os.ftruncate(self._file, 0)

    def bytes_to(self, stop: int) -> memoryview:
        """Return its bytes, writable, at least `stop` of them, which are reserved."""
        if stop > len(self._bytes):
            self._bytes = memoryview(mmap.mmap(self._file, 0))
        return self._bytes


class ArrayWriter:
    """Write arrays to a file, one after the other.

    Parameters
    ----------
    file : SharedFile or None
        Nobody may still use what it holds after `end`.
    end : int
        The first byte to write to.
    """

    def __init__(self, file: SharedFile | None, end: int = 0) -> None:
        self.file, self.end = file, end
        self._reserved = 0

    @property
    def place(self) -> tuple[str | None, int]:
        """Return what `at` in another process needs to go on."""
        return None if self.file is None else self.file.key, self.end

    @classmethod
    def at(cls, key: str | None, end: int) -> ArrayWriter:
        """Return a writer that continues what another one wrote."""
        return cls(None if key is None else SharedFile.open(key), end)

    def put(self, array: NDArray[Any]) -> int | NDArray[Any]:
        """Write an array and return what to send in its place.

        That is its first byte; or, without a file or where memory is full, the array.
        """
        file, start = self.file, self.end
        if file is None:
            return array
        stop = start + array.nbytes
        try:
            if stop > self._reserved:
                self._reserved = file.reserve(stop)
            there = file.bytes_to(stop)
        except OSError:
            return array
        self.end = stop + -stop % _ALIGN
        np.ndarray(array.shape, array.dtype, there, start)[...] = array
        return start

    def read_into(self, out: NDArray[Any], sent: int | NDArray[Any]) -> None:
        """Copy what `put` returned to an array of the same shape and dtype."""
        if self.file is not None and isinstance(sent, int):
            there = self.file.bytes_to(sent + out.nbytes)
            sent = np.ndarray(out.shape, out.dtype, there, sent)
        out[...] = sent


class SharedValue(NamedTuple):
    """A value whose arrays are in a file; made by `share`.

    Parameters
    ----------
    key : str
        That of the file.
    spans : tuple of (int, int)
        First byte and size in bytes of each array.
    pickled : bytes
        The value without its arrays (pickle protocol 5, out-of-band buffers).
    """

    key: str
    spans: tuple[tuple[int, int], ...]
    pickled: bytes


def share(value: Any, writer: ArrayWriter) -> Any:
    """Write the arrays of a picklable value; return what to send instead.

    That is a SharedValue, or the value itself where `writer` has no file or memory is
    full.
    """
    if writer.file is None:
        return value
    arrays: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(value, protocol=5, buffer_callback=arrays.append)
    spans = []
    for one in arrays:
        raw = np.frombuffer(one.raw(), np.uint8)
        start = writer.put(raw)
        if not isinstance(start, int):
            return value
        spans.append((start, raw.nbytes))
    return SharedValue(writer.file.key, tuple(spans), pickled)


def load_shared(value: Any) -> Any:
    """Return the value that `share` was given.

    Its arrays lie in the file: they are read-only, and good until it is written again.
    """
    if not isinstance(value, SharedValue):
        return value
    file = SharedFile.open(value.key)
    return pickle.loads(value.pickled, buffers=[
        file.bytes_to(start + nbytes).toreadonly()[start:start + nbytes]
        for start, nbytes in value.spans])


class SharedFiles:
    """Files for the tasks of one recording, then for those of another.

    Parameters
    ----------
    shares : bool
        False where workers may be threads of this process or run on other machines:
        there are no files then, and values are sent as the executor sends them.

    Attributes
    ----------
    lent : bool
        Whether they are in use.
    """

    def __init__(self, *, shares: bool) -> None:
        self._shares, self.lent = shares, True
        self._files: dict[int, SharedFile] = {}
        self._tasks: set[Future[Any]] = set()
        # Processes that were forked meanwhile have them mapped, too.
        weakref.finalize(
            self, _give_back, self._files, self._tasks, os.getpid()).atexit = False

    def writer(self, index: int) -> ArrayWriter:
        """Return a writer to one of the files."""
        file = self._files.get(index)
        if file is None and self._shares and len(self._files) < _MOST_FILES:
            file = SharedFile.create()
            if file is not None:
                self._files[index] = file
        return ArrayWriter(file)

    def used_by(self, task: Future[Any]) -> None:
        """Note that a task uses a file until it is done."""
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    @property
    def idle(self) -> bool:
        """Whether nobody uses them, not even a task that was left behind."""
        return not (self.lent or self._tasks)

    def trim(self, most: int) -> None:
        """Keep so many bytes at most."""
        for file in self._files.values():
            most -= file.size
            if most < 0:
                file.empty()


def _give_back(
    files: dict[int, SharedFile], tasks: set[Future[Any]], process: int
) -> None:
    if not tasks and os.getpid() == process:
        for file in files.values():
            file.empty()


_lock = threading.RLock()   # garbage collection may end a recording in between
_known: weakref.WeakKeyDictionary[
    Executor, list[SharedFiles]] = weakref.WeakKeyDictionary()


@contextlib.contextmanager
def shared_files(executor: Executor) -> Iterator[SharedFiles]:
    """Lend files that this process shares with an executor's workers.

    They are kept for the next recording, until the executor is gone.

    Parameters
    ----------
    executor : Executor

    Yields
    ------
    SharedFiles
    """
    if not isinstance(executor, ProcessPoolExecutor):
        yield SharedFiles(shares=False)
        return
    with _lock:
        known = _known.setdefault(executor, [])
        mine = next((files for files in known if files.idle), None)
        if mine is None:
            mine = SharedFiles(shares=True)
            known.append(mine)
        mine.lent = True
    try:
        yield mine
    finally:
        with _lock:
            for files in known:     # of recordings that were fused at the same time
                if files.idle:
                    files.trim(0)
            mine.lent = False
            if mine.idle:
                mine.trim(_KEPT)
