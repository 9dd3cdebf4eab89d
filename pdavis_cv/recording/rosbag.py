"""ROS 1 and ROS 2 bags: events of several packages, and grey images.

The library rosbags reads the containers; messages are decoded here, because making an
object for each event would take a hundred times as long.
"""
from __future__ import annotations

import bz2
import functools
import itertools
import struct
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from contextvars import ContextVar
from copy import deepcopy
from itertools import count, islice
from types import SimpleNamespace
from typing import Any, cast

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._packages import package
from pdavis_cv._remote import as_path
from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.aedat4.samples import EIGHT_BIT_DN, TEN_BIT_DN
from pdavis_cv.recording.base import ApsFrame, RecordingInfo
from pdavis_cv.recording.event_packets import ENCODINGS, trigger
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.options import MAX_SIDE, SourceOptions
from pdavis_cv.recording.packetise import END_OF_TIME, Batch
from pdavis_cv.recording.prophesee import WordStream, ordered_triggers
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import PiecewiseRecording
from pdavis_cv.recording.timeline import (
    BEFORE,
    FILLED,
    HELD,
    NEVER,
    OFFSET,
    REACH,
    Clock,
    Timeline,
)

HORIZON_US = 500_000
"""Longest time by which events and images of a bag may be out of order."""
SIZES = 9
"""Number of messages whose most frequent size is taken as that of the sensor."""
_LEAST = 1 << 20
"""Bytes of a text that any database may make: a statement, a message in it."""
_MESSAGE = 1 << 10
"""Bytes that reading a message is worth beside its own: a bag needs 40 to store one."""
_BUDGET: ContextVar[Budget | None] = ContextVar("budget", default=None)
"""Of the bag that rosbags reads just now."""
EVENT_ARRAYS = frozenset(f"{package}/msg/EventArray" for package in (
    "dvs_msgs", "prophesee_event_msgs", "dv_ros_msgs"))
EVENT_PACKETS = frozenset((
    "event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray"))
IMAGES = "sensor_msgs/msg/Image"
REFERENCE, TEXT = "sensor_msgs/msg/TimeReference", "std_msgs/msg/String"
COPIED, EXPOSURE = "source_facts", "exposure"
"""Names of the topics in which a bag of this library says what is known of its source,
and begin, end and arrival of each frame."""
_READ = ("mono", "libcaer", "libcaer_cmp", "evt3", "trigger")
"""Encodings of events in packets that are read."""
_STORES = {b"SQLite format 3": ".db3", b"\x89MCAP0\r\n": ".mcap"}
"""First bytes of a ROS 2 bag's files, and the suffix by which rosbags knows them."""
# Bytes of an event, and offsets in it of x, y, seconds, nanoseconds, polarity.
_ROS1 = 13, np.array([0, 2, 4, 8, 12])
# CDR aligns numbers: padding precedes the seconds, except in the first event.
ROS2_EVENTS = 16, np.array([0, 2, 6, 10, 14])
_GAP = 2
_GREY = {"mono8": ("u1", 1, 255), "8UC1": ("u1", 1, 255),
         "mono16": ("u2", 1, 65535), "16UC1": ("u2", 1, 65535)}
"""Dtype, DN of a step, and full scale in DN of images, by their encoding."""
_Where = tuple[NDArray[np.uint8], int, int, int, NDArray[np.int64], int]
"""Bytes, first byte, bytes per event, number, places and shift, for `ros_events`."""


def rosbags() -> tuple[Any, Any]:
    """Return the modules rosbags.rosbag1 and rosbags.rosbag2."""
    package("rosbags", "ROS bags need a package: pip install rosbags (extra [ros])")
    from rosbags import rosbag1, rosbag2
    _bound_decompressors()
    return rosbag1, rosbag2


