"""Write AEDAT-2.0 as jAER does: events, reset and signal reads, IMU, triggers."""
from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import clear
from pdavis_cv._checks import sensor_shape
from pdavis_cv.recording.aedat2.header import CHIP_SIZES, SOURCE
from pdavis_cv.recording.base import ApsFrame, Packet, RecordingInfo, Source
from pdavis_cv.recording.writer import RecordingWriter, info_of, source_text

HOLD_US = 300_000
"""Time for which words are held back, as a frame's first read precedes its events."""
FLUSH_WORDS = 1 << 18
_CHIPS = {size: name for name, size in CHIP_SIZES.items()}
_CLASSES = {"davis346": "Davis346red", "davis240": "Davis240C",
            "davis640": "Davis640", "davis208": "Davis208PixelParade",
            "davis128": "Davis128"}
_TRIGGER_CODES = {1: 3, 2: 2, 3: 4}
ACCEL_G = 1 / 4096      # range code 2: 8 g
GYRO_DEG_S = 1 / 32.8   # range code 2: 1000 degrees per second
_IMU_SIGNS = np.array([-1, 1, 1, 1, -1, 1, -1], np.float32)


class Aedat2Writer(RecordingWriter):
    """Write an AEDAT-2.0 file that jAER and this library can read.

    Frames are written as reset and signal reads, column by column.  If a frame has no
    reads, its reset is 1023 DN; invalid pixels get reads that decode as invalid.

    Parameters
    ----------
    path : path
        The file appears under this name when the writer is closed.
    sensor_size : (int, int)
        (height, width) of a DAVIS.
    origin_us : int
        Subtracted from times, which have 32 bits; it is written to the header.
    wall_clock_us : int, optional
        Unix time in microseconds of time 0.
    preferences : mapping of str to str, optional
        Preferences for the header, e.g. ``{"APS.Exposure": "10000"}``.
    source : RecordingInfo, optional
        What is known of the source; the header keeps it, with its origin.

    Raises
    ------
    ValueError
        If no DAVIS has this size.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, sensor_size: tuple[int, int],
        origin_us: int = 0, wall_clock_us: int | None = None,
        preferences: Mapping[str, str] | None = None,
        source: RecordingInfo | None = None,
    ) -> None:
        if sensor_shape(sensor_size, "sensor_size") not in _CHIPS:
            raise ValueError("sensor_size must be that of a DAVIS, one of "
                             f"{sorted(_CHIPS)}, got {tuple(sensor_size)}")
        super().__init__(path, sensor_size)
        self._origin, self._wall = int(origin_us), wall_clock_us
        self._preferences = dict(preferences or {})
        self._source = source
        self._rolling: bool | None = None
        self._exposure_us: int | None = None
        self._started = False
        # Words that are held back, as pairs of times and words.
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.uint8]]] = []
        self._count = 0
        self._written_us = -(1 << 61)
        self._frame_end_us = -(1 << 61)

    def _write(self, packet: Packet) -> None:
        for frame in packet.frames:
            self._put_frame(frame)
        if len(packet.events):
            self._put_events(packet.events)
        if len(packet.imu):
            self._put_imu(packet.imu)
        if len(packet.triggers):
            self._put_triggers(packet.triggers)
        if self._count > FLUSH_WORDS and packet.stop_us is not None:
            self._flush(packet.stop_us - HOLD_US)

    def _put_words(
        self, times: NDArray[np.int64], addresses: NDArray[np.uint32]
    ) -> None:
        words = np.empty((len(times), 2), ">u4")
        words[:, 0] = addresses
        words[:, 1] = ((times - self._origin) & 0xFFFFFFFF).astype(np.uint32)
        if len(times):
            self._waiting.append((times, words.view(np.uint8)))
        self._count += len(times)

    def _put_events(self, events: NDArray[Any]) -> None:
        height, width = self.sensor_size        # row 0 is the highest y, x is mirrored
        y, x = (most - 1 - events[name].astype(np.uint32)
                for name, most in (("y", height), ("x", width)))
        self._put_words(events["t"].astype(np.int64),
                        y << 22 | x << 12 | (events["p"] != 0).astype(np.uint32) << 11)

    def _put_frame(self, frame: ApsFrame) -> None:
        height, width = self.sensor_size
        reset, signal = self._reads(frame)
        starts, ends = (np.asarray(t, np.int64) for t in (
            frame.exposure_start_us, frame.exposure_end_us))
        rolling = bool(starts.ndim or ends.ndim)
        if self._rolling is None:
            self._rolling = rolling
            self._exposure_us = round(frame.exposure_ms * 1000)
        column = np.arange(width)
        bound = max(self._written_us, self._frame_end_us + 1)
        if rolling:
            first = np.broadcast_to(starts, width).astype(np.int64)
            second = np.broadcast_to(ends, width).astype(np.int64)
        else:
            start, end = int(starts), int(ends)
            readout = frame.available_us - end
            lead = min(readout, max(start - bound, 0))
            first = start - lead + lead * column // max(width - 1, 1)
            second = end + readout * column // max(width - 1, 1)
        late = first < bound
        if late.any():
            self._lost["frames whose first read came too early were begun later"] += 1
            first = np.maximum(first, bound)
            second = np.maximum(second, first)
        y = np.arange(height - 1, -1, -1, dtype=np.uint32)  # row 0 is the highest y
        base = (np.uint32(0x80000000) | y[None, :] << np.uint32(22)
                | column.astype(np.uint32)[:, None] << np.uint32(12))
        self._put_words(np.repeat(first, height), (base | reset.T).ravel())
        self._put_words(np.repeat(second, height),
                        (base | np.uint32(0x400) | signal.T).ravel())
        self._frame_end_us = int(second.max())

    def _reads(self, frame: ApsFrame) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        if frame.reset is not None and frame.signal is not None and (
                int(frame.reset.max()) <= 1023 and int(frame.signal.max()) <= 1023):
            return frame.reset.astype(np.uint32), frame.signal.astype(np.uint32)
        dn = np.rint(frame.dn).astype(np.int64)
        valid = (np.ones(frame.shape, np.bool_) if frame.valid is None else frame.valid)
        low, high = np.where(valid, -639, -1023), np.where(valid, 1020, 1023)
        self._lost["pixels outside the range of the converter were clipped"] += int(
            np.count_nonzero((dn < low) | (dn > high)))
        dn = np.clip(dn, low, high)
        # A signal of 0 or a reset below 384 decodes as invalid.
        reset = np.where(valid, 1023 + np.minimum(dn, 0), np.maximum(dn, 0))
        return reset.astype(np.uint32), (reset - dn).astype(np.uint32)

    def _put_imu(self, samples: NDArray[Any]) -> None:
        values = np.empty((len(samples), 7), np.float64)
        values[:, :3] = samples["accel"] / ACCEL_G
        values[:, 3] = (samples["temperature"] - 35) * 340
        values[:, 4:] = samples["gyro"] / GYRO_DEG_S
        raw = np.rint(values * _IMU_SIGNS)
        self._lost["IMU values beyond 8 g or 1000 degrees per second were clipped"] += (
            int(np.count_nonzero((raw < -32768) | (raw > 32767))))
        raw = np.clip(raw, -32768, 32767).astype(np.int64)
        code = np.arange(7)
        addresses = (0x80000C00 | code << 28 | (raw & 0xFFFF) << 12).astype(np.uint32)
        self._put_words(np.repeat(samples["t"].astype(np.int64), 7), addresses.ravel())

    def _put_triggers(self, samples: NDArray[Any]) -> None:
        known = np.isin(samples["type"], list(_TRIGGER_CODES))
        self._lost["triggers that are not external edges or pulses"] += int(
            np.count_nonzero(~known))
        samples = samples[known]
        codes = [0x400 + _TRIGGER_CODES[kind] for kind in samples["type"].tolist()]
        self._put_words(samples["t"].astype(np.int64), np.array(codes, np.uint32))

    def _flush(self, until_us: int) -> None:
        if not self._started:
            self._started = True
            self._file.write(self._header())
        if not self._waiting:
            return
        times = np.concatenate([t for t, _ in self._waiting])
        words = np.concatenate([w for _, w in self._waiting])
        order = np.argsort(times, kind="stable")
        times, words = times[order], words[order]
        n = int(np.searchsorted(times, until_us))
        self._file.write(words[:n].tobytes())
        if n:
            self._written_us = int(times[n - 1])
        self._waiting = [(times[n:], words[n:])] if n < len(times) else []
        # Words held back are not counted, or each packet would sort them again.
        self._count = 0

    def _finish(self) -> None:
        self._flush(1 << 62)

    def _header(self) -> bytes:
        chip = _CLASSES[_CHIPS[self.sensor_size]]
        now_ms = time.time_ns() // 1_000_000
        start: list[str] = []
        if self._wall is not None and self._waiting:
            first = min(int(t.min()) for t, _ in self._waiting)
            start = [f" DataStartTime: System.currentTimeMillis() "
                     f"{(self._wall + first) // 1000}"]
        preferences = {
            "APS.GlobalShutter": "false" if self._rolling else "true",
            "APS.Exposure": str(self._exposure_us or 0),
            "IMU.AccelFullScale": "2", "IMU.GyroFullScale": "2"}
        for key, value in self._preferences.items():
            preferences.setdefault(key, value)
        lines = [
            "!AER-DAT2.0", " This is a raw AE data file - do not edit",
            " Data format is int32 address, int32 timestamp (8 bytes total), repeated "
            "for each event", " Timestamps tick: 1 us", " Creator: pdavis_cv",
            f" Creation time: System.currentTimeMillis() {now_ms}",
            f" TimeOrigin: {self._origin} us",
            *([] if self._source is None else [
                f" {SOURCE}: {source_text(self._source)}"]),
            f" AEChip: eu.seebetter.ini.chips.davis.{chip}",
            "Start of Preferences for this AEChip (search for name)"]
        lines += [f'<entry key="{chip}.{key}" value="{_attribute(value)}"/>'
                  for key, value in sorted(preferences.items())]
        lines += ["End of Preferences for this AEChip", *start, "End Of ASCII Header"]
        return "".join(f"#{line}\r\n" for line in lines).encode("latin-1", "replace")


def write_aedat2(path: str | os.PathLike[str], recording: Source) -> Mapping[str, int]:
    """Write a recording as AEDAT-2.0.

    Parameters
    ----------
    path : path
        The file appears under this name when it is complete.
    recording : Source
        Its sensor must have the size of a DAVIS.

    Returns
    -------
    mapping of str to int
        Number of occurrences of what the format could not hold, by description.
    """
    clear(path)
    with aedat2_writer(path, recording) as writer:
        for packet in recording.packets():
            writer.add(packet)
    return writer.losses


def aedat2_writer(path: str | os.PathLike[str], recording: Source) -> Aedat2Writer:
    """Return a writer with the header for a recording."""
    info = info_of(recording)
    start = info.start_us or 0
    # Times have 32 bits, so Unix times need an origin.
    origin = 0 if 0 <= start < 1 << 31 else start - 1_000_000
    return Aedat2Writer(
        path, sensor_size=info.sensor_size, origin_us=origin,
        wall_clock_us=info.wall_clock_us,
        preferences={**_bias_preferences(info.biases),
                     **info.header.get("preferences", {})}, source=info)


def _bias_preferences(biases: Mapping[str, float]) -> dict[str, str]:
    """Return coarse and fine codes of bias currents; see `bias_currents`."""
    codes: dict[str, str] = {}
    for name, current in biases.items():
        if current <= 0:
            continue
        coarse = next((c for c in range(7, -1, -1)
                       if current / (389e-9 * 8.0 ** (2 - c)) * 256 <= 255.5), 0)
        fine = min(255, round(current / (389e-9 * 8.0 ** (2 - coarse)) * 256))
        codes[f"AddressedIPotCF.{name}.BitValueCoarse"] = str(coarse)
        codes[f"AddressedIPotCF.{name}.BitValueFine"] = str(fine)
    return codes


def _attribute(value: str) -> str:
    return "".join(c for c in str(value) if c.isprintable() and c not in '"<&')
