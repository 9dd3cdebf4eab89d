"""Read one stream of an AEDAT-4 file, packet by packet, in time order."""
from __future__ import annotations

import contextlib
from bisect import bisect_right
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.errors import PdavisWarning, RecordingError
from pdavis_cv.recording.aedat4 import samples
from pdavis_cv.recording.aedat4.container import Aedat4File, Entry
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError, Table
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, ApsFrame
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.timeline import (
    BACKWARD,
    HELD,
    LAST,
    LOOK_AHEAD,
    NEVER,
    OFFSET,
    OUTSIDE,
    REACH,
    Clock,
    Timeline,
    possible_range,
)

_SAMPLE = 64
"""Bytes that an IMU sample takes while it is read; four of the file may name it."""
FRAMES_UNDER_WAY = 3
"""The index gives a frame's timestamp; its readout ends before that of this many more.
"""
KEPT_BYTES = 1 << 22
"""Packets that were examined ahead are kept up to this size, larger ones read again."""

GROUP, SMALL = 32, 16384
"""So many packets are put in order at a time, if none has more events; they lie between
multiples of the number, so that findings are those of any other reading."""
RUN = 1 << 17
"""Packets that begin in the same piece of the file of this size are read together."""
_ROOM = samples.EVENT * SMALL + 1024
"""Bytes to which a small packet is unpacked."""

Mark = tuple[str, int, Clock, tuple[int, int]]
"""Kind and number of a packet, clock before it, middle and end of the last frame."""
_Times = tuple[int, int, int, int, int, int]
_DTYPES = {"FRME": np.dtype([("t", "<i8"), ("number", "<i8")]), "IMUS": IMU_DTYPE,
           "TRIG": TRIGGER_DTYPE}
_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("", "V3")])
_NAMES = {"EVTS": "events", "FRME": "frames", "IMUS": "IMU samples", "TRIG": "triggers"}


