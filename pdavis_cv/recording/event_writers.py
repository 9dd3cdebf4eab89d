"""Writers of formats that hold events only: RAW, Event Stream, text, NumPy, Parquet."""
from __future__ import annotations

import json
import os
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import clear
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import Packet, Recording
from pdavis_cv.recording.parquet import METADATA, pyarrow
from pdavis_cv.recording.prophesee import EVT2, EVT3, RISING
from pdavis_cv.recording.writer import RecordingWriter, edges_of, source_text

_ES_STEP = 127
"""Time that a byte without an event adds, us."""
_ES_LATEST = 1 << 31
"""First time above which times of an Event Stream begin at 0, us: a byte for each
127 us would precede the first event."""
_ROW_GROUP = 1 << 18
# Bits of a time's lower part, and the longest step of its upper part between two words:
# readers take each fall for one overflow, and those of EVT3 expect every value.
_EVT = {EVT2: (6, 1 << 20), EVT3: (12, 1)}
_MOST_COORDINATE = 2047


class _EventWriter(RecordingWriter):
    """Base: what is no event is counted as lost; the recording tells the header."""

    holds = frozenset(("events",))

    def __init__(self, path: str | os.PathLike[str], recording: Recording) -> None:
        self._info = recording.info
        super().__init__(path, recording.info.sensor_size)
        try:
            self._begin()
        except BaseException:
            self.discard()
            raise

    @classmethod
    def write(cls, path: str | os.PathLike[str], recording: Recording, **options: Any
              ) -> Mapping[str, int]:
        """Write a recording; return the number of what was lost, by description."""
        clear(path)
        with cls(path, recording, **options) as writer:
            for packet in recording.packets():
                writer.add(packet)
        return writer.losses

    def _begin(self) -> None:
        """Write what comes before the first event."""

    def _write(self, packet: Packet) -> None:
        for name in {"frames", "imu", "triggers"} - self.holds:
            self._lost[name] += len(getattr(packet, name))
        if any(len(getattr(packet, name)) for name in self.holds):
            self._put(packet.events, packet.triggers)

    @abstractmethod
    def _put(self, events: NDArray[Any], triggers: NDArray[Any]) -> None:
        """Write events, and triggers if the format holds them; not both are empty."""

    def _finish(self) -> None:
        pass


