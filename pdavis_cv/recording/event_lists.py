"""Lists of events: lines of text (CSV) and NumPy arrays."""
from __future__ import annotations

import zipfile
import zlib
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.files import microseconds
from pdavis_cv.recording.numpy_files import StoredArray, stored_arrays, unpacked
from pdavis_cv.recording.options import MAX_SIDE, SourceOptions
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import SequentialRecording
from pdavis_cv.recording.text_form import (
    NAMES,
    UNITS,
    US_PER,
    checked_order,
    text_form,
    unit_of,
    unit_of_times,
)
from pdavis_cv.recording.timeline import FILLED, Clock

CHUNK = 1 << 18
"""Bytes of text that are read at a time."""
ROWS = 1 << 16
"""Rows of arrays that are read at a time."""
LOOKED_AT = 1 << 16
"""Bytes of text at its beginning, middle and end, from which its form is found."""


class _EventList(SequentialRecording):
    """Base of event lists, which do not give the sensor's size or the unit of time."""

    _copied: str | None = None
    """What a file of this library says of its source."""

    def _facts(self, kind: str, options: SourceOptions,
               header: Mapping[str, Any], of_file: tuple[int, int] | None = None
               ) -> RecordingInfo:
        """Return the facts; without a size, the first events determine it."""
        return RecordingInfo(
            format=kind, frame_count=0, imu_count=0, trigger_count=0, header=header,
            **stated(options, self._copied, sensor_size=self._sensor_size(
                of_file, self._farthest)))

    def _unit_said(self, unit: str, doubt: str) -> str:
        """Return the unit of times; say why to doubt it."""
        if doubt:
            self._log.add("time unit", None, doubt)
        return unit

    @abstractmethod
    def _farthest(self) -> tuple[int, int]:
        """Return the largest x and y of the first events."""


