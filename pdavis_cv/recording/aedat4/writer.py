"""Write AEDAT-4 as DV does: packets, LZ4, index."""
from __future__ import annotations

import os
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from html import escape
from typing import Any

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import clear
from pdavis_cv._packages import package
from pdavis_cv.recording.aedat4.container import COMPRESSIONS, MAGIC
from pdavis_cv.recording.aedat4.samples import EIGHT_BIT_DN, TEN_BIT_DN
from pdavis_cv.recording.base import ApsFrame, Packet, RecordingInfo, Source
from pdavis_cv.recording.writer import RecordingWriter, info_of, source_text
from pdavis_cv.sensor import Layout

EVENTS, FRAMES, IMU, TRIGGERS = range(4)
_STREAMS = (("EVTS", "events", "Array of events (polarity ON/OFF)."),
            ("FRME", "frames", "Standard frame."),
            ("IMUS", "imu", "Inertial Measurement Unit data samples."),
            ("TRIG", "triggers", "External triggers and special signals."))
# A root table with one vector: size, root, identifier, padding, vtable, table.
_VECTOR = struct.Struct("<II4s2xHHHiII")
# vtable of 13 fields, then the table in the order of alignment.
_FRAME = struct.Struct("<II4s15H2xi6q4hIbb2xI")
_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "?"), ("pad", "V3")])
_IMU = np.dtype([("back", "<i4"), ("t", "<i8"), ("values", "<f4", 10), ("pad", "<u4")])
_IMU_VTABLE = struct.pack("<13H", 26, 52, 4, *range(12, 52, 4))
_TRIGGER = np.dtype([("back", "<i4"), ("t", "<i8"), ("type", "u1"), ("pad", "V3")])
_TRIGGER_VTABLE = struct.pack("<4H", 8, 13, 4, 12)
_INDEX = np.dtype([("back", "<i4"), ("offset", "<i8"), ("stream", "<i4"),
                   ("size", "<i4"), ("count", "<i8"), ("start", "<i8"),
                   ("stop", "<i8"), ("pad", "<u4")])
_INDEX_VTABLE = struct.pack("<7H", 14, 44, 4, 12, 20, 28, 36)

UNKNOWN = "unknown"
"""Source of a file whose camera is not known."""


def full_scale_of(info: RecordingInfo) -> int:
    """Return the full scale of frames of 16 bits; that of a DAVIS if it is unknown."""
    known = info.full_scale_dn
    return TEN_BIT_DN if known in (None, EIGHT_BIT_DN) else known


