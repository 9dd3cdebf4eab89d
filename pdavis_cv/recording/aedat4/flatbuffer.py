"""Read untrusted FlatBuffers: every offset is checked."""
from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pdavis_cv import _kernels

_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_I32 = struct.Struct("<i")
_HEAD = struct.Struct("<II4s")
_SCALARS = {code: struct.Struct("<" + code) for code in "bBhHiIqQf"}


class PayloadError(ValueError):
    """Raised when a payload cannot be decompressed, or an offset or size is wrong."""


class Table:
    """One table inside a buffer.

    Parameters
    ----------
    data : bytes
    at : int
        Offset of the table.
    """

    __slots__ = ("_at", "_data", "_length", "_vtable")

    def __init__(self, data: bytes | memoryview, at: int) -> None:
        self._data, self._at = data, at
        self._vtable = at - _get(_I32, data, at)
        self._length = _get(_U16, data, self._vtable)

    def place(self, field: int) -> int:
        """Return the offset of a field, 0 if it has its default."""
        slot = 4 + 2 * field
        if slot + 2 > self._length:
            return 0
        relative = _get(_U16, self._data, self._vtable + slot)
        return self._at + relative if relative else 0

    def scalar(self, field: int, code: str, default: int = 0) -> int:
        """Return an integer field; code as in `struct`."""
        at = self.place(field)
        return _get(_SCALARS[code], self._data, at) if at else default

    def vector(self, field: int, item: int) -> tuple[int, int]:
        """Return the offset of the items of a vector, and their number.

        Parameters
        ----------
        field : int
        item : int
            Bytes per item.
        """
        at = self.place(field)
        if not at:
            return 0, 0
        at += _get(_U32, self._data, at)
        count = _get(_U32, self._data, at)
        if count * item > len(self._data) - at - 4:
            raise PayloadError(
                f"a vector of {count} items of {item} bytes does not fit into "
                f"{len(self._data)} bytes")
        return at + 4, count

    def text(self, field: int) -> str:
        """Return a string field."""
        at, count = self.vector(field, 1)
        return bytes(self._data[at:at + count]).decode("utf-8", "replace")


def root_table(data: bytes | memoryview, identifier: bytes) -> Table:
    """Return the root of a size-prefixed buffer.

    Raises
    ------
    PayloadError
        If the size or the identifier is wrong.
    """
    try:
        size, root, found = _HEAD.unpack_from(data)
    except struct.error:
        raise PayloadError(f"it has {len(data)} bytes") from None
    if size > len(data) - 4:
        raise PayloadError(f"it should hold {size + 4} bytes, but has {len(data)}")
    if found != identifier:
        raise PayloadError(f"it should be {identifier.decode()}, but is {found!r}")
    return Table(data, 4 + root)


def table_fields(
    data: bytes | memoryview, at: int, count: int, field: int, dtype: DTypeLike,
    columns: int = 1,
) -> NDArray[Any]:
    """Return fields of the same type of a vector of tables, shape (count, columns).

    Parameters
    ----------
    data : bytes or memoryview
    at, count : int
        Offset of the vector's items, and their number; see `Table.vector`.
    field : int
        The first of the fields.
    dtype : dtype
    columns : int
        Number of fields.

    Raises
    ------
    PayloadError
        If a table lies outside the buffer.
    """
    out = np.zeros((count, columns), dtype)
    if _kernels.aedat4_table_fields(
            np.frombuffer(data, np.uint8), at, field,
            out.view(np.uint8).reshape(count, columns, out.itemsize)) != count:
        raise PayloadError("a table lies outside its packet")
    return out


def _get(code: struct.Struct, data: bytes | memoryview, at: int) -> int:
    try:
        value: int = code.unpack_from(data, at if at >= 0 else len(data))[0]
    except struct.error:
        raise PayloadError(f"offset {at} points outside {len(data)} bytes") from None
    return value
