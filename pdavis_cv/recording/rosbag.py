"""ROS 1 and ROS 2 bags: events of dvs_msgs and event_camera_msgs, and grey images.

The library rosbags reads the containers; messages are decoded here, because making an
object for each event would take a hundred times as long.
"""
from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import count, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import ApsFrame, Packet, RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.files import FileRecording
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import Batch, packetise
from pdavis_cv.recording.prophesee import WordStream
from pdavis_cv.recording.scratch import Gathering, Scratch
from pdavis_cv.recording.timeline import (
    LAST,
    LOOK_AHEAD,
    NEVER,
    OFFSET,
    Clock,
    Timeline,
    possible_range,
)

__all__ = ["RosRecording"]

HORIZON_US = 500_000
"""Longest time by which events and images of a bag may be out of order."""
MAX_SIDE = 8192
SIZES = 9
"""Number of messages whose most frequent size is taken as that of the sensor."""
MAX_MESSAGE = 1 << 28
EVENT_ARRAYS = "dvs_msgs/msg/EventArray"
EVENT_PACKETS = "event_camera_msgs/msg/EventPacket"
IMAGES = "sensor_msgs/msg/Image"
# Bytes of an event, and offsets in it of x, y, seconds, nanoseconds, polarity.
_ROS1 = 13, np.array([0, 2, 4, 8, 12])
# CDR aligns numbers: padding precedes the seconds, except in the first event.
_ROS2 = 16, np.array([0, 2, 6, 10, 14])
_GAP = 2
_GREY = {"mono8": ("u1", 255), "8UC1": ("u1", 255), "mono16": ("u2", 65535),
         "16UC1": ("u2", 65535)}


class _Message:
    """Read the fields of one message in order.

    Parameters
    ----------
    data : bytes
        The message as stored in the bag.
    cdr : bool
        Whether it is of ROS 2 (aligned, with a header of four bytes) instead of ROS 1.
    """

    def __init__(self, data: bytes, cdr: bool) -> None:
        self.data, self._cdr, self._at = data, cdr, 4 if cdr else 0
        if cdr and data[1:2] not in (b"\x01", b"\x00"):
            raise ValueError(f"an encapsulation {data[:4]!r}")
        if cdr and data[1] == 0:
            raise ValueError("big-endian numbers")

    def number(self, code: str) -> int:
        """Return the next number; code as in `struct`."""
        size = struct.calcsize(code)
        if self._cdr:
            self._at += -(self._at - 4) % size
        value: int = struct.unpack_from("<" + code, self.data, self._at)[0]
        self._at += size
        return value

    def block(self) -> bytes:
        """Return the next sequence of bytes, or the bytes of a string."""
        size = self.number("I")
        if size > len(self.data) - self._at:
            raise ValueError(f"{size} bytes in a message of {len(self.data)}")
        self._at += size
        return self.data[self._at - size:self._at]

    def text(self) -> str:
        """Return the next string."""
        return self.block().rstrip(b"\0").decode("latin-1")

    def header(self) -> int:
        """Return the time of a std_msgs/Header in ns."""
        if not self._cdr:
            self.number("I")  # seq
        seconds = self.number("i" if self._cdr else "I")
        nanoseconds = self.number("I")
        self.text()
        return seconds * 1_000_000_000 + nanoseconds

    def size(self) -> tuple[int, int]:
        """Return (height, width)."""
        height, width = self.number("I"), self.number("I")
        if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
            raise ValueError(f"a size of {width}x{height}")
        return height, width

    def events(self) -> tuple[NDArray[np.uint8], int, int, int, NDArray[np.int64], int]:
        """Return the location of a sequence of dvs_msgs/Event, for `ros_events`."""
        count, at, data = self.number("I"), self._at, self.data
        size, places = _ROS2 if self._cdr else _ROS1
        shift = _GAP if self._cdr else 0
        if self._cdr:
            at += -(at - 4) % 4 - _GAP
        if count and at + count * size - (1 if self._cdr else 0) > len(data):
            raise ValueError(f"{count} events in a message of {len(data)} bytes")
        return np.frombuffer(data, np.uint8), at, size, count, places, shift

    def times(self, most: int) -> NDArray[np.int64]:
        """Return the times of the first events of a dvs_msgs/EventArray in us."""
        self.header()
        self.size()
        data, at, stride, count, places, _ = self.events()
        seconds, nanoseconds = (
            np.ndarray((min(count, most),), code, data, at + int(places[i]), (stride,))
            for code, i in (("<i4", 2), ("<u4", 3)))
        found: NDArray[np.int64] = seconds.astype(np.int64)
        found *= 1_000_000
        found += nanoseconds // 1000
        return found


