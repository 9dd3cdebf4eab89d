"""Write HDF5 in the layouts of E2P and rpg (events and frames) and DSEC (events)."""
from __future__ import annotations

import functools
import os
from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv.recording.aedat4.samples import EIGHT_BIT_DN
from pdavis_cv.recording.base import ApsFrame, Recording, RecordingInfo
from pdavis_cv.recording.hdf5.reader import CHUNK
from pdavis_cv.recording.hdf5.sink import written
from pdavis_cv.recording.writer import source_text


def write_hdf5(path: str | os.PathLike[str], recording: Recording, *,
               flavour: str = "e2p") -> Mapping[str, int]:
    """Write a recording as HDF5, which appears under its name when it is complete.

    E2P and rpg hold events and frames; DSEC's layout holds events only.  Returns what
    the format could not hold, by description, and how often.
    """
    if flavour not in _FLAVOURS:
        raise ValueError(f"flavour must be {', '.join(_FLAVOURS)}, got {flavour!r}")
    info = recording.info
    imu, triggers = [], []
    with write_beside(path) as part, written(part) as file:
        file.attrs["sensor_size"] = info.sensor_size
        file.attrs["writer"] = "pdavis_cv"
        file.attrs["source_facts"] = source_text(info)
        if info.camera:
            file.attrs["camera"] = info.camera
        if info.layout is not None:
            file.attrs["layout"] = (*info.layout.row0, *info.layout.row1)
            if info.layout.colours is not None:
                file.attrs["colours"] = info.layout.colours
            if info.layout.owner is not None:
                file.attrs["sensor"] = info.layout.owner
        filled = _FLAVOURS[flavour](file, info)
        for packet in recording.packets():
            if len(packet.events):
                filled.add_events(packet.events)
            for frame in packet.frames:
                filled.add_frame(frame)
            imu.append(packet.imu)
            triggers.append(packet.triggers)
        filled.finish()
        for name, parts in (("imu", imu), ("triggers", triggers)):
            rows = np.concatenate(parts) if parts else np.empty(0)
            if len(rows):
                file[f"pdavis/{name}"] = rows
    return MappingProxyType(dict(filled.lost))


class _E2p:
    """A table of events, frames with the number of events before them."""

    def __init__(self, file: Any, info: RecordingInfo) -> None:
        self._file, self._size = file, info.sensor_size
        self._count = 0
        self._valid: Any = None
        self._times: list[tuple[int, int, int, int, int]] = []
        self.lost: Counter[str] = Counter()
        self._begin()

    def _begin(self) -> None:
        self._events = _growing(self._file, "events", "i8", 4)
        self._images: Any = None

    def add_events(self, events: NDArray[Any]) -> None:
        self._count += len(events)
        self._put_events(events)

    def _put_events(self, events: NDArray[Any]) -> None:
        _append(self._events, np.stack(
            [events[name].astype(np.int64) for name in "txyp"], 1))

    def _put_image(self, frame: ApsFrame) -> None:
        if self._images is None:
            self._images = _growing(self._file, "frame", "f4", *self._size)
        _append(self._images, frame.dn[None])

    def add_frame(self, frame: ApsFrame) -> None:
        self._put_image(frame)
        if self._valid is None:
            self._valid = _growing(self._file, "pdavis/valid", "?", *self._size)
        _append(self._valid, (np.ones(frame.shape, np.bool_) if frame.valid is None
                              else frame.valid)[None])
        start, end = frame.exposure_start_us, frame.exposure_end_us
        if np.ndim(start) or np.ndim(end):
            self.lost["exposure times per column"] += 1
        if not (isinstance(start, int) and isinstance(end, int)):
            half = round(frame.exposure_ms * 500)
            start, end = frame.mid_us - half, frame.mid_us + half
        self._times.append((frame.mid_us, self._count, start, end, frame.available_us))

    stamps: tuple[str, ...] = ("frame_ts", "frame_idx")

    def finish(self) -> None:
        names = (*self.stamps, "pdavis/exposure_start_us", "pdavis/exposure_end_us",
                 "pdavis/available_us")
        if self._times:
            columns = np.array(self._times, np.int64).T[-len(names):]
            for name, values in zip(names, columns, strict=True):
                self._file[name] = values


class _Rpg(_E2p):
    """Columns of events, times in seconds; each frame a dataset with its time."""

    stamps = ()

    def _begin(self) -> None:
        self._columns = {name: _growing(self._file, f"events/{name}s", kind)
                         for name, kind in (("t", "f8"), ("x", "i2"), ("y", "i2"),
                                            ("p", "?"))}
        self._file.attrs["sensor_resolution"] = self._size

    def _put_events(self, events: NDArray[Any]) -> None:
        for name, column in self._columns.items():
            _append(column, events[name] / 1e6 if name == "t" else events[name])

    def _put_image(self, frame: ApsFrame) -> None:
        dn = frame.dn
        if frame.full_scale_dn == EIGHT_BIT_DN:
            dn = np.rint(dn / 4).clip(0, 255).astype(np.uint8)
        image = self._file.create_dataset(
            f"images/image{len(self._times):09d}", data=dn, compression="gzip")
        image.attrs["timestamp"] = frame.mid_us / 1e6
        image.attrs["size"] = self._size
        image.attrs["event_idx"] = self._count


class _Dsec:
    """Columns of events, and the first event of each millisecond."""

    def __init__(self, file: Any, info: RecordingInfo) -> None:
        self._file, self._offset = file, info.start_us or 0
        self._columns = {name: _growing(file, f"events/{name}", kind) for name, kind
                         in (("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1"))}
        file["t_offset"] = np.int64(self._offset)
        self._first = np.zeros(1, np.int64)
        self.lost: Counter[str] = Counter()

    def add_events(self, events: NDArray[Any]) -> None:
        count, t = len(self._columns["t"]), events["t"] - self._offset
        for name in "xyp":
            _append(self._columns[name], events[name])
        _append(self._columns["t"], t)
        edges = np.arange(len(self._first), int(t[-1]) // 1000 + 1) * 1000
        self._first = np.concatenate([self._first, count + np.searchsorted(t, edges)])

    def add_frame(self, frame: ApsFrame) -> None:
        self.lost["frames"] += 1

    def finish(self) -> None:
        self._file["ms_to_idx"] = self._first


_FLAVOURS: dict[str, type[_E2p] | type[_Dsec]] = {
    "e2p": _E2p, "dsec": _Dsec, "rpg": _Rpg}


def _growing(file: Any, name: str, dtype: str, *shape: int) -> Any:
    """Return a new dataset without rows, of the given shape each."""
    chunk = (CHUNK if not shape or shape == (4,) else 1, *shape)
    return file.create_dataset(
        name, (0, *shape), dtype, maxshape=(None, *shape), chunks=chunk,
        compression="gzip", compression_opts=1, shuffle=True)


def _append(data: Any, rows: NDArray[Any]) -> None:
    n = len(data)
    data.resize(n + len(rows), axis=0)
    data[n:] = rows


write_e2p = functools.partial(write_hdf5, flavour="e2p")
write_dsec = functools.partial(write_hdf5, flavour="dsec")
write_rpg = functools.partial(write_hdf5, flavour="rpg")
