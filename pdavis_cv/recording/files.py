"""What every reader of files is: opening, closing, positioned reads, problems."""
from __future__ import annotations

import dataclasses
import os
import threading
import warnings
import weakref
from abc import abstractmethod
from collections.abc import Callable, Hashable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._remote import RemotePath, as_path
from pdavis_cv.errors import DamagedFileWarning, PdavisWarning, RecordingError
from pdavis_cv.recording.base import Problem, Recording, RecordingInfo
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.timeline import BACKWARD, FILLED, OFFSET, OUTSIDE, Clock
from pdavis_cv.sensor import Layout

__all__ = ["FileReader", "FileRecording", "ProblemLog", "clock_text"]


class FileReader:
    """A file that several threads may read at any place; closed when collected.

    Parameters
    ----------
    path : path
    descriptor : int, optional
        Of a file that is open already, which `close` closes; `path` is its name then.

    Raises
    ------
    RecordingError
        If the file cannot be opened.
    """

    def __init__(
        self, path: str | os.PathLike[str], descriptor: int | None = None
    ) -> None:
        self.path = Path(path)
        flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
        try:
            self._descriptor = (
                os.open(self.path, flags) if descriptor is None else descriptor)
        except OSError as error:
            raise RecordingError(
                f"{path}: cannot be opened: {error.strerror}") from error
        self._close = weakref.finalize(self, os.close, self._descriptor)
        self._lock = threading.Lock()
        self.size = os.fstat(self._descriptor).st_size

    def read(self, offset: int, size: int) -> bytes:
        """Return up to size bytes from offset on; fewer only at the end.

        Raises
        ------
        ValueError
            If the recording was closed.
        RecordingError
            If the system cannot read.
        """
        if not self._close.alive:
            raise ValueError(f"{self.path.name}: recording is closed")
        if offset < 0 or size <= 0:
            return b""
        size = min(size, max(self.size - offset, 0))
        parts = []
        try:
            while size > 0:
                part = self._pread(size, offset)
                if not part:
                    break
                parts.append(part)
                offset, size = offset + len(part), size - len(part)
        except OSError as error:
            raise self._unreadable(offset, error) from error
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def read_into(self, offset: int, buffer: memoryview) -> int:
        """Fill a buffer of bytes from offset on; return how many there were.

        Memory that is used again costs less than fresh memory for each read.
        Raises as `read` does.
        """
        if not hasattr(os, "preadv"):
            data = self.read(offset, len(buffer))
            buffer[:len(data)] = data
            return len(data)
        if not self._close.alive:
            raise ValueError(f"{self.path.name}: recording is closed")
        size, done = min(len(buffer), max(self.size - offset, 0)), 0
        try:
            while done < size:
                part = os.preadv(self._descriptor, [buffer[done:size]], offset + done)
                if not part:
                    break
                done += part
        except OSError as error:
            raise self._unreadable(offset + done, error) from error
        return done

    def _unreadable(self, offset: int, error: OSError) -> RecordingError:
        return RecordingError(
            f"{self.path}: byte {offset} cannot be read: {error.strerror}")

    def _pread(self, size: int, offset: int) -> bytes:
        if hasattr(os, "pread"):
            return os.pread(self._descriptor, size, offset)
        with self._lock:  # Windows has no positioned read
            os.lseek(self._descriptor, offset, os.SEEK_SET)
            return os.read(self._descriptor, size)

    def close(self) -> None:
        """Release the file."""
        self._close()


class RemoteReader(FileReader):
    """An object of a store that several threads may read at any place, by ranges.

    Parameters
    ----------
    path : RemotePath

    Raises
    ------
    RecordingError
        If it is not there.
    """

    def __init__(self, path: RemotePath) -> None:
        self.path: Any = path
        try:
            self.size = path.stat().st_size
            self._block = path.ranges()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be opened: {error}") from error
        self._close: Any = weakref.finalize(self, self._block.cache_clear)

    def read_into(self, offset: int, buffer: memoryview) -> int:
        """Fill a buffer of bytes from offset on; return how many there were."""
        data = self.read(offset, len(buffer))
        buffer[:len(data)] = data
        return len(data)

    def _pread(self, size: int, offset: int) -> bytes:
        found: bytes = self.path.read(self._block, offset, size)
        return found