class Cursor:
    """Read the packets of one stream, ``"EVTS"``, ``"FRME"``, ``"IMUS"`` or ``"TRIG"``.

    Where the index is trusted, there is no timeline, and no packet holds times beyond
    its neighbours', so that reading may begin at any packet; see `clean`.  The size is
    that of the sensor, (height, width); `jaer` tells that jAER wrote the file: rows are
    from the bottom, frame times differ.  With `strict` the first bad sample raises.
    `known` has the times of the frames that have been read, by packet; frames are
    added.  Of frames before the packet `begins` only the times are needed.
    """

    def __init__(
        self, file: Aedat4File, kind: str, entries: list[Entry],
        timeline: Timeline | None, *, size: tuple[int, int],
        scale: samples.FrameScale | None = None, jaer: bool = False,
        strict: bool = False, memory: Scratch, known: dict[int, _Times],
    ) -> None:
        self.kind = kind
        reach, held = (2, 2) if kind == "FRME" else (
            (REACH, HELD) if kind == "EVTS" else (REACH, REACH))
        self.clock = Clock(timeline, reach=reach, held=held)
        self.needed = reach + held + (FRAMES_UNDER_WAY if kind == "FRME" else REACH)
        self._trusted = timeline is None
        self._file, self._entries, self.next = file, entries, 0
        self._size, self._scale, self._strict = size, scale, strict
        self._jaer, self._memory = jaer, memory
        self._before = NEVER, NEVER
        self._ahead: dict[int, Table] = {}
        self._raw: dict[int, samples.RawFrame] = {}
        self.last = NEVER
        self.begins, self._known = 0, known
        self._index = file.index[entries[0].stream] if (
            kind == "EVTS" and entries and timeline is None and not strict
            and not file.compression.startswith("ZSTD")) else None
        self._unpacked = np.empty(min(_ROOM, file.budget.most(0)), np.uint8)
        self._run = RUN - 1

    @property
    def mark(self) -> Mark:
        """The current position; it is not a copy."""
        return self.kind, self.next, self.clock, self._before

    def go_to(self, mark: Mark) -> None:
        """Move to a position from `mark` of another cursor of this stream."""
        _, self.next, self.clock, self._before = mark
        self.last = self.clock.last

    def pull(self) -> Any:
        """Return the next samples that are certain, None at the end."""
        while self.next <= len(self._entries):
            number, self.next = self.next, self.next + 1
            final = number == len(self._entries)
            if final and not number:
                return None
            try:
                jumps = self.clock.jumps
                got = (self._events if self.kind == "EVTS" else self._samples)(
                    number, final=final)
            except PayloadError as error:
                self._file.lost(self._entries[number], error)
                continue
            self._count(self._entries[self.next - 1 - final], final, jumps)
            self.last = self.clock.last
            return self._frames(got) if self.kind == "FRME" else got
        return None

    def clean(self, number: int) -> int:
        """Return the number of samples of a packet, 0 unless all agree with the index.

        All before lie before them, whatever is damaged there.
        """
        try:
            times = self._decoded(number, keep=self._index is None)["t"]
        except PayloadError:
            return 0
        first, last = self._neighbours(number)
        first = max(first, self._entries[number].start_us or NEVER)
        good = len(times) and first <= times[0] and times[-1] <= last and np.all(
            times[1:] >= times[:-1])
        return len(times) if good else 0

    def _events(self, number: int, *, final: bool) -> NDArray[Any]:
        if final:
            return self.clock.settled(self.clock.room(self._memory, 0), final=True)
        if self._index is not None:
            stop = number - number % GROUP + GROUP
            out = self.clock.room(self._memory, int(
                np.minimum(self._index[number:stop, 2], SMALL).sum()))
            self.next = self._plain(number, min(stop, len(self._index)), out)
            if self.next > number:
                return self.clock.settled(out)
            self.next = number + 1
        entry = self._entries[number]
        table = self._table(entry)
        at, count = table.vector(0, samples.EVENT)
        if entry.samples not in (None, count):
            begin = entry.offset - 8
            self._file.log.damage(
                (entry.offset, "count"), f"byte {begin}: a packet of {count} "
                f"events, {entry.samples} by the index", offset=begin)
        bounds = self._neighbours(number) if self._trusted else self._possible(
            _times(table.data, at, count))
        state, jumps = self.clock.state, self.clock.jumps
        out = self.clock.room(self._memory, count)
        _kernels.aedat4_events(
            table.data, at, count, *self._size, self._jaer, *bounds, state, out)
        got = self.clock.settled(out)
        if self._strict and (state[OUTSIDE] or state[BACKWARD]):
            self._refuse(entry, np.ndarray((count,), _EVENT, table.data, at), bounds,
                         falls=self.clock.jumps == jumps)
        return got

    def _plain(self, number: int, stop: int, out: NDArray[Any]) -> int:
        """Append packets that are as usual; return the number of the first other."""
        index, file = self._index, self._file
        assert index is not None
        until = number
        while number == until < stop and index[number, 2] <= SMALL:
            begin = int(index[number, 0]) - 8
            until = bisect_right(index[:, 0], begin | self._run, number + 1, stop)
            end = min(int(index[until - 1, :2].sum()), begin + RUN + _ROOM)
            number = _kernels.aedat4_packets(
                self._memory.read(file.reader, begin, end - begin), begin, index,
                number, until, self._entries[number].stream, file.compression != "none",
                *self._size, self._jaer, self._unpacked, self.clock.state, out)
            self._run = RUN - 1 if number == until else 0
        return number

    def _refuse(self, entry: Entry, events: NDArray[Any], bounds: tuple[int, int], *,
                falls: bool) -> None:
        """Raise for the first bad event, unless it lies in a packet before."""
        t, (first, last), (height, width) = events["t"], bounds, self._size
        backward = (t < first) | (t > last)
        if falls:
            backward[1:] |= t[1:] < t[:-1]
        x, y, p = (events[name] for name in "xyp")
        bad = backward | (x < 0) | (x >= width) | (y < 0) | (y >= height) | (p > 1)
        for i in np.flatnonzero(bad)[:1].tolist():
            raise RecordingError(
                f"{self._file.reader.path}: byte {entry.offset - 8}: event {i} of the "
                f"packet at (t={t[i]}, x={x[i]}, y={y[i]}, p={p[i]}) "
                + ("does not agree in time with those around it" if backward[i] else
                   "lies outside the sensor"))

    def _samples(self, number: int, *, final: bool) -> NDArray[Any]:
        """Return IMU samples, triggers, or times and numbers of frames."""
        if final:
            got = np.empty(0, _DTYPES[self.kind])
        else:
            got = self._decoded(number)
            if self._trusted:
                first, last = self._neighbours(number)
                good = [first <= t <= last for t in got["t"].tolist()]
                if not all(good):
                    self._dropped(self._entries[number], "index", good.count(False))
                    got = got[good]
        return self.clock.order(got, final=final)

    def _decoded(self, number: int, *, keep: bool = False) -> NDArray[Any]:
        """Return the samples of a packet; of a frame, time and number of the packet."""
        entry = self._entries[number]
        if (known := self._times_of(number)) is not None:
            available = samples.exposure_times(known, jaer=self._jaer)[2]
            return np.array([(available, number)], _DTYPES[self.kind])
        table = self._table(entry, keep=keep)
        if self.kind == "EVTS":
            times = _times(table.data, *table.vector(0, samples.EVENT))
            return np.asarray(times).view([("t", "<i8")])
        if self.kind in ("IMUS", "TRIG"):
            self._file.budget.piece(
                _SAMPLE * table.vector(0, 4)[1], "a packet of samples")
            return (samples.imu_samples if self.kind == "IMUS" else samples.triggers)(
                table)
        try:
            raw = self._raw[number] = samples.raw_frame(table)
        except samples.UnknownFrameError as error:
            self._file.log.add(
                "unknown frame", entry.offset, f"{error} is skipped",
                offset=entry.offset - 8, warning=PdavisWarning)
            return np.empty(0, _DTYPES[self.kind])
        available = samples.exposure_times(raw.times, jaer=self._jaer)[2]
        return np.array([(available, number)], _DTYPES[self.kind])

    def _times_of(self, number: int) -> _Times | None:
        """Return the times of a frame of which no more is needed, if they are known."""
        return self._known.get(number) if (
            self.kind == "FRME" and number < self.begins) else None

    def _table(self, entry: Entry, *, keep: bool = False) -> Table:
        """Return a packet, which may have been examined before, or is to be again."""
        found = self._ahead.pop(entry.offset, None) or self._file.table(entry)
        if keep and len(found.data) <= KEPT_BYTES:
            self._ahead[entry.offset] = found
        return found

    def _neighbours(self, number: int) -> tuple[int, int]:
        """Return the range of times of a packet, from an index that is trusted.

        Two wrong entries would be needed to spoil it.
        """
        # A frame is stamped when it begins, and others begin before it ends.
        beyond = FRAMES_UNDER_WAY if self.kind == "FRME" else 1
        entries, after = self._entries, number + beyond
        first = entries[number - beyond].stop_us if number >= beyond else NEVER
        last = entries[after].start_us if after < len(entries) else -NEVER
        assert first is not None
        assert last is not None
        return first, last

    def _possible(self, times: NDArray[np.int64]) -> tuple[int, int]:
        """Return the range of times of a packet, from the packets around it."""
        if not len(times):
            return NEVER, -NEVER
        last = int(self.clock.state[LAST])
        before = NEVER if last == NEVER else last - int(self.clock.state[OFFSET])
        return possible_range(times, self._following(), before)

    def _following(self) -> list[NDArray[np.int64]]:
        """Return the times of the next readable packets of events."""
        found: list[NDArray[np.int64]] = []
        for entry in self._entries[self.next:self.next + 2 * LOOK_AHEAD]:
            with contextlib.suppress(PayloadError):
                table = self._table(entry, keep=True)
                at, count = table.vector(0, samples.EVENT)
                if count:
                    found.append(_times(table.data, at, count))
            if len(found) == LOOK_AHEAD:
                break
        return found

    def _frames(self, places: NDArray[Any]) -> list[ApsFrame]:
        """Return the frames of packets, at the times that their clock gives them."""
        found = []
        for t, number in places.tolist():
            entry = self._entries[number]
            if (known := self._times_of(number)) is not None:
                soe, eoe, available = samples.exposure_times(known, jaer=self._jaer)
                mid = (soe + eoe) // 2 + t - available
                if mid > self._before[0] and t > self._before[1]:
                    self._before = mid, t
                continue
            raw = self._raw.get(number) or samples.raw_frame(self._file.table(entry))
            self._raw = {k: one for k, one in self._raw.items() if k > number}
            if raw.colour:
                self._file.log.add(
                    "colour frame", entry.offset, "colour channels were averaged",
                    offset=entry.offset - 8)
            soe, eoe, available = samples.exposure_times(raw.times, jaer=self._jaer)
            if self._jaer:
                self._file.log.add(
                    "frame times", None, "jAER's AEDAT-4 does not hold start and end "
                    "of exposure: its middle was placed in the middle of the readout, "
                    f"within {(available - raw.times[1] - (eoe - soe)) // 2} us")
            move = t - available
            mid = (soe + eoe) // 2 + move
            if mid <= self._before[0] or t <= self._before[1]:
                self._dropped(entry, "middle", 1)
                continue
            scale = samples.scale_of(raw.pixels) if self._scale is None else self._scale
            if scale.itemsize != raw.pixels.dtype.itemsize:
                scale = samples.scale_of(raw.pixels)
            try:
                frame = samples.aps_frame(
                    raw, scale, (soe + move, eoe + move, t), self._size,
                    flip=self._jaer)
            except PayloadError as error:
                self._file.lost(entry, error)
                continue
            self._before = mid, t
            self._known[number] = raw.times
            found.append(frame)
        return found

    def _count(self, entry: Entry, final: bool, jumps: int) -> None:
        """Add what the clock and the kernel left out of a packet."""
        state = self.clock.state
        if self.clock.jumps > jumps:
            t_us = int(state[LAST])
            self._file.log.add(
                "segment", (entry.offset, final), "time jumped back by more than a "
                "second: a new segment, moved to follow the one before",
                count=self.clock.jumps - jumps, offset=entry.offset - 8,
                start_us=t_us, stop_us=t_us)
        if state[BACKWARD] or state[OUTSIDE]:
            self._dropped(entry, final, state[BACKWARD])
            self._dropped(entry, final, state[OUTSIDE], "outside sensor",
                          "events outside the sensor were dropped")

    def _dropped(self, entry: Entry, key: Any, count: Any, kind: str = "backward time",
                 message: str | None = None) -> None:
        if not count:
            return
        message = message or (
            f"{_NAMES[self.kind]} were dropped because time ran backward")
        if self._strict:
            raise RecordingError(
                f"{self._file.reader.path}: byte {entry.offset - 8}: {count} {message}")
        self._file.log.add(
            kind, (entry.offset, key), message, count=int(count),
            offset=entry.offset - 8, start_us=entry.start_us, stop_us=entry.stop_us)


def _times(data: bytes | memoryview, at: int, count: int) -> NDArray[np.int64]:
    """Return the times in the file of the events of the vector at byte at."""
    return np.ndarray((count,), "<i8", data, at, (16,))
