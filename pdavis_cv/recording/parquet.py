"""Tables of events in Parquet; the package pyarrow reads them, group by group."""
from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._packages import package
from pdavis_cv.recording.event_lists import NumpyRecording

_MOST_ROWS = 1 << 22
"""Rows that are read at once: most groups are smaller."""
METADATA = "pdavis_cv"
"""Key of the table's metadata that holds the sensor's size and facts of the source."""


def pyarrow() -> tuple[Any, Any]:
    """Return the packages pyarrow and pyarrow.parquet."""
    arrow = package(
        "pyarrow", "Parquet needs a package: pip install pyarrow (extra [parquet])")
    from pyarrow import parquet
    return arrow, parquet


@dataclass
class _Column:
    """A column of a table, read in groups of rows, large ones in parts."""

    table: Any
    name: str
    starts: NDArray[np.int64]
    kind: str
    shape: tuple[int]
    _part: tuple[int, NDArray[Any]] = field(default_factory=lambda: (0, np.empty(0)))
    _parts: Iterator[Any] = field(default_factory=lambda: iter(()))
    _stop: int = 0

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, start: int, stop: int, read: dict[Any, NDArray[Any]] | None = None
             ) -> NDArray[Any]:
        """Return rows start <= i < stop, fewer if a group cannot be read."""
        found, stop = [np.empty(0, np.int64)], min(stop, len(self))
        while start < stop:
            try:
                first, values = self._with(start)
            except (OSError, ValueError, StopIteration):    # pyarrow's are of these
                break
            found.append(values[start - first:stop - first])
            start = min(first + len(values), stop)
        return np.concatenate(found[1:] or found)

    def _with(self, row: int) -> tuple[int, NDArray[Any]]:
        """Return the first row of the part that holds a row, and its values."""
        first, values = self._part
        if not first <= row < self._stop:
            k = int(np.searchsorted(self.starts, row, "right")) - 1
            first, self._stop = self.starts[k:k + 2].tolist()
            self._parts = self.table.iter_batches(
                _MOST_ROWS, row_groups=[k], columns=[self.name])
            values = values[:0]
        while row >= first + len(values):
            first, values = first + len(values), next(self._parts)[0].to_numpy(
                zero_copy_only=False)
        self._part = first, values
        return self._part


class ParquetRecording(NumpyRecording):
    """A table of events in Parquet; see `open_recording`.

    Its columns are t, x, y, p, or have their usual other names; units of time are as in
    NumPy's arrays.
    """

    _kind = "Parquet"

    def _found(self) -> dict[str, _Column]:
        table = pyarrow()[1].ParquetFile(self._path)
        self._closing.callback(table.close)
        about = json.loads((table.schema_arrow.metadata or {}).get(
            METADATA.encode(), b"{}"))
        if "sensor_size" in about:
            height, width = about["sensor_size"]
            self._size = int(height), int(width)
        self._copied = about.get("source_facts")
        groups = [table.metadata.row_group(k).num_rows
                  for k in range(table.num_row_groups)]
        starts = np.cumsum([0, *groups], dtype=np.int64)
        return {field.name.lower(): _Column(
            table, field.name, starts, np.dtype(field.type.to_pandas_dtype()).kind,
            (int(starts[-1]),))
            for field in table.schema_arrow}
