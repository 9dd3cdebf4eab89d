"""Base of file readers: opening, closing, checked events and problems."""
from __future__ import annotations

import dataclasses
import os
import warnings
from _thread import allocate_lock  # threading is slow to import
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
from pdavis_cv.events import FAR
from pdavis_cv.recording.base import Problem, Recording, RecordingInfo
from pdavis_cv.recording.facts import ASSUMED, CALLER, FILE, Fact
from pdavis_cv.recording.file_reader import FileReader, RemoteReader
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.options import MAX_SIDE, SourceOptions
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.timeline import BACKWARD, OUTSIDE, Clock

_NOTHING_STATED = SourceOptions()
_SIZES = ((260, 346), (480, 640), (720, 1280))
"""(height, width) of usual sensors, for files without a sensor size."""


class ProblemLog:
    """Collect the problems of one recording; repeated reading counts each only once.

    Its name is for warnings.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = allocate_lock()
        self._found: dict[str, Problem] = {}
        self._seen: set[Hashable] = set()
        self._warned: set[type[Warning]] = set()

    def add(self, kind: str, key: Hashable | None, message: str, *, count: int = 1,
            offset: int | None = None, start_us: int | None = None,
            stop_us: int | None = None,
            warning: type[PdavisWarning] | None = None) -> None:
        """Add a finding; one with the same key as an earlier one is ignored.

        With None as key it is always counted; streams that may last for days use it, so
        that no keys have to be stored.  A warning is issued once per class.

        Findings of one kind are merged into one `Problem`: the message and offset of
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
        """Add the finding that a part of the file is lost."""
        self.add("damage", key, message, offset=offset, start_us=start_us,
                 stop_us=stop_us, warning=DamagedFileWarning)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """One Problem per kind, in the order of their first finding."""
        with self._lock:
            return tuple(self._found.values())