class ProblemLog:
    """Problems of one recording, each finding counted once however often it is read.

    Parameters
    ----------
    name : str
        Name of the recording, for warnings.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = threading.Lock()
        self._found: dict[str, Problem] = {}
        self._seen: set[Hashable] = set()
        self._warned: set[type[Warning]] = set()

    def add(self, kind: str, key: Hashable | None, message: str, *, count: int = 1,
            offset: int | None = None, start_us: int | None = None,
            stop_us: int | None = None,
            warning: type[PdavisWarning] | None = None) -> None:
        """Note a finding; key says which one it is, None that none comes twice.

        A stream that may last for days gives None, so that no key is kept.  Warns once
        per class of warning.

        The findings of one kind make one `Problem`: the message and the offset of
        the first, the sum of the counts, the hull of the time ranges.
        """
        with self._lock:
            if key is not None:
                if (kind, key) in self._seen:
                    return
                self._seen.add((kind, key))
            old = self._found.get(kind)
            if old is None:
                self._found[kind] = Problem(
                    kind, message, count, offset, start_us, stop_us)
            else:
                starts = [t for t in (old.start_us, start_us) if t is not None]
                stops = [t for t in (old.stop_us, stop_us) if t is not None]
                self._found[kind] = dataclasses.replace(
                    old, count=old.count + count, start_us=min(starts, default=None),
                    stop_us=max(stops, default=None))
            warn = warning is not None and warning not in self._warned
            if warning is not None:
                self._warned.add(warning)
        if warn and warning is not None:
            warnings.warn(f"{self.name}: {message}", warning, stacklevel=3)

    def damage(self, key: Hashable, message: str, *, offset: int,
               start_us: int | None = None, stop_us: int | None = None) -> None:
        """Note that a part of the file is lost."""
        self.add("damage", key, message, offset=offset, start_us=start_us,
                 stop_us=stop_us, warning=DamagedFileWarning)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """One Problem per kind, in the order of finding."""
        with self._lock:
            return tuple(self._found.values())


class FileRecording(Recording):
    """A recording in a file: opening, closing, pickling and problems of every format.

    A format's reader says in `_open` what the file is, and in `packets` what it holds.

    Parameters
    ----------
    path : path
    layout : Layout, optional
    bad_events : {"drop", "raise"}
    camera : str, optional
        Which camera, if the file holds several.
    **options
        Of the format; see `Format`.

    Attributes
    ----------
    _log : ProblemLog
        Where findings go; with `_strict` they are errors, see `_count`.
    _closing : ExitStack
        What `_open` opens is put here, and `close` releases it.
    """

    def __init__(self, path: str | os.PathLike[str], *, layout: Layout | None = None,
                 bad_events: str = "drop", camera: str | None = None,
                 **options: Any) -> None:
        self._arguments = {"layout": layout, "bad_events": bad_events,
                           "camera": camera, **options}
        self._path = as_path(path)
        self._strict = bad_events == "raise"
        self._log = ProblemLog(str(path))
        self._closing = ExitStack()
        try:
            self._info = self._open(layout, camera, **options)
        except BaseException:
            self._closing.close()
            raise

    @abstractmethod
    def _open(self, layout: Layout | None, camera: str | None) -> RecordingInfo:
        """Open the file and return its facts; formats with options take them too.

        Raises
        ------
        RecordingError
            If it cannot be opened or is not what it says.
        """

    def _bytes(self) -> FileReader:
        """Return the file's bytes, which `close` releases."""
        reader = RemoteReader(self._path) if isinstance(
            self._path, RemotePath) else FileReader(self._path)
        self._closing.callback(reader.close)
        return reader

    def _count(self, at: int, kind: str, count: int, message: str, *,
               unit: str = "byte") -> None:
        """Note how many samples at a place were left out and why, or refuse the file.

        Parameters
        ----------
        at : int
            Place in the file: each counts once, however often it is read.
        kind : str
            Of `Problem`.
        count : int
            How many; 0 is nothing.
        message : str
            Goes on after the number.
        unit : str
            What `at` counts.
        """
        if not count:
            return
        if self._strict:
            raise RecordingError(f"{self._path}: {unit} {at}: {count} {message}")
        self._log.add(kind, at, message, count=count,
                      offset=at if unit == "byte" else None)

    def _dropped(self, clock: Clock, at: int, jumps: int, *, unit: str = "byte"
                 ) -> None:
        """Note what a kernel left out of a piece, as the clock's state counts it.

        Parameters
        ----------
        clock : Clock
            Its counts are of this piece.
        at, unit
            As in `_count`.
        jumps : int
            How often time jumped back by more than a second.
        """
        if jumps:
            self._log.add("segment", at, "time jumped back by more than a second: a "
                          "new segment, moved to follow the one before",
                          offset=at if unit == "byte" else None)
        for kind, count, message in (
                ("outside sensor", clock.state[OUTSIDE], "events outside the sensor "
                 "were dropped"),
                ("backward time", clock.state[BACKWARD], "events were dropped because "
                 "time ran backward")):
            self._count(at, kind, int(count), message, unit=unit)

    def _checked(self, columns: Sequence[NDArray[Any]], clock: Clock, at: int,
                 memory: Scratch, *, unit: str = "byte") -> NDArray[Any]:
        """Return those events that lie on the sensor and in order; count the others.

        Parameters
        ----------
        columns : four of ndarray, shape (N,)
            t in us, int64; x, y; p, where negative is OFF; whole numbers.
        clock : Clock
            Time of the events before these.
        memory : Scratch
            Gives the room for them.
        at, unit
            As in `_count`.

        Returns
        -------
        ndarray of EVENT_DTYPE, shape (M,)
        """
        t = np.ascontiguousarray(columns[0])
        x, y, p = map(_narrow, columns[1:])
        return self._taken(
            lambda done, out: _kernels.event_columns(
                t, x, y, p, done, *self._info.sensor_size, clock.state, out),
            len(t), clock, at, memory, unit=unit)

    def _taken(self, kernel: Callable[[int, NDArray[Any]], tuple[int, int, int]],
                 count: int, clock: Clock, at: int, memory: Scratch, *, unit: str
                 ) -> NDArray[Any]:
        """Return what a kernel takes of count events; count what it leaves out.

        Parameters
        ----------
        kernel : callable
            (first, out) -> (how far, whether time jumps back there, the time there).
        count, clock, at, memory, unit
            As in `_checked`.
        """
        events = memory.room(count)
        clock.begin()
        done = jumps = 0
        while done < count:
            done, jump, t = kernel(done, events)
            if jump:
                clock.jump(t + int(clock.state[OFFSET]))
                jumps += 1
        self._dropped(clock, at, jumps, unit=unit)
        return events[:int(clock.state[FILLED])]

    @property
    def path(self) -> Path:
        """The file that is read."""
        return self._path

    @property
    def info(self) -> RecordingInfo:
        """Header facts."""
        return self._info

    @property
    def problems(self) -> Sequence[Problem]:
        """What was found wrong so far."""
        return self._log.problems

    def close(self) -> None:
        """Release the file."""
        self._closing.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, (type(self), os.fspath(self._path), self._arguments)


def _narrow(column: NDArray[Any]) -> NDArray[np.int32]:
    """Return whole numbers as int32; beyond that they lie outside any sensor."""
    if column.dtype.kind == "u" and column.dtype.itemsize > 2:
        column = np.minimum(column, column.dtype.type(1 << 30))
    elif column.dtype.itemsize > 4:
        column = np.clip(column, -1, 1 << 30)
    return np.ascontiguousarray(column, np.int32)


def _reopen(reader: Callable[..., FileRecording], path: str,
            arguments: dict[str, Any]) -> FileRecording:
    return reader(path, **arguments)


def clock_text(start_us: int | None, stop_us: int | None) -> str:
    """Return words for a time range of which an end may be unknown."""
    if start_us is None and stop_us is None:
        return "at an unknown time"
    if start_us is None:
        return f"before {stop_us} us"
    if stop_us is None:
        return f"after {start_us} us"
    return f"from {start_us} to {stop_us} us"
