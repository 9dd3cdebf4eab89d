"""Write the provenance of data into their file."""
from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

import pdavis_cv
from pdavis_cv._types import Facts
from pdavis_cv.export.files import plain
from pdavis_cv.quantities import INTENSITY, chosen
from pdavis_cv.recording.base import Recording, Source

# Identifies our box in MP4; random, version 4.
_UUID = bytes.fromhex("6f0c5f1e2a4b4f6e9c3d70646176697a")
_PNG_START, _PNG_KEY = b"\x89PNG\r\n\x1a\n", b"pdavis_cv"
_GIF_COMMENT = b"\x21\xfe"
_TAG_NAME = "PDAVIS_PROVENANCE"
# Element numbers of Matroska.
_SEGMENT, _TAGS = b"\x18\x53\x80\x67", b"\x12\x54\xc3\x67"
_TAG, _TARGETS, _SIMPLE = b"\x73\x73", b"\x63\xc0", b"\x67\xc8"
_NAME, _STRING = b"\x45\xa3", b"\x44\x87"
_MARKS = ((_PNG_START, b"iTXt" + _PNG_KEY, 5), (b"RIFF", b"pdvs", 4),
          (b"\x1aE\xdf\xa3", _TAG_NAME.encode(), 10), (b"", b"uuid" + _UUID, 0))
"""How a file begins, what precedes the facts in it, and bytes that lie between."""
_LONGEST = 64  # largest number of elements of an array that is written out


def light_unit(recording: Recording) -> str:
    """Return the unit of intensities: DN, if the frames' exposure is not known.

    It is 1 without frames, as events tell only how light changes.
    """
    frame = next((f for packet in recording.packets() for f in packet.frames), None)
    return "1" if frame is None else INTENSITY if frame.exposure_ms else "DN"


def units(names: Sequence[str], recording: Recording) -> dict[str, str]:
    """Return the units of quantities; that of intensities depends on the recording."""
    light = light_unit(recording)
    return {one.name: light if one.unit == INTENSITY else one.unit
            for one in chosen(names)}


def provenance(
    images: Mapping[str, Any], source: Source | None = None, **facts: Any,
) -> dict[str, Any]:
    """Return the provenance to be written into a file.

    Parameters
    ----------
    images : mapping of str to object
        Provenance of a PolarFrame.
    source : Source, optional
        The recording, of whose files names, sizes and SHA-256 are added as ``input``:
        of one file, or of several as ``files``.
    **facts
        Further facts, e.g. channels and units.

    Returns
    -------
    dict of str to object
        Suitable for JSON; arrays of more than 64 numbers become shape and SHA-256.

    Raises
    ------
    OSError
        If the source cannot be read.
    """
    found: dict[str, Any] = {"pdavis_cv": pdavis_cv.__version__, **images, **facts}
    if source is not None:
        files = [member.facts for member in source.members]
        found["input"] = files[0] if len(files) == 1 else {
            "name": source.name, "files": files}
    return {str(name): _short(value) for name, value in found.items()}


def _short(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.size > _LONGEST:
        return {"shape": list(value.shape), "dtype": str(value.dtype),
                "sha256": hashlib.sha256(np.ascontiguousarray(value).tobytes()
                                         ).hexdigest()}
    if isinstance(value, Mapping):
        return {str(name): _short(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_short(inner) for inner in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return _short(plain(value))


def to_json(facts: Facts) -> str:
    """Return facts as one line of JSON."""
    return json.dumps(_short(facts), allow_nan=False)


def embed(path: str | os.PathLike[str], facts: Facts) -> None:
    """Add facts, as JSON, to a finished video or animation, in place.

    They become a box in MP4, a tag in Matroska, a chunk in AVI and WebP, a comment in
    GIF; players ignore them.  Another format is a ValueError.
    """
    text = to_json(facts).encode()
    with Path(path).open("r+b") as file:
        start = file.read(12)
        if start[:4] == b"\x1aE\xdf\xa3":
            _extend_segment(file, text)
            return
        file.seek(0, os.SEEK_END)
        if start[4:8] == b"ftyp":
            file.write(struct.pack(">I4s", 24 + len(text), b"uuid") + _UUID + text)
        elif start[:4] == b"RIFF":
            # After the last RIFF list, which AVI readers do not read.
            text += b" " * (len(text) % 2)
            file.write(b"pdvs" + struct.pack("<I", len(text)) + text)
            if start[8:] == b"WEBP":  # WebP readers skip unknown chunks
                size = file.tell() - 8
                file.seek(4)
                file.write(struct.pack("<I", size))
        elif start[:4] == b"GIF8":
            file.seek(-1, os.SEEK_END)  # before the trailer
            blocks = (text[i:i + 255] for i in range(0, len(text), 255))
            file.write(_GIF_COMMENT + b"".join(
                bytes([len(block)]) + block for block in blocks) + b"\0;")
        else:
            raise ValueError(f"{path}: neither MP4, Matroska, AVI, GIF nor WebP")


def read_embedded(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return the facts that `embed` or `embed_png` wrote, None if there are none.

    Parameters
    ----------
    path : path
        A video, an animation or a PNG.

    Returns
    -------
    dict of str to object, or None
    """
    data = Path(path).read_bytes()
    if data[:4] == b"GIF8":
        at, text = data.rfind(_GIF_COMMENT) + 2, b""
        while at > 1 and (length := data[at]):
            text += data[at + 1:at + 1 + length]
            at += 1 + length
    else:
        mark, gap = next((mark, gap) for start, mark, gap in _MARKS
                         if data.startswith(start))
        at = data.rfind(mark)
        text = b"" if at < 0 else data[at + len(mark) + gap:]
    if not text.startswith(b"{"):
        return None
    facts, _ = json.JSONDecoder().raw_decode(text.decode(errors="ignore"))
    return dict(facts)


def embed_png(data: bytes, facts: Facts) -> bytes:
    """Return PNG data with facts, as JSON, in a text chunk after the header."""
    if not data.startswith(_PNG_START):
        raise ValueError(f"data must be PNG, got first bytes {data[:4]!r}")
    body = b"iTXt" + _PNG_KEY + b"\0" * 5 + to_json(facts).encode()
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(
        ">I", zlib.crc32(body))
    header = len(_PNG_START) + 25  # IHDR always has 13 bytes
    return data[:header] + chunk + data[header:]


def _element(kind: bytes, body: bytes) -> bytes:
    return kind + (len(body) | 1 << 56).to_bytes(8, "big") + body


def _extend_segment(file: BinaryIO, text: bytes) -> None:
    """Append a Tags element to Matroska's Segment and update the Segment's size."""
    tags = _element(_TAGS, _element(_TAG, _element(_TARGETS, b"") + _element(
        _SIMPLE, _element(_NAME, _TAG_NAME.encode()) + _element(_STRING, text))))
    file.seek(0)
    head = file.read(4096)
    at = head.find(_SEGMENT)
    if at < 0 or head[at + 4] != 1:
        raise ValueError("Matroska file without a Segment of 8-byte size")
    size = int.from_bytes(head[at + 5:at + 12], "big")
    if size != (1 << 56) - 1:  # all ones: unknown, it ends with the file
        file.seek(at + 5)
        file.write((size + len(tags)).to_bytes(7, "big"))
    file.seek(0, os.SEEK_END)
    file.write(tags)