class RosRecording(FileRecording):
    """A recording in a ROS bag; see `open_recording`.

    Events of ``dvs_msgs/EventArray`` and of ``event_camera_msgs/EventPacket`` (in the
    encodings ``mono`` and ``evt3``), grey ``sensor_msgs/Image``.  Times are those of
    the messages; the exposure of images is not known.

    Parameters
    ----------
    path : path
        A ``.bag`` file, or the folder of a ROS 2 bag.
    options : SourceOptions
        Its ``camera`` is a part of the topics' names, if the bag holds several.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        try:
            from rosbags import rosbag1, rosbag2
        except ImportError:
            raise ImportError(
                "ROS bags need a package: pip install rosbags") from None
        self._cdr = self._path.is_dir()
        self._kind: Any = (rosbag2 if self._cdr else rosbag1).Reader
        self._closed = False
        self._closing.callback(setattr, self, "_closed", True)
        try:
            with self._kind(self._path) as bag:
                self._topics = self._choose(bag.connections, options.camera)
                size = self._sensor_size(bag)
                self._message_count = sum(
                    c.msgcount for c in bag.connections
                    if (c.topic, c.msgtype) in self._topics)
        except RecordingError:
            raise
        except Exception as error:  # rosbags and its database may raise anything
            raise RecordingError(
                f"{self._path}: not a bag that can be read: {error}") from error
        images = sum(kind == IMAGES for _, kind in self._topics)
        return RecordingInfo(
            format=f"ROS {2 if self._cdr else 1} bag",
            camera=", ".join(sorted(topic for topic, _ in self._topics)), **stated(
                options, sensor_size=size,
                frame_times="time stamps" if images else None),
            frame_count=None if images else 0, imu_count=0, trigger_count=0,
            event_count=None if images < len(self._topics) else 0, wall_clock_us=0)

    def _choose(self, connections: Sequence[Any], camera: str | None
                ) -> set[tuple[str, str]]:
        """Return (topic, type) of the events and of the images."""
        known = [c for c in connections
                 if c.msgtype in (EVENT_ARRAYS, EVENT_PACKETS, IMAGES)
                 and (camera is None or camera in c.topic)]
        for what, kinds in (("events", (EVENT_ARRAYS, EVENT_PACKETS)),
                            ("images", (IMAGES,))):
            topics = sorted({c.topic for c in known if c.msgtype in kinds})
            if len(topics) > 1:
                raise RecordingError(
                    f"{self._path}: several topics of {what}, pass camera=: "
                    f"{', '.join(topics)}")
        if not known:
            topics = sorted({f"{c.topic} ({c.msgtype})" for c in connections})
            raise RecordingError(
                f"{self._path}: neither events nor images"
                + (f" of a camera named {camera!r}" if camera else "")
                + f"; it holds {', '.join(topics) or 'nothing'}")
        return {(c.topic, c.msgtype) for c in known}

    def _of(self, bag: Any) -> Iterator[tuple[str, str, bytes]]:
        """Yield (topic, type, data) of the chosen topics' messages in an open bag."""
        wanted = [c for c in bag.connections if (c.topic, c.msgtype) in self._topics]
        for connection, _, data in bag.messages(wanted):
            yield connection.topic, connection.msgtype, data

    def _sensor_size(self, bag: Any) -> tuple[int, int]:
        """Return the most frequent sensor size of the first messages."""
        sizes: list[tuple[int, int]] = []
        seen = False
        for _, _, data in islice(self._of(bag), SIZES):
            seen = True
            with suppress(ValueError, struct.error):
                message = _Message(data, self._cdr)
                message.header()
                sizes.append(message.size())
        if not sizes:
            raise RecordingError(
                f"{self._path}: neither events nor images in its topics" if not seen
                else f"{self._path}: the first messages give no size of the sensor")
        return max(sizes, key=sizes.count)

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        if self._closed:
            raise ValueError(f"{self._path.name}: recording is closed")
        return packetise(self._batches(Scratch()), start_us, stop_us)

    def events(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> NDArray[Any]:
        """Return the events of start_us <= time < stop_us as one array."""
        if self._closed:
            raise ValueError(f"{self._path.name}: recording is closed")
        memory = Gathering(start_us, stop_us)
        for done, batch in enumerate(self._batches(memory), 1):
            if batch.events is not None and memory.keep(batch.events):
                break
            if start_us is stop_us is None:
                memory.expect(done / max(self._message_count, done))
        return memory.events

    def _batches(self, memory: Scratch) -> Iterator[Batch]:
        timeline = Timeline()
        clocks = {name: Clock(timeline) for name in ("events", "frames")}
        words = WordStream(3, self._info.sensor_size)
        promised = NEVER
        both = len(self._topics) > 1
        messages = self._messages()
        ahead = deque(islice(messages, LOOK_AHEAD))
        for number in count():
            if not ahead:
                return
            topic, kind, data = ahead.popleft()
            ahead.extend(islice(messages, 1))
            batch = Batch()
            try:
                message = _Message(data, self._cdr)
                if kind == IMAGES:
                    batch.frames = self._frame(
                        message, clocks["frames"], number, promised)
                elif kind == EVENT_ARRAYS:
                    message.header()
                    message.size()
                    batch.events = self._array(
                        message, clocks["events"], memory, number, ahead)
                else:
                    batch.events = self._packet(
                        message, clocks["events"], words, memory, number)
            except (ValueError, struct.error) as error:
                self._log.damage(number, f"message {number}, of {topic}, is damaged: "
                                 f"{error}", offset=0)
                continue
            if batch.events is not None and len(batch.events) and (
                    batch.events["t"][0] < promised):
                late = batch.events["t"] < promised
                self._count(number, "backward time", int(late.sum()), "events came "
                            "later than the images after them", unit="message")
                batch.events = batch.events[~late]
            newest = max(clock.last for clock in clocks.values())
            promised = batch.complete_us = max(promised, newest - (
                HORIZON_US if both else 0))
            yield batch

    def _messages(self) -> Iterator[tuple[str, str, bytes]]:
        """Yield (topic, type, data) up to the end or the first unreadable part.

        The bag is opened anew each time, as the library's readers have one position.
        """
        with ExitStack() as stack:
            try:
                messages = self._of(stack.enter_context(self._kind(self._path)))
                ahead = next(messages, None)
            except Exception as error:  # as in _open
                self._lost(error)
                return
            while ahead is not None:
                if self._closed:
                    raise ValueError(f"{self._path.name}: recording is closed")
                yield ahead
                try:
                    ahead = next(messages, None)
                except Exception as error:
                    self._lost(error)
                    return

    def _lost(self, error: Exception) -> None:
        self._log.damage("end", f"the bag cannot be read further: {error}", offset=0)

    def _frame(self, message: _Message, clock: Clock, number: int, promised: int
               ) -> list[ApsFrame]:
        t = np.array([message.header() // 1000], np.int64)
        size = message.size()
        encoding = message.text()
        big = message.number("B")
        step = message.number("I")
        data = message.block()
        if size != self._info.sensor_size or encoding not in _GREY:
            self._count(number, "wrong image", 1, f"images are {size[1]}x{size[0]} "
                        f"{encoding}, not grey or not the sensor's size",
                        unit="message")
            return []
        kind, full = _GREY[encoding]
        dtype = np.dtype((">" if big else "<") + kind)
        if step < size[1] * dtype.itemsize or len(data) < step * size[0]:
            raise ValueError(f"{len(data)} bytes for {size[0]} rows of {step}")
        rows = np.frombuffer(data, np.uint8, step * size[0]).reshape(size[0], step)
        image = np.ascontiguousarray(rows[:, :size[1] * dtype.itemsize]).view(dtype)
        keep, _ = clock.order(t)
        if not keep[0] or t[0] <= promised:
            self._count(number, "backward time", 1, "images were dropped because time "
                        "ran backward", unit="message")
            return []
        return [ApsFrame(image, int(t[0]), int(t[0]), full_scale_dn=full)]

    def _array(self, message: _Message, clock: Clock, memory: Scratch, number: int,
               ahead: Iterable[tuple[str, str, bytes]]) -> NDArray[Any]:
        """Return the events of a dvs_msgs/EventArray; ahead are the next messages."""
        where, before = message.events(), clock.last
        events = self._taken(
            lambda done, out: _kernels.ros_events(
                *where, done, *self._info.sensor_size, clock.state, out),
            where[3], clock, number, memory, unit="message")
        following = list(self._following(ahead, 1, clock))
        if not len(events) or (following and events["t"][-1] <= following[0][0]):
            return events
        following = list(self._following(ahead, MAX_MESSAGE, clock))
        _, last = possible_range(events["t"].astype(np.int64), following, before)
        good = events[:np.searchsorted(events["t"], last, "right")]
        if len(good) < len(events):
            self._count(number, "backward time", len(events) - len(good), "events were "
                        "dropped because time ran backward", unit="message")
            clock.state[LAST] = good["t"][-1] if len(good) else before
        return good

    def _following(self, ahead: Iterable[tuple[str, str, bytes]], most: int,
                   clock: Clock) -> Iterator[NDArray[np.int64]]:
        """Yield the first times of each message of events among the next ones."""
        for _, kind, data in ahead:
            if kind == EVENT_ARRAYS:
                with suppress(ValueError, struct.error):
                    times = _Message(data, self._cdr).times(most)
                    if len(times):
                        yield times + int(clock.state[OFFSET])

    def _packet(self, message: _Message, clock: Clock, words: WordStream,
                memory: Scratch, number: int) -> NDArray[Any]:
        """Return the events of an event_camera_msgs/EventPacket."""
        stamp = message.header() // 1000
        message.size()
        message.number("Q")  # seq
        base = message.number("Q")
        encoding = message.text()
        big = message.number("B")
        data = message.block()
        if big or encoding not in ("mono", "evt3"):
            raise RecordingError(
                f"{self._path}: events in the encoding {encoding!r}"
                f"{', big-endian,' if big else ''} are not read, mono and evt3 are")
        if encoding == "mono":
            word = np.frombuffer(data, "<u8", len(data) // 8)
            t = ((word & 0xFFFFFFFF).astype(np.int64) + base) // 1000
            columns = t, word >> 32 & 0xFFFF, word >> 48 & 0x7FFF, word >> 63
            return self._checked(columns, clock, number, memory, unit="message")
        if clock.last == NEVER:
            # The sensor's time has another zero; the stamp is that of the first event.
            first = WordStream(3, words.size).events(
                np.frombuffer(data, "<u2", len(data) // 2), Clock(Timeline()))
            clock.state[OFFSET] = stamp - int(first["t"][0]) if len(first) else 0
        events = words.events(
            np.frombuffer(data, "<u2", len(data) // 2), clock, memory)
        self._dropped(clock, number, words.jumps, unit="message")
        return events