class Aedat4Writer(RecordingWriter):
    """Write an AEDAT-4 file that DV, dv-processing, aedat and this library can read.

    Parameters
    ----------
    path : path
        The file appears under this name when the writer is closed.
    sensor_size : (int, int)
        (height, width).
    layout : Layout, optional
        Polarizer layout, written to the header with its owner.
    camera : str
        Name and serial number in the form of DV.
    compression : {"lz4", "none", "zstd"}
        zstd needs the extra ``[zstd]``.
    frame_bits : {16, 8}, optional
        16 stores 10-bit DN, 8 stores DN / 4; default: 8 if the first frame is from an
        8-bit file, else 16.
    full_scale_dn : int
        Largest DN of 16-bit frames, written to the header.
    source : RecordingInfo, optional
        What is known of the source; the header keeps it, with its origin.

    Raises
    ------
    ValueError
        If an argument has another value than those listed.
    ImportError
        If zstd is requested and its package is not installed.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, sensor_size: tuple[int, int],
        layout: Layout | None = None, camera: str = UNKNOWN,
        compression: str = "lz4", frame_bits: int | None = None,
        full_scale_dn: int = TEN_BIT_DN, source: RecordingInfo | None = None,
    ) -> None:
        if compression not in ("lz4", "none", "zstd"):
            raise ValueError(
                f"compression must be lz4, none or zstd, got {compression!r}")
        if frame_bits not in (None, 8, 16):
            raise ValueError(f"frame_bits must be 8 or 16, got {frame_bits!r}")
        self._compress = _compressor(compression)
        super().__init__(path, sensor_size)
        self._bits = frame_bits
        self._index = array("q")    # of each packet: offset, stream, size, ...
        self._file.write(MAGIC + _header(
            range(len(_STREAMS)), self.sensor_size, layout, camera, compression,
            full_scale_dn, source))
        self._position_at = len(MAGIC) + 32

    def _write(self, packet: Packet) -> None:
        self._put_samples(EVENTS, packet.events, _events)
        for frame in packet.frames:
            if self._bits is None:      # the first frame determines it
                self._bits = 8 if frame.full_scale_dn == EIGHT_BIT_DN else 16
            self._put(FRAMES, _frame(frame, self._bits, self._lost), 1,
                      frame.mid_us, frame.mid_us)
        self._put_samples(IMU, packet.imu, _imu)
        self._put_samples(TRIGGERS, packet.triggers, _triggers)

    def _put_samples(self, stream: int, samples: NDArray[Any],
                     encoded: Callable[[NDArray[Any]], bytes | NDArray[Any]]) -> None:
        if len(samples):
            first, last = samples["t"][[0, -1]].tolist()
            self._put(stream, encoded(samples), len(samples), first, last)

    def _put(self, stream: int, payload: bytes | NDArray[Any], count: int,
             start: int, stop: int) -> None:
        data = self._compress(payload)
        self._file.write(struct.pack("<ii", stream, len(data)))
        self._index.extend((self._file.tell(), stream, len(data), count, start, stop))
        self._file.write(data)

    def _finish(self) -> None:
        position = self._file.tell()
        names = ("offset", "stream", "size", "count", "start", "stop")
        rows = np.array(self._index, np.int64).reshape(-1, len(names))
        table = np.zeros(len(rows), _INDEX)
        for name, column in zip(names, rows.T, strict=True):
            table[name] = column
        self._file.write(self._compress(_tables(b"FTAB", _INDEX_VTABLE, table)))
        self._file.seek(self._position_at)
        self._file.write(struct.pack("<q", position))


class StreamEncoder:
    """One stream of packets as dv's network protocol has it: a header, then packets.

    The stream is `EVENTS`, `FRAMES`, ...; compression ``"none"``, ``"lz4"`` or
    ``"zstd"``. A connection begins with `head`.
    """

    def __init__(self, stream: int, info: RecordingInfo, compression: str) -> None:
        self._compress = _compressor(compression)
        self._stream = stream
        self.head = _header(
            [stream], info.sensor_size, info.layout,
            info.camera or UNKNOWN, compression, full_scale_of(info), info)

    def encoded(self, packet: Packet) -> Iterator[bytes]:
        """Yield what a packet holds of this stream, each as its bytes on the wire.

        Frames are 16 bit: 10-bit DN.
        """
        payloads: list[bytes | NDArray[Any]] = []
        if self._stream == EVENTS and len(packet.events):
            payloads.append(_events(packet.events))
        elif self._stream == FRAMES:
            # A network stream does not report what it cannot hold.
            payloads += [_frame(frame, 16, Counter()) for frame in packet.frames]
        elif self._stream == IMU and len(packet.imu):
            payloads.append(_imu(packet.imu))
        elif self._stream == TRIGGERS and len(packet.triggers):
            payloads.append(_triggers(packet.triggers))
        for payload in payloads:
            data = self._compress(payload)
            yield struct.pack("<ii", self._stream, len(data)) + data


def write_aedat4(
    path: str | os.PathLike[str], recording: Source, *, compression: str = "lz4",
    frame_bits: int | None = None,
) -> Mapping[str, int]:
    """Write a recording as AEDAT-4.

    Parameters
    ----------
    path : path
        The file appears under this name when it is complete.
    recording : Source
    compression : {"lz4", "none", "zstd"}
    frame_bits : {16, 8}, optional
        See `Aedat4Writer`.

    Returns
    -------
    mapping of str to int
        Number of occurrences of what the format could not hold, by description.
    """
    info = info_of(recording)
    clear(path)
    with Aedat4Writer(
            path, sensor_size=info.sensor_size, layout=info.layout,
            camera=info.camera or UNKNOWN, compression=compression,
            frame_bits=frame_bits, full_scale_dn=full_scale_of(info),
            source=info) as writer:
        for packet in recording.packets():
            writer.add(packet)
    return writer.losses


def _compressor(name: str) -> Callable[[Any], bytes]:
    if name == "none":
        return lambda data: bytes(memoryview(data))
    if name == "lz4":
        return lambda data: bytes(lz4.frame.compress(data, store_size=False))
    zstandard = package("zstandard", "zstd needs a package: pip install zstandard")
    compressor = zstandard.ZstdCompressor(level=3)
    return lambda data: bytes(compressor.compress(memoryview(data).cast("B")))


def _events(events: NDArray[Any]) -> NDArray[Any]:
    out = np.zeros(32 + _EVENT.itemsize * len(events), np.uint8)
    _head(out, b"EVTS", len(events))
    records = out[32:].view(_EVENT)
    for name in "txyp":
        records[name] = events[name]
    return out


def stored_pixels(frame: ApsFrame, bits: int, lost: Counter[str]
                  ) -> tuple[NDArray[Any], int, int]:
    """Return a frame's image as it is stored, and one time of its exposure for all.

    The image has 8 or 16 bits, (H, W); of 8, a step is 4 DN.  What cannot be held is
    added to `lost`, where a number may be 0.  The times are start and end, us.
    """
    step, most = (4, 255) if bits == 8 else (1, 65_535)
    values = np.rint(frame.dn / np.float32(step))
    lost["pixels with negative DN were stored as 0"] += int(
        np.count_nonzero(values < 0))
    lost["pixels above the full scale were clipped"] += int(
        np.count_nonzero(values > most))
    clipped = np.clip(values, 0, most)
    if frame.valid is not None:
        shown = clipped < (255 if bits == 8 else frame.full_scale_dn)
        lost["invalid pixels are not marked as such in the file"] += int(
            np.count_nonzero(~frame.valid & shown))
    starts, ends = (np.asarray(t) for t in (
        frame.exposure_start_us, frame.exposure_end_us))
    if starts.ndim or ends.ndim:
        lost["frames with exposure times per column keep their mean"] += 1
    half = int((ends - starts).mean() / 2)
    start, end = frame.mid_us - half, frame.mid_us + half
    if not starts.ndim and not ends.ndim:
        start, end = int(starts), int(ends)
    return clipped.astype("u1" if bits == 8 else "<u2"), start, end


def _frame(frame: ApsFrame, bits: int, lost: Counter[str]) -> bytes:
    """Return the FlatBuffer of a frame; add what it cannot hold to `lost`."""
    image, start, end = stored_pixels(frame, bits, lost)
    pixels = image.tobytes()
    starts = np.asarray(frame.exposure_start_us)
    height, width = frame.shape
    body = _FRAME.pack(
        _FRAME.size - 4 + len(pixels), 40, b"FRME",
        30, 66, 4, 12, 20, 28, 36, 64, 52, 54, 56, 58, 60, 44, 65,
        32, frame.mid_us, int(starts.min()), frame.available_us, start, end,
        end - start, width, height, 0, 0, 8,
        0 if bits == 8 else 2, 1, len(pixels))
    return bytes(body + pixels)


def _imu(samples: NDArray[Any]) -> bytes:
    records = np.zeros(len(samples), _IMU)
    records["t"] = samples["t"]
    records["values"][:, 0] = samples["temperature"]
    records["values"][:, 1:4] = samples["accel"]
    records["values"][:, 4:7] = samples["gyro"]
    return _tables(b"IMUS", _IMU_VTABLE, records)


def _triggers(samples: NDArray[Any]) -> bytes:
    records = np.zeros(len(samples), _TRIGGER)
    records["t"], records["type"] = samples["t"], samples["type"]
    return _tables(b"TRIG", _TRIGGER_VTABLE, records)


def _tables(identifier: bytes, vtable: bytes, records: NDArray[Any]) -> bytes:
    """Return a buffer with a vector of tables that share one vtable."""
    count, stride = len(records), records.dtype.itemsize
    vtable_at = 32 + 4 * count
    # Tables begin 4 bytes before a multiple of 8: their first field is an int64.
    first = -(-(vtable_at + len(vtable) - 4) // 8) * 8 + 4
    tables_at = first + stride * np.arange(count)
    records["back"] = tables_at - vtable_at
    out = np.zeros(first + stride * count, np.uint8)
    _head(out, identifier, count)
    slots = 32 + 4 * np.arange(count)
    out[32:vtable_at] = (tables_at - slots).astype("<u4").view(np.uint8)
    out[vtable_at:vtable_at + len(vtable)] = np.frombuffer(vtable, np.uint8)
    out[first:] = records.view(np.uint8)
    return out.tobytes()


def _head(out: NDArray[Any], identifier: bytes, count: int) -> None:
    # vtable at 14, table at 20, its vector at 28.
    _VECTOR.pack_into(out.data, 0, len(out) - 4, 16, identifier, 6, 8, 4, 6, 4, count)


def _header(
    streams: Iterable[int], size: tuple[int, int], layout: Layout | None, camera: str,
    compression: str, full_scale_dn: int, source: RecordingInfo | None,
) -> bytes:
    """Return the size-prefixed FlatBuffer IOHE of some streams."""
    code = COMPRESSIONS.index(compression.upper() if compression != "none" else "none")
    text = _info_node(
        streams, size, layout, camera, COMPRESSIONS[code], full_scale_dn, source
    ).encode()
    # vtable at 12, table at 28: position at 32, compression at 40, text at 44.
    body = struct.pack("<I4s5H6xiqiII", 24, b"IOHE", 10, 20, 12, 4, 16,
                       16, -1, code, 4, len(text)) + text + b"\0"
    return struct.pack("<I", len(body)) + body


def _info_node(
    streams: Iterable[int], size: tuple[int, int], layout: Layout | None, camera: str,
    compression: str, full_scale_dn: int, source: RecordingInfo | None,
) -> str:
    def attribute(key: str, value: object, kind: str = "string") -> str:
        text = escape(str(value), quote=False)
        return f'<attr key="{key}" type="{kind}">{text}</attr>'

    lines = ['<dv version="2.0">',
             '<node name="outInfo" path="/mainloop/Recorder/outInfo/">']
    for number in streams:
        kind, name, description = _STREAMS[number]
        path = f"/mainloop/Recorder/outInfo/{number}/"
        lines += [
            f'<node name="{number}" path="{path}">',
            attribute("compression", compression.upper()),
            attribute("originalModuleName", "pdavis_cv"),
            attribute("originalOutputName", name),
            attribute("typeDescription", description),
            attribute("typeIdentifier", kind),
            f'<node name="info" path="{path}info/">']
        if number in (EVENTS, FRAMES):
            lines += [attribute("sizeX", size[1], "int"),
                      attribute("sizeY", size[0], "int")]
        if number == FRAMES:
            lines.append(attribute("fullScaleDN", full_scale_dn, "int"))
        if layout is not None:
            lines.append(attribute("polarizerLayout", layout.stored_angles))
        if layout is not None and layout.owner is not None:
            lines.append(attribute("polarizerSensor", layout.owner))
        if source is not None:
            lines.append(attribute("sourceFacts", source_text(source)))
        lines += [attribute("source", camera), attribute("tsOffset", 0, "long"),
                  "</node>", "</node>"]
    return "\n".join([*lines, "</node>", "</dv>", ""])
