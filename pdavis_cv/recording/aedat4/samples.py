"""Decode the packets of AEDAT-4: events, frames, IMU samples, triggers."""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import FAR
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError, Table
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, ApsFrame

EVENT = 16
"""Bytes of an event of EVTS."""
MAX_EXPOSURE_US = 60_000_000
"""Longest exposure; a longer one is taken as damage."""

_PIXELS: dict[int, np.dtype[Any]] = {0: np.dtype("u1"), 2: np.dtype("<u2")}
"""Type of pixels by OpenCV's depth code."""


class UnknownFrameError(PayloadError):
    """Raised for a frame whose pixels have a type that no event camera uses."""


class FrameScale(NamedTuple):
    """Conversion of pixel values to 10-bit DN.

    `factor` is DN per unit of the file, `clipped` the smallest saturated value,
    `itemsize` the bytes per pixel in the file.
    """

    factor: float
    full_scale_dn: int
    clipped: int
    itemsize: int = 2


EIGHT_BIT_DN, TEN_BIT_DN = 1020, 1023
EIGHT_BIT = FrameScale(4.0, EIGHT_BIT_DN, 255, 1)
TEN_BIT = FrameScale(1.0, TEN_BIT_DN, TEN_BIT_DN)
LEFT_JUSTIFIED = FrameScale(1 / 64, TEN_BIT_DN, TEN_BIT_DN << 6)


class RawFrame(NamedTuple):
    """A frame as stored in the file: pixels of uint8 or uint16, (h, w).

    Its first pixel is at (x, y) on the sensor; the times are timestamp, start and end
    of frame, start and end of exposure, exposure; `colour` tells that channels that
    differed were averaged.
    """

    pixels: NDArray[Any]
    x: int
    y: int
    times: tuple[int, int, int, int, int, int]
    colour: bool = False


def raw_frame(table: Table) -> RawFrame:
    """Return the frame of a FRME table.

    PayloadError if sizes contradict each other, UnknownFrameError if the pixel type is
    not 8 or 16 bit unsigned with 1, 3 or 4 channels.
    """
    t, sof, eof, soe, eoe = table.fields(0, np.int64, 5)
    [exposure], [code] = table.fields(11, np.int64), table.fields(5, np.int8)
    width, height, x, y = table.fields(6, np.int16, 4)
    at, size = table.vector(10, 1)
    depth, channels = code & 7, (code >> 3) + 1
    if depth not in _PIXELS or channels not in (1, 3, 4):
        raise UnknownFrameError(f"frame of OpenCV type {code}")
    dtype = _PIXELS[depth]
    if width <= 0 or height <= 0 or x < 0 or y < 0 or (
            size != width * height * channels * dtype.itemsize):
        raise PayloadError(
            f"a frame of {width}x{height} at ({x}, {y}) with {channels} channels "
            f"cannot have {size} bytes")
    pixels = np.frombuffer(table.data, dtype, width * height * channels, at)
    colour = False
    if channels > 1:
        planes = pixels.reshape(height, width, channels)[..., :3]
        pixels = planes[..., 0]
        colour = bool(np.any(planes != planes[..., :1]))
        if colour:
            pixels = np.rint(planes.mean(2)).astype(dtype)
    return RawFrame(pixels.reshape(height, width), x, y,
                    (t, sof, eof, soe, eoe, exposure), colour)


def scale_of(pixels: NDArray[Any]) -> FrameScale:
    """Return the scale of 8-bit, 10-bit or left-justified 16-bit frames."""
    if pixels.dtype.itemsize == 1:
        return EIGHT_BIT
    if int(pixels.max(initial=0)) <= 1023:
        return TEN_BIT
    return LEFT_JUSTIFIED


