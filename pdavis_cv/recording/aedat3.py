"""Recordings in AEDAT-3.1, as written by cAER."""
from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE, FAR
from pdavis_cv.recording.aedat2.header import CHIP_SIZES
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, ApsFrame, RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import END_OF_TIME, Batch, cell_start
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.search import Search
from pdavis_cv.recording.sequential import PiecewiseRecording
from pdavis_cv.recording.timeline import (
    BACKWARD,
    HELD,
    LOOK_AHEAD,
    NEVER,
    Clock,
    Marks,
    Timeline,
    possible_range,
)
from pdavis_cv.sensor import Sensor

MAX_PACKET = 64 << 20
HULL_BYTES = 16 << 20
"""Bytes of events from which the size of an unknown sensor is assumed."""
_BEGINNINGS = 4
"""Largest number of apparent packet headers that are tried inside another packet."""
_AHEAD = 8
"""Number of packets ahead in which the next of the same kind is searched, to check
times against it."""
_END = b"#!END-HEADER\r\n"
_HEAD = struct.Struct("<hhiiiiii")
_BEGIN = re.compile(rb"(?=[\x00-\x04]\x00..(?:[\x08\x24\x30]\x00\x00\x00\x04|..."
                    rb"\x00\x08)\x00\x00\x00)", re.DOTALL)
"""Kind, source, bytes per event and offset of the time in it: 8 in frames, else 4."""
_SIZES = {0: 8, 1: 8, 3: 36, 4: 48}
_SIZE = struct.Struct("<ii")
_MARKS = tuple(_SIZE.pack(size, 4) for size in sorted(set(_SIZES.values())))
"""Bytes per event and offset of its time, as they appear in packet headers."""
SPECIAL, POLARITY, FRAME, IMU6, IMU9 = range(5)
_ANY = -1
Decoded = tuple[int, int, Any, NDArray[np.int64]]
"""A packet: byte offset, kind, samples or frames, and their times."""
_FRAME = struct.Struct("<i4i4i")
_IMU = np.dtype([("info", "<i4"), ("t", "<i4"), ("accel", "<f4", 3),
                 ("gyro", "<f4", 3), ("temperature", "<f4")])
_IMU9 = np.dtype([*_IMU.descr, ("compass", "<f4", 3)])
# libcaer's special events: external input rising, falling, pulse.
_TRIGGERS = {2: 1, 3: 2, 4: 3}
MARK_BYTES = 1 << 18
HORIZON_US = 500_000
"""Longest time by which packets of different kinds may be out of order."""


