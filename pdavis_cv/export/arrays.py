"""Write a series of images as one NumPy array file."""
from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pdavis_cv._beside import write_beside
from pdavis_cv._types import Image
from pdavis_cv.export.files import SeriesFile

__all__ = ["ArrayFile"]


class ArrayFile(SeriesFile):
    """Write an NPY file of unknown length, image by image, in bounded memory.

    Parameters
    ----------
    path : path
        File to write, readable by ``numpy.load``; appears when it is complete.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "series.npy"
    ...     with ArrayFile(path) as file:
    ...         for i in range(3):
    ...             file.add(np.full((2, 4), i, np.float32))
    ...     np.load(path).shape
    (3, 2, 4)
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._stack = contextlib.ExitStack()
        part = self._stack.enter_context(write_beside(path))
        self._file: BinaryIO = self._stack.enter_context(part.open("wb"))
        self.path = Path(path)
        self.count = 0
        self._like: tuple[np.dtype[Any], tuple[int, ...]] | None = None

    def add(self, image: Image) -> None:
        """Append an image.

        Parameters
        ----------
        image : ndarray
            All images must have the same dtype and shape.

        Raises
        ------
        ValueError
            If dtype or shape differ from the first image's.
        """
        like = (image.dtype, image.shape)
        if self._like is None:
            self._like = like
            self._write_header()
        elif self._like != like:
            raise ValueError(f"image must be like the first, {self._like}, got {like}")
        np.ascontiguousarray(image).tofile(self._file)
        self.count += 1

    def _write_header(self) -> None:
        dtype, shape = self._like or (np.dtype(np.float32), (0, 0))
        # NumPy pads headers so that the first axis may have up to 21 digits.
        np.lib.format.write_array_header_1_0(self._file, {
            "descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False,
            "shape": (self.count, *shape)})

    def _finish(self) -> None:
        self._file.seek(0)
        self._write_header()
