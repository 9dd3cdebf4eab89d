"""Read untrusted FlatBuffers: every offset is checked."""
from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pdavis_cv import _kernels

_HEAD = struct.Struct("<I4x4s")
_ROOT = 4
"""Where the offset of the root table lies."""


class PayloadError(ValueError):
    """Raised when a payload cannot be decompressed, or an offset or size is wrong."""


class Table:
    """The root table of a size-prefixed buffer.

    Parameters
    ----------
    data : bytes
    identifier : bytes
        The type that it should have.

    Raises
    ------
    PayloadError
        If the size or the identifier is wrong.
    """

    __slots__ = ("data",)

    def __init__(self, data: bytes | memoryview, identifier: bytes) -> None:
        self.data = data
        try:
            size, found = _HEAD.unpack_from(data)
        except struct.error:
            raise PayloadError(f"it has {len(data)} bytes") from None
        if size > len(data) - 4:
            raise PayloadError(f"it should hold {size + 4} bytes, but has {len(data)}")
        if found != identifier:
            raise PayloadError(f"it should be {identifier.decode()}, but is {found!r}")

    def vector(self, field: int, item: int) -> tuple[int, int]:
        """Return the offset of a vector's items of so many bytes, and their number."""
        at, count = _kernels.aedat4_vector(self.data, field, item)
        if at < 0:
            raise PayloadError(
                f"a vector of {count} items of {item} bytes does not fit into "
                f"{len(self.data)} bytes")
        return at, count

    def text(self, field: int) -> str:
        """Return a string field."""
        at, count = self.vector(field, 1)
        return bytes(self.data[at:at + count]).decode("utf-8", "replace")

    def fields(self, first: int, dtype: DTypeLike, columns: int = 1) -> list[Any]:
        """Return fields of the same type, from the first on; 0 is their default."""
        found: list[Any] = self._fields(_ROOT, 1, first, dtype, columns)[0].tolist()
        return found

    def rows(self, first: int, dtype: DTypeLike, columns: int = 1) -> NDArray[Any]:
        """Return such fields of the tables in the vector that is the first field.

        Their shape is (number of tables, columns).
        """
        return self._fields(*self.vector(0, 4), first, dtype, columns)

    def _fields(self, at: int, count: int, first: int, dtype: DTypeLike, columns: int
                ) -> NDArray[Any]:
        out = np.zeros((count, columns), dtype)
        if _kernels.aedat4_table_fields(
                np.frombuffer(self.data, np.uint8), at, first,
                out.view(np.uint8).reshape(count, columns, out.itemsize)) != count:
            raise PayloadError("a table lies outside its packet")
        return out
