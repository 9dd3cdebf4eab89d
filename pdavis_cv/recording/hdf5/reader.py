"""HDF5 in the layouts of E2P and rpg (events and frames), DSEC and Metavision (events).

E2P: ``/events`` (N, 4) of t, x, y, p, ``/frame`` (K, H, W), ``/frame_ts``,
``/frame_idx``.  DSEC: ``/events/{t,x,y,p}``, ``/ms_to_idx``, ``/t_offset``.  The
layout of rpg and Monash: ``/events/{ts,xs,ys,ps}``, ``/images/image000000000`` with an
attribute ``timestamp``, ``sensor_resolution``.  Metavision: ``/CD/events`` with fields
x, y, p, t, and ``/EXT_TRIGGER/events``.  Data that these layouts do not have
(exposure, IMU, triggers) are stored under ``/pdavis``.
"""
from __future__ import annotations

import contextlib
import math
import re
from bisect import bisect_left
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._packages import package
from pdavis_cv.errors import DamagedFileWarning, PdavisError, RecordingError
from pdavis_cv.events import EVENT_DTYPE, FAR
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    TRIGGER_DTYPE,
    ApsFrame,
    RecordingInfo,
    joined,
)
from pdavis_cv.recording.facts import ASSUMED, FILE, Fact, stated
from pdavis_cv.recording.files import microseconds
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import END_OF_TIME, Batch, cell_start
from pdavis_cv.recording.prophesee import OTHER_TRIGGERS, ordered_triggers
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import PiecewiseRecording
from pdavis_cv.recording.text_form import US_PER, unit_of
from pdavis_cv.recording.timeline import NEVER, Clock, Timeline
from pdavis_cv.sensor import Layout, Sensor

CHUNK = 1 << 16
LEAST_PIECE = 256
_PIXEL = 6
"""Bytes that a pixel of a frame takes while it is read."""
MAX_EXPOSURE_US = 60_000_000
ECF = 0x8ECF
"""Prophesee's number of its codec among the filters of HDF5."""
_COLUMNS = {("t", "x", "y", "p"): "HDF5 (DSEC)", ("ts", "xs", "ys", "ps"): "HDF5 (rpg)"}
"""Formats by the names of the columns of ``/events``."""
Columns = tuple[NDArray[Any], ...]
"""t, x, y, p of some events."""


def h5py_module() -> Any:
    """Return the package h5py, or raise ImportError with the command to install it."""
    return package("h5py", "HDF5 needs a package: pip install h5py")


class _LostError(Exception):
    """Raised when HDF5 cannot read a part of a file."""


@contextlib.contextmanager
def _reading() -> Iterator[None]:
    """Convert any exception that h5py raises for a damaged file into one type."""
    try:
        yield
    except PdavisError:
        raise
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError,
            OverflowError, MemoryError, SystemError) as error:
        raise _LostError(f"{type(error).__name__}: {error}") from error