class FileRecording(Recording):
    """Base of recordings in files: opening, closing, pickling and problems.

    The reader of a format implements `_open`, which returns the facts, and `packets`.

    Parameters
    ----------
    path : path
    options : SourceOptions
        What the caller states.

    Attributes
    ----------
    _log : ProblemLog
        Receives findings; with `_strict` they are raised as errors, see `_count`.
    _closing : ExitStack
        Holds what `_open` opens, to be released by `close`.
    _budget : Budget
        What the file may make its reader take.
    """

    _unit = "byte"
    """Unit of positions in the file."""

    def __init__(self, path: str | os.PathLike[str],
                 options: SourceOptions = _NOTHING_STATED) -> None:
        self._options = options
        self._path = as_path(path)
        self._strict = options.bad_events == "raise"
        self._log = ProblemLog(str(path))
        self._budget = Budget(path, options.limits)
        self._closing = ExitStack()
        self._closed = False
        try:
            self._info = self._open(options)
        except BaseException:
            self._closing.close()
            raise

    @abstractmethod
    def _open(self, options: SourceOptions) -> RecordingInfo:
        """Open the file and return its facts, with those of `stated`."""

    def _check_camera(self, camera: str | None, name: str | None) -> None:
        """Raise RecordingError if the caller's camera is no part of the file's name."""
        if camera is not None and camera.lower() not in (name or "").lower():
            raise RecordingError(
                f"{self._path}: no camera named {camera!r}: it is {name}")

    def _sensor_size(
        self, of_file: Fact | tuple[int, int] | None,
        farthest: Callable[[], tuple[int, int]] | None = None,
    ) -> Fact:
        """Return (height, width) as the file or the caller states it, or assumed.

        `farthest` returns the largest x and y of the first events: the smallest usual
        sensor that holds them is assumed.
        """
        if of_file is None and self._options.size is not None:
            of_file = Fact(self._options.size, CALLER)
        if of_file is None and farthest is not None:
            x, y = (min(max(int(most), 0), MAX_SIDE - 1) for most in farthest())
            size = next(((h, w) for h, w in _SIZES if y < h and x < w), (y + 1, x + 1))
            self._log.add("unknown size", None, "the file does not give the sensor's "
                          f"size: {size[1]}x{size[0]} holds the first events; "
                          "sensor_size=(height, width) sets another")
            of_file = Fact(size, ASSUMED)
        if of_file is None:
            raise RecordingError(
                f"{self._path}: the header does not give the sensor's size")
        fact = of_file if isinstance(of_file, Fact) else Fact(of_file, FILE)
        height, width = fact.value
        if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
            raise RecordingError(f"{self._path}: sensor sides must lie in 1..{MAX_SIDE}"
                                 f", got {width}x{height}")
        return fact

    def _bytes(self) -> FileReader:
        """Return the file's bytes, which `close` releases."""
        reader = RemoteReader(self._path) if isinstance(
            self._path, RemotePath) else FileReader(self._path)
        self._closing.callback(reader.close)
        return reader

    def _count(self, at: int, kind: str, count: int, message: str) -> None:
        """Add the number of samples that were left out; if strict, raise instead.

        Each position `at` in the file, in `_unit`, is counted once, as a `Problem` of
        this kind; the message follows the number.  Nothing is done for 0.
        """
        if not count:
            return
        if self._strict:
            raise RecordingError(f"{self._path}: {self._unit} {at}: {count} {message}")
        self._log.add(kind, at, message, count=count, offset=self._offset(at))

    def _offset(self, at: int) -> int | None:
        return at if self._unit == "byte" else None

    def _checked(self, columns: Sequence[NDArray[Any]], clock: Clock, at: int,
                 memory: Scratch) -> NDArray[Any]:
        """Return the events that lie on the sensor and in time order; count the others.

        The columns are t in us, int64; x; y; p, where negative is OFF; all integers,
        (N,).  The clock is that of the events before these; `memory` provides that of
        the result.  For `at` see `_count`.
        """
        t = np.require(columns[0], None, ("C", "A"))
        x, y, p = map(_narrow, columns[1:])
        return self._taken(lambda out: _kernels.event_columns(
            t, x, y, p, *self._info.sensor_size, clock.state, out),
            len(t), clock, at, memory)

    def _taken(self, kernel: Callable[[NDArray[Any]], object] | None, count: int,
               clock: Clock, at: int, memory: Scratch) -> NDArray[Any]:
        """Return the events that a kernel decodes and the clock accepts for good.

        The kernel appends up to count events to memory; without one, none follow.  The
        other arguments are those of `_checked`.
        """
        jumps = clock.jumps
        out = clock.room(memory, count)
        if kernel is not None:
            kernel(out)
        events = clock.settled(out, final=kernel is None)
        if clock.jumps > jumps:
            self._log.add("segment", at, "time jumped back by more than a second: a "
                          "new segment, moved to follow the one before",
                          count=clock.jumps - jumps, offset=self._offset(at))
        self._count(at, "outside sensor", int(clock.state[OUTSIDE]),
                    "events outside the sensor were dropped")
        self._count(at, "backward time", int(clock.state[BACKWARD]),
                    "events were dropped because time ran backward")
        return events

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
        """Problems found so far."""
        return self._log.problems

    def close(self) -> None:
        """Release the file."""
        self._closed = True
        self._closing.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (os.fspath(self._path), self._options)


def _narrow(column: NDArray[Any]) -> NDArray[np.int32]:
    """Return integers as int32; clipped values, and fractions, are on no sensor."""
    if column.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            column = np.where(column % 1 == 0, np.clip(
                column.astype(np.float64), -1, 1 << 30), 1 << 30)
    elif column.dtype.kind == "u" and column.dtype.itemsize > 2:
        column = np.minimum(column, column.dtype.type(1 << 30))
    elif column.dtype.itemsize > 4:
        column = np.clip(column, -1, 1 << 30)
    return np.require(column, np.int32, ("C", "A"))


def microseconds(t: NDArray[Any], unit: float) -> NDArray[np.int64]:
    """Return times, in units of so many us, in us.

    Those that no clock has are dropped when they are checked.
    """
    if t.dtype.kind != "f":
        return (t if unit >= 1 else t // round(1 / unit)).astype(np.int64)
    with np.errstate(over="ignore"):
        t = np.rint(t.astype(np.float64) * unit)
    return np.where(np.abs(t) < FAR, t, -2 * FAR).astype(np.int64)


def clock_text(start_us: int | None, stop_us: int | None) -> str:
    """Return a text for a time range, one end of which may be unknown."""
    if start_us is None and stop_us is None:
        return "at an unknown time"
    if start_us is None:
        return f"before {stop_us} us"
    if stop_us is None:
        return f"after {start_us} us"
    return f"from {start_us} to {stop_us} us"
