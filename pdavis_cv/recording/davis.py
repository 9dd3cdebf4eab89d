"""Decode the words that a DAVIS346 sends over USB into packets."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.aps import cds
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    MAX_PACKET_EVENTS,
    TRIGGER_DTYPE,
    ApsFrame,
    Packet,
)
from pdavis_cv.recording.files import ProblemLog

DAVIS346_SIZE = (260, 346)
WRAP_US = 1 << 15
"""Time stamps in words have 15 bits of us; a wrap word marks each overflow."""

# Places in the kernel's state, as in _kernels/_davis_usb.pyx.
(_EVENTS, _IMU_SAMPLES, _TRIGGERS, _BASE, _TIME, _ROW, _SHUTTER, _EXPOSED_FROM,
 _EXPOSED_UNTIL, _RESET_DONE) = range(10)
_READ, _IMU_BYTES, _FIRST_COUNT, _CUT_FRAMES = 12, 14, 23, 27
_COUNTS = (
    ("outside sensor", "addresses outside the sensor were left out"),
    ("backward time", "times ran backward and were taken as the last"),
    ("damage", "words have no known meaning"),
    ("cut columns", "columns of frames were not whole: their pixels are invalid"),
    ("cut frames", "frames were not whole and were left out"),
    ("cut imu", "IMU samples were not whole and were left out"),
)
_STREAM = 29
_FRAME, _RESET = 1, 2
_MISSING = 65535
_ROOM = 256     # IMU samples and triggers of one call; many in a second

_LONGEST_LOSS_S = 86_400.0
"""Longest gap that is filled in from the host's clock; a longer one is damage."""

_FULL_SCALE = 32768
_ACCEL_G, _GYRO_DPS = 2, 250
"""Smallest ranges of the IMU, which double with its scale (data sheet of MPU-6050)."""
_TEMPERATURES = {
    "InvenSense6050Or6150": (340.0, 35.0), "InvenSense9250": (333.87, 21.0)}
"""DN per degree Celsius, and degrees at 0 DN (data sheets; libcaer)."""