@functools.cache
def _bound_decompressors() -> None:
    """Let the decompressors of rosbags draw on the budget of the bag that is read."""
    from rosbags.rosbag1 import reader as of_ros1
    from rosbags.rosbag2 import metadata, reader, storage_mcap, storage_sqlite3

    of_ros2, of_sqlite = cast(Any, reader), cast(Any, storage_sqlite3)

    def bound(plain: Callable[..., bytes], kind: Callable[[], Any] | None) -> Any:
        def unpack(data: bytes, *size: int) -> bytes:
            budget = _BUDGET.get()
            found = plain(data, *size) if budget is None or kind is None else (
                budget.unpacked(kind(), data, "a chunk or message"))
            if budget is not None:
                budget.take(len(found))
            return found
        return unpack

    zstd = of_ros2.zstd
    for table, name, kind in (
            (of_ros1.decompressors, "none", None),
            (of_ros1.decompressors, "bz2", bz2.BZ2Decompressor),
            (of_ros1.decompressors, "lz4", lz4.frame.LZ4FrameDecompressor),
            (storage_mcap.DECOMPRESSORS, "lz4", lz4.frame.LZ4FrameDecompressor),
            (storage_mcap.DECOMPRESSORS, "zstd", zstd.ZstdDecompressor)):
        table[name] = bound(table[name], kind)
    if (apsw := getattr(of_sqlite, "apsw", None)) is not None:
        def connect(*arguments: Any, **named: Any) -> Any:
            # Columns may be expressions, whose values may be longer than the file.
            found = apsw.Connection(*arguments, **named)
            if (budget := _BUDGET.get()) is not None:
                found.limit(apsw.SQLITE_LIMIT_LENGTH, max(budget.size, _LEAST))
            return found

        of_sqlite.apsw = SimpleNamespace(**vars(apsw) | {"Connection": connect})
    yaml = of_ros2.YAML

    def without_merging(**options: Any) -> Any:
        # Merge keys ("<<") can double what each line makes; no bag has them.
        made = yaml(**options)
        made.Constructor = type(
            "Plain", (made.Constructor,), {"flatten_mapping": lambda *_: None})
        return made

    of_ros2.YAML = cast(Any, metadata).YAML = without_merging
    of_ros2.zstd = SimpleNamespace(
        open=zstd.open, decompress=bound(zstd.decompress, zstd.ZstdDecompressor))


def _drawn(bag: Any, connections: Any) -> Generator[tuple[Any, bytes], None, None]:
    """Yield connection and data of the messages in an open bag, drawing on its budget.

    An index of MCAP may name chunks again and again, or many for the same time, which
    rosbags keeps until their time has passed.
    """
    budget, storage = _BUDGET.get(), getattr(bag, "storage", None)
    assert budget is not None
    for one in getattr(storage, "storages", [storage]):
        chunks = getattr(one, "chunks", ())
        if sum(chunk.compressed_size for chunk in chunks) > budget.size:
            raise ValueError("its index names more bytes than there are")
        budget.waiting(max(itertools.accumulate(size for *_, size in sorted(
            step for chunk in chunks for step in (
                (chunk.message_start_time, 0, chunk.uncompressed_size),
                (chunk.message_end_time, 1, -chunk.uncompressed_size)))), default=0))
    # An open query would keep a database from being closed.
    with closing(bag.messages(connections)) as messages:
        for connection, _, data in messages:
            budget.take(len(data) + _MESSAGE)
            yield connection, data


