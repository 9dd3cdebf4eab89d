"""The table of formats that the library reads and writes.

A format is a reader, derived from `pdavis_cv.recording.files.FileRecording`, and a
`Format`, which stands in this table or is another package's entry point.
"""
from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.format import Format
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.registry import Registry, instead, loaded

_HEAD = 4096
_ALWAYS = frozenset((
    "layout", "sensor", "sensor_size", "camera", "bad_events", "limits", "isolated"))
"""Options that every format has."""

_ALL = frozenset(("events", "frames", "imu", "triggers"))
_EVENTS = frozenset(("events",))
_ROOM = "pdavis_cv.recording"

FORMATS: Registry[Format] = Registry("format", {one.name: one for one in (
    Format(
        name="aedat4", title="AEDAT-4", suffixes=(".aedat4",),
        by_ranges=True, magic=(b"#!AER-DAT4",), holds=_ALL,
        reader=f"{_ROOM}.aedat4.reader:Aedat4Recording",
        writer=f"{_ROOM}.aedat4.writer:write_aedat4",
        write_options=("compression",)),
    Format(
        name="aedat3", title="AEDAT-3.1", suffixes=(".aedat",),
        by_ranges=True, magic=(b"#!AER-DAT3.1",), holds=_ALL,
        reader=f"{_ROOM}.aedat3:Aedat3Recording"),
    Format(
        name="aedat2", title="AEDAT-2.0", suffixes=(".aedat", ".aedat2"),
        by_ranges=True, magic=(b"#!AER-DAT2",), holds=_ALL,
        reader=f"{_ROOM}.aedat2.reader:Aedat2Recording",
        writer=f"{_ROOM}.aedat2.writer:write_aedat2"),
    Format(
        name="e2p", title="HDF5 of E2P", suffixes=(".h5", ".hdf5"),
        magic=(b"\x89HDF\r\n\x1a\n",), holds=_ALL, extra="hdf5",
        read_options=("trigger_channel",),      # whichever HDF5 it turns out to be
        reader=f"{_ROOM}.hdf5.reader:Hdf5Recording",
        writer=f"{_ROOM}.hdf5.writer:write_e2p"),
    Format(
        name="dsec", title="HDF5 of DSEC", suffixes=(".h5", ".hdf5"),
        magic=(b"\x89HDF\r\n\x1a\n",), holds=_EVENTS, extra="hdf5",
        reader=f"{_ROOM}.hdf5.reader:Hdf5Recording",
        writer=f"{_ROOM}.hdf5.writer:write_dsec"),
    Format(
        name="rpg", title="HDF5 of rpg and Monash", suffixes=(".h5", ".hdf5"),
        magic=(b"\x89HDF\r\n\x1a\n",), holds=frozenset(("events", "frames")),
        extra="hdf5", reader=f"{_ROOM}.hdf5.reader:Hdf5Recording",
        writer=f"{_ROOM}.hdf5.writer:write_rpg"),
    Format(
        name="metavision", title="HDF5 of Metavision", suffixes=(".h5", ".hdf5"),
        magic=(b"\x89HDF\r\n\x1a\n",), holds=frozenset(("events", "triggers")),
        extra="hdf5", reader=f"{_ROOM}.hdf5.reader:Hdf5Recording"),
    Format(
        name="davis-usb", title="words of a DAVIS346 over USB", holds=_ALL,
        suffixes=(".usb",), magic=(b"#!PDAVIS-USB1\n",),
        reader=f"{_ROOM}.davis_trace:TraceRecording"),
    Format(
        name="prophesee", title="Prophesee RAW (EVT2, EVT2.1, EVT3) and DAT",
        holds=frozenset(("events", "triggers")),
        suffixes=(".raw", ".dat"), by_ranges=True, read_options=("trigger_channel",),
        sniff=f"{_ROOM}.prophesee:is_prophesee",
        reader=f"{_ROOM}.prophesee:PropheseeRecording",
        writer=f"{_ROOM}.event_writers:RawWriter.write", written=(".raw",),
        write_options=("encoding",)),
    Format(
        name="es", title="Event Stream", holds=_EVENTS, suffixes=(".es",),
        by_ranges=True, magic=(b"Event Stream",),
        reader=f"{_ROOM}.event_stream:EventStreamRecording",
        writer=f"{_ROOM}.event_writers:StreamWriter.write"),
    Format(
        name="rosbag", title="ROS 1 and ROS 2 bags", extra="ros",
        suffixes=(".bag", ".db3", ".mcap"), folder="metadata.yaml",
        magic=(b"#ROSBAG V2.0", b"SQLite format 3\0", b"\x89MCAP0\r\n"),
        holds=frozenset(("events", "frames", "triggers")),
        reader=f"{_ROOM}.rosbag:RosRecording",
        writer=f"{_ROOM}.bag_writer:write_rosbag", written=(".mcap", ".db3"),
        write_options=("encoding",)),
    Format(
        name="text", title="events as lines of text", holds=_EVENTS,
        suffixes=(".csv", ".txt"), sniff=f"{_ROOM}.text_form:is_text_events",
        read_options=("columns",),
        reader=f"{_ROOM}.event_lists:TextRecording",
        writer=f"{_ROOM}.event_writers:TextWriter.write"),
    Format(
        name="parquet", title="Parquet", holds=_EVENTS, extra="parquet",
        suffixes=(".parquet",), magic=(b"PAR1",),
        reader=f"{_ROOM}.parquet:ParquetRecording",
        writer=f"{_ROOM}.event_writers:ParquetWriter.write"),
    Format(
        name="images", title="video or images of a polarization camera",
        holds=frozenset(("frames",)), needs_layout=True, extra="frames",
        sniff=f"{_ROOM}.images.stills:is_image_array",
        read_options=("source_fps", "exposure_us", "bits", "full_scale_dn",
                      "analyser_steps", "align_planes"),
        reader=f"{_ROOM}.images.reader:ImageRecording"),
    Format(
        name="numpy", title="NumPy arrays of events", holds=_EVENTS,
        suffixes=(".npy", ".npz"), magic=(b"\x93NUMPY", b"PK\x03\x04"),
        reader=f"{_ROOM}.event_lists:NumpyRecording",
        writer=f"{_ROOM}.event_writers:NumpyWriter.write", written=(".npy",)))}, Format)
