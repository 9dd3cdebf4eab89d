"""Files of the raw words that a DAVIS346 sent over USB, for diagnosis.

A file holds a magic line, a line of JSON about the camera, and the transfers.  Each
transfer has its time of arrival in s (float64), 1 if data before it were lost (uint32),
the number of bytes that follow (uint32), all little-endian, and the bytes.
"""
from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pdavis_cv._beside import Unfinished
from pdavis_cv._types import Closing
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.davis import DavisDecoder, Orientation
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import Batch
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import PiecewiseRecording
from pdavis_cv.sensor import Sensor

MAGIC = b"#!PDAVIS-USB1\n"
_LONGEST_LINE = 1 << 16
_LARGEST = 1 << 26
_LARGEST_SIDE = 4096
_RECORD = struct.Struct("<dII")


@dataclass(frozen=True)
class Transfer:
    """The bytes of one USB transfer.

    `host_s` is the time of arrival of the last one, s, on any clock; `lost` tells that
    data before them were lost.
    """

    data: bytes
    host_s: float
    lost: bool = False


class TraceWriter(Closing):
    """Write transfers to a file; use as a context manager, or call `close`.

    The file gets its name when the writer is closed, also by an exception, as it holds
    what was sent until then; if it could not be written, no file remains.
    """

    def __init__(
        self, path: str | os.PathLike[str], info: RecordingInfo,
        orientation: Orientation,
    ) -> None:
        head = {"camera": info.camera, "serial": info.serial,
                "sensor_size": info.sensor_size, "header": dict(info.header),
                "orientation": dataclasses.asdict(orientation)}
        self._unfinished = Unfinished(path)
        with self._unfinished.named():
            self._file = self._unfinished.part.open("wb")
        with self._writing():
            self._file.write(MAGIC + json.dumps(head).encode() + b"\n")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Remove the file after an error in the block, which is of the system."""
        try:
            with self._unfinished.named():
                yield
        except OSError:
            with contextlib.suppress(OSError):   # the disk may be too full to flush
                self._file.close()
            self._unfinished.discard()
            raise

    def add(self, transfer: Transfer) -> None:
        """Write a transfer."""
        with self._writing():
            self._file.write(_RECORD.pack(
                transfer.host_s, transfer.lost, len(transfer.data)) + transfer.data)

    def close(self) -> None:
        """Finish the file and give it its name."""
        if self._file.closed:
            return
        with self._writing():
            self._file.close()
            self._unfinished.finish()


class TraceRecording(PiecewiseRecording):
    """A recording in a file of `TraceWriter`; always read from its beginning."""

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._reader = self._bytes()
        start = self._reader.read(0, _LONGEST_LINE)
        end = start.find(b"\n", len(MAGIC))
        try:
            head = json.loads(start[len(MAGIC):end])
            height, width = map(int, head["sensor_size"])
            orientation = dict(head["orientation"])
            orientation["imu_flipped"] = tuple(orientation["imu_flipped"])
            self._orientation = Orientation(**orientation)
            header = dict(head["header"])
        except (ValueError, KeyError, TypeError, OverflowError,
                RecursionError) as error:
            raise RecordingError(
                f"{self._path}: the line about the camera is damaged: {error}"
            ) from error
        if not (0 < height <= _LARGEST_SIDE and 0 < width <= _LARGEST_SIDE):
            raise RecordingError(f"{self._path}: no sensor has {width}x{height} pixels")
        name = head.get("camera")
        self._check_camera(options.camera, name)
        self._begin = end + 1
        return RecordingInfo(
            format="DAVIS346 over USB", camera=name, serial=head.get("serial"),
            header=header, **stated(
                options, sensor_size=(height, width), sensor=Sensor.of_chip(name),
                frame_times="time stamps", full_scale_dn=1023))

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each transfer."""
        # Each reading finds the same problems again; they are reported once.
        log = ProblemLog(str(self._path))
        decoder = DavisDecoder(self._info.sensor_size, self._orientation, log)
        for transfer in self._transfers():
            found = decoder.feed(transfer.data, transfer.host_s, lost=transfer.lost)
            for packet in found:
                samples: dict[str, Any] = {
                    name: part for name in ("events", "imu", "triggers")
                    if len(part := getattr(packet, name))}
                # A frame, or the packet's last sample, may be at the current time.
                complete = (packet.stop_us or decoder.time_us + 1) - 1
                yield Batch(
                    frames=list(packet.frames), complete_us=complete, **samples), 0.0
        for problem in log.problems:
            self._count(0, problem.kind, problem.count, problem.message)

    def _transfers(self) -> Iterator[Transfer]:
        at = self._begin
        while at < self._reader.size:
            head = self._reader.read(at, _RECORD.size)
            if len(head) == _RECORD.size:
                host_s, lost, size = _RECORD.unpack(head)
                data = self._reader.read(at + _RECORD.size, min(size, _LARGEST))
                if size <= _LARGEST and len(data) == size:
                    yield Transfer(data, host_s, bool(lost))
                    at += _RECORD.size + size
                    continue
            self._log.damage(at, f"byte {at}: a transfer is cut short", offset=at)
            return