class _Message:
    """Read the fields of one message, as stored in the bag, in order.

    With `cdr` it is of ROS 2 (aligned, with a header of four bytes) instead of ROS 1.
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
        stamp = self.stamp()
        self.text()
        return stamp

    def stamp(self) -> int:
        """Return a time in ns."""
        seconds = self.number("i" if self._cdr else "I")
        return seconds * 1_000_000_000 + self.number("I")

    def size(self) -> tuple[int, int]:
        """Return (height, width)."""
        height, width = self.number("I"), self.number("I")
        if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
            raise ValueError(f"a size of {width}x{height}")
        return height, width

    def events(self) -> _Where:
        """Return the location of a sequence of dvs_msgs/Event, for `ros_events`."""
        count, at, data = self.number("I"), self._at, self.data
        size, places = ROS2_EVENTS if self._cdr else _ROS1
        shift = _GAP if self._cdr else 0
        if self._cdr:
            at += -(at - 4) % 4 - _GAP
        if count and at + count * size - (1 if self._cdr else 0) > len(data):
            raise ValueError(f"{count} events in a message of {len(data)} bytes")
        return np.frombuffer(data, np.uint8), at, size, count, places, shift


class RosRecording(PiecewiseRecording):
    """A recording in a ROS bag; see `open_recording`.

    A ``.bag`` file, the folder of a ROS 2 bag, or a ``.db3`` or ``.mcap`` file.  Events
    of ``EventArray`` in dvs_msgs, prophesee_event_msgs and dv_ros_msgs, and of
    ``event_camera_msgs/EventPacket`` (in the encodings ``libcaer``, ``libcaer_cmp``,
    ``evt3``, ``mono``), with external triggers; grey ``sensor_msgs/Image``.  Times are
    those of the messages; the exposure of images is not known.  A stated ``camera`` is
    a part of the topics' names, if the bag holds several.
    """

    _unit = "message"

    def _open(self, options: SourceOptions) -> RecordingInfo:
        rosbag1, rosbag2 = rosbags()
        self._cdr = self._is_ros2()
        self._kind: Any = (rosbag2 if self._cdr else rosbag1).Reader
        try:
            with self._drawing(self._budget), self._kind(self._path) as bag:
                self._encodings = self._found_encodings(bag, options.camera)
                copied = self._first_text(bag)
                self._topics = self._choose(
                    bag.connections, options.camera, copied is not None)
                size = self._size_of(bag)
                self._message_count = sum(
                    c.msgcount for c in bag.connections
                    if (c.topic, c.msgtype) in self._topics)
        except RecordingError:
            raise
        except Exception as error:  # rosbags and its database may raise anything
            raise RecordingError(
                f"{self._path}: not a bag that can be read: {error}") from error
        kinds = {self._role(topic, kind) for topic, kind in self._topics}
        triggers = {"evt3", "trigger"} & {
            self._encodings.get(topic) for topic, _ in self._topics}
        known = stated(options, copied, sensor_size=size,
                       frame_times="time stamps" if "images" in kinds else None)
        self._scales = dict(_GREY)
        if copied is not None:      # as in AEDAT-4: 8 bits are the upper ones of 10
            ten = known.get("full_scale_dn")
            self._scales = {"mono8": ("u1", 4, ten or EIGHT_BIT_DN),
                            "mono16": ("u2", 1, ten or TEN_BIT_DN)}
        return RecordingInfo(
            format=f"ROS {2 if self._cdr else 1} bag",
            camera=", ".join(sorted(topic for topic, _ in self._topics)), **known,
            frame_count=None if "images" in kinds else 0, imu_count=0,
            trigger_count=None if triggers else 0,
            event_count=None if "events" in kinds else 0,
            wall_clock_us=0 if copied is None else None,
            header={"encodings": dict(self._encodings)})

    def _is_ros2(self) -> bool:
        """Return whether it is a bag of ROS 2.

        If its name does not end as rosbags needs it, that is an error.
        """
        if self._path.is_dir():
            for one in self._path.iterdir():
                as_path(one)
            return True
        with self._path.open("rb") as file:
            start = file.read(16)
        suffix = next((its for magic, its in _STORES.items()
                       if start.startswith(magic)), None)
        if suffix is not None and self._path.suffix != suffix:
            raise RecordingError(
                f"{self._path}: a file of a ROS 2 bag must be named *{suffix}")
        return suffix is not None

    def _found_encodings(self, bag: Any, camera: str | None) -> dict[str, str]:
        """Return the encodings of topics of packets, from the first of each."""
        found: dict[str, str] = {}
        for one in bag.connections:
            if one.msgtype not in EVENT_PACKETS or (
                    camera is not None and camera not in one.topic):
                continue
            with closing(_drawn(bag, [one])) as messages:
                for _, data in messages:
                    with suppress(ValueError, struct.error):
                        packet = _Packet(_Message(data, self._cdr))
                        if packet.big or packet.encoding not in _READ:
                            raise RecordingError(
                                f"{self._path}: events of {one.topic} in the encoding "
                                f"{packet.encoding!r}"
                                f"{', big-endian,' if packet.big else ''} are not "
                                f"read, {', '.join(_READ)} are")
                        found[one.topic] = packet.encoding
                        break
        return found

    def _role(self, topic: str, kind: str) -> str | None:
        """Return whether a topic has events, triggers or images, None for others."""
        if kind == IMAGES:
            return "images"
        if kind == REFERENCE and topic.endswith(f"/{EXPOSURE}"):
            return "exposures"
        if kind not in EVENT_ARRAYS | EVENT_PACKETS:
            return None
        return "triggers" if self._encodings.get(topic) == "trigger" else "events"

    def _first_text(self, bag: Any) -> str | None:
        """Return what the bag says of its source, if this library wrote it."""
        for one in bag.connections:
            if one.topic.endswith(f"/{COPIED}") and one.msgtype == TEXT:
                with closing(_drawn(bag, [one])) as messages:
                    for _, data in messages:
                        with suppress(ValueError, struct.error):
                            return _Message(data, self._cdr).text()
        return None

    def _choose(self, connections: Sequence[Any], camera: str | None, copied: bool
                ) -> set[tuple[str, str]]:
        """Return (topic, type) of the events, the triggers and the images."""
        known = {(c.topic, c.msgtype): self._role(c.topic, c.msgtype)
                 for c in connections if camera is None or camera in c.topic}
        known = {key: role for key, role in known.items()
                 if role is not None and (copied or role != "exposures")}
        for what in ("events", "images", "triggers"):
            topics = sorted({topic for (topic, _), role in known.items()
                             if role == what})
            if len(topics) > 1:
                raise RecordingError(
                    f"{self._path}: several topics of {what}, pass camera=: "
                    f"{', '.join(topics)}")
        if not set(known.values()) & {"events", "images"}:
            topics = sorted({f"{c.topic} ({c.msgtype})" for c in connections})
            raise RecordingError(
                f"{self._path}: neither events nor images"
                + (f" of a camera named {camera!r}" if camera else "")
                + f"; it holds {', '.join(topics) or 'nothing'}")
        return set(known)

    def _of(self, bag: Any) -> Generator[tuple[str, str, bytes], None, None]:
        """Yield (topic, type, data) of the chosen topics' messages in an open bag."""
        wanted = [c for c in bag.connections if (c.topic, c.msgtype) in self._topics]
        with closing(_drawn(bag, wanted)) as messages:
            for connection, data in messages:
                yield connection.topic, connection.msgtype, data

    def _size_of(self, bag: Any) -> tuple[int, int]:
        """Return the most frequent sensor size of the first messages.

        That of events counts, as another camera may have taken the images.
        """
        sizes: dict[bool, list[tuple[int, int]]] = {False: [], True: []}
        seen = False
        for images in (False, True):
            wanted = [c for c in bag.connections if (c.topic, c.msgtype) in self._topics
                      and (c.msgtype == IMAGES) == images]
            if not wanted:
                continue
            with closing(_drawn(bag, wanted)) as messages:
                for _, data in islice(messages, SIZES):
                    seen = True
                    with suppress(ValueError, struct.error):
                        message = _Message(data, self._cdr)
                        message.header()
                        sizes[images].append(message.size())
        best = sizes[False] or sizes[True]
        if not best:
            raise RecordingError(
                f"{self._path}: neither events nor images in its topics" if not seen
                else f"{self._path}: the first messages give no size of the sensor")
        return max(best, key=best.count)

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each message, and the share of the bag read by then."""
        timeline = Timeline()
        clocks = {name: Clock(timeline, held=HELD if name == "events" else 0)
                  for name in ("events", "frames", "triggers")}
        words = WordStream(3, self._info.sensor_size)
        promised = NEVER
        exposures: dict[int, tuple[int, int, int]] = {}
        both = len(self._topics) > 1
        messages = self._messages()
        ahead = deque(islice(messages, REACH))
        for number in count():
            if not ahead:
                batch = Batch()
                self._release(
                    batch, clocks["events"], END_OF_TIME, promised, number, memory)
                yield batch, 1.0
                return
            topic, kind, data = ahead.popleft()
            ahead.extend(islice(messages, 1))
            batch = Batch()
            try:
                message = _Message(data, self._cdr)
                if kind == IMAGES:
                    batch.frames = self._frame(
                        message, clocks["frames"], number, promised, exposures,
                        list(self._stamps(ahead)))
                elif kind == REFERENCE:
                    start, end = message.header() // 1000, message.stamp() // 1000
                    exposures[start + end >> 1] = start, end, int(message.text())
                elif kind in EVENT_ARRAYS:
                    message.header()
                    message.size()
                    batch.events = self._array(
                        message.events(), clocks["events"], number, memory)
                else:
                    batch = self._packet(
                        _Packet(message), clocks, words, memory, number, promised)
            except (ValueError, struct.error) as error:
                self._log.damage(number, f"message {number}, of {topic}, is damaged: "
                                 f"{error}", offset=0)
                continue
            if batch.events is not None and len(batch.events) and (
                    batch.events["t"][0] < promised):
                late = batch.events["t"] < promised
                self._count(number, "backward time", int(late.sum()), "events came "
                            "later than the images after them")
                batch.events = batch.events[~late]
            due = max(clock.last for clock in clocks.values()) - HORIZON_US * both
            if not both and clocks["events"].begun:     # whose triggers may be ahead
                due = clocks["events"].last
            self._release(batch, clocks["events"], due, promised, number, memory)
            promised = batch.complete_us = max(promised, due)
            yield batch, (number + 1) / max(self._message_count, number + 1)

    @contextmanager
    def _drawing(self, budget: Budget) -> Iterator[None]:
        """Take what is unpacked or read in the block from the budget."""
        token = _BUDGET.set(budget)
        try:
            yield
        finally:
            _BUDGET.reset(token)

    def _messages(self) -> Iterator[tuple[str, str, bytes]]:
        """Yield (topic, type, data) up to the end or the first unreadable part.

        The bag is opened anew each time, as the library's readers have one position.
        """
        budget = Budget(self._path, self._budget.limits)
        with ExitStack() as stack:
            messages: Generator[tuple[str, str, bytes], None, None] | None = None
            while True:
                try:
                    with self._drawing(budget):
                        if messages is None:
                            messages = stack.enter_context(closing(self._of(
                                stack.enter_context(self._kind(self._path)))))
                        ahead = next(messages, None)
                except RecordingError:
                    raise
                except Exception as error:  # as in _open
                    self._log.damage(
                        "end", f"the bag cannot be read further: {error}", offset=0)
                    return
                if ahead is None:
                    return
                self._check_open()
                yield ahead

    def _frame(self, message: _Message, clock: Clock, number: int, promised: int,
               exposures: dict[int, tuple[int, int, int]], following: list[int]
               ) -> list[ApsFrame]:
        stamp = message.header() // 1000
        size = message.size()
        encoding = message.text()
        big = message.number("B")
        step = message.number("I")
        data = message.block()
        if size != self._info.sensor_size or encoding not in self._scales:
            self._count(number, "wrong image", 1, f"images are {size[1]}x{size[0]} "
                        f"{encoding}, not grey or not the sensor's size")
            return []
        kind, factor, full = self._scales[encoding]
        dtype = np.dtype((">" if big else "<") + kind)
        if step < size[1] * dtype.itemsize or len(data) < step * size[0]:
            raise ValueError(f"{len(data)} bytes for {size[0]} rows of {step}")
        rows = np.frombuffer(data, np.uint8, step * size[0]).reshape(size[0], step)
        image = np.ascontiguousarray(rows[:, :size[1] * dtype.itemsize]).view(dtype)
        found = clock.among(np.array([(stamp,)], [("t", "<i8")]), following)["t"]
        mid = int(found[0]) if len(found) else promised
        if mid <= promised:
            self._count(number, "backward time", 1, "images were dropped because time "
                        "ran backward")
            return []
        start, end, ready = exposures.pop(mid, (mid, mid, None))
        if start + end >> 1 != mid or (ready or end) < end:
            raise ValueError(f"an exposure from {start} to {end} us, read at {ready}")
        dn = image * np.float32(factor)
        valid = None if factor == 1 and full in (255, 65535) else dn < full
        return [ApsFrame(dn, start, end, full_scale_dn=full, available_us=ready,
                         valid=None if valid is None or valid.all() else valid)]

    def _stamps(self, ahead: Iterable[tuple[str, str, bytes]]) -> Iterator[int]:
        """Yield the times of the images among the next messages."""
        for _, kind, data in ahead:
            if kind == IMAGES:
                with suppress(ValueError, struct.error):
                    yield _Message(data, self._cdr).header() // 1000

    def _array(self, where: _Where, clock: Clock, number: int, memory: Scratch
               ) -> NDArray[Any]:
        """Return the events of a dvs_msgs/EventArray, given where they are."""
        return self._taken(
            lambda out: _kernels.ros_events(
                *where, *self._info.sensor_size, clock.state, out),
            where[3], clock, number, memory)

    def _packet(self, packet: _Packet, clocks: dict[str, Clock], words: WordStream,
                memory: Scratch, number: int, promised: int) -> Batch:
        """Return the events or triggers of an event_camera_msgs/EventPacket."""
        clock, data, rising = clocks["events"], packet.data, None
        batch = Batch()
        if packet.big or packet.encoding not in _READ:
            raise ValueError(f"events in the encoding {packet.encoding!r}"
                             f"{', big-endian' if packet.big else ''}")
        if packet.encoding in ENCODINGS:
            batch.events = self._checked(
                ENCODINGS[packet.encoding](data, packet.base_ns), clock, number, memory)
        elif packet.encoding == "trigger":
            t, rising = trigger(data, packet.base_ns)
            t = clock.moved(t, clock.last)
        else:
            read = np.frombuffer(data, "<u2", len(data) // 2)
            if not clock.begun:
                # The sensor's time has another zero; the stamp is that of the first.
                preview, state = deepcopy(words), Clock(None).state
                room = np.empty(words.room(read), EVENT_DTYPE)
                preview.decode(read, state, room)
                first = room["t"][:min(int(state[FILLED]), 1)]
                first = np.concatenate((first, preview.triggers[:1, 0]))
                clock.state[OFFSET] = packet.stamp_us - int(first.min()) if len(
                    first) else 0
            before = clock.last
            batch.events = self._taken(
                lambda out: words.decode(read, clock.state, out), words.room(read),
                clock, number, memory)
            self._count(number, *words.untimed())
            t, rising = words.triggers.T
            t = clock.moved(t, before)
        if rising is not None and len(t):
            batch.triggers, late = ordered_triggers(t, rising, max(
                promised, clocks["triggers"].last))
            self._count(number, "late triggers", late, "triggers were dropped because "
                        "time ran backward")
            if len(batch.triggers):
                clocks["triggers"].state[BEFORE] = batch.triggers["t"][-1]
        return batch


class _Packet:
    """The fields of an event_camera_msgs/EventPacket."""

    def __init__(self, message: _Message) -> None:
        self.stamp_us = message.header() // 1000
        message.size()
        message.number("Q")  # seq
        self.base_ns = message.number("Q")
        self.encoding = message.text()
        self.big = bool(message.number("B"))
        self.data = message.block()
        if self.base_ns >= 1 << 62:
            raise ValueError(f"a base of time of {self.base_ns} ns")
