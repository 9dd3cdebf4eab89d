"""Decode AEDAT-2.0 words into events, frames, IMU samples and triggers."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.aps import cds
from pdavis_cv.errors import DamagedFileWarning, RecordingError
from pdavis_cv.recording.aedat2.addresses import as_davis
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, ApsFrame
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.packetise import Batch
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.timeline import NEVER

__all__ = ["CHUNK_WORDS", "Decoder", "ImuScale", "Mark"]

CHUNK_WORDS = 1 << 16
STALE_BYTES = 8 << 20
"""Longest repetition of earlier words at the end of old files, bytes."""
MOST_LOOKS = 8
"""Largest number of searches for repeated words, which are slow; a damaged file may
jump at every word."""

# Indices into the kernel's state.
BASE, LAST, BACKWARD, OUTSIDE, UNKNOWN, EVENTS, SAMPLES, TRIGGERS = range(8)
LABELLED, FIRST_BAD, STATE = 8, 9, 11
SIGNALS, FIRST_RESET, LAST_RESET, FIRST_SIGNAL, LAST_SIGNAL = 1, 3, 4, 5, 6
INTERLEAVED, FRAME_STATE = 7, 9
END, JUMP, WHOLE, NEXT = range(4)

_TRIGGER_TYPES = np.array([0, 0, 2, 1, 3], np.uint8)  # falling, rising, pulse


class Mark(NamedTuple):
    """A position where reading can resume: a chunk, and the state of time before it."""

    chunk: int
    base: int
    last: int


class ImuScale(NamedTuple):
    """The physical values of one unit of the IMU's converters."""

    accel_g: float
    gyro_deg_s: float


