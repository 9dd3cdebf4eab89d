"""open_recording: one door for every kind of file."""
from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import Recording
from pdavis_cv.sensor import Layout

__all__ = ["open_recording"]

_BAD_EVENTS = ("drop", "raise")


def open_recording(
    source: str | os.PathLike[str] | Recording,
    *,
    layout: Layout | None = None,
    fps: float | None = None,
    bad_events: str = "drop",
    camera: str | None = None,
) -> Recording:
    """Open a recording, whatever its format.

    The first bytes decide, never the name.

    Parameters
    ----------
    source : path or Recording
        A file; a Recording is returned as it is.  With a layout also a grey video,
        image, TIFF stack or pattern of image names (``shot_%04d.png``, ``shot_*.png``)
        of a polarization camera.
    layout : Layout, optional
        Polarizer layout of the camera.
    fps : float, optional
        Images per second of a source whose images carry no times; default the
        video's, 25 for images.
    bad_events : {"drop", "raise"}
        What to do with events outside the sensor or before their predecessor:
        drop and count them in ``problems``, or raise RecordingError.
    camera : str, optional
        Which camera, by name or serial number, if the file holds several.

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
    """
    if isinstance(source, Recording):
        return source
    if layout is not None and not isinstance(layout, Layout):
        raise TypeError(f"layout must be a Layout, got {type(layout).__name__}")
    if bad_events not in _BAD_EVENTS:
        raise ValueError(
            f"bad_events must be one of {', '.join(_BAD_EVENTS)}, got {bad_events!r}")
    path = Path(source)
    # What has no such name may be a pattern of image names.
    start = _first_bytes(path) if layout is None or path.is_file() else b""
    options: dict[str, Any] = {
        "layout": layout, "bad_events": bad_events, "camera": camera}
    if start.startswith(b"#!AER-DAT4"):
        from pdavis_cv.recording.aedat4 import Aedat4Recording

        return Aedat4Recording(path, **options)
    if start.startswith(b"\x89HDF\r\n\x1a\n"):
        from pdavis_cv.recording.hdf5 import Hdf5Recording

        return Hdf5Recording(path, **options)
    if start.startswith(b"#!AER-DAT3.1"):
        from pdavis_cv.recording.aedat3 import Aedat3Recording

        return Aedat3Recording(path, **options)
    if start.startswith(b"#!AER-DAT2"):
        from pdavis_cv.recording.aedat2 import Aedat2Recording

        return Aedat2Recording(path, **options)
    if layout is not None:
        from pdavis_cv.recording.mosaic_source import open_mosaic

        return open_mosaic(source, layout=layout, fps=fps)
    if start.startswith(b"#"):
        raise RecordingError(f"{path}: byte 0: {_other_aedat(start)}")
    if not start:
        raise RecordingError(f"{path}: byte 0: the file is empty")
    raise RecordingError(
        f"{path}: byte 0: not a recording, first bytes {start[:8]!r} (a video or "
        "image of a polarization camera needs layout=)")


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


def _first_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(64)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be opened: {error.strerror}") from error