class TextRecording(_EventList):
    """A list of events as text, one per line; see `open_recording`.

    Numbers are separated by blanks, commas, semicolons or tabs.  Lines before the first
    event may name the columns, or give the sensor's width and height.  Times with
    fractions are seconds, whole ones microseconds, or nanoseconds beyond 10**17.  Also
    a zip archive with one such text.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._reader = self._text()
        self._end = self._reader.size
        blocks = self._looked_at()
        form = text_form(blocks[0])
        if form is None:
            raise RecordingError(
                f"{self._path}: its lines are not four or more numbers")
        order = checked_order(self._path, form, options.columns, blocks)
        self._more = form.columns > len(order)
        if self._more and "_" not in order and not (options.columns or form.order):
            self._log.add("further columns", None, f"lines have {form.columns} columns:"
                          " the first four are read as time, x, y, polarity")
        self._begin, self._bottom = form.begin, form.bottom
        self._order = np.array(["txyp".find(name) for name in order], np.int64)
        unit = form.unit or self._unit_said(*unit_of_times(blocks, order))
        self._unit_of_time = UNITS.index(unit)
        return self._facts(f"text, times in {unit}", options, {
            "time_unit": unit, "first_row": "bottom" if form.bottom else "top"},
            form.size)

    def _text(self) -> FileReader:
        """Return the text, unpacked if it is in an archive of one."""
        reader = self._bytes()
        if reader.read(0, 4) != b"PK\x03\x04":
            return reader
        try:
            with zipfile.ZipFile(self._path) as archive:
                # is_dir() fails on a name that is empty.
                members = [m for m in archive.infolist()
                           if not m.filename.endswith("/")]
            texts = [m for m in members
                     if m.filename.lower().endswith((".txt", ".csv"))]
            self._budget.total(sum(m.file_size for m in texts))
            text = unpacked(self._path, texts[0]) if len(texts) == 1 else None
        except RecordingError:
            raise
        except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError,
                RuntimeError, ValueError, zlib.error) as error:
            raise RecordingError(
                f"{self._path}: not a zip archive that can be read: {error}") from error
        if text is None:
            names = ", ".join(m.filename for m in members[:5])
            raise RecordingError(
                f"{self._path}: a zip archive is read if it holds one text of events "
                f"or NumPy's arrays; it holds {len(members)} files: {names}")
        self._closing.callback(text.close)
        return text

    def _looked_at(self) -> list[bytes]:
        """Return whole lines at the beginning, in the middle and at the end."""
        size, read = self._reader.size, self._reader.read
        first = read(0, LOOKED_AT)
        if size <= LOOKED_AT:
            return [first if first.endswith(b"\n") else first + b"\n"]
        later = (read(at, LOOKED_AT) for at in (size // 2, size - LOOKED_AT))
        return [first, *(data[data.find(b"\n") + 1:] for data in later)]

    def _farthest(self) -> tuple[int, int]:
        data, state = self._chunk(self._begin, Scratch()), Clock(None).state
        events = np.empty(_room(data), EVENT_DTYPE)
        self._lines(data, (MAX_SIDE, MAX_SIDE), state, events)
        x, y = (events[axis][:int(state[FILLED])] for axis in "xy")
        return int(x.max(initial=0)), int(y.max(initial=0))

    def _next(self, at: int, clock: Clock, state: Any, memory: Scratch
              ) -> tuple[NDArray[Any], int]:
        data = self._chunk(at, memory)
        done = bad = 0

        def decode(out: NDArray[Any]) -> None:
            nonlocal done, bad
            begin = int(clock.state[FILLED])
            done, bad = self._lines(data, self._info.sensor_size, clock.state, out)
            if self._bottom:
                rows = out["y"][begin:int(clock.state[FILLED])]
                rows[:] = self._info.sensor_size[0] - 1 - rows

        events = self._taken(decode, _room(data), clock, at, memory)
        self._count(at, "bad line", bad, "lines are not four numbers")
        if not done and len(data) >= CHUNK:
            raise RecordingError(
                f"{self._path}: byte {at}: a line of more than {CHUNK} bytes")
        return events, min(at + done, self._reader.size)

    def _chunk(self, at: int, memory: Scratch) -> NDArray[np.uint8]:
        data = memory.read(self._reader, at, CHUNK)
        if len(data) and at + len(data) == self._reader.size and data[-1] != ord("\n"):
            return np.append(data, np.uint8(ord("\n")))  # the last line may have none
        return data

    def _lines(self, data: NDArray[np.uint8], size: tuple[int, int],
               state: NDArray[np.int64], out: NDArray[Any]) -> tuple[int, int]:
        """Append the events of whole lines; return how far, and how many are bad."""
        return _kernels.text_events(
            data, 0, self._order, self._more, self._unit_of_time, *size, state, out)


def _room(data: NDArray[np.uint8]) -> int:
    """Return how many events a text may hold: a line has four digits and separators."""
    return len(data) // 8 + 1


class NumpyRecording(_EventList):
    """A list of events in ``.npy`` or ``.npz``; see `open_recording`.

    A ``.npy`` file holds fields t, x, y, p (or their usual other names), or four
    columns in this order; a ``.npz`` file holds one array for each, or such an array
    under any name.  Times with fractions are seconds, integers are microseconds, or
    nanoseconds beyond 10**17.  Compressed arrays are unpacked into a temporary file.
    """

    _kind, _unit = "NumPy", "row"
    _size: tuple[int, int] | None = None

    def _found(self) -> Mapping[str, Any]:
        """Return the arrays of the file by name, each like a `StoredArray`."""
        self._reader = self._bytes()
        return stored_arrays(
            self._reader, lambda reader: self._closing.callback(reader.close),
            self._budget)

    def _open(self, options: SourceOptions) -> RecordingInfo:
        try:
            found = self._found()
        except (RecordingError, ImportError):
            raise
        except Exception as error:  # NumPy raises anything for a damaged header
            raise RecordingError(
                f"{self._path}: not arrays that can be read: {error}") from None
        self._arrays_of = _events_of(found, str(self._path))
        self._end = len(self._arrays_of[0])
        self._scale = self._unit_said(*unit_of(self._arrays_of[0].rows(0, ROWS)))
        return self._facts(
            f"{self._kind}, times in {self._scale}", options,
            {"time_unit": self._scale}, self._size)

    def _farthest(self) -> tuple[int, int]:
        # Coordinates beyond any sensor are damage.
        x, y = (column[(column >= 0) & (column < MAX_SIDE)]
                for column in self._columns(0)[1:3])
        return int(x.max(initial=0)), int(y.max(initial=0))

    def _next(self, at: int, clock: Clock, state: Any, memory: Scratch
              ) -> tuple[NDArray[Any], int]:
        columns = self._columns(at)
        after = at + len(columns[0])
        if after == at:
            return np.empty(0, EVENT_DTYPE), at
        return self._checked(columns, clock, at, memory), after

    def _columns(self, at: int) -> tuple[NDArray[Any], ...]:
        """Return t in us, x, y, p of the rows from `at` on."""
        read: dict[Any, NDArray[Any]] = {}
        columns = [array.rows(at, at + ROWS, read) for array in self._arrays_of]
        whole = min(map(len, columns))
        if whole < min(ROWS, len(self._arrays_of[0]) - at):
            self._log.damage(at, f"row {at + whole}: the file ends before its last row",
                             offset=self._path.stat().st_size)
        t, x, y, p = (column[:whole] for column in columns)
        return microseconds(t, US_PER[self._scale]), x, y, p


def _events_of(found: Mapping[str, Any], path: str) -> tuple[Any, ...]:
    """Return the columns t, x, y, p of a file, which have the same length."""
    def named(columns: Mapping[str, Any]) -> tuple[Any, ...] | None:
        by_name = {NAMES[name.lower()]: column for name, column in columns.items()
                   if name.lower() in NAMES}
        if set(by_name) != set("txyp"):
            return None
        chosen = tuple(by_name[name] for name in "txyp")
        good = len({a.shape for a in chosen}) == 1 and all(
            len(a.shape) == 1 and a.kind in "iufb" for a in chosen)
        return chosen if good else None

    events = named(found)
    for array in found.values():
        if events is not None:
            break
        if not isinstance(array, StoredArray):
            continue
        names = array.dtype.names
        if names is not None and len(array.shape) == 1:
            events = named({name: array.of(name) for name in names})
        elif array.shape[1:] == (4,) and array.kind in "iuf":
            events = tuple(map(array.of, range(4)))
    if events is None:
        what = ", ".join(f"{name or 'an array'} {a.shape} {getattr(a, 'dtype', a.kind)}"
                         for name, a in found.items())
        raise RecordingError(
            f"{path}: no events: arrays t, x, y, p are needed, one with such fields, "
            f"or one of shape (N, 4); it holds {what or 'nothing'}")
    return events
