"""Source, Recording, Packet, ApsFrame and the facts about a recording."""
from __future__ import annotations

import copy
import dataclasses
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._advice import Advises
from pdavis_cv._checks import of_interval, typed, whole_number
from pdavis_cv._types import Closing
from pdavis_cv.events import EVENT_DTYPE, FAR, checked_time
from pdavis_cv.recording.facts import FILE, Fact
from pdavis_cv.recording.options import MOST_DN
from pdavis_cv.sensor import Layout, Sensor

if TYPE_CHECKING:
    from pdavis_cv.recording.members import Member

MAX_PACKET_EVENTS, MAX_PACKET_US = 65_536, 10_000

IMU_DTYPE = np.dtype([
    ("t", "<i8"), ("temperature", "<f4"), ("accel", "<f4", 3), ("gyro", "<f4", 3)])
"""Time in us, degrees Celsius, g, degrees per second; axes as iniVation's: x to the
right, y up, z towards the scene, rotation counter-clockwise positive."""

TRIGGER_DTYPE = np.dtype([("t", "<i8"), ("type", "u1")])
"""Time in us; type as in AEDAT-4: 0 time reset, 1/2/3 external rising/falling/pulse,
4/5 generator rising/falling, 6/7 frame start/end, 8/9 exposure start/end."""


