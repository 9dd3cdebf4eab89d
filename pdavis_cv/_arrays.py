"""Read untrusted archives of NumPy arrays, without pickles and in bounded memory."""
from __future__ import annotations

import io
import math
import os
import sys
import warnings
import zipfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._remote import as_path

_ZIP = b"PK\x03\x04"
MOST_HEADER = 10_000
"""Longest header of an array, bytes: NumPy's own limit, but before it is read."""


def array_header(
    file: IO[bytes], size: int
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order (True = Fortran) and dtype of an ``.npy`` of `size` bytes.

    The file is left at its first element.  A header that is damaged, has objects or
    claims more data than there are is a ValueError.
    """
    version = np.lib.format.read_magic(file)
    read, wide = ((np.lib.format.read_array_header_1_0, 2) if version == (1, 0)
                  else (np.lib.format.read_array_header_2_0, 4))
    start = file.read(wide)
    length = int.from_bytes(start, "little")
    if length > MOST_HEADER:
        raise ValueError(f"a header of {length} bytes, at most {MOST_HEADER} are read")
    header = io.BytesIO(start + file.read(length))
    with warnings.catch_warnings():     # of type names and escapes in field names
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", SyntaxWarning)
        shape, fortran, dtype = read(header)
    if dtype.hasobject or any(side < 0 for side in shape) or (
            max(dtype.itemsize, 1) * math.prod(shape) > size):
        raise ValueError(f"an array of shape {shape} and type {dtype} in {size} bytes")
    return shape, fortran, dtype


def read_arrays(
    path: str | os.PathLike[str], most_bytes: int
) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz`` by name, read-only.

    `most_bytes` bounds all arrays together: a few kilobytes can unpack to 1000 times as
    much.  A file of another format or a damaged one is a ValueError.
    """
    with as_path(path).open("rb") as source:
        data = source.read(len(_ZIP))
        if data == _ZIP:        # /dev/zero has no end
            data += source.read(most_bytes)
    try:
        if len(data) > most_bytes:
            raise ValueError(f"more than {most_bytes} bytes")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > most_bytes:
                raise ValueError(f"{size} bytes in it, at most {most_bytes} are read")
            return {member.filename.removesuffix(".npy"): _array(archive.read(member))
                    for member in members}
    except ValueError:
        raise
    except Exception as error:      # an archive can go wrong in any way
        raise ValueError(f"{type(error).__name__}: {error}") from None


def _array(data: bytes) -> NDArray[Any]:
    file = io.BytesIO(data)
    shape, fortran, dtype = array_header(file, len(data))
    found: NDArray[Any] = np.frombuffer(data, dtype, math.prod(shape), file.tell())
    if dtype.kind == "U" and np.any(
            found.view(np.dtype("u4").newbyteorder(dtype.byteorder)) > sys.maxunicode):
        raise ValueError("a text with characters that there are not")
    return found.reshape(shape, order="F" if fortran else "C")