@dataclass(frozen=True)
class Orientation:
    """The orientation of a camera's chips, as reported by its logic.

    It tells whether rows of events are columns of the image; whether the readout of
    frames begins at the right, begins at the bottom, and proceeds along rows; whether
    the axes x, y, z of the IMU are inverted, and its type, which determines the scale
    of its temperature.
    """

    events_turned: bool = False
    frames_flipped_x: bool = False
    frames_flipped_y: bool = False
    frames_turned: bool = False
    imu_flipped: tuple[bool, bool, bool] = (False, False, False)
    imu_type: str | None = "InvenSense6050Or6150"

    def upright(self, reads: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return images (K, H, W) of what was read out, uint16 (K, columns, rows)."""
        images = reads if self.frames_turned else reads.swapaxes(1, 2)
        return images[:, ::-1 if self.frames_flipped_y else 1,
                      ::-1 if self.frames_flipped_x else 1].copy()


class DavisDecoder:
    """Decode words of a sensor (height, width) into packets.

    Buffers may be divided anywhere; the log receives the problems found.
    """

    def __init__(
        self, size: tuple[int, int], orientation: Orientation, log: ProblemLog
    ) -> None:
        self._orientation, self._log = orientation, log
        self._size = size
        columns, rows = size if orientation.frames_turned else size[::-1]
        self._reads = np.full((2, columns, rows), _MISSING, np.uint16)
        self._times = np.zeros((2, columns), np.int64)
        self._state = np.zeros(_STREAM, np.int64)
        self._state[[_ROW, _SHUTTER, _READ, _IMU_BYTES]] = -1
        self._imu_rows = np.empty((_ROOM, 9), np.int64)
        self._trigger_rows = np.empty((_ROOM, 2), np.int64)
        self._odd = b""
        self._lost, self._losses = False, 0
        self._host_s: float | None = None
        self._noted = [0] * len(_COUNTS)

    @property
    def time_us(self) -> int:
        """The camera's current time."""
        return int(self._state[_TIME])

    def feed(
        self, data: bytes, host_s: float | None = None, *, lost: bool = False
    ) -> Iterator[Packet]:
        """Decode the next words and yield packets in time order.

        `host_s` is the time of arrival of their end, s, on any clock; `lost` tells that
        data before them were lost.  A packet has at most one frame, and may span more
        than 10 ms at low event rates.
        """
        if lost:
            self._forget()
        expected = None
        if host_s is not None and self._host_s is not None:
            passed_s = host_s - self._host_s
            if 0 <= passed_s < _LONGEST_LOSS_S:     # nor NaN, of a damaged file
                expected = self.time_us + round(1e6 * passed_s)
        self._host_s = host_s
        data = self._odd + data if self._odd else data
        even = len(data) & ~1
        self._odd = data[even:]
        words = np.frombuffer(data[:even] if self._odd else data, "<u2")
        words = np.ascontiguousarray(words, np.uint16)
        if self._lost:
            words = self._from_a_time_on(words, expected)
        begin, state = 0, self._state
        while begin < len(words):
            events = np.empty(min(len(words) - begin, MAX_PACKET_EVENTS), EVENT_DTYPE)
            state[:_BASE] = 0
            begin, why = _kernels.davis_words(
                words, begin, self._orientation.events_turned, *self._size, state,
                self._reads, self._times, events, self._imu_rows, self._trigger_rows)
            frames = (self._frame(),) if why == _FRAME else ()
            filled, imu, triggers = state[:_BASE].tolist()
            if filled or frames or imu or triggers:
                packet = Packet(events[:filled], frames)
                if imu:
                    packet.imu = self._imu(self._imu_rows[:imu])
                if triggers:
                    packet.triggers = _triggers(self._trigger_rows[:triggers])
                yield packet
            if why == _RESET:
                yield self._restarted()
        self._note()

    def _restarted(self) -> Packet:
        """Continue the time after a reset of the camera's clock, as a new segment."""
        time = self.time_us
        if time:
            self._log.add("segment", time, "the camera's clock was reset: what follows "
                          "is moved to follow what came before", start_us=time)
        self._state[_BASE] = time
        return Packet(triggers=_triggers(np.array([[time, 0]])))

    def _forget(self) -> None:
        """Discard incomplete frames and samples after a loss of words."""
        self._odd, self._lost = b"", True
        state = self._state
        state[[_ROW, _READ, _IMU_BYTES]] = -1
        if state[_SHUTTER] >= 0:
            state[_SHUTTER] = -1
            state[_CUT_FRAMES] += 1
        self._losses += 1
        self._log.add("overflow", self._losses, "the host was too slow: data of the "
                      "camera were lost", start_us=self.time_us)

    def _from_a_time_on(
        self, words: NDArray[np.uint16], expected_us: int | None
    ) -> NDArray[np.uint16]:
        """Return the words from the first time stamp on, after a loss.

        Wrap words may have been lost, so the number of overflows is chosen that agrees
        best with the host's clock.
        """
        timed = np.flatnonzero((words >> 15 == 1) | (words >> 12 == 7))
        if not len(timed):
            return words[:0]
        self._lost = False
        word = int(words[timed[0]])
        if expected_us is not None:
            low, wraps = ((word & (WRAP_US - 1), 0) if word >> 15
                          else (0, word & 0xFFF))
            base = int(self._state[_BASE])
            # Number of overflows after the base, which a reset may have changed.
            passed = round((expected_us - low - base) / WRAP_US) - wraps
            self._state[_BASE] = base + max(passed, 0) * WRAP_US
        return words[timed[0]:]

    def _frame(self) -> ApsFrame:
        state = self._state
        reads = self._orientation.upright(self._reads)
        reset, signal = reads
        if reads.max() == _MISSING:
            reads[:, (reads == _MISSING).any(axis=0)] = 0
        dn, valid = cds(reset, signal)
        start: Any
        end: Any
        if state[_SHUTTER] == 0:
            start = int(state[_EXPOSED_FROM])
            start = int(state[_RESET_DONE]) if start < 0 else start
            end = int(state[_EXPOSED_UNTIL])
            end = int(self._times[1, 0]) if end < 0 else end
            end = max(start, end)
        elif self._orientation.frames_turned:   # ApsFrame has no times of rows
            start, end = (round(float(times.mean())) for times in self._times)
            end = max(start, end)
        else:
            start, end = self._times.copy()
            end = np.maximum(start, end)
            if self._orientation.frames_flipped_x:
                start, end = start[::-1], end[::-1]
        state[_SHUTTER] = -1
        return ApsFrame(
            dn, start, end, valid=None if valid.all() else valid,
            available_us=max(self.time_us, int(np.max(end))), reset=reset,
            signal=signal)

    def _imu(self, rows: NDArray[np.int64]) -> NDArray[Any]:
        samples = np.empty(len(rows), IMU_DTYPE)
        scale, values = rows[:, 1], rows[:, 2:].astype(np.float32)
        signs = np.where(self._orientation.imu_flipped, -1, 1) / _FULL_SCALE
        samples["t"] = rows[:, 0]
        for name, at, least, shift, mark in (
                ("accel", 0, _ACCEL_G, 2, 0x80), ("gyro", 4, _GYRO_DPS, 0, 0x40)):
            range_ = least << (scale >> shift & 3)
            range_ = np.where(scale & mark, range_, np.nan)[:, None]
            samples[name] = values[:, at:at + 3] * signs * range_
        slope, zero = _TEMPERATURES.get(self._orientation.imu_type or "", (1.0, 0.0))
        samples["temperature"] = np.where(
            scale & 0x20, values[:, 3] / slope + zero, np.nan)
        return samples

    def _note(self) -> None:
        """Add the problems that the kernel has counted since the last call."""
        counts = self._state[_FIRST_COUNT:].tolist()
        if counts == self._noted:
            return
        for (kind, message), count, noted in zip(
                _COUNTS, counts, self._noted, strict=True):
            if count > noted:
                self._log.add(kind, count, message, count=count - noted,
                              start_us=self.time_us)
        self._noted = counts


def _triggers(rows: NDArray[np.int64]) -> NDArray[Any]:
    triggers = np.empty(len(rows), TRIGGER_DTYPE)
    triggers["t"], triggers["type"] = rows[:, 0], rows[:, 1]
    return triggers
