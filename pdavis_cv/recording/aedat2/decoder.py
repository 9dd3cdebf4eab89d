"""Decode AEDAT-2.0 words into events, frames, IMU samples and triggers."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.aps import cds
from pdavis_cv.errors import DamagedFileWarning
from pdavis_cv.recording.aedat2.addresses import as_davis
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, ApsFrame
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.packetise import Batch
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.timeline import (
    BACKWARD,
    FILLED,
    HELD,
    NEVER,
    ORDERED,
    REACH,
    SEGMENT_US,
    WRAP_US,
    Clock,
    Timeline,
)

CHUNK_WORDS = 1 << 17
STALE_BYTES = 8 << 20
"""Longest repetition of earlier words at the end of old files, bytes."""
MOST_LOOKS = 8
"""Largest number of searches for repeated words, which are slow; a damaged file may
jump at every word."""

# Indices into the kernel's state.
TIME, OUTSIDE, UNKNOWN, EVENTS, SAMPLES, TRIGGERS, LABELLED = range(7)
STATE = 8
SIGNALS, FIRST_RESET, LAST_RESET, FIRST_SIGNAL, LAST_SIGNAL = 1, 3, 4, 5, 6
INTERLEAVED, FRAME_STATE = 7, 9
END, WHOLE, NEXT = range(3)

_TRIGGER_TYPES = np.array([0, 0, 2, 1, 3], np.uint8)  # falling, rising, pulse


class Mark(NamedTuple):
    """A position where reading can resume: a chunk, and the clock before it."""

    chunk: int
    clock: Clock

    @classmethod
    def first(cls) -> Mark:
        """Return that of a file's first chunk."""
        return cls(0, Clock(Timeline(bits=32)))


class ImuScale(NamedTuple):
    """The physical values of one unit of the IMU's converters."""

    accel_g: float
    gyro_deg_s: float