class Aedat3Recording(PiecewiseRecording):
    """A recording in AEDAT-3.1; see `open_recording`.

    The format has no index: the first reading makes one, for those that follow.  A
    stated ``camera`` must be part of the source's name.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._reader = self._bytes()
        self._marks = Marks(MARK_BYTES)
        head = self._reader.read(0, 1 << 20)
        end = head.find(_END)
        if end < 0:
            raise RecordingError(
                f"{self.path}: byte 0: no {_END.strip().decode()} within 1 MiB")
        self._start = end + len(_END)
        lines = head[:end].decode("latin-1").splitlines()
        facts = dict(line[1:].split(":", 1) for line in lines if ":" in line[1:])
        source = next((value.strip() for name, value in facts.items()
                       if name.startswith("Source")), "")
        self._check_camera(options.camera, source)
        name = source.lower()
        size = self._sensor_size(next((
            size for chip, size in CHIP_SIZES.items() if name.startswith(chip)),
            None) or self._frame_size(), self._farthest)
        has_frames = self._has_frames()
        return RecordingInfo(
            format="AEDAT-3.1", writer="cAER", camera=source or None, **stated(
                options, sensor_size=size, sensor=Sensor.of_chip(source),
                frame_times="time stamps" if has_frames else None,
                full_scale_dn=1023 if has_frames else None),
            frame_count=None if has_frames else 0, header={
                "first_row": "top", "imu_axes": "iniVation",
                **{name.strip(): value.strip() for name, value in facts.items()}})

    def _has_frames(self) -> bool:
        """Return whether the file holds frames, from its packet headers."""
        at = self._start
        while at < self._reader.size:
            found = self._plausible(at)
            if found is None or found[0] == FRAME:
                return True  # the damaged part may hold some
            at += _HEAD.size + found[1] * found[3]
        return False

    def _frame_size(self) -> tuple[int, int] | None:
        """Return the size of the first frame that is consistent with its packet."""
        for _, kind, size, _, data in self._raw(self._start, quiet=True):
            if kind == FRAME and len(data) >= 36:
                width, height = struct.unpack_from("<ii", data, 20)
                # One, three or four channels; any other size is damaged or cropped.
                if 0 < width <= 4096 and 0 < height <= 4096 and (
                        size - 36 in (2 * width * height * k for k in (1, 3, 4))):
                    return height, width
        return None

    def _farthest(self) -> tuple[int, int]:
        """Return the largest x and y of the first events."""
        x = y = 0
        for at, kind, _, _, data in self._raw(self._start, quiet=True):
            if at > self._start + HULL_BYTES:
                break
            if kind == POLARITY:
                word = np.frombuffer(data, "<u4", len(data) // 8 * 2)[::2]
                word = word[(word & 1).astype(bool)]
                x = max(x, int((word >> 17).max(initial=0)))
                y = max(y, int((word >> 2 & 0x7FFF).max(initial=0)))
        return x, y

    def _raw(
        self, at: int, *, quiet: bool = False
    ) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Yield (byte, kind, event size, overflow, events) of packets from at on."""
        end = self._reader.size
        search = Search(self._reader, self._budget, self._begins)
        found = self._plausible(at)
        while at < end:
            if found is None:
                after = next(search.places(at + 1, end), None)
                if not quiet:
                    self._log.damage(
                        at, f"byte {at}: no whole packet is here, reading goes on at "
                        f"byte {end if after is None else after}", offset=at)
                if after is None:
                    return
                at, found = after, self._plausible(after)
                continue
            kind, size, overflow, count = found
            after = at + _HEAD.size + size * count
            following = self._plausible(after)
            # The size is wrong or bytes are missing: the next may begin inside.
            inside = next(search.places(at + 1, after), None) if (
                following is None and after < end) else None
            data = b"" if inside else self._reader.read(at + _HEAD.size, size * count)
            if (following is not None or after >= end) and _looks_torn(
                    kind, size, data):
                inside = self._hidden(search, at + 1, after)
            if inside is not None:
                if not quiet:
                    self._log.damage(at, f"byte {at}: a packet that should end at "
                                     f"byte {after} ends at {inside}", offset=at)
                count = max(inside - at - _HEAD.size, 0) // size
                after, following = inside, self._plausible(inside)
                search.wasted(len(data))
                data = self._reader.read(at + _HEAD.size, size * count)
            if len(data) < size * count:
                if not quiet:
                    self._log.damage(
                        at, f"byte {at}: the file was cut while it is read", offset=at)
                return
            yield at, kind, size, overflow, data
            at, found = after, following

    def _plausible(self, at: int, head: bytes | None = None
                   ) -> tuple[int, int, int, int] | None:
        """Return kind, bytes per event, overflows and count of a packet at a byte."""
        head = self._reader.read(at, _HEAD.size) if head is None else head
        if len(head) < _HEAD.size:
            return None
        kind, source, size, offset, overflow, capacity, number, valid = (
            _HEAD.unpack(head))
        if (not 0 <= kind < 32 or source < 0 or size <= 0 or overflow < 0
                or not 0 < offset < size or not 0 <= valid <= number <= capacity
                or _SIZES.get(kind, size) != size or number == 0
                or number * size > MAX_PACKET
                or at + _HEAD.size + number * size > self._reader.size):
            return None
        return kind, size, overflow, number

    def _begins(self, base: int, block: bytes) -> Iterator[int]:
        """Yield where packets of a known kind begin in the bytes from base on."""
        for found in _BEGIN.finditer(block):
            at = found.start()
            if self._plausible(base + at, block[at:at + _HEAD.size]) is not None:
                yield at

    def _hidden(self, search: Search, at: int, until: int) -> int | None:
        """Return where packets begin inside a packet that lost bytes.

        They are accepted if they end where it seems to end, or if there are two in a
        row (bytes were then added after them).
        """
        for inside in islice(search.places(at, until), _BEGINNINGS):
            after, count = inside, 0
            while after < until and count < 2 and (
                    found := self._plausible(after)) is not None:
                after += _HEAD.size + found[1] * found[3]
                count += 1
            if after == until or count > 1:
                return inside
        return None

    # Reading -------------------------------------------------------------------

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each packet, and the share of the file read by then."""
        timeline = Timeline()
        clocks = [Clock(timeline, held=HELD if kind == POLARITY else 0)
                  for kind in range(4)]
        begin, last_mid, promised = self._start, NEVER, NEVER
        before: dict[int, int] = {}     # kind -> time of the last sample
        if start_us is not None:
            mark = self._marks.before(cell_start(start_us))
            if mark is not None:
                begin, clocks, last_mid, promised, before = mark
        packets = self._decoded(begin)
        ahead = deque(islice(packets, _AHEAD))
        while ahead:
            at, kind, found, times = ahead.popleft()
            ahead.extend(islice(packets, 1))
            newest = max(clock.last for clock in clocks)
            self._marks.note(at, newest, (at, clocks, last_mid, promised, before))
            sane = ~_wild(kind, times, before, ahead)
            if not sane.all():
                self._count(at, "wild time", int((~sane).sum()), "samples were dropped "
                            "because their time does not fit those around it")
                found = [f for f, good in zip(found, sane, strict=True) if good] if (
                    kind == FRAME) else found[sane]
                times = times[sane]
            if not len(times):
                continue
            before[kind] = before[_ANY] = int(times[-1])
            batch, clock = Batch(), clocks[min(kind, IMU6)]
            following = [int(t) for one in ahead if one[1] == kind for t in one[3][:8]]
            jumps, late = clock.jumps, 0
            if kind == FRAME:
                for frame in found:
                    t = clock.among(np.array([(frame.available_us,)], [("t", "<i8")]),
                                    following)["t"]
                    if not len(t) or frame.mid_us <= last_mid or t[0] < promised:
                        self._count(at, "backward time", 1, "frames were dropped "
                                    "because time ran backward")
                        continue
                    last_mid = frame.mid_us
                    batch.frames.append(frame)
            else:
                found = (clock.order(found) if kind == POLARITY
                         else clock.among(found, following))
                setattr(batch, _FIELDS[kind], found[found["t"] >= promised])
                late = len(found) - len(getattr(batch, _FIELDS[kind]))
            if clock.jumps > jumps:
                self._log.add("segment", at, "time jumped back by more than a "
                              "second: a new segment follows", offset=at)
            self._count(at, "backward time", late + int(clock.state[BACKWARD]),
                        "samples were dropped because time ran backward")
            # Packets of different kinds are not in time order relative to each other.
            newest = max(clock.last for clock in clocks)
            self._release(
                batch, clocks[POLARITY], newest - HORIZON_US, promised, at, memory)
            promised = batch.complete_us = max(promised, newest - HORIZON_US)
            yield batch, at / self._reader.size
        batch = Batch()
        self._release(batch, clocks[POLARITY], END_OF_TIME, promised,
                      self._reader.size, memory)
        yield batch, 1.0

    def _decoded(self, begin: int) -> Iterator[Decoded]:
        """Yield (byte, kind, samples or frames, times) of each packet from begin on."""
        for at, kind, size, overflow, data in self._raw(begin):
            found: Any
            if kind == FRAME:
                frames = (self._frame(data[i:i + size], overflow, at)
                          for i in range(0, len(data), size))
                found = [frame for frame in frames if frame is not None]
                times = np.array([frame.available_us for frame in found], np.int64)
            elif kind in _READ:
                found = _READ[kind](data, overflow << 31)
                if kind == POLARITY:
                    height, width = self._info.sensor_size
                    inside = (found["x"] < width) & (found["y"] < height)
                    self._count(at, "outside sensor", int((~inside).sum()),
                                "events outside the sensor were dropped")
                    found = found if inside.all() else found[inside]
                times = found["t"].astype(np.int64)
            else:
                continue
            if len(times):
                yield at, kind, found, times

    def _frame(self, data: bytes, overflow: int, at: int) -> ApsFrame | None:
        height, width = self._info.sensor_size
        if len(data) < _FRAME.size:
            return None
        info, sof, eof, soe, eoe, w, h, x, y = _FRAME.unpack_from(data)
        channels = info >> 1 & 7 or 1
        if (w <= 0 or h <= 0 or x < 0 or y < 0 or x + w > width or y + h > height
                or channels != 1 or len(data) < _FRAME.size + 2 * w * h):
            self._count(at, "wrong size", 1, "frames do not fit on the sensor, or have "
                        "colours; they were dropped")
            return None
        base = overflow << 31
        raw = np.frombuffer(data, "<u2", w * h, _FRAME.size).reshape(h, w)
        dn, valid = np.zeros((height, width), np.float32), np.zeros(
            (height, width), np.bool_)
        # DN are left-justified to 16 bits.
        dn[y:y + h, x:x + w] = (raw >> 6).astype(np.float32)
        valid[y:y + h, x:x + w] = raw >> 6 < 1023
        start, end = base + soe, base + eoe
        if not 0 <= end - start <= 60_000_000:
            start = end = base + sof
        ready = base + eof
        if max(abs(start), abs(end), abs(ready)) >= FAR:
            self._count(at, "backward time", 1, "frames were dropped because no clock "
                        "reaches their time")
            return None
        return ApsFrame(dn, start, end, valid=None if valid.all() else valid,
                        available_us=ready if 0 <= ready - end <= 60_000_000 else end)


def _looks_torn(kind: int, size: int, data: bytes) -> bool:
    """Return whether a packet may have lost bytes and contain the next one.

    If it lost as many bytes as the next packet has, it still ends at a packet.  Two
    signs are required: its payload contains bytes of a packet header, and, for polarity
    events (the only long packets), times are out of order or too few to check.
    """
    if kind == POLARITY and len(data) > size:
        times = np.ndarray((len(data) // size,), "<i4", data, 4, (size,))
        if np.all(times[1:] >= times[:-1]):
            return False
    return any(data.find(mark) >= 0 for mark in (*_MARKS, _SIZE.pack(size, 8)))


def _wild(kind: int, times: NDArray[np.int64], before: dict[int, int],
          ahead: Iterable[Decoded]) -> NDArray[np.bool_]:
    """Return which times come from damaged words.

    Each packet has its own count of overflows, so all times of one may be wrong.
    Packets of one kind are in time order, packets of different kinds nearly so.
    """
    following = [one[3] for one in ahead if one[1] == kind][:LOOK_AHEAD]
    others = [one[3] for one in ahead if one[1] != kind]
    # Samples before `promised` are dropped, so times that are accepted must not advance
    # it by the whole horizon.
    slack = HORIZON_US // 2
    following += [one + slack for one in others[:LOOK_AHEAD - len(following)]]
    first, last = possible_range(
        times, following, before.get(kind, before.get(_ANY, NEVER + slack) - slack))
    return (times < first) | (times > last)


def _polarity(data: bytes, base: int) -> NDArray[Any]:
    raw = np.frombuffer(data, "<u4").reshape(-1, 2)
    raw = raw[(raw[:, 0] & 1).astype(bool)]
    events = np.empty(len(raw), EVENT_DTYPE)
    word = raw[:, 0]
    events["t"] = raw[:, 1].astype(np.int64) + base
    events["x"], events["y"] = word >> 17 & 0x7FFF, word >> 2 & 0x7FFF
    events["p"] = word >> 1 & 1
    return events


def _imu(data: bytes, base: int, record: np.dtype[Any] = _IMU) -> NDArray[Any]:
    raw = np.frombuffer(data, record)
    raw = raw[(raw["info"] & 1).astype(bool)]
    samples = np.empty(len(raw), IMU_DTYPE)
    samples["t"] = raw["t"].astype(np.int64) + base
    for name in ("accel", "gyro", "temperature"):
        samples[name] = raw[name]
    return samples


def _special(data: bytes, base: int) -> NDArray[Any]:
    raw = np.frombuffer(data, "<u4").reshape(-1, 2)
    kinds = raw[:, 0] >> 1 & 0x7F
    keep = (raw[:, 0] & 1).astype(bool) & np.isin(kinds, list(_TRIGGERS))
    samples = np.empty(int(keep.sum()), TRIGGER_DTYPE)
    samples["t"] = raw[keep, 1].astype(np.int64) + base
    samples["type"] = [_TRIGGERS[kind] for kind in kinds[keep].tolist()]
    return samples


_READ: dict[int, Callable[[bytes, int], NDArray[Any]]] = {
    SPECIAL: _special, POLARITY: _polarity, IMU6: _imu,
    IMU9: partial(_imu, record=_IMU9)}
_FIELDS = {SPECIAL: "triggers", POLARITY: "events", IMU6: "imu", IMU9: "imu"}
