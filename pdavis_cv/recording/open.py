"""open_recording: one door for every kind of file."""
from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from pdavis_cv._remote import as_path, is_remote
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.registry import (
    first_bytes,
    format_of,
    formats,
    read_with,
)
from pdavis_cv.sensor import Layout

__all__ = ["open_recording"]

_BAD_EVENTS = ("drop", "raise")


def open_recording(
    source: str | os.PathLike[str] | Recording,
    *,
    layout: Layout | str | None = None,
    fps: float | None = None,
    bad_events: str = "drop",
    camera: str | None = None,
    **options: Any,
) -> Recording:
    """Open a recording, whatever its format.

    The first bytes decide, never the name.

    Parameters
    ----------
    source : path or Recording
        A file, or an object of a store such as ``s3://bucket/run.aedat4`` (extra
        ``[remote]``), read by ranges; a Recording is returned as it is.  With a layout
        also a grey video, image, TIFF stack or pattern of image names
        (``shot_%04d.png``, ``shot_*.png``) of a polarization camera.
    layout : Layout or str, optional
        Polarizer layout of the camera, or its name; see `Layout.of`.
    fps : float, optional
        Images per second of a source whose images carry no times; default the
        video's, 25 for images.
    bad_events : {"drop", "raise"}
        What to do with events outside the sensor or before their predecessor:
        drop and count them in ``problems``, or raise RecordingError.
    camera : str, optional
        Which camera, by name or serial number, if the file holds several.
    **options
        Of the file's format; see ``Format.read_options``.

    Returns
    -------
    Recording

    Raises
    ------
    RecordingError
        If the source cannot be opened or is not a recording; the message names the
        file, the byte and what was seen.
    LayoutError
        If the recording gives another layout than the caller.
    TypeError
        If an option is not one of the format's.

    Notes
    -----
    Which formats there are is a table, `pdavis_cv.formats`; other packages add theirs
    through the entry-point group ``pdavis_cv.formats``.
    """
    if isinstance(source, Recording):
        return source
    layout = None if layout is None else Layout.of(layout)
    if bad_events not in _BAD_EVENTS:
        raise ValueError(
            f"bad_events must be one of {', '.join(_BAD_EVENTS)}, got {bad_events!r}")
    path = as_path(source)
    # What has no such name may be a pattern of image names.
    start = first_bytes(path) if layout is None or path.exists() else b""
    found = format_of(path, start)
    if found is None and layout is not None:
        found = next(one for one in formats() if one.needs_layout)
    if found is None:
        raise _not_a_recording(path, start)
    if is_remote(path) and not found.by_ranges:
        raise RecordingError(
            f"{path}: {found.title} cannot be read by ranges: copy it to a disk")
    if "fps" in found.read_options:
        options = {"fps": fps, **options}
    return read_with(
        found, source, options, layout=layout, bad_events=bad_events, camera=camera)


def _not_a_recording(path: Path, start: bytes) -> RecordingError:
    if path.is_dir():
        return RecordingError(f"{path}: a folder, and no recording that is one")
    if start.startswith(b"#"):
        return RecordingError(f"{path}: byte 0: {_other_aedat(start)}")
    if not start:
        return RecordingError(f"{path}: byte 0: the file is empty")
    return RecordingError(
        f"{path}: byte 0: not a recording, first bytes {start[:8]!r} (a video or "
        "image of a polarization camera needs its layout: layout=, --layout)")


def _other_aedat(start: bytes) -> str:
    """Say what a file with AEDAT's comments is, if it is none of those that are read.

    Without a line for the version it would be AEDAT-1: 16-bit addresses, of whose
    polarity and direction jAER and its vendor's documents say opposite things.
    """
    if found := re.match(rb"#!AER-DAT([\w.]*)", start):
        return (f"AEDAT-{found[1].decode() or '?'} is not read; DV converts it to "
                "AEDAT-4")
    return ("no line #!AER-DAT: not a recording, or AEDAT-1 of a DVS128 (16-bit "
            "addresses), which is not read: no DAVIS wrote it")