def exposure_times(
    times: tuple[int, int, int, int, int, int], *, jaer: bool = False
) -> tuple[int, int, int]:
    """Return start and end of exposure and end of readout.

    These are SOE and EOE (start and end of exposure) if EOE > SOE; otherwise the
    timestamp is taken as mid-exposure.  jAER writes SOF and EOF (start and end of
    frame) into SOE and EOE.  The reads before and after the exposure take about equally
    long, so its middle is that of SOF .. EOF, for both shutters, within half of
    (EOF - SOF - exposure).
    """
    t, sof, eof, soe, eoe, exposure = times
    if jaer and 0 < eof - sof <= MAX_EXPOSURE_US:
        span = exposure if 0 < exposure <= eof - sof else 0
        soe = sof + (eof - sof - span) // 2
        return soe, soe + span, eof
    if not 0 < eoe - soe <= MAX_EXPOSURE_US:
        span = exposure if 0 < exposure <= MAX_EXPOSURE_US else 0
        soe = t - span // 2
        eoe = soe + span
    return soe, eoe, eof if 0 <= eof - eoe <= MAX_EXPOSURE_US else eoe


def aps_frame(
    raw: RawFrame, scale: FrameScale, times: tuple[int, int, int],
    size: tuple[int, int], *, flip: bool = False,
) -> ApsFrame:
    """Return a raw frame in 10-bit DN on the whole sensor (height, width), upright.

    The times are start and end of exposure, end of readout; `flip` tells that the
    file's first row is the lowest.  PayloadError if the frame does not fit on the
    sensor.
    """
    height, width = raw.pixels.shape
    if raw.y + height > size[0] or raw.x + width > size[1]:
        raise PayloadError(
            f"a frame of {width}x{height} at ({raw.x}, {raw.y}) does not fit on a "
            f"sensor of {size[1]}x{size[0]}")
    if not all(-FAR <= t <= FAR for t in times):
        raise PayloadError(f"a frame at {times[0]} us")
    usable = raw.pixels < scale.clipped
    kind = np.uint16 if scale.factor >= 1 else np.float32   # integers take less memory
    dn = np.multiply(raw.pixels, kind(scale.factor), dtype=kind)
    if (height, width) != size:
        window = np.s_[raw.y:raw.y + height, raw.x:raw.x + width]
        whole, valid = np.zeros(size, kind), np.zeros(size, np.bool_)
        whole[window], valid[window] = dn, usable
        dn, usable = whole, valid
    if flip:
        dn, usable = dn[::-1], usable[::-1]
    dn.flags.writeable = kind is np.float32
    return ApsFrame(
        dn, times[0], times[1], available_us=times[2],
        full_scale_dn=scale.full_scale_dn,
        valid=None if usable.all() else np.ascontiguousarray(usable))


def imu_samples(table: Table) -> NDArray[Any]:
    """Return the samples of an IMUS table, shape (N,)."""
    values = table.rows(1, np.float32, 7)
    samples = np.zeros(len(values), IMU_DTYPE)
    samples["t"] = table.rows(0, np.int64)[:, 0]
    samples["temperature"] = values[:, 0]
    samples["accel"], samples["gyro"] = values[:, 1:4], values[:, 4:7]
    return samples


def triggers(table: Table) -> NDArray[Any]:
    """Return the samples of a TRIG table, shape (N,)."""
    times = table.rows(0, np.int64)[:, 0]
    samples = np.zeros(len(times), TRIGGER_DTYPE)
    samples["t"], samples["type"] = times, table.rows(1, np.uint8)[:, 0]
    return samples


def span(kind: str, table: Table) -> tuple[int, int] | None:
    """Return the times of the first and last sample of a packet, as in an index.

    None for a packet without samples; for a frame, its timestamp.  PayloadError if it
    cannot be decoded, UnknownFrameError for a frame whose pixels have an unknown type.
    """
    if kind == "FRME":
        time = raw_frame(table).times[0]
        return time, time
    if kind == "EVTS":
        at, count = table.vector(0, EVENT)
        if not count:
            return None
        first, last = (int.from_bytes(table.data[i:i + 8], "little", signed=True)
                       for i in (at, at + EVENT * (count - 1)))
        return first, last
    got = (imu_samples if kind == "IMUS" else triggers)(table)
    return (int(got["t"][0]), int(got["t"][-1])) if len(got) else None