class Decoder:
    """Decode one file from a mark on.

    Parameters
    ----------
    reader : FileReader
    log : ProblemLog
    data_start : int
        Byte where the words begin.
    size : (int, int)
        Sensor (height, width).
    global_shutter : bool, optional
        Shutter mode in the header.
    scale : ImuScale
    mark : Mark
    quiet_us : int
        Findings before this time are not logged, as they depend on earlier data.
    strict : bool
        True to raise at the first bad word.
    dvs128 : bool
        Whether addresses are those of a DVS128.
    """

    def __init__(
        self, reader: FileReader, log: ProblemLog, data_start: int,
        size: tuple[int, int], *, global_shutter: bool | None, scale: ImuScale,
        mark: Mark, quiet_us: int = NEVER, strict: bool = False, dvs128: bool = False,
    ) -> None:
        self._dvs128 = dvs128
        self._reader, self._log, self._start = reader, log, data_start
        self._shutter, self._scale, self._strict = global_shutter, scale, strict
        self._quiet_us = quiet_us
        self.chunk = mark.chunk
        self._state = np.zeros(STATE, np.int64)
        self._state[BASE], self._state[LAST] = mark.base, mark.last
        self._frame = np.zeros(FRAME_STATE, np.int64)
        self._reset, self._signal = (np.zeros(size, np.uint16) for _ in range(2))
        self._seen = np.zeros(size, np.uint8)
        self._times = np.zeros((2, size[1]), np.int64)
        self._sample = np.zeros(7, np.int16)
        self._block = np.empty(8 * (CHUNK_WORDS + 1), np.uint8)
        n = CHUNK_WORDS
        self._imu_t, self._imu = np.empty(n // 7 + 2, np.int64), np.empty(
            (n // 7 + 2, 7), np.int16)
        self._trigger_t, self._trigger = np.empty(n, np.int64), np.empty(n, np.uint8)
        self._last_mid = NEVER
        self._looks = 0
        self._clear()

    @property
    def mark(self) -> Mark:
        """The mark at the next chunk."""
        return Mark(self.chunk, int(self._state[BASE]), int(self._state[LAST]))

    def batches(self, memory: Scratch, *, frames: bool = True) -> Iterator[Batch]:
        """Yield the samples of each chunk, or the events alone."""
        while len(words := self._words()):
            events = memory.room(min(len(words), CHUNK_WORDS))
            found: list[ApsFrame] | None = [] if frames else None
            self._state[EVENTS] = 0
            self._decode(words, events, found)
            batch = Batch(events[:int(self._state[EVENTS])],
                          complete_us=int(self._state[LAST]))
            if found is not None:
                batch.frames, batch.imu = found, self._imu_samples()
                batch.triggers = self._trigger_samples()
            yield batch
        if frames and self._frame[SIGNALS]:     # the file ends inside a frame
            yield Batch(frames=self._take_frame(self._reader.size, whole=False),
                        complete_us=int(self._state[LAST]))

    def _words(self) -> NDArray[np.uint8]:
        """Return the next chunk, shape (N, 8), and the word after it."""
        whole = self._reader.read_into(self._place, self._block.data) // 8
        words = self._block[:8 * whole].reshape(whole, 8)
        if self._dvs128:
            as_davis(words)
        return words

    @property
    def _place(self) -> int:
        return self._start + 8 * CHUNK_WORDS * self.chunk

    def _decode(self, words: NDArray[np.uint8], events: NDArray[Any],
                frames: list[ApsFrame] | None) -> None:
        at, n, state = self._place, min(len(words), CHUNK_WORDS), self._state
        state[[BACKWARD, OUTSIDE, UNKNOWN, SAMPLES, TRIGGERS, LABELLED]] = 0
        done = 0
        while done < n:
            done, why = _kernels.aedat2_words(
                words, done, n, state, self._frame, self._reset, self._signal,
                self._seen, self._times, self._sample, events, self._imu_t, self._imu,
                self._trigger_t, self._trigger)
            if self._strict and state[FIRST_BAD] >= 0:
                self._refuse(at, words, int(state[FIRST_BAD]))
            if why in (WHOLE, NEXT) and frames is None:
                self._clear()
            elif why in (WHOLE, NEXT) and frames is not None:
                frames += self._take_frame(at + 8 * done, whole=why == WHOLE)
            elif why == JUMP and self._jump(words, done, at + 8 * done):
                self._reader_done()
                break
        self._report(at)
        self.chunk += 1

    def _reader_done(self) -> None:
        self.chunk = 1 << 60

    # Time ----------------------------------------------------------------------

    def _jump(self, words: NDArray[Any], i: int, offset: int) -> bool:
        """Begin a new segment before word i; return whether the rest is repeated."""
        if self._rest_is_stale(offset):
            return True
        raw = int.from_bytes(words[i, 4:].tobytes(), "big", signed=True)
        last = int(self._state[LAST])
        self._state[BASE] = last + 1 - raw
        self._add("segment", offset, "time jumped back by more than a second: a new "
                  "segment, moved to follow the one before", offset=offset)
        return False

    def _rest_is_stale(self, offset: int) -> bool:
        """Return whether the rest repeats earlier words, as written by old flushes."""
        left = self._reader.size - offset
        self._looks += 1
        if left > STALE_BYTES or self._looks > MOST_LOOKS:
            return False
        rest = self._reader.read(offset, left // 8 * 8)
        before = max(self._start, offset - 2 * STALE_BYTES)
        if rest not in self._reader.read(before, offset - before):
            return False
        self._add("stale words", offset, "the file ends with words that it already "
                  "held; they were dropped", count=len(rest) // 8, offset=offset)
        return True

    # Frames --------------------------------------------------------------------

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
            self._state[LAST], state[LAST_SIGNAL]))
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

    # The other samples ---------------------------------------------------------

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

    def _trigger_samples(self) -> NDArray[Any]:
        n = int(self._state[TRIGGERS])
        samples = np.empty(n, TRIGGER_DTYPE)
        samples["t"] = self._trigger_t[:n]
        samples["type"] = _TRIGGER_TYPES[self._trigger[:n]]
        return samples

    # Findings ------------------------------------------------------------------

    def _report(self, at: int) -> None:
        state = self._state
        for place, kind, message in (
                (BACKWARD, "backward time", "words were dropped because time ran "
                 "backward"),
                (OUTSIDE, "outside sensor", "events and samples outside the sensor "
                 "were dropped"),
                (UNKNOWN, "unknown words", "words of no known kind were skipped"),
                (LABELLED, "labelled events", "events carry a label (v2e marks noise "
                 "so); they are kept")):
            if state[place]:
                self._add(kind, at, message, count=int(state[place]), offset=at)

    def _add(self, kind: str, key: int, message: str, *, count: int = 1,
             offset: int) -> None:
        last = int(self._state[LAST])
        if last >= self._quiet_us:
            self._log.add(kind, key, message, count=count, offset=offset,
                          start_us=last, stop_us=last)

    def _refuse(self, at: int, words: NDArray[Any], i: int) -> None:
        raise RecordingError(
            f"{self._reader.path}: byte {at + 8 * i}: word {words[i].tobytes().hex()} "
            "lies outside the sensor, or before its predecessor")

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
