"""Arrays in ``.npy`` and ``.npz`` files, read in blocks of rows.

They are not mapped into memory, as truncating a mapped file would kill the process.
"""
from __future__ import annotations

import math
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._arrays import array_header
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.limits import Budget

_LOCAL_HEADER = 30
"""Bytes of a member's header before its name; the last two words are the sizes of the
name and of the extra field."""


@dataclass(frozen=True)
class StoredArray:
    """An array in a file, of which one column or field, or all, is read.

    It is `fortran` if it is stored column by column; its data begin at the byte
    `offset` of what `opened` returns the `FileReader` of; the first call may unpack it.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool
    offset: int
    opened: Callable[[], FileReader]
    column: int | str | None = None

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def kind(self) -> str:
        """The `kind` of the dtype."""
        return (self.dtype[self.column] if isinstance(self.column, str)
                else self.dtype).kind

    def of(self, column: int | str) -> StoredArray:
        """Return one column or field of the array."""
        return replace(self, column=column)

    def rows(self, start: int, stop: int, read: dict[Any, NDArray[Any]] | None = None
             ) -> NDArray[Any]:
        """Return rows start <= i < stop of a one- or two-dimensional array.

        There are fewer if the file ends before.  `read` keeps these rows' bytes for the
        other columns; it is updated.
        """
        stop, wide = min(stop, len(self)), math.prod(self.shape[1:])
        if self.fortran and isinstance(self.column, int):
            start, stop = (at + self.column * len(self) for at in (start, stop))
            wide = 1
        key = self.opened, self.offset, start
        found = None if read is None else read.get(key)
        if found is None:
            row = self.dtype.itemsize * wide
            data = self.opened().read(self.offset + start * row, (stop - start) * row)
            found = np.frombuffer(data, self.dtype, len(data) // row * wide)
            if read is not None:
                read[key] = found
        if self.column is None or (wide == 1 and not isinstance(self.column, str)):
            return found
        column: NDArray[Any] = (found[self.column] if isinstance(self.column, str)
                                else found[self.column::wide])
        return column


def stored_arrays(reader: FileReader, kept: Callable[[FileReader], object],
                  budget: Budget) -> dict[str, StoredArray]:
    """Return the arrays of a file by name in lower case; "" for that of ``.npy``.

    `kept` is called with each reader that has to be closed with the recording.  A
    damaged file may raise any exception of NumPy or zipfile.
    """
    if reader.read(0, 2) != b"PK":
        with Path(reader.path).open("rb") as file:
            return {"": _header(file, reader.size, lambda: reader)}
    with zipfile.ZipFile(reader.path) as archive:
        members = archive.infolist()
        budget.total(sum(m.file_size for m in members))
        return {member.filename.removesuffix(".npy").lower(): _member(
            archive, member, reader, kept) for member in members}


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, reader: FileReader,
            kept: Callable[[FileReader], object]) -> StoredArray:
    made: list[FileReader] = []

    def opened() -> FileReader:
        if not made:
            made.append(unpacked(reader.path, member))
            kept(made[0])
        return made[0]

    with archive.open(member) as file:
        found = _header(file, member.file_size, opened)
    if member.compress_type != zipfile.ZIP_STORED:
        return found
    head = reader.read(member.header_offset, _LOCAL_HEADER)
    sizes = (int.from_bytes(head[at:at + 2], "little") for at in (26, 28))
    begin = member.header_offset + _LOCAL_HEADER + sum(sizes)
    return replace(found, offset=begin + found.offset, opened=lambda: reader)


def unpacked(path: Path, member: zipfile.ZipInfo) -> FileReader:
    """Unpack a compressed member into an unnamed temporary file; return its reader."""
    with (zipfile.ZipFile(path) as archive, archive.open(member) as source,
          tempfile.TemporaryFile() as file):
        shutil.copyfileobj(source, file)
        file.flush()
        return FileReader(path, os.dup(file.fileno()))


def _header(file: IO[bytes], size: int, opened: Callable[[], FileReader]
            ) -> StoredArray:
    """Return the array whose header is at the beginning of a file of `size` bytes."""
    shape, fortran, dtype = array_header(file, size)
    return StoredArray(dtype, shape, fortran, file.tell(), opened)
