"""Files whose first bytes no format knows."""
from __future__ import annotations

import re
from pathlib import Path

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.format import Format
from pdavis_cv.recording.images.names import is_four_planes
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.registry import FORMATS, first_bytes
from pdavis_cv.recording.text_form import PNM


def format_with(options: SourceOptions, path: Path, start: bytes) -> Format:
    """Return the format by what the caller says of the file; RecordingError if none."""
    if _is_text(start):
        if options.columns is None:     # never an image, whatever the layout
            raise _not_a_recording(path, start)
        return FORMATS["text"]
    if options.known_layout is not None or options.analyser_steps is not None or (
            is_four_planes(str(path))):
        return FORMATS["images"]
    raise _not_a_recording(path, first_bytes(path))


def _not_a_recording(path: Path, start: bytes) -> RecordingError:
    if path.is_dir():
        bags = sorted(one.name for one in path.iterdir()
                      if one.suffix in (".db3", ".mcap"))
        return RecordingError(f"{path}: a folder that is not a recording" + (
            f" (a bag without metadata.yaml: open {bags[0]} in it)" if bags else ""))
    if start.startswith(b"#"):
        return RecordingError(f"{path}: byte 0: {_other_aedat(start)}")
    if not start:
        return RecordingError(f"{path}: byte 0: the file is empty")
    what = ("text, but no lines of events: time, x, y, polarity" if _is_text(start) else
            "a video or image of a polarization camera needs its layout, e.g. "
            'layout="sony"')
    return RecordingError(
        f"{path}: byte 0: not a recording, first bytes {start[:8]!r} ({what})")


def _is_text(start: bytes) -> bool:
    """Return whether a file begins with text that is no image (PNM is one)."""
    return bool(start) and not _NOT_TEXT.search(start) and not PNM.match(start)


_NOT_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")


def _other_aedat(start: bytes) -> str:
    """Return a message for a file of another AEDAT version.

    A file without a version line would be AEDAT-1 with 16-bit addresses, for which the
    documentation of jAER and of the vendor contradict each other.
    """
    if found := re.match(rb"#!AER-DAT([\w.]*)", start):
        return (f"AEDAT-{found[1].decode() or '?'} is not read; DV converts it to "
                "AEDAT-4")
    return ("no line #!AER-DAT: not a recording, or AEDAT-1 of a DVS128 (16-bit "
            "addresses), which is not read: no DAVIS wrote it")
