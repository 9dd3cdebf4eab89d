"""Still images, which cv2 reads, and arrays of NumPy."""
from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from pdavis_cv._opencv import opencv
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.images.pictures import (
    Images,
    PictureFacts,
    Pictures,
    one_plane,
)
from pdavis_cv.recording.numpy_files import stored_arrays

__all__ = ["ArrayPictures", "StillPicture", "is_image_array"]

_PGM = re.compile(rb"P[25]\s(?:\s*#.*\n)*\s*\d+\s+\d+\s+(\d+)\s")
_SHAPE = re.compile(rb"\x93NUMPY.{4,6}\{[^}]*'shape': \((\d[\d, ]*)\)", re.DOTALL)
_FEWEST_COLUMNS = 16
"""Fewer are the columns of a list of events."""
_JPEG = b"\xff\xd8\xff"


def is_image_array(start: bytes) -> bool:
    """Return whether a file is an array of images, from its first bytes."""
    found = _SHAPE.match(start)
    sides = [] if found is None else [int(n) for n in found[1].split(b",") if n.strip()]
    return len(sides) > 2 or (len(sides) == 2 and sides[1] >= _FEWEST_COLUMNS)


class StillPicture(Pictures):
    """One image in a file.

    Parameters
    ----------
    path : str
    """

    def __init__(self, path: str) -> None:
        self._path = path
        with Path(path).open("rb") as file:
            start = file.read(1024)
        stated = _PGM.match(start)
        self.facts = PictureFacts(
            kind="image", count=1, lossy="JPEG" if start.startswith(_JPEG) else None,
            full_scale_dn=int(stated[1]) if stated else None)

    def images(self, first: int = 0) -> Images:
        """Iterate over the image; see `Pictures`."""
        if first:
            return
        cv2 = opencv()
        image = cv2.imread(self._path, cv2.IMREAD_UNCHANGED)
        if image is None:
            raise RecordingError(f"{self._path}: the image cannot be decoded")
        yield None, one_plane(image, self._path)


class ArrayPictures(Pictures):
    """Images in a ``.npy`` file: (H, W), (T, H, W), (4, H, W) or (T, 4, H, W).

    Parameters
    ----------
    path : str

    Raises
    ------
    RecordingError
        If the array has another shape or is stored column by column.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        reader = FileReader(path)
        try:
            array = stored_arrays(reader, lambda _: None)[""]
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
                yield None, (image if image.ndim == 3
                             else one_plane(image, self._path))
        finally:
            reader.close()