class Decoder:
    """Decode one file from a mark on.

    `count` is ``FileRecording._count``, `data_start` the byte where the words begin;
    `origin_us` is added to times.  The size is that of the sensor, (height, width);
    `global_shutter` what the header says of it; `dvs128` tells whether addresses are
    those of a DVS128.  Findings before `quiet_us` are not logged, as they depend on
    earlier data.
    """

    def __init__(
        self, reader: FileReader, log: ProblemLog,
        count: Callable[[int, str, int, str], None], data_start: int, origin_us: int,
        size: tuple[int, int], *, global_shutter: bool | None, scale: ImuScale,
        mark: Mark, quiet_us: int = NEVER, dvs128: bool = False,
    ) -> None:
        self._dvs128 = dvs128
        self._reader, self._log, self._count = reader, log, count
        self._start, self._origin, self._size = data_start, origin_us, size
        self._shutter, self._scale = global_shutter, scale
        self._quiet_us = quiet_us
        self.chunk, self.clock = mark
        self._state = np.zeros(STATE, np.int64)
        self._frame = np.zeros(FRAME_STATE, np.int64)
        self._reset, self._signal = (np.zeros(size, np.uint16) for _ in range(2))
        self._seen = np.zeros(size, np.uint8)
        self._times = np.zeros((2, size[1]), np.int64)
        self._sample = np.zeros(7, np.int16)
        self._block = np.zeros((CHUNK_WORDS + 1, 8), np.uint8)
        n = CHUNK_WORDS + HELD + REACH
        self._imu_t, self._imu = np.empty(n // 7 + 2, np.int64), np.empty(
            (n // 7 + 2, 7), np.int16)
        self._trigger_t, self._trigger = np.empty(n, np.int64), np.empty(n, np.uint8)
        self._last_mid = NEVER
        self._looks = 0
        self._clear()

    @property
    def mark(self) -> Mark:
        """The mark at the next chunk."""
        return Mark(self.chunk, self.clock)

    def batches(self, memory: Scratch, *, frames: bool = True) -> Iterator[Batch]:
        """Yield the samples of each chunk, or the events alone."""
        others, n, clock = 1, 1, self.clock
        while n:
            before, jumps, offset = others, clock.jumps, clock.offset
            at = min(self._start + 8 * CHUNK_WORDS * self.chunk, self._reader.size)
            words = self._block[:self._reader.read_into(
                at, self._block.reshape(-1).data) // 8]
            if self._dvs128:
                as_davis(words)
            n = min(len(words), CHUNK_WORDS)    # the last is that after the chunk
            out = clock.room(memory, n)
            others = _kernels.aedat2_rows(
                self._block, n, self._origin, *self._size, clock.state, out)
            if clock.state[ORDERED] < 0:
                stale = n - self._until_stale(words, n, at)
                clock.state[FILLED] -= stale
                n -= stale
            rows = clock.settled(out, final=not n)
            self._count(at, "backward time", int(clock.state[BACKWARD]),
                        "words were dropped because time ran backward")
            if clock.jumps > jumps and (clock.offset - offset) % WRAP_US:
                self._add("segment", at, "time jumped back by more than a second: a "
                          "new segment, moved to follow the one before", offset=at)
            batch = Batch(rows, complete_us=clock.last)
            if others or before or not n:
                self._decode(rows, batch, at, frames=frames)
            self.chunk = self.chunk + 1 if n == CHUNK_WORDS else 1 << 40
            yield batch
        if frames and self._frame[SIGNALS]:     # the file ends inside a frame
            yield Batch(frames=self._take_frame(self._reader.size, whole=False),
                        complete_us=clock.last)

    def _decode(self, rows: NDArray[Any], batch: Batch, at: int, *, frames: bool
                ) -> None:
        """Put the samples of rows into a batch."""
        state = self._state
        state[[OUTSIDE, UNKNOWN, EVENTS, SAMPLES, TRIGGERS, LABELLED]] = 0
        done, why = 0, NEXT
        while why != END:
            done, why = _kernels.aedat2_samples(
                rows, done, state, self._frame, self._reset, self._signal, self._seen,
                self._times, self._sample, self._imu_t, self._imu, self._trigger_t,
                self._trigger)
            if why != END and frames:
                batch.frames += self._take_frame(at, whole=why == WHOLE)
            elif why != END:
                self._clear()
        batch.events = rows[:int(state[EVENTS])]
        if frames:
            batch.imu = self._imu_samples()
            n = int(state[TRIGGERS])
            batch.triggers = np.empty(n, TRIGGER_DTYPE)
            batch.triggers["t"] = self._trigger_t[:n]
            batch.triggers["type"] = _TRIGGER_TYPES[self._trigger[:n]]
        self._count(at, "outside sensor", int(state[OUTSIDE]),
                    "events and samples outside the sensor were dropped")
        for place, kind, message in (
                (UNKNOWN, "unknown words", "words of no known kind were skipped"),
                (LABELLED, "labelled events", "events carry a label (v2e marks noise "
                 "so); they are kept")):
            if state[place]:
                self._add(kind, at, message, count=int(state[place]), offset=at)

    def _until_stale(self, words: NDArray[np.uint8], n: int, at: int) -> int:
        """Return how many of n words come before a repetition of earlier words.

        Old flushes repeated them at the end of a file.
        """
        t = words.view(">i4")[:, 1].astype(np.int64)
        for i in (np.flatnonzero(t[:-1] - t[1:] > SEGMENT_US) + 1).tolist():
            offset = at + 8 * i
            left = self._reader.size - offset
            if left > STALE_BYTES or self._looks >= MOST_LOOKS:
                continue
            self._looks += 1
            rest = self._reader.read(offset, left // 8 * 8)
            before = max(self._start, offset - 2 * STALE_BYTES)
            if rest in self._reader.read(before, offset - before):
                self._add("stale words", offset, "the file ends with words that it "
                          "already held; they were dropped", count=len(rest) // 8,
                          offset=offset)
                return int(i)
        return n

    # Samples -------------------------------------------------------------------

    def _clear(self) -> None:
        self._frame[:] = 0
        self._frame[[2, 8]] = -1
        for array in (self._reset, self._signal, self._seen, self._times):
            array.fill(0)

    def _take_frame(self, offset: int, *, whole: bool) -> list[ApsFrame]:
        state, seen = self._frame.copy(), self._seen == 3
        reset, signal = self._reset.copy(), self._signal.copy()
        times = self._times.copy()
        self._clear()
        missing = int(np.count_nonzero(~seen))
        if missing:
            self._add("incomplete frame", offset, "frames lack samples; those pixels "
                      "are not valid", offset=offset)
        if missing == seen.size:
            return []
        dn, valid = cds(reset, signal)
        if missing:
            dn[~seen] = 0
            valid &= seen
        # The end of a frame without its last sample is detected only now.
        now = int(state[LAST_SIGNAL] if whole else max(
            self._state[TIME], state[LAST_SIGNAL]))
        start: Any
        end: Any
        if state[INTERLEAVED] or self._shutter is False:
            start, end = _column_times(times, seen.any(0))
            now = max(now, int(end.max()))
        else:
            start = int(state[LAST_RESET])
            end = max(int(state[FIRST_SIGNAL]), start)
        frame = ApsFrame(dn, start, end, available_us=now, reset=reset, signal=signal,
                         valid=None if valid.all() else valid)
        if frame.mid_us <= self._last_mid:
            self._add("backward time", offset,
                      "frames were dropped because time ran backward", offset=offset)
            return []
        self._last_mid = frame.mid_us
        return [frame]

    def _imu_samples(self) -> NDArray[Any]:
        n = int(self._state[SAMPLES])
        samples = np.empty(n, IMU_DTYPE)
        raw = self._imu[:n].astype(np.float32)
        samples["t"] = self._imu_t[:n]
        samples["accel"] = raw[:, :3] * np.float32(self._scale.accel_g) * np.array(
            [-1, 1, 1], np.float32)
        samples["temperature"] = raw[:, 3] / 340 + 35
        samples["gyro"] = raw[:, 4:] * np.float32(self._scale.gyro_deg_s) * np.array(
            [-1, 1, -1], np.float32)
        return samples

    # Findings ------------------------------------------------------------------

    def _add(self, kind: str, key: int, message: str, *, count: int = 1,
             offset: int) -> None:
        last = self.clock.last
        if last >= self._quiet_us:
            self._log.add(kind, key, message, count=count, offset=offset,
                          start_us=last, stop_us=last)

    def check_end(self) -> None:
        """Warn once if the file ends inside a word."""
        left = (self._reader.size - self._start) % 8
        if left:
            offset = self._reader.size - left
            self._log.add(
                "damage", offset, f"byte {offset}: the file ends inside a word",
                offset=offset, warning=DamagedFileWarning)


def _column_times(
    times: NDArray[np.int64], read: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return start and end of each column's exposure, interpolating missing ones."""
    columns = np.arange(len(read))
    base = int(times[0][read].min())
    start, end = (
        np.rint(np.interp(columns, columns[read], (row[read] - base).astype(float))
                ).astype(np.int64) + base for row in times)
    return start, np.maximum(start, end)