"""The formats by name, in the order in which they are tried on a file."""


def suffixes() -> tuple[str, ...]:
    """Return all suffixes of recordings, in lower case with the dot, each once."""
    return tuple(dict.fromkeys(
        suffix for one in FORMATS.usable().values() if not one.needs_layout
        for suffix in one.suffixes))


def format_of(path: Path, start: bytes) -> Format | None:
    """Return the format of a file by its first bytes (b"" for a folder), or None."""
    def first(table: Iterable[Format]) -> Format | None:
        return next((one for one in table if one.knows(path, start)), None)

    return first(FORMATS[name] for name in FORMATS.known) or first(
        FORMATS.usable().values())


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a recording, from its name or its first bytes.

    It is not opened as a recording; False if it cannot be read.
    """
    here = Path(path)
    if here.suffix.lower() in suffixes():
        return True
    from pdavis_cv.recording.images.names import is_four_planes  # slow to import
    try:
        return ((here.is_file() or here.is_dir()) and format_of(
            here, first_bytes(here)) is not None) or is_four_planes(os.fspath(path))
    except (OSError, ValueError):  # ValueError: a null character in the name
        return False


def first_bytes(path: Path) -> bytes:
    """Return the first bytes of a file, b"" for a folder."""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD)
    except OSError as error:
        if path.is_dir():
            return b""
        scheme, colon, _ = str(path).partition(":")
        live = ""
        if colon and len(scheme) > 1 and scheme.isalpha():     # C: is a disk
            live = "; the address of a live source is for pdavis_cv.open_source"
        elif isinstance(error, FileNotFoundError) and str(path).isalnum():
            live = "; a camera has an address, such as usb:"
        raise RecordingError(
            f"{path}: cannot be opened: {error.strerror or error}{live}") from error


def read_with(one: Format, source: Any, options: SourceOptions) -> Recording:
    """Open a file with a format's reader; TypeError for an option that it lacks."""
    given = {name for name in options.facts()
             if getattr(options, name) not in (None, False)}
    for name in sorted(given.union(options.parameters) - _ALWAYS - set(
            one.read_options)):
        known = sorted(_ALWAYS.union(one.read_options))
        raise TypeError(f"{name}= is no option of {one.title}, which has "
                        f"{', '.join(f'{each}=' for each in known)}"
                        f"{instead(name, known)}")
    recording: Recording = loaded(one.reader)(source, options)
    return recording


def writer_for(
    path: str | os.PathLike[str], name: str | None = None
) -> tuple[Format, Callable[..., Mapping[str, int]]]:
    """Return the format to write a file in, and the function that writes it.

    A name of the format overrides the suffix.
    """
    suffix = Path(path).suffix.lower()
    found = FORMATS[name] if name is not None else next(
        (one for one in FORMATS.usable().values()
         if suffix in one.written), None)
    if found is None:
        raise ValueError(
            f"{Path(path).name}: the name must end in "
            + ", ".join(dict.fromkeys(
                suffix for one in FORMATS.usable().values()
                for suffix in one.written)))
    if found.writer is None:
        raise ValueError(f"format {name!r} can only be read")
    return found, loaded(found.writer)
