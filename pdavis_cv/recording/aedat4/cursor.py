"""Read one stream of an AEDAT-4 file, packet by packet, in time order."""
from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.errors import PdavisWarning, RecordingError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.aedat4 import samples
from pdavis_cv.recording.aedat4.container import Aedat4File, Entry
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError, Table
from pdavis_cv.recording.base import ApsFrame, joined
from pdavis_cv.recording.timeline import (
    LOOK_AHEAD,
    NEVER,
    SEGMENT_US,
    Clock,
    Timeline,
    possible_range,
)

__all__ = ["Cursor"]

_SAMPLE = 64
"""Bytes that an IMU sample takes while it is read; four of the file may name it."""
KEPT_BYTES = 1 << 22
"""Packets that were examined ahead are kept up to this size, larger ones read again."""


class Cursor:
    """Read the packets of one stream.

    Parameters
    ----------
    file : Aedat4File
    kind : str
        ``"EVTS"``, ``"FRME"``, ``"IMUS"`` or ``"TRIG"``.
    entries : list of Entry
    timeline : Timeline
    size : (int, int)
        Sensor (height, width).
    scale : FrameScale, optional
    jaer : bool
        True if jAER wrote the file: rows are from the bottom, frame times differ.
    strict : bool
        True to raise at the first bad sample.
    first : int
        Index of the first packet to read.
    last_us : int
        Time of the last sample before it.
    """

    def __init__(
        self, file: Aedat4File, kind: str, entries: list[Entry], timeline: Timeline, *,
        size: tuple[int, int], scale: samples.FrameScale | None = None,
        jaer: bool = False, strict: bool = False, first: int = 0, last_us: int = NEVER,
    ) -> None:
        self.kind = kind
        self.clock = Clock(timeline, last_us)
        self._file, self._entries, self._next = file, entries, first
        self._size, self._scale, self._strict = size, scale, strict
        self._jaer = jaer
        self._last_mid = NEVER
        self._ahead: dict[int, tuple[bytes, Table]] = {}
        self._read = {"EVTS": self._events, "FRME": self._frames,
                      "IMUS": self._samples, "TRIG": self._samples}[kind]

    @property
    def mark(self) -> tuple[str, int, Clock, int]:
        """The current position; it is not a copy."""
        return self.kind, self._next, self.clock, self._last_mid

    def go_to(self, mark: tuple[str, int, Clock, int]) -> None:
        """Move to a position from `mark` of another cursor of this stream."""
        _, self._next, self.clock, self._last_mid = mark

    def pull(self) -> Any:
        """Return the samples of the next readable packet, None at the end."""
        while self._next < len(self._entries):
            entry = self._entries[self._next]
            self._next += 1
            try:
                return self._read(entry)
            except PayloadError as error:
                self._file.lost(entry, error)
        return None

    def all_events(self, stop_us: int) -> NDArray[Any] | None:
        """Return the events up to the packet that reaches stop_us, as one array.

        None if time jumps back, as the shift of a new segment depends on all streams.
        """
        rest = range(self._next, len(self._entries))
        # A damaged index may hold any count; the size of a packet limits it.
        out = np.empty(sum(min(e.count or 0, 16 * e.size) for e in self._entries[
            self._next:] if (e.start_us or NEVER) < stop_us), EVENT_DTYPE)
        state = self.clock.state
        state[0] = 0
        for number in rest:
            entry, self._next = self._entries[number], number + 1
            try:
                data, table = self._table(entry)
                at, count = samples.event_vector(table)
            except PayloadError as error:
                self._file.lost(entry, error)
                continue
            used = int(state[0])
            self._file.budget.total((used + count) * out.itemsize)
            if used + count > len(out):
                more = np.empty(max(len(out), count), EVENT_DTYPE)
                out = joined([out, more])
            if not self._decode(entry, data, at, count, out, segments=False):
                return None
            if self.clock.last >= stop_us:
                break
        return out[:int(state[0])]

    def _table(self, entry: Entry) -> tuple[bytes, Table]:
        """Return a packet of events, which may have been examined before."""
        return self._ahead.pop(entry.offset, None) or self._file.table(entry)

    def _events(self, entry: Entry) -> NDArray[Any]:
        data, table = self._table(entry)
        at, count = samples.event_vector(table)
        out = np.empty(count, EVENT_DTYPE)
        self.clock.state[0] = 0
        self._decode(entry, data, at, count, out)
        return out[:int(self.clock.state[0])]

    def _decode(self, entry: Entry, data: bytes, at: int, count: int,
                out: NDArray[Any], *, segments: bool = True) -> bool:
        """Append a packet's events to out; return False if a segment begins."""
        raw, state = np.frombuffer(data, np.uint8), self.clock.state
        state[3] = state[4] = 0
        done, bounds = 0, self._bounds(data, at, count)
        while True:
            done = _kernels.aedat4_events(
                raw, at, done, count, *self._size, self._jaer, *bounds, state, out)
            if self._strict and state[5] >= 0:
                self._refuse(entry, data, at, int(state[5]))
            if done == count:
                break
            if not segments:
                return False
            t = _time(data, at, done) + int(state[2])
            self._segment(entry, (done, t), t)
        self._count(entry, "outside sensor", int(state[3]),
                    "events outside the sensor were dropped")
        self._count(entry, "backward time", int(state[4]),
                    "events were dropped because time ran backward")
        return True

    def _bounds(self, data: bytes, at: int, count: int) -> tuple[int, int]:
        """Return the range of times that events of this packet may have.

        It follows from the index, where two wrong entries would be needed to spoil it;
        without an index, from the packets around it.
        """
        if not self._file.indexed:
            if not count:
                return NEVER, -NEVER
            before = NEVER if self.clock.last == NEVER else (
                self.clock.last - int(self.clock.state[2]))
            return possible_range(_times(data, at, count), self._following(), before)
        i, entries = self._next - 1, self._entries
        here = entries[i]
        first, last = [here.start_us], [here.stop_us]
        if i > 0:
            first.append(entries[i - 1].stop_us)
        if i + 1 < len(entries):
            last.append(entries[i + 1].start_us)
        return (max(min((t for t in first if t is not None), default=NEVER), NEVER),
                min(max((t for t in last if t is not None), default=-NEVER), -NEVER))

    def _following(self) -> list[NDArray[np.int64]]:
        """Return the times of the next readable packets of events."""
        found: list[NDArray[np.int64]] = []
        for entry in self._entries[self._next:self._next + 2 * LOOK_AHEAD]:
            with contextlib.suppress(PayloadError):
                data, table = self._table(entry)
                if len(data) <= KEPT_BYTES:
                    self._ahead[entry.offset] = data, table
                at, count = samples.event_vector(table)
                if count:
                    found.append(_times(data, at, count))
            if len(found) == LOOK_AHEAD:
                break
        return found

    def _frames(self, entry: Entry) -> list[ApsFrame]:
        data, table = self._file.table(entry)
        try:
            raw = samples.raw_frame(data, table)
        except samples.UnknownFrameError as error:
            self._file.log.add(
                "unknown frame", entry.offset, f"{error} is skipped",
                offset=entry.offset - 8, warning=PdavisWarning)
            return []
        if raw.colour:
            self._file.log.add(
                "colour frame", entry.offset, "colour channels were averaged",
                offset=entry.offset - 8)
        soe, eoe, available = samples.exposure_times(raw.times, jaer=self._jaer)
        if self._jaer:
            self._file.log.add(
                "frame times", None, "jAER's AEDAT-4 does not hold start and end of "
                "exposure: its middle was placed in the middle of the readout, within "
                f"{(available - raw.times[1] - (eoe - soe)) // 2} us")
        time = np.array([available], np.int64)
        before = self.clock.last
        keep, segments = self.clock.order(time)
        for _ in segments:
            self._note_segment(entry, "frame", int(time[0]))
        move = int(time[0]) - available
        mid = (soe + eoe) // 2 + move
        if not keep[0] or int(time[0]) == before or mid <= self._last_mid:
            self._count(entry, "backward time", 1,
                        "frames were dropped because time ran backward")
            return []
        scale = samples.scale_of(raw.pixels) if self._scale is None else self._scale
        if scale.itemsize != raw.pixels.dtype.itemsize:
            scale = samples.scale_of(raw.pixels)
        frame = samples.aps_frame(
            raw, scale, (soe + move, eoe + move, available + move), self._size,
            flip=self._jaer)
        self._last_mid = mid
        return [frame]

    def _samples(self, entry: Entry) -> NDArray[Any]:
        read = samples.imu_samples if self.kind == "IMUS" else samples.triggers
        data, table = self._file.table(entry)
        self._file.budget.piece(
            _SAMPLE * table.vector(0, 4)[1], "a packet of samples")
        got = read(data, table)
        times = got["t"].astype(np.int64)
        if not self._file.indexed and len(times) > 2 and (
                int(times[-1]) - int(times[-2]) > SEGMENT_US):
            got, times = got[:-1], times[:-1]       # all that follow would seem late
            self._count(entry, "backward time", 1,
                        "samples were dropped because time ran backward after them")
        keep, segments = self.clock.order(times)
        got["t"] = times
        for i in segments:
            self._note_segment(entry, i, int(times[i]))
        if keep.all():
            return got
        name = "IMU samples" if self.kind == "IMUS" else "triggers"
        self._count(entry, "backward time", int(np.count_nonzero(~keep)),
                    f"{name} were dropped because time ran backward")
        return got[keep]

    def _segment(self, entry: Entry, key: Any, t_us: int) -> None:
        moved = self.clock.jump(t_us)
        self._note_segment(entry, key, t_us + moved)

    def _note_segment(self, entry: Entry, key: Any, t_us: int) -> None:
        self._file.log.add(
            "segment", (entry.offset, key), "time jumped back by more than a second: "
            "a new segment, moved to follow the one before", offset=entry.offset - 8,
            start_us=t_us, stop_us=t_us)

    def _count(self, entry: Entry, kind: str, count: int, message: str) -> None:
        if not count:
            return
        if self._strict:
            raise RecordingError(
                f"{self._file.reader.path}: byte {entry.offset - 8}: {count} {message}")
        self._file.log.add(
            kind, entry.offset, message, count=count, offset=entry.offset - 8,
            start_us=entry.start_us, stop_us=entry.stop_us)

    def _refuse(self, entry: Entry, data: bytes, at: int, i: int) -> None:
        x, y = (int.from_bytes(data[at + 16 * i + k:][:2], "little", signed=True)
                for k in (8, 10))
        raise RecordingError(
            f"{self._file.reader.path}: byte {entry.offset - 8}: event {i} of the "
            f"packet at (t={_time(data, at, i)}, x={x}, y={y}, "
            f"p={data[at + 16 * i + 12]}) lies outside the sensor, or before its "
            "predecessor")


def _times(data: bytes, at: int, count: int) -> NDArray[np.int64]:
    """Return the times in the file of the events of the vector at byte at."""
    return np.ndarray((count,), "<i8", data, at, (16,))


def _time(data: bytes, at: int, i: int) -> int:
    """Return the time in the file of event i of the vector at byte at."""
    return int.from_bytes(data[at + 16 * i:at + 16 * i + 8], "little", signed=True)
