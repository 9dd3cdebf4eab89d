"""HDF5 in the layouts of E2P (events and frames) and of DSEC (events).

E2P: ``/events`` (N, 4) of t, x, y, p, ``/frame`` (K, H, W), ``/frame_ts``,
``/frame_idx``.  DSEC: ``/events/{t,x,y,p}``, ``/ms_to_idx``, ``/t_offset``.  What
they do not hold (exposure, IMU, triggers) stands beside it under ``/pdavis``.
"""
from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    TRIGGER_DTYPE,
    ApsFrame,
    Packet,
    Problem,
    Recording,
    RecordingInfo,
)
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.packetise import Batch, cell_start, packetise
from pdavis_cv.recording.timeline import NEVER, Clock, Timeline
from pdavis_cv.sensor import Layout, Sensor, resolve_layout

__all__ = ["MAGIC", "Hdf5Recording", "write_hdf5"]

MAGIC = b"\x89HDF\r\n\x1a\n"
CHUNK = 1 << 16


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise ImportError("HDF5 needs a package: pip install 'pdavis-cv[hdf5]'"
                          ) from None
    return h5py


class Hdf5Recording(Recording):
    """A recording in HDF5; see `open_recording`.

    Parameters
    ----------
    path : path
    layout : Layout, optional
    bad_events : {"drop", "raise"}
    camera : str, optional
        Not used: such files hold one camera.
    """

    def __init__(self, path: str | os.PathLike[str], *, layout: Layout | None = None,
                 bad_events: str = "drop", camera: str | None = None) -> None:
        self._arguments = (os.fspath(path), layout, bad_events, camera)
        self._strict = bad_events == "raise"
        self._path = Path(path)
        self._log = ProblemLog(str(path))
        try:
            self._file = _h5py().File(path, "r")
        except OSError as error:
            raise RecordingError(f"{path}: byte 0: HDF5 cannot read it: {error}"
                                 ) from error
        try:
            self._columns = self._find_events()
            self._frames = self._file.get("frame")
            self._info = self._make_info(layout)
        except BaseException:
            self._file.close()
            raise

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, self._arguments

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
        self._file.close()

    def _find_events(self) -> Any:
        """Return a function from rows to (t, x, y, p), and the number of events."""
        h5py = _h5py()
        events = self._file.get("events")
        if isinstance(events, h5py.Group) and all(k in events for k in "txyp"):
            self._format = "HDF5 (DSEC)"
            offset = int(self._file["t_offset"][()]) if "t_offset" in self._file else 0
            self._count = min(len(events[k]) for k in "txyp")
            return lambda rows: (events["t"][rows].astype(np.int64) + offset,
                                 *(events[k][rows] for k in "xyp"))
        if isinstance(events, h5py.Dataset) and events.ndim == 2 and (
                events.shape[1] == 4):
            self._format, self._count = "HDF5 (E2P)", len(events)
            return lambda rows: (
                self._microseconds(events[rows, 0]),
                *(events[rows, k] for k in (1, 2, 3)))
        raise RecordingError(
            f"{self._path}: no /events of E2P (N, 4) or DSEC (t, x, y, p); it holds "
            f"{', '.join(self._file) or 'nothing'}")

    @staticmethod
    def _microseconds(t: NDArray[Any]) -> NDArray[np.int64]:
        """Return times in microseconds; those with fractions are seconds."""
        if t.dtype.kind == "f" and np.any(t != np.rint(t)):
            t = np.rint(t * 1e6)
        return t.astype(np.int64)

    def _make_info(self, layout: Layout | None) -> RecordingInfo:
        attributes = self._file.attrs
        if "sensor_size" in attributes:
            height, width = (int(side) for side in attributes["sensor_size"])
        elif self._frames is not None and self._frames.ndim == 3:
            height, width = self._frames.shape[1:]
        else:
            # DSEC does not say: take the first events' hull, a DAVIS346 at least.
            _, x, y, _ = self._columns(slice(0, CHUNK))
            height = max(260, int(y.max(initial=0)) + 1)
            width = max(346, int(x.max(initial=0)) + 1)
        known = attributes.get("layout")
        if known is not None:
            a, b, c, d = (int(angle) for angle in known)
            layout = resolve_layout(layout, recording=Layout((a, b), (c, d)))
        start = None
        if self._count:
            start = int(self._columns(slice(0, 1))[0][0])
        frames = 0 if self._frames is None else len(self._frames)
        return RecordingInfo(
            format=self._format, sensor_size=(height, width),
            writer=attributes.get("writer"), camera=attributes.get("camera"),
            sensor=Sensor.PDAVIS if (height, width) == Sensor.PDAVIS.size else None,
            layout=layout, start_us=start, event_count=self._count,
            frame_count=frames, imu_count=len(self._table("imu", IMU_DTYPE)),
            trigger_count=len(self._table("triggers", TRIGGER_DTYPE)))

    def _table(self, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
        group = self._file.get("pdavis")
        if group is None or name not in group:
            return np.empty(0, dtype)
        table: NDArray[Any] = group[name][()].astype(dtype)
        return table

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        if not self._file:
            raise ValueError(f"{self._path.name}: recording is closed")
        return packetise(self._batches(start_us), start_us, stop_us)

    def _batches(self, start_us: int | None) -> Iterator[Batch]:
        frames = self._all_frames()
        samples = Batch(imu=self._table("imu", IMU_DTYPE),
                        triggers=self._table("triggers", TRIGGER_DTYPE),
                        complete_us=NEVER)
        yield samples
        clock, taken, before = Clock(Timeline()), 0, NEVER
        first = 0 if start_us is None else self._chunk_before(cell_start(start_us))
        for row in range(first, self._count, CHUNK):
            events = self._events(slice(row, row + CHUNK), clock, row)
            now = clock.last
            ready = []
            while taken < len(frames) and frames[taken][0] <= max(now, before):
                ready.append(self._frame(frames[taken][1]))
                taken += 1
            before = now
            yield Batch(events, ready, complete_us=min(
                [now, *(t for t, _ in frames[taken:taken + 1])]))
        yield Batch(frames=[self._frame(k) for _, k in frames[taken:]])

    def _chunk_before(self, t_us: int) -> int:
        lo, hi = 0, (self._count + CHUNK - 1) // CHUNK
        while hi - lo > 1:
            middle = (lo + hi) // 2
            t = self._columns(slice(middle * CHUNK, middle * CHUNK + 1))[0][0]
            lo, hi = (middle, hi) if t < t_us else (lo, middle)
        return max(lo, 0) * CHUNK

    def _events(self, rows: slice, clock: Clock, row: int) -> NDArray[Any]:
        t, x, y, p = self._columns(rows)
        height, width = self._info.sensor_size
        p = np.where(p < 0, 0, p)  # some writers use -1 for OFF
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (p <= 1)
        keep, segments = clock.order(t)
        if segments:
            self._log.add("segment", row, "time jumped back by more than a second: a "
                          "new segment, moved to follow the one before")
        for kind, good, message in (
                ("outside sensor", inside, "events outside the sensor were dropped"),
                ("backward time", keep, "events were dropped because time ran "
                 "backward")):
            bad = int(np.count_nonzero(~good))
            if bad and self._strict:
                raise RecordingError(f"{self._path}: row {row}: {bad} {message}")
            if bad:
                self._log.add(kind, row, message, count=bad)
        good = inside & keep
        events = np.empty(int(np.count_nonzero(good)), EVENT_DTYPE)
        for name, column in zip("txyp", (t, x, y, p), strict=True):
            events[name] = column[good]
        return events

    def _all_frames(self) -> list[tuple[int, int]]:
        """Return (available_us, number) of the frames, in time order."""
        if self._frames is None or "frame_ts" not in self._file:
            return []
        mids = self._microseconds(self._file["frame_ts"][()])
        times = self._extra("available_us", mids)
        found, last = [], NEVER
        for k, t in enumerate(times.tolist()[:len(self._frames)]):
            if t > last:
                found.append((t, k))
                last = t
            else:
                self._log.add("backward time", ("frame", k), "frames were dropped "
                              "because time ran backward")
        return found

    def _extra(self, name: str, default: NDArray[Any]) -> NDArray[Any]:
        group = self._file.get("pdavis")
        if group is None or name not in group or len(group[name]) != len(default):
            return default
        column: NDArray[Any] = group[name][()]
        return column

    def _frame(self, k: int) -> ApsFrame:
        image = self._frames[k]
        mids = self._microseconds(self._file["frame_ts"][()])
        start, end, ready = (int(self._extra(name, mids)[k]) for name in (
            "exposure_start_us", "exposure_end_us", "available_us"))
        full = 1020 if image.dtype == np.uint8 else 1023
        dn = image.astype(np.float32) * np.float32(4 if image.dtype == np.uint8 else 1)
        valid = dn < full
        group = self._file.get("pdavis")
        if group is not None and "valid" in group:
            valid = group["valid"][k].astype(np.bool_)
        return ApsFrame(dn, start, max(start, end), full_scale_dn=full,
                        available_us=max(start, end, ready),
                        valid=None if valid.all() else valid)


def write_hdf5(path: str | os.PathLike[str], recording: Recording, *,
               flavour: str = "e2p") -> Mapping[str, int]:
    """Write a recording as HDF5.

    Parameters
    ----------
    path : path
        The file appears under this name when it is whole.
    recording : Recording
    flavour : {"e2p", "dsec"}
        E2P holds events and frames; DSEC's layout holds events only.

    Returns
    -------
    mapping of str to int
        What the format could not hold, and how often.

    Raises
    ------
    ValueError
        If the flavour is not one of those listed.
    ImportError
        If h5py is missing.
    """
    if flavour not in ("e2p", "dsec"):
        raise ValueError(f"flavour must be e2p or dsec, got {flavour!r}")
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with _h5py().File(part, "w") as file:
            lost = _fill(file, recording, flavour)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return MappingProxyType(lost)


def _fill(file: Any, recording: Recording, flavour: str) -> dict[str, int]:
    info = recording.info
    lost: dict[str, int] = {}
    file.attrs["sensor_size"] = info.sensor_size
    file.attrs["writer"] = "pdavis_cv"
    if info.camera:
        file.attrs["camera"] = info.camera
    if info.layout is not None:
        file.attrs["layout"] = (*info.layout.row0, *info.layout.row1)

    def growing(name: str, dtype: Any, *shape: int) -> Any:
        chunk = (CHUNK if not shape or shape == (4,) else 1, *shape)
        return file.create_dataset(
            name, (0, *shape), dtype, maxshape=(None, *shape), chunks=chunk,
            compression="gzip", compression_opts=1, shuffle=True)

    def append(data: Any, rows: Any) -> None:
        n = len(data)
        data.resize(n + len(rows), axis=0)
        data[n:] = rows

    columns = {}
    table = None
    if flavour == "dsec":
        columns = {name: growing(f"events/{name}", kind) for name, kind in (
            ("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1"))}
        file["t_offset"] = np.int64(info.start_us or 0)
    else:
        table = growing("events", "i8", 4)
    height, width = info.sensor_size
    images: Any = None
    count, milliseconds = 0, np.zeros(1, np.int64)
    extras: dict[str, list[Any]] = {name: [] for name in (
        "frame_ts", "frame_idx", "exposure_start_us", "exposure_end_us",
        "available_us")}
    imu, triggers = [], []
    for packet in recording.packets():
        events = packet.events
        if len(events) and table is not None:
            append(table, np.stack([events[k].astype(np.int64) for k in "txyp"], 1))
        elif len(events):
            offset = info.start_us or 0
            for name in "xyp":
                append(columns[name], events[name])
            t = events["t"] - offset
            append(columns["t"], t)
            last = int(t[-1]) // 1000
            if last >= len(milliseconds):
                edges = np.arange(len(milliseconds), last + 1) * 1000
                milliseconds = np.concatenate(
                    [milliseconds, count + np.searchsorted(t.copy(), edges)])
        count += len(events)
        for frame in packet.frames:
            if flavour == "dsec":
                lost["frames"] = lost.get("frames", 0) + 1
                continue
            if images is None:
                images = growing("frame", "f4", height, width)
                valid = growing("pdavis/valid", "?", height, width)
            append(images, frame.dn[None])
            append(valid, (np.ones(frame.shape, np.bool_) if frame.valid is None
                           else frame.valid)[None])
            if np.ndim(frame.exposure_start_us) or np.ndim(frame.exposure_end_us):
                lost["exposure times per column"] = lost.get(
                    "exposure times per column", 0) + 1
            half = round(frame.exposure_ms * 500)
            start, end = frame.mid_us - half, frame.mid_us + half
            if isinstance(frame.exposure_start_us, int) and isinstance(
                    frame.exposure_end_us, int):
                start, end = frame.exposure_start_us, frame.exposure_end_us
            for name, value in zip(extras, (frame.mid_us, count, start, end,
                                            frame.available_us), strict=True):
                extras[name].append(value)
        imu.append(packet.imu)
        triggers.append(packet.triggers)
    if flavour == "dsec":
        file["ms_to_idx"] = milliseconds
    elif images is not None:
        for name, values in extras.items():
            place = name if name.startswith("frame_") else f"pdavis/{name}"
            file[place] = np.array(values, np.int64)
    for name, parts in (("imu", imu), ("triggers", triggers)):
        rows = np.concatenate(parts) if parts else np.empty(0)
        if len(rows):
            file[f"pdavis/{name}"] = rows
    return lost


def _reopen(path: str, layout: Layout | None, bad_events: str,
            camera: str | None) -> Hdf5Recording:
    return Hdf5Recording(path, layout=layout, bad_events=bad_events, camera=camera)