class ApsFrame(Advises):
    """One intensity frame after correlated double sampling.

    Parameters
    ----------
    dn : array_like, shape (H, W)
        Reset minus signal in DN, as float32; may be negative.  A read-only array of
        integers is converted when it is first used.
    exposure_start_us, exposure_end_us : int, or ndarray of int, shape (W,)
        Exposure times on the recording's clock; per column for a rolling shutter.
    valid : ndarray of bool, shape (H, W), optional
        True = usable; None means that every pixel is.
    available_us : int, optional
        End of the readout; default: the end of the exposure.
    full_scale_dn : int
        Largest DN of the converter.
    reset, signal : ndarray of uint16, shape (H, W), optional
        The two reads, if the file has them.

    Raises
    ------
    ValueError
        If shapes differ or the exposure ends before it starts.
    """

    __slots__ = ("_dn", "available_us", "exposure_end_us", "exposure_start_us",
                 "full_scale_dn", "reset", "signal", "valid")

    _dn: NDArray[Any]
    exposure_start_us: int | NDArray[np.int64]
    exposure_end_us: int | NDArray[np.int64]
    valid: NDArray[np.bool_] | None
    available_us: int
    full_scale_dn: int
    reset: NDArray[np.uint16] | None
    signal: NDArray[np.uint16] | None

    def __init__(
        self, dn: ArrayLike, exposure_start_us: int | NDArray[Any],
        exposure_end_us: int | NDArray[Any], *, valid: NDArray[np.bool_] | None = None,
        available_us: int | None = None, full_scale_dn: int = 1023,
        reset: NDArray[np.uint16] | None = None,
        signal: NDArray[np.uint16] | None = None,
    ) -> None:
        stored = np.asarray(dn)
        if stored.dtype.kind == "O":
            raise TypeError(f"dn must be numbers, got {type(dn).__name__}")
        if stored.dtype.kind not in "iu" or stored.flags.writeable:
            stored = np.require(stored, np.float32, ("C", "A"))
        self._dn = stored
        if stored.ndim != 2:
            raise ValueError(f"dn must be (H, W), got shape {stored.shape}")
        for name, array in (("valid", valid), ("reset", reset), ("signal", signal)):
            typed(name, array, np.ndarray | None, "an ndarray")
            if array is not None and array.shape != stored.shape:
                raise ValueError(
                    f"{name} must have dn's shape {stored.shape}, got {array.shape}")
        if valid is not None and valid.dtype != np.bool_:
            raise TypeError(f"valid must be bool, got {valid.dtype}")
        self.exposure_start_us = self._times("exposure_start_us", exposure_start_us)
        self.exposure_end_us = self._times("exposure_end_us", exposure_end_us)
        start, end = self.exposure_start_us, self.exposure_end_us
        if np.count_nonzero(end < start):       # `any` of one bool takes 2 us
            raise ValueError(
                "exposure_end_us must not be before exposure_start_us, got "
                f"{self.exposure_start_us} .. {self.exposure_end_us}")
        last = end if isinstance(end, int) else int(np.max(end))
        self.available_us = last if available_us is None else checked_time(
            "available_us", available_us)
        if self.available_us < last:
            raise ValueError(
                f"available_us must not be before the exposure's end {last}, got "
                f"{available_us}")
        self.valid, self.reset, self.signal = valid, reset, signal
        self.full_scale_dn = whole_number("full_scale_dn", full_scale_dn, 1, MOST_DN)

    def _times(self, name: str, value: int | NDArray[Any]) -> int | NDArray[np.int64]:
        if type(value) is int and abs(value) <= FAR:
            return value
        array = np.asarray(value)
        if array.dtype.kind not in "iu":
            raise TypeError(f"{name} must be integer microseconds, got {array.dtype}")
        if array.size and not -FAR <= array.min() <= array.max() <= FAR:
            raise ValueError(
                f"{name} must lie within 2**61 us of 0, got {array.min()} .. "
                f"{array.max()}")
        if array.ndim == 0:
            return int(array)
        if array.shape != (self._dn.shape[1],):
            raise ValueError(
                f"{name} must be one number or one per column ({self._dn.shape[1]},), "
                f"got shape {array.shape}")
        return np.require(array, np.int64, ("C", "A"))

    @property
    def dn(self) -> NDArray[np.float32]:
        """Reset minus signal in DN, shape (H, W)."""
        if self._dn.dtype != np.float32:
            self._dn = np.ascontiguousarray(self._dn, np.float32)
        return self._dn

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        rows, columns = self._dn.shape
        return rows, columns

    @property
    def mid_us(self) -> int:
        """Middle of the exposure; for a rolling shutter, the mean over columns."""
        start = np.asarray(self.exposure_start_us)
        end = np.asarray(self.exposure_end_us)
        if start.ndim == 0 and end.ndim == 0:
            return int(start + (end - start) // 2)
        columns = start + (end - start) / 2
        base = int(columns.flat[0])
        return base + round(float(np.mean(columns - base)))

    @property
    def column_mid_us(self) -> NDArray[np.int64]:
        """Middle of each column's exposure, shape (W,)."""
        start = np.asarray(self.exposure_start_us)
        mid = start + (np.asarray(self.exposure_end_us) - start) // 2
        return np.broadcast_to(mid, (self._dn.shape[1],)).astype(np.int64)

    @property
    def exposure_ms(self) -> float:
        """Exposure in milliseconds (mean over columns); 0 where unknown."""
        duration = np.asarray(self.exposure_end_us) - self.exposure_start_us
        return float(np.mean(duration)) / 1000

    def replace(self, **changes: Any) -> ApsFrame:
        """Return a copy with some attributes changed; the others are shared.

        Parameters
        ----------
        **changes
            Parameters of the constructor, checked as there.

        Returns
        -------
        ApsFrame
        """
        return ApsFrame(**{name.lstrip("_"): getattr(self, name)
                           for name in self.__slots__} | changes)

    def moved(self, us: int) -> ApsFrame:
        """Return the frame with exposure times that are later by us.

        The time of arrival stays the same unless the exposure would end after it.
        """
        if us == 0:
            return self
        end = self.exposure_end_us + us
        return self.replace(
            exposure_start_us=self.exposure_start_us + us, exposure_end_us=end,
            available_us=max(self.available_us, int(np.max(end))))

    def cropped(self, rows: slice, columns: slice) -> ApsFrame:
        """Return the frame cropped to a part of the sensor, with views if possible."""
        def part(array: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if array is None else array[rows, columns]

        def times(value: int | NDArray[np.int64]) -> int | NDArray[np.int64]:
            return value if isinstance(value, int) else value[columns]

        frame = copy.copy(self)     # what the constructor checks holds for a part, too
        frame._dn = np.ascontiguousarray(self._dn[rows, columns], np.float32)
        frame.exposure_start_us = times(self.exposure_start_us)
        frame.exposure_end_us = times(self.exposure_end_us)
        frame.valid, frame.reset, frame.signal = map(
            part, (self.valid, self.reset, self.signal))
        return frame

    def __repr__(self) -> str:
        height, width = self.shape
        return (f"ApsFrame({width}x{height}, mid {self.mid_us} us, "
                f"exposure {self.exposure_ms:g} ms)")


# glibc returns memory at the end of its heap to the system, but from then on that a
# block of this size was released it keeps as much: each packet would else come of
# pages that the system has to make, which takes longer than to decode it.  Blocks above
# 32 MB do not count.
np.empty(31 << 20, np.uint8)


def joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return one or more arrays of the same dtype as one array, a copy."""
    out = np.empty(sum(map(len, parts)), parts[0].dtype)
    # Copy bytes, as NumPy copies packed structures field by field.
    data, at = np.frombuffer(out, np.uint8), 0
    for part in parts:
        data[at:at + part.nbytes] = np.frombuffer(part, np.uint8)
        at += part.nbytes
    return out


def check_size(frame: ApsFrame, size: tuple[int, int], what: str = "frame") -> None:
    """Raise ValueError unless a frame has the size of the sensor, (height, width)."""
    if frame.shape != size:
        raise ValueError(f"{what} is {frame.shape[1]}x{frame.shape[0]}, the sensor "
                         f"{size[1]}x{size[0]}")


@dataclass(slots=True, eq=False)
class Packet(Advises):
    """A short piece of a recording; its arrays belong to the receiver.

    Packets of a recording do not overlap and come in time order.  Each holds at
    most 65,536 events and one frame, and spans at most 10 ms.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Time-ordered events.
    frames : tuple of ApsFrame
        At most one, placed in time by its ``available_us``.
    imu : ndarray of IMU_DTYPE, shape (M,)
    triggers : ndarray of TRIGGER_DTYPE, shape (K,)
    until_us : int, optional
        No later packet holds a sample before this time.  A live source sets it while
        nothing happens, so that images need not wait for the next sample.
    """

    events: NDArray[Any] = field(default_factory=lambda: np.empty(0, EVENT_DTYPE))
    frames: tuple[ApsFrame, ...] = ()
    imu: NDArray[Any] = field(default_factory=lambda: np.empty(0, IMU_DTYPE))
    triggers: NDArray[Any] = field(default_factory=lambda: np.empty(0, TRIGGER_DTYPE))
    until_us: int | None = None

    @property
    def start_us(self) -> int | None:
        """Time of the first sample of any kind, None for an empty packet."""
        return min(self._ends(0), default=None)

    @property
    def stop_us(self) -> int | None:
        """One past the last sample of any kind, None for an empty packet."""
        last = max(self._ends(-1), default=None)
        return None if last is None else last + 1

    def _ends(self, i: int) -> list[int]:
        arrays = (self.events, self.imu, self.triggers)
        times = [int(array["t"][i]) for array in arrays if len(array)]
        return times + [frame.available_us for frame in self.frames]


@dataclass(frozen=True, kw_only=True)
class RecordingInfo(Advises):
    """Facts about a recording from its header.

    Counts and ``stop_us`` are None when the file has no index.

    Parameters
    ----------
    format : str
        ``"AEDAT-4"``, ``"AEDAT-2.0"``, ``"memory"``, ``"mosaic video"``, ...
    sensor_size : (int, int)
        (height, width).
    writer : str, optional
        The program that wrote the file.
    camera : str, optional
        Name of the camera as the file gives it, with the serial number if known.
    serial : str, optional
        Serial number of the camera.
    sensor : Sensor, optional
        The kind of sensor, if the file or the caller names it.
    layout : Layout, optional
        Polarizer layout, if the caller or the file gives it.
    demosaic : str, optional
        How frames become channels, if only one way is right: ``"superpixel"`` for four
        planes that are laid out as a mosaic.
    start_us, stop_us : int, optional
        Half-open interval that holds every sample.
    event_count, frame_count, imu_count, trigger_count : int, optional
        0 when the file has no such stream.
    exposure_us : int, optional
        Exposure time in the header.
    full_scale_dn : int, optional
        Largest DN of the frames' converter.
    frame_times : float or str, optional
        Rate of the frames in Hz from which their times are made, or the kind of times
        that they have.
    wall_clock_us : int, optional
        Unix time in microseconds at time 0 of the recording.
    biases : mapping of str to float
        Bias currents in ampere, if the header has them.
    header : mapping of str to object
        All other entries of the header.
    origins : mapping of str to str
        Where a field comes from if not from the file, by its name; see `Fact`.
    """

    format: str
    sensor_size: tuple[int, int]
    writer: str | None = None
    camera: str | None = None
    serial: str | None = None
    sensor: Sensor | None = None
    layout: Layout | None = None
    demosaic: str | None = None
    start_us: int | None = None
    stop_us: int | None = None
    event_count: int | None = None
    frame_count: int | None = None
    imu_count: int | None = None
    trigger_count: int | None = None
    exposure_us: int | None = None
    full_scale_dn: int | None = None
    frame_times: float | str | None = None
    wall_clock_us: int | None = None
    biases: Mapping[str, float] = field(default_factory=dict)
    header: Mapping[str, Any] = field(default_factory=dict)
    origins: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in _MAPPINGS:
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def extinction_ratio(self) -> float | None:
        """Nominal extinction ratio of the polarizers, None if no sensor is known."""
        return None if self.sensor is None else self.sensor.extinction_ratio

    @property
    def facts(self) -> Mapping[str, Fact]:
        """What is known of the source by name, with its origin; see `Fact`."""
        origins = {"extinction_ratio": self.origins.get("sensor", FILE), **self.origins}
        return {name: Fact(value, origins.get(name, FILE)) for name in _FACTS
                if (value := getattr(self, name)) is not None}

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values |= {name: dict(values[name]) for name in _MAPPINGS}
        return partial(RecordingInfo, **values), ()


_MAPPINGS = ("biases", "header", "origins")
_FACTS = ("sensor_size", "sensor", "layout", "extinction_ratio", "frame_times",
          "exposure_us", "full_scale_dn")


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem in a recording, and how it was handled.

    Parameters
    ----------
    kind : str
        ``"damage"``, ``"backward time"``, ``"outside sensor"``, ``"segment"``, ...
    message : str
        One sentence for the user.
    count : int
        Number of events, frames or packets concerned.
    offset : int, optional
        Byte offset in the file.
    start_us, stop_us : int, optional
        Affected time range.
    """

    kind: str
    message: str
    count: int = 1
    offset: int | None = None
    start_us: int | None = None
    stop_us: int | None = None


@dataclass(frozen=True, kw_only=True)
class Report:
    """Result of reading a recording from beginning to end.

    Parameters
    ----------
    start_us, stop_us : int or None
        Half-open interval that holds every sample; None for an empty recording.
    event_count, on_count, frame_count, imu_count, trigger_count : int
    problems : tuple of Problem
    """

    start_us: int | None
    stop_us: int | None
    event_count: int
    on_count: int
    frame_count: int
    imu_count: int
    trigger_count: int
    problems: tuple[Problem, ...]


class Source(Advises, Closing):
    """Packets in time order that may be readable only once: a file or a camera.

    Use as a context manager, or call `close`; reading afterwards raises ValueError.

    Attributes
    ----------
    realtime : bool
        True: data that are not read in time are lost.  False: the source waits for its
        reader.
    """

    realtime: bool = False

    @property
    @abstractmethod
    def info(self) -> RecordingInfo:
        """Facts from the header, known without reading the data."""

    @property
    @abstractmethod
    def problems(self) -> Sequence[Problem]:
        """Problems found so far; grows while reading, each problem appears once."""

    @abstractmethod
    def packets(self) -> Iterator[Packet]:
        """Iterate over all samples in time order.

        Yields
        ------
        Packet
        """

    @property
    def path(self) -> Path | None:
        """The file that is read, None if there is none."""
        return None

    @property
    def members(self) -> tuple[Member, ...]:
        """The files that it is made of, empty if there are none."""
        from pdavis_cv.recording.members import members_of  # slow to import
        return () if self.path is None else members_of(self.path)

    @property
    def name(self) -> str:
        """Short name for people: that of the file, else the format."""
        return self.info.format if self.path is None else self.path.name

    def __repr__(self) -> str:
        info = self.info
        height, width = info.sensor_size
        name = "" if self.path is None else f" {self.name}"
        counts = "".join(
            f", {count} {what}" for what, count in (
                ("frames", info.frame_count), ("events", info.event_count))
            if count is not None)
        return f"<{info.format} recording{name}: {width}x{height}{counts}>"


class PlainSource(Source):
    """A source that sets `_info`, and has no problems: what it gives was checked."""

    _info: RecordingInfo

    @property
    def info(self) -> RecordingInfo:
        """Header facts."""
        return self._info

    @property
    def problems(self) -> Sequence[Problem]:
        """Always empty."""
        return ()


class Recording(Source):
    """A source that can be read again, by interval, and concurrently.

    Made by ``open_recording`` and ``recording_from_arrays``.  A file is pickled by its
    path, a recording in memory by value.
    """

    def __init_subclass__(cls, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        for name in {"packets", "events"} & vars(cls).keys():
            setattr(cls, name, of_interval(vars(cls)[name]))

    @abstractmethod
    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order.

        A frame's time is its ``available_us``.  Packet boundaries come from the
        recording, never from the interval: a packet that straddles ``start_us``
        or ``stop_us`` is cut, and all others are the same for every interval.

        Parameters
        ----------
        start_us, stop_us : int, optional
            Half-open interval; default all.

        Yields
        ------
        Packet
        """

    def events(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> NDArray[Any]:
        """Return the events of start_us <= time < stop_us as one array.

        This is faster than joining those of `packets`, as frames are not decoded.

        Parameters
        ----------
        start_us, stop_us : int, optional
            Half-open interval; default all.

        Returns
        -------
        ndarray of EVENT_DTYPE, shape (N,)
            Time-ordered; it belongs to the caller.
        """
        return joined([np.empty(0, EVENT_DTYPE),
                       *(p.events for p in self.packets(start_us, stop_us))])

    def scan(self) -> Report:
        """Read the whole recording once and return a report."""
        start: int | None = None
        stop: int | None = None
        events = on = frames = imu = triggers = 0
        for packet in self.packets():
            if packet.start_us is not None and packet.stop_us is not None:
                start = packet.start_us if start is None else start
                stop = max(packet.stop_us, stop or packet.stop_us)
            events += len(packet.events)
            on += int(np.count_nonzero(packet.events["p"]))
            frames += len(packet.frames)
            imu += len(packet.imu)
            triggers += len(packet.triggers)
        return Report(
            start_us=start, stop_us=stop, event_count=events, on_count=on,
            frame_count=frames, imu_count=imu, trigger_count=triggers,
            problems=tuple(self.problems))


def start_of(recording: Recording) -> int:
    """Return the time of the recording's first sample, 0 if it is empty."""
    start = recording.info.start_us
    if start is None:
        start = next((packet.start_us for packet in recording.packets()), None)
    return 0 if start is None else start