class Hdf5Recording(PiecewiseRecording):
    """A recording in HDF5; see `open_recording`."""

    _unit = "row"

    def _open(self, options: SourceOptions) -> RecordingInfo:
        h5py, path = h5py_module(), self._path
        self._channel = options.trigger_channel
        try:
            with _reading():
                # Each chunk is unpacked once, however large.
                self._file = h5py.File(
                    path, "r", rdcc_nbytes=int(self._budget.limits.memory) // 8)
        except _LostError as error:
            raise RecordingError(f"{path}: byte 0: HDF5 cannot read it: {error}"
                                 ) from error
        self._closing.callback(self._file.close)
        try:
            with _reading():
                self._columns = self._find_events()
                self._frames = self._dataset(self._file, "frame", 3)
                images = self._member(self._file, "images")
                if self._frames is None and isinstance(images, h5py.Group):
                    self._frames = _SeparateImages(images, self._dataset, self._member)
                return self._make_info(options)
        except _LostError as error:
            raise RecordingError(f"{path}: the file is damaged: {error}") from error

    # Opening -------------------------------------------------------------------

    def _member(self, group: Any, name: str) -> Any:
        """Return a group or a dataset that lies in this file, None if there is none.

        If HDF5 would read another file instead, which nobody named, that is an error.
        """
        h5py = h5py_module()
        link = group.get(name, getlink=True)
        where = f"{group.name.rstrip('/')}/{name}"
        kind = {h5py.ExternalLink: "an external link",
                h5py.SoftLink: "a soft link"}.get(type(link))
        if kind is not None:
            raise RecordingError(
                f"{self._path}: {where} is {kind} to "
                f"{getattr(link, 'filename', '') or 'the file'}:{link.path}, which is "
                "not followed: copy the data into one file")
        found = None if link is None else group[name]
        if isinstance(found, h5py.Dataset) and (found.is_virtual or found.external):
            kind = "a virtual data set" if found.is_virtual else "external storage"
            raise RecordingError(
                f"{self._path}: {where} is {kind}: its data lie in other files, which "
                "are not read: copy the data into one file")
        return found

    def _dataset(self, group: Any, name: str, dimensions: int) -> Any:
        """Return a checked dataset of numbers, None if there is none."""
        found = self._member(group, name)
        if found is None:
            return None
        if not isinstance(found, h5py_module().Dataset) or found.ndim != dimensions or (
                found.dtype.kind not in "iufb"):
            raise RecordingError(
                f"{self._path}: {found.name if found.name else name} must be numbers "
                f"in {dimensions} dimensions")
        self._bounded(found, name)
        return found

    def _bounded(self, found: Any, name: str) -> None:
        """Raise RecordingError if a dataset is larger than the budget allows."""
        row = found.dtype.itemsize * math.prod(found.shape[1:])
        chunk = found.dtype.itemsize * math.prod(found.chunks or ())
        self._budget.piece(     # four columns keep one chunk each
            max(row, 4 * chunk, _PIXEL * math.prod(found.shape[1:])),
            f"{name} of shape {found.shape} in chunks {found.chunks}, pieces")
        self._budget.total(row * len(found))

    def _records(self, name: str, fields: str) -> Any:
        """Return ``/NAME/events`` of Metavision, None if there is none."""
        h5py = h5py_module()
        group = self._member(self._file, name)
        if not isinstance(group, h5py.Group):
            return None
        found = self._member(group, "events")
        if found is None:
            return None
        if not isinstance(found, h5py.Dataset) or found.ndim != 1 or (
                not set(fields) <= set(found.dtype.names or ())):
            raise RecordingError(
                f"{self._path}: /{name}/events must be records of {', '.join(fields)}")
        self._bounded(found, f"/{name}/events")
        filters = found.id.get_create_plist()
        for k in range(filters.get_nfilters()):
            number = filters.get_filter(k)[0]
            if not h5py.h5z.filter_avail(number):
                codec = "ECF" if number == ECF else f"filter {number}"
                raise RecordingError(
                    f"{self._path}: HDF5 of Metavision, compressed by {codec}, for "
                    "which HDF5 lacks the plugin: set HDF5_PLUGIN_PATH to that of "
                    "Prophesee's hdf5_ecf, or convert the file by "
                    "metavision_file_to_dat")
        return found

    def _find_events(self) -> Callable[[slice], Columns]:
        """Return a function from rows to (t, x, y, p); set the number of rows."""
        read: Callable[[slice], Columns]
        events = self._member(self._file, "events")
        group: Any = events if isinstance(events, h5py_module().Group) else {}
        names = next((names for names in _COLUMNS if all(k in group for k in names)),
                     None)
        if (records := self._records("CD", "txyp")) is not None:
            self._format, parts = "HDF5 (Metavision)", [records]

            def read(rows: slice) -> Columns:
                part = records[rows]
                return tuple(np.ascontiguousarray(part[name]) for name in "txyp")
        elif names is not None:
            self._format = _COLUMNS[names]
            parts = [self._dataset(events, name, 1) for name in names]

            def read(rows: slice) -> Columns:
                return tuple(column[rows] for column in parts)
        elif events is not None and events is not group and (
                table := self._dataset(self._file, "events", 2)).shape[1] == 4:
            self._format, parts = "HDF5 (E2P)", [table]

            def read(rows: slice) -> Columns:
                return tuple(table[rows].T)
        else:
            raise RecordingError(
                f"{self._path}: no /events of E2P (N, 4), DSEC (t, x, y, p) or "
                "rpg (ts, xs, ys, ps), no /CD/events of Metavision; it "
                f"holds {', '.join(self._file) or 'nothing'}")
        lengths = [len(part) for part in parts]
        if len(set(lengths)) > 1:
            said = ", ".join(f"{part.name} {length}" for part, length in zip(
                parts, lengths, strict=True))
            raise RecordingError(
                f"{self._path}: columns of events must have one length, got {said}")
        self._length = lengths[0]
        self._piece = min((part.chunks or (CHUNK,))[0] for part in parts)
        unit = 1.0
        with contextlib.suppress(_LostError):   # which is said when they are read
            unit = US_PER[unit_of(self._first(read)[0])[0]]
        stated = self._member(self._file, "t_offset")
        offset = 0 if stated is None else int(stated[()])
        if abs(offset) > FAR // 2:
            raise RecordingError(f"{self._path}: t_offset of {offset:g} us is no time")

        def columns(rows: slice) -> Columns:
            t, x, y, p = read(rows)
            return microseconds(t, unit) + offset, x, y, p

        def times(rows: slice) -> NDArray[np.int64]:
            return microseconds(
                parts[0][rows] if len(parts) > 1 else read(rows)[0], unit) + offset

        self._times, self._firsts = times, [NEVER]
        return columns

    def _first(self, read: Callable[[slice], Columns]) -> Columns:
        """Return the columns of the readable ones of the first events."""
        step = min(max(self._piece, LEAST_PIECE), CHUNK)
        for rows in (slice(0, CHUNK), *(
                slice(row, row + step) for row in range(0, self._length, step))):
            with contextlib.suppress(_LostError), _reading():
                return read(rows)
        raise _LostError("none of its events can be read")

    def _farthest(self) -> tuple[int, int]:
        """Return the largest x and y of the first events."""
        _, x, y, _ = self._first(self._columns)
        return int(x.max(initial=0)), int(y.max(initial=0))

    def _stated_size(self, options: SourceOptions) -> Fact | None:
        """Return the sensor (height, width) that the file states, None without."""
        for name in ("sensor_size", "sensor_resolution", "geometry"):
            found = self._file.attrs.get(name)
            if found is None:
                continue
            if isinstance(found, bytes | str):
                text = found.decode("latin-1") if isinstance(found, bytes) else found
                sides = [int(side) for side in re.findall(r"-?\d{1,9}", text)]
                sides = [] if min(sides, default=0) < 1 else sides
                if len(sides) == 2 and name == "geometry":  # of Metavision
                    return Fact((sides[1], sides[0]), FILE)
                if len(sides) == 2:
                    height, width = sorted(sides)
                    self._log.add("sensor size", None, f"the attribute {name} is the "
                                  f"text {text!r}: taken as {width}x{height}")
                    return Fact((height, width), ASSUMED)
            else:
                sides = [int(side) for side in np.ravel(found)]
                if len(sides) == 2 and sides == np.ravel(found).tolist():
                    return Fact((sides[0], sides[1]), FILE)
            if options.size is None:
                raise RecordingError(
                    f"{self._path}: the attribute {name} must be two numbers, height "
                    f"and width, it is {found!r}; sensor_size= states it")
        return None

    def _make_info(self, options: SourceOptions) -> RecordingInfo:
        attributes, frames = self._file.attrs, self._frames
        of_frames = None if frames is None or not len(frames) else frames.shape[1:]
        size = self._sensor_size(
            self._stated_size(options) or of_frames, self._farthest)
        if of_frames is not None and of_frames != size.value:
            raise RecordingError(
                f"{self._path}: frames are of shape {of_frames}, the sensor is "
                f"{size.value}")
        known = attributes.get("layout")
        layout = None if known is None else Layout.stored(
            ",".join(str(int(angle)) for angle in known) + (
                f"-{colours}" if (colours := attributes.get("colours")) else ""),
            attributes.get("sensor"))
        camera = attributes.get("camera")
        known = stated(
            options, attributes.get("source_facts"), layout=layout,
            sensor_size=size, sensor=Sensor.of_chip(camera),
            frame_times=None if self._frames is None else "time stamps")
        self._full_scale = known.get("full_scale_dn")
        return RecordingInfo(
            format=self._format, writer=attributes.get("writer"), camera=camera,
            **known,
            start_us=self._start(), event_count=self._length,
            frame_count=0 if self._frames is None else len(self._frames),
            imu_count=len(self._table("imu", IMU_DTYPE)),
            trigger_count=len(self._triggers()))

    def _start(self) -> int | None:
        try:
            with _reading():
                return int(self._columns(slice(0, 1))[0][0]) if self._length else None
        except _LostError:
            return None  # reported when it is read

    # Reading -------------------------------------------------------------------

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each chunk, and the share of the events read by then."""
        places, taken = self._all_frames() if frames else [], 0
        if frames:
            yield Batch(imu=self._table("imu", IMU_DTYPE), triggers=self._triggers(),
                        complete_us=NEVER), 0.0
        clock, before = Clock(Timeline()), NEVER
        for row in range(self._row_before(start_us), self._length, CHUNK):
            events = self._events(row, min(row + CHUNK, self._length), clock, memory)
            now = clock.last
            ready: list[ApsFrame] = []
            while taken < len(places) and places[taken].ready <= max(now, before):
                ready += self._frame(places[taken])
                taken += 1
            before = now
            yield Batch(events, ready, complete_us=min(
                [now, *(f.ready for f in places[taken:taken + 1])])), (
                    min(row + CHUNK, self._length) / self._length)
        rest = self._taken(None, 0, clock, self._length, memory)
        yield Batch(rest, complete_us=min([END_OF_TIME, *(
            f.ready for f in places[taken:taken + 1])])), 1.0
        for place in places[taken:]:
            yield Batch(frames=self._frame(place), complete_us=place.ready), 1.0

    def _row_before(self, start_us: int | None) -> int:
        """Return a row up to which times are in order, and all before that is needed.

        A chunk more is read, as the clock decides on an event from those around it.
        `_firsts` are the times of the first rows of the chunks that are known.
        """
        if start_us is None:
            return 0
        t_us, firsts = cell_start(start_us), self._firsts.copy()
        with contextlib.suppress(_LostError), _reading():
            while firsts[-1] < t_us and (end := len(firsts) * CHUNK) < self._length:
                t = self._times(slice(end - CHUNK, end + 1))
                if np.any(t[1:] < t[:-1]):
                    break
                firsts.append(int(t[-1]))
        self._firsts = firsts
        return max(bisect_left(firsts, t_us) - 2, 0) * CHUNK

    def _events(self, row: int, stop: int, clock: Clock, memory: Scratch
                ) -> NDArray[Any]:
        """Return the events of rows, except those that cannot be read."""
        try:
            with _reading():
                columns = self._columns(slice(row, stop))
        except _LostError as error:
            step = max(self._piece, LEAST_PIECE)
            if stop - row > step:
                # in separate memory, as all parts would share the same scratch memory
                return joined([self._events(at, min(at + step, stop), clock, Scratch())
                               for at in range(row, stop, step)])
            self._damage(row, f"events {row} .. {stop}", error)
            return np.empty(0, EVENT_DTYPE)
        return self._checked(columns, clock, row, memory)

    def _table(self, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return the IMU samples or triggers that this library's writer stored."""
        try:
            with _reading():
                group = self._member(self._file, "pdavis")
                found = None if group is None else self._member(group, name)
                if found is None:
                    return np.empty(0, dtype)
                # HDF5 itself crashes on a record whose fields overlap.
                if found.dtype != dtype or found.ndim != 1:
                    raise ValueError(f"{found.shape} of {found.dtype}")
                self._bounded(found, name)
                table: NDArray[Any] = found[()]
        except _LostError as error:
            self._damage(name, name, error)
            return np.empty(0, dtype)
        kept = Clock(Timeline()).order(table, final=True)
        if len(kept) < len(table):
            self._log.add("backward time", name, f"{name} samples were dropped because "
                          "time ran backward", count=len(table) - len(kept))
        return kept

    def _triggers(self) -> NDArray[Any]:
        """Return the external triggers of Metavision, or those of this library."""
        try:
            with _reading():
                records = self._records("EXT_TRIGGER", "tp")
                if records is not None:
                    found = records[()]
                    if "id" in found.dtype.names:
                        mine = found["id"] == self._channel
                        self._count(0, "other triggers", int((~mine).sum()),
                                    OTHER_TRIGGERS.format(self._channel))
                        found = found[mine]
                    triggers, late = ordered_triggers(
                        found["t"].astype(np.int64), found["p"], NEVER)
                    self._count(0, "late triggers", late, "triggers were "
                                "dropped because time ran backward")
                    return triggers
        except _LostError as error:
            self._damage("EXT_TRIGGER", "the triggers", error)
        return self._table("triggers", TRIGGER_DTYPE)

    def _all_frames(self) -> list[_Place]:
        """Return the numbers and times of all frames, in time order."""
        if self._frames is None:
            return []
        try:
            with _reading():
                if isinstance(self._frames, _SeparateImages):
                    raw = self._frames.times
                else:
                    stamps = self._dataset(self._file, "frame_ts", 1)
                    raw = np.zeros(0) if stamps is None else stamps[()]
                mids = microseconds(raw, US_PER[unit_of(raw)[0]])
                rows = np.stack([self._extra(name, mids) for name in (
                    "exposure_start_us", "exposure_end_us", "available_us")], 1)
        except _LostError as error:
            self._damage("frame_ts", "the times of all frames", error)
            return []
        if len(mids) != len(self._frames):
            self._log.add("frame_ts", 0, f"{len(self._frames)} frames have "
                          f"{len(mids)} times: only so many of both are read")
        found: list[_Place] = []
        last = last_mid = NEVER
        for k, (start, end, ready) in enumerate(rows.tolist()[:len(self._frames)]):
            if not 0 <= end - start <= MAX_EXPOSURE_US:
                start = end = int(mids[k])
            if not 0 <= ready - end <= MAX_EXPOSURE_US:
                ready = end
            mid = (start + end) // 2
            if last < ready < -NEVER and mid > last_mid and start > NEVER:
                found.append(_Place(k, start, end, ready))
                last, last_mid = ready, mid
            else:
                self._log.add("backward time", ("frame", k), "frames were dropped "
                              "because time ran backward")
        return found

    def _extra(self, name: str, default: NDArray[Any]) -> NDArray[Any]:
        group = self._member(self._file, "pdavis")
        column = None if group is None else self._dataset(group, name, 1)
        if column is None or len(column) != len(default):
            return default
        return microseconds(column[()], 1.0)

    def _frame(self, place: _Place) -> list[ApsFrame]:
        """Return a list of the frame, empty if it cannot be read."""
        try:
            with _reading():
                image = self._frames[place.k]
                eight = image.dtype == np.uint8
                full = self._full_scale or (1020 if eight else 1023)
                with np.errstate(over="ignore"):    # what is not finite is not valid
                    dn = image.astype(np.float32) * np.float32(4 if eight else 1)
                valid = dn < full
                group = self._member(self._file, "pdavis")
                known = None if group is None else self._dataset(group, "valid", 3)
                if known is not None and known.shape == self._frames.shape:
                    valid = known[place.k].astype(np.bool_)
        except _LostError as error:
            self._damage(("frame", place.k), f"frame {place.k}", error, place)
            return []
        finite = np.isfinite(dn)
        if not finite.all():
            dn[~finite], valid = 0, valid & finite
        return [ApsFrame(dn, place.start, place.end, full_scale_dn=full,
                         available_us=place.ready,
                         valid=None if valid.all() else valid)]

    def _damage(self, key: Hashable, what: str, error: Exception,
                place: _Place | None = None) -> None:
        # HDF5 does not report the byte of an error.
        self._log.add(
            "damage", key, f"{what} cannot be read ({error})",
            start_us=place.start if place else None,
            stop_us=place.ready if place else None, warning=DamagedFileWarning)


class _Place(NamedTuple):
    """A frame's number and times."""

    k: int
    start: int
    end: int
    ready: int


class _SeparateImages:
    """The images of rpg's layout, which are separate datasets, as one stack.

    They are in the group ``/images``; those without a numeric ``timestamp`` are left
    out. `dataset` returns a checked dataset of numbers for (group, name, dimensions),
    `member` what lies in this file for (group, name).
    """

    def __init__(self, group: Any, dataset: Callable[[Any, str, int], Any],
                 member: Callable[[Any, str], Any]) -> None:
        images = {name: member(group, name) for name in group}
        found = sorted((float(image.attrs["timestamp"]), name) for name, image in
                       images.items() if "timestamp" in image.attrs)
        self._group, self._dataset = group, dataset
        self._names = [name for _, name in found]
        self.times = np.array([t for t, _ in found], np.float64)
        first = dataset(group, self._names[0], 2).shape if found else (0, 0)
        self.shape = (len(found), *first)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, k: int) -> NDArray[Any]:
        image: NDArray[Any] = self._dataset(self._group, self._names[k], 2)[()]
        if image.shape != self.shape[1:]:
            raise ValueError(f"an image of shape {image.shape}")
        return image
