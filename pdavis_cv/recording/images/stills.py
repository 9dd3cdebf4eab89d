"""Still images, which cv2 reads, and arrays of NumPy."""
from __future__ import annotations

import math
import os
import re
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pdavis_cv._opencv import opencv
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.images.pictures import (
    Images,
    PictureFacts,
    Pictures,
    one_plane,
    readable,
)
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.numpy_files import stored_arrays

_PGM = re.compile(rb"P[2356]\s(?:\s*#.*\n)*\s*(\d+)\s+(\d+)\s+(\d+)\s")
_SHAPE = re.compile(rb"\x93NUMPY.{4,6}\{[^}]*'shape': \((\d[\d, ]*)\)", re.DOTALL)
_SIDES = (
    (re.compile(rb"\x89PNG.{12}(.{8})", re.DOTALL), ">ii"),
    (re.compile(rb"BM.{16}(.{8})", re.DOTALL), "<ii"),
    (re.compile(rb".{,512}ihdr(.{8})", re.DOTALL), ">ii"))
"""Where PNG, BMP and JPEG 2000 state their sides."""
_WEBP = {b"VP8 ": (26, 16, 14), b"VP8L": (21, 14, 14), b"VP8X": (24, 24, 24)}
"""Byte of WebP's first side, bits to the second one, and of each, by its kind."""
_PIXEL = 6
"""Bytes of a pixel of three channels of 16 bits."""
_FEWEST_COLUMNS = 16
"""Fewer are the columns of a list of events."""
_JPEG = b"\xff\xd8\xff"
_MOST_SCANS = 100
"""Of a JPEG: each costs a pass over all pixels; progressive ones have about ten."""


def is_image_array(start: bytes) -> bool:
    """Return whether a file is an array of images, from its first bytes."""
    found = _SHAPE.match(start)
    sides = [] if found is None else [*map(int, re.findall(rb"\d+", found[1]))]
    return len(sides) > 2 or (len(sides) == 2 and sides[1] >= _FEWEST_COLUMNS)


def _sides(file: BinaryIO) -> tuple[int, int]:
    """Return two sides that an image states, or more; (0, 0) if it is of no kind."""
    start = file.read(1024)
    for pattern, code in _SIDES:
        if found := pattern.match(start):
            first, second = struct.unpack(code, found[1])
            return abs(first), abs(second)
    if found := _PGM.match(start):
        return int(found[1]), int(found[2])
    if start[8:12] == b"WEBP" and start[12:16] in _WEBP:
        at, step, bits = _WEBP[start[12:16]]
        both, mask = int.from_bytes(start[at:at + 6], "little"), (1 << bits) - 1
        return (both & mask) + 1, (both >> step & mask) + 1
    file.seek(2)
    while start.startswith(_JPEG) and len(head := file.read(4)) == 4:
        if 0xC0 <= head[1] <= 0xCF and head[1] not in (0xC4, 0xC8, 0xCC):
            return struct.unpack(">xHH", file.read(5))
        # A byte may fill up before a marker, or a segment follows.
        file.seek(-3 if head[1] == 0xFF else int.from_bytes(head[2:], "big") - 2,
                  os.SEEK_CUR)
    return 0, 0


def _check_chunks(file: BinaryIO, path: str) -> None:
    """Raise RecordingError if a chunk of a PNG ends beyond it: cv2 makes room first."""
    at, size, kind = 8, file.seek(0, os.SEEK_END), b""
    while file.seek(at) < size and kind != b"IEND":
        length, kind = int.from_bytes(file.read(4), "big"), file.read(4)
        if at + 12 + length > size:
            raise RecordingError(f"{path}: byte {at}: a chunk of {length} bytes in a "
                                 f"file of {size}")
        at += 12 + length


class StillPicture(Pictures):
    """One image in a file."""

    def __init__(self, path: str, budget: Budget) -> None:
        self._path, self._budget = path, budget
        with Path(path).open("rb") as file:
            start = file.read(1024)
        stated, self._png = _PGM.match(start), start.startswith(b"\x89PNG")
        self.facts = PictureFacts(
            kind="image", count=1, lossy="JPEG" if start.startswith(_JPEG) else None,
            full_scale_dn=int(stated[3]) if stated else None)

    def images(self, first: int = 0) -> Images:
        """Iterate over the image; see `Pictures`."""
        if first:
            return
        cv2 = opencv()
        with Path(self._path).open("rb") as file:
            width, height = _sides(file)
            if self._png:
                _check_chunks(file, self._path)
            self._budget.piece(file.seek(0, os.SEEK_END), "an image file")
            file.seek(0)
            data = file.read()
            if self.facts.lossy and data.count(b"\xff\xda") > _MOST_SCANS:
                raise RecordingError(
                    f"{self._path}: a JPEG of more than {_MOST_SCANS} scans")
        if not width * height:      # cv2 would decode what the name does not say
            raise RecordingError(
                f"{self._path}: the image cannot be decoded: of no kind that is read")
        self._budget.piece(_PIXEL * width * height, f"{width}x{height} pixels")
        with readable(self._path, "picture"):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise RecordingError(f"{self._path}: the image cannot be decoded")
        yield None, one_plane(image, self._path)


class ArrayPictures(Pictures):
    """Images in a ``.npy`` file: (H, W), (T, H, W), (4, H, W) or (T, 4, H, W).

    An array of another shape, or stored column by column, is a RecordingError.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        reader = FileReader(path)
        try:
            array = stored_arrays(reader, lambda _: None, Budget(path))[""]
        except Exception as error:  # NumPy raises anything for a damaged header
            raise RecordingError(
                f"{path}: not an array that can be read: {error}") from None
        finally:
            reader.close()
        self._dtype, self._offset, shape = array.dtype, array.offset, array.shape
        four = len(shape) > 2 and shape[-3] == 4
        leading = shape[:-3] if four else shape[:-2]
        if len(shape) < 2 or len(leading) > 1 or array.fortran or not math.prod(shape):
            raise RecordingError(
                f"{path}: images must be (H, W), (T, H, W), (4, H, W) or "
                f"(T, 4, H, W) in C order, got {shape}"
                + (" column by column" if array.fortran else ""))
        self._shape = shape[len(leading):]
        self.facts = PictureFacts(kind="NumPy", count=math.prod(leading))

    def images(self, first: int = 0) -> Images:
        """Iterate over the images; see `Pictures`."""
        size = math.prod(self._shape) * self._dtype.itemsize
        reader = FileReader(self._path)
        try:
            for k in range(first, self.facts.count or 0):
                data = reader.read(self._offset + k * size, size)
                if len(data) < size:
                    raise RecordingError(f"{self._path}: the file ends in image {k}")
                image = np.frombuffer(data, self._dtype).reshape(self._shape)
                yield None, (image if image.ndim == 3 else one_plane(image, self._path))
        finally:
            reader.close()