class RawWriter(_EventWriter):
    """Prophesee's RAW, in EVT2 or EVT3; holds triggers as well."""

    holds = frozenset(("events", "triggers"))

    def __init__(self, path: str | os.PathLike[str], recording: Recording,
                 encoding: str = "evt3") -> None:
        if encoding not in ("evt2", "evt3"):
            raise ValueError(f"encoding of RAW must be evt2 or evt3, got {encoding!r}")
        self._version = EVT3 if encoding == "evt3" else EVT2
        height, width = recording.info.sensor_size
        if max(height, width) > _MOST_COORDINATE + 1:
            raise ValueError(
                f"RAW holds sensors of at most 2048x2048, got {width}x{height}")
        super().__init__(path, recording)
        self._origin: int | None = None
        self._last = 0, -1, -1      # upper and lower part of time, row

    def _header(self, first_us: int) -> None:
        # Times wrap; whole turns stand in the header, as faery has them.
        bits = 24 if self._version == EVT3 else 34
        self._origin = max(first_us, 0) >> bits << bits
        if first_us < 0:
            raise ValueError(f"RAW holds no time before 0, got {first_us} us")
        height, width = self.sensor_size
        origin = f"% t0 {self._origin}\n" if self._origin else ""
        self._file.write(
            f"% evt {self._version}.0\n% format EVT{self._version};height={height};"
            f"width={width}\n% geometry {width}x{height}\n{origin}"
            f"% generator pdavis_cv\n% source_facts {source_text(self._info)}\n"
            "% end\n".encode())

    def _put(self, events: NDArray[Any], triggers: NDArray[Any]) -> None:
        triggers = edges_of(triggers, self._lost)
        if not len(events) + len(triggers):
            return
        t = np.concatenate((events["t"], triggers["t"])).astype(np.int64)
        order = np.argsort(t, kind="stable")
        t, is_event = t[order], order < len(events)
        if self._origin is None:
            self._header(int(t[0]))
        x, y, p, edge = np.zeros((4, len(t)), np.int64)
        x[is_event], y[is_event], p[is_event] = (events[name] for name in "xyp")
        edge[~is_event] = triggers["type"] == RISING
        if self._version == EVT3:
            last = np.where(is_event, p << 11 | x | 2 << 12, edge | 10 << 12)
            self._words(t, np.where(is_event, y, -1), last)
        else:
            last = np.where(is_event, p << 28 | x << 11 | y, edge | 10 << 28)
            self._words(t, None, last | (t & 63) << 22)

    def _words(self, t: NDArray[np.int64], row: NDArray[np.int64] | None,
               last: NDArray[np.int64]) -> None:
        """Write the words of samples: upper and lower time, row, and the last one."""
        bits, step = _EVT[self._version]
        t = t - (self._origin or 0)
        high, low = t >> bits, t & (1 << bits) - 1
        old_high, old_low, old_row = self._last
        if old_low < 0:
            old_high = int(high[0]) - 1
        highs = -(np.diff(high, prepend=old_high) // -step)
        count = highs + 1
        if row is not None:
            new_row = (np.diff(row, prepend=old_row) != 0) & (row >= 0)
            new_low = (highs > 0) | (np.diff(low, prepend=old_low) != 0)
            count += new_row.astype(np.int64) + new_low
        end = np.cumsum(count)
        # Every word is an upper time, counted up to that of its sample, or is replaced.
        place = np.arange(end[-1]) - np.repeat(end - count, count)
        place -= np.repeat(highs - 1, count)
        words = np.repeat(high, count) + place * step & (
            0xFFF if row is not None else 0xFFFFFFF)
        words |= 8 << (12 if row is not None else 28)
        words[end - 1] = last
        if row is not None:
            words[(end - 2)[new_row]] = row[new_row]
            words[(end - 2 - new_row)[new_low]] = 6 << 12 | low[new_low]
        self._file.write(words.astype("<u4" if row is None else "<u2").tobytes())
        self._last = int(high[-1]), int(low[-1]), -1 if row is None else int(row[-1])

    def _finish(self) -> None:
        if self._origin is None:
            self._header(0)


class StreamWriter(_EventWriter):
    """Event Stream."""

    def _begin(self) -> None:
        self._now: int | None = None
        height, width = self.sensor_size
        self._file.write(b"Event Stream\2\0\0\1" + np.array(
            [width, height], "<u2").tobytes())

    def _put(self, events: NDArray[Any], triggers: NDArray[Any]) -> None:
        if self._now is None:
            first = int(events["t"][0])
            self._now = 0 if 0 <= first < _ES_LATEST else first
            if self._now:
                self._lost["us before the first event: times begin at 0"] = first
        steps: NDArray[Any] = np.diff(events["t"].astype(np.int64), prepend=self._now)
        ends = np.cumsum(5 + steps // _ES_STEP)
        out = np.full(int(ends[-1]), 0xFF, np.uint8)
        rows = np.empty(len(events), [("head", "u1"), ("x", "<u2"), ("y", "<u2")])
        rows["head"] = (steps % _ES_STEP) << 1 | events["p"]
        rows["x"], rows["y"] = events["x"], self.sensor_size[0] - 1 - events["y"]
        out[(ends - 5)[:, None] + np.arange(5)] = rows.view(np.uint8).reshape(-1, 5)
        self._file.write(out.data)
        self._now = int(events["t"][-1])


class TextWriter(_EventWriter):
    """Lines of text, times in us."""

    def _begin(self) -> None:
        height, width = self.sensor_size    # in the names, as faery has it
        self._file.write(f"t,x@{width},y@{height},on\n".encode())

    def _put(self, events: NDArray[Any], triggers: NDArray[Any]) -> None:
        columns = [events[name].tolist() for name in "txyp"]
        self._file.write("".join(map(
            "%d,%d,%d,%d\n".__mod__, zip(*columns, strict=True))).encode())


class NumpyWriter(_EventWriter):
    """An array of EVENT_DTYPE, ``.npy``."""

    def _begin(self) -> None:
        self._count = 0
        self._header()

    def _header(self) -> None:
        # NumPy leaves room for the digits of any number of rows.
        np.lib.format.write_array_header_1_0(self._file, {
            "descr": np.lib.format.dtype_to_descr(EVENT_DTYPE),
            "fortran_order": False, "shape": (self._count,)})

    def _put(self, events: NDArray[Any], triggers: NDArray[Any]) -> None:
        self._file.write(np.ascontiguousarray(events).data)
        self._count += len(events)

    def _finish(self) -> None:
        self._file.seek(0)
        self._header()


class ParquetWriter(_EventWriter):
    """A table with columns t (us), x, y, p."""

    def _begin(self) -> None:
        self._arrow, parquet = pyarrow()
        self._schema = self._arrow.schema(
            [(name, self._arrow.from_numpy_dtype(EVENT_DTYPE[name]))
             for name in "txyp"], {METADATA: json.dumps({
                 "sensor_size": self.sensor_size,
                 "source_facts": source_text(self._info)})})
        self._table = parquet.ParquetWriter(
            self._file, self._schema, compression="zstd", use_dictionary=False)
        self._waiting: list[NDArray[Any]] = []

    def _put(self, events: NDArray[Any], triggers: NDArray[Any]) -> None:
        self._waiting.append(events)
        if sum(map(len, self._waiting)) >= _ROW_GROUP:
            self._group()

    def _group(self) -> None:
        self._table.write_table(self._arrow.table(
            {name: np.concatenate([one[name] for one in self._waiting])
             for name in "txyp"}, schema=self._schema))
        self._waiting.clear()

    def _finish(self) -> None:
        if self._waiting:
            self._group()
        self._table.close()
