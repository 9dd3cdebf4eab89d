"""Write HDF5 in the layouts of E2P (events and frames) and DSEC (events)."""
from __future__ import annotations

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from pdavis_cv._beside import write_beside
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.hdf5.reader import CHUNK, h5py_module

__all__ = ["write_dsec", "write_e2p", "write_hdf5"]


def write_hdf5(path: str | os.PathLike[str], recording: Recording, *,
               flavour: str = "e2p") -> Mapping[str, int]:
    """Write a recording as HDF5.

    Parameters
    ----------
    path : path
        The file appears under this name when it is complete.
    recording : Recording
    flavour : {"e2p", "dsec"}
        E2P holds events and frames; DSEC's layout holds events only.

    Returns
    -------
    mapping of str to int
        Number of occurrences of what the format could not hold, by description.

    Raises
    ------
    ValueError
        If the flavour is unknown.
    ImportError
        If h5py is not installed.
    """
    if flavour not in ("e2p", "dsec"):
        raise ValueError(f"flavour must be e2p or dsec, got {flavour!r}")
    with write_beside(path) as part, h5py_module().File(part, "w") as file:
        lost = _fill(file, recording, flavour)
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
        if info.layout.owner is not None:
            file.attrs["sensor"] = info.layout.owner

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


def write_e2p(path: str | os.PathLike[str], recording: Recording) -> Mapping[str, int]:
    """Write HDF5 in the layout of E2P; see `write_hdf5`."""
    return write_hdf5(path, recording, flavour="e2p")


def write_dsec(path: str | os.PathLike[str], recording: Recording) -> Mapping[str, int]:
    """Write HDF5 in the layout of DSEC; see `write_hdf5`."""
    return write_hdf5(path, recording, flavour="dsec")
