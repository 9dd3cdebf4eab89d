"""Tables of events in Parquet; the package pyarrow reads them, group by group."""
from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.event_lists import NumpyRecording

METADATA = "pdavis_cv"
"""Key of the table's metadata that holds the sensor's size and facts of the source."""


def pyarrow() -> tuple[Any, Any]:
    """Return the packages pyarrow and pyarrow.parquet."""
    try:
        import pyarrow as package
        from pyarrow import parquet
    except ImportError:
        raise ImportError(
            "Parquet needs a package: pip install pyarrow (extra [parquet])") from None
    return package, parquet


@dataclass
class _Column:
    """A column of a table, read in groups of rows."""

    table: Any
    name: str
    starts: NDArray[np.int64]
    kind: str
    shape: tuple[int]
    _group: tuple[int, NDArray[Any] | None] = -1, None

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, start: int, stop: int, read: dict[Any, NDArray[Any]] | None = None
             ) -> NDArray[Any]:
        """Return rows start <= i < stop, fewer if a group cannot be read."""
        parts, stop = [np.empty(0, np.int64)], min(stop, len(self))
        while start < stop:
            k = int(np.searchsorted(self.starts, start, "right")) - 1
            cached, values = self._group
            if cached != k or values is None:
                try:
                    values = self.table.read_row_group(k, [self.name])[0].to_numpy()
                except (OSError, ValueError):   # pyarrow's own are derived from these
                    break
                self._group = k, values
            first = int(self.starts[k])
            parts.append(values[start - first:stop - first])
            start = min(int(self.starts[k + 1]), stop)
        return np.concatenate(parts[1:] or parts)


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
