"""ROS 2 bags, in MCAP or sqlite3: messages of events and images, and recordings."""
from __future__ import annotations

import contextlib
import functools
import os
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import Unfinished, clear
from pdavis_cv._types import Closing
from pdavis_cv.recording.aedat4.samples import EIGHT_BIT_DN
from pdavis_cv.recording.aedat4.writer import stored_pixels
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.recording.prophesee import RISING
from pdavis_cv.recording.rosbag import COPIED, EXPOSURE, IMAGES, ROS2_EVENTS, rosbags
from pdavis_cv.recording.writer import edges_of, source_text

NAMESPACE = "pdavis"
"""Frame of all messages, and beginning of their topics."""
PACKET, ARRAY = "event_camera_msgs/msg/EventPacket", "dvs_msgs/msg/EventArray"
_SIZE = "std_msgs/Header header\nuint32 height\nuint32 width\n"
_DEFINITIONS = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\n"
                          "bool polarity\n",
    ARRAY: f"{_SIZE}Event[] events\n",
    PACKET: f"{_SIZE}uint64 seq\nuint64 time_base\nstring encoding\n"
            "bool is_bigendian\nuint8[] events\n"}
_CHANNELS = {np.dtype("u1"): "8UC1", np.dtype("u2"): "16UC1", np.dtype("f4"): "32FC1"}


@functools.cache
def _store() -> Any:
    rosbags()
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


class Bag(Closing):
    """Write messages of one camera to a ROS 2 bag, which appears when it is complete.

    Topics are ``/pdavis/NAME``; the frame of all messages is ``pdavis``.  A path in
    ``.mcap`` or ``.db3`` (sqlite3) is a single file, another one a new folder, in MCAP.
    The size, (height, width), is that of images and sensor.
    """

    def __init__(self, path: str | os.PathLike[str], size: tuple[int, int]) -> None:
        _, rosbag2 = rosbags()
        self.path, self.size = Path(path), size
        self._topics: dict[str, Any] = {}
        self._counts: Counter[str] = Counter()
        clear(path)
        self._unfinished = Unfinished(path, "")
        kind = rosbag2.StoragePlugin
        self._bag = rosbag2.Writer(
            self._unfinished.part / self.path.stem, version=8, storage_plugin=(
                kind.SQLITE3 if self.path.suffix == ".db3" else kind.MCAP))
        with self._writing():
            self._bag.open()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Remove what was written if the block fails."""
        try:
            with self._unfinished.named():
                yield
        except BaseException as error:
            self.discard()
            if isinstance(error, sqlite3.Error):
                raise OSError(f"{self.path}: {error}") from error
            raise

    def put(self, topic: str, kind: str, t_us: int, *, tail: bytes = b"",
            stamp_us: int | None = None, **fields: Any) -> None:
        """Write a message to ``/pdavis/TOPIC`` that arrived at t_us.

        `stamp_us` is the time in its header, by default `t_us`; `tail` replaces its
        last four bytes, those of an empty sequence.  A time before 0 is a ValueError.
        """
        if t_us < 0:
            raise ValueError(f"a bag holds no time before 0, got {t_us} us")
        store = _store()
        message = store.types[kind]
        if "header" in message.__dataclass_fields__:
            fields["header"] = store.types["std_msgs/msg/Header"](
                stamp=self.time(t_us if stamp_us is None else stamp_us),
                frame_id=NAMESPACE)
        data = bytes(store.serialize_cdr(message(**fields), kind))
        with self._writing():
            if topic not in self._topics:
                self._topics[topic] = self._bag.add_connection(
                    f"/{NAMESPACE}/{topic}", kind, typestore=store)
            self._bag.write(self._topics[topic], 1000 * t_us,
                            data[:-4] + tail if tail else data)
        self._counts[topic] += 1

    @staticmethod
    def time(t_us: int) -> Any:
        """Return a time as a message."""
        return _store().types["builtin_interfaces/msg/Time"](
            sec=t_us // 1_000_000, nanosec=t_us % 1_000_000 * 1000)

    def image(self, topic: str, t_us: int, image: NDArray[Any],
              encoding: str | None = None, stamp_us: int | None = None) -> None:
        """Write an image of uint8, uint16 or float32, (H, W), or BGR, (H, W, 3).

        The encoding is by default that of the dtype, or ``bgr8``.
        """
        image = np.ascontiguousarray(image)
        self.put(topic, IMAGES, t_us, stamp_us=stamp_us, height=image.shape[0],
                 width=image.shape[1], is_bigendian=0, step=image.strides[0],
                 encoding=encoding or (
                     "bgr8" if image.ndim == 3 else _CHANNELS[image.dtype]),
                 data=image.view(np.uint8).ravel())

    def camera_info(self, t_us: int, stamp_us: int | None = None) -> None:
        """Write the size of the images; zeros say that the lens is not calibrated."""
        zeros, roi = np.zeros(9), _store().types["sensor_msgs/msg/RegionOfInterest"]
        self.put("camera_info", "sensor_msgs/msg/CameraInfo", t_us, stamp_us=stamp_us,
                 height=self.size[0], width=self.size[1], distortion_model="",
                 d=zeros[:0], k=zeros, r=zeros, p=np.zeros(12), binning_x=0,
                 binning_y=0, roi=roi(0, 0, 0, 0, False))

    def text(self, topic: str, t_us: int, text: str) -> None:
        """Write a text."""
        self.put(topic, "std_msgs/msg/String", t_us, data=text)

    def events(self, events: NDArray[Any], kind: str) -> None:
        """Write events, in time order, as a message of a type."""
        first, last = int(events["t"][0]), int(events["t"][-1])
        if kind == ARRAY:
            self.put("events", kind, last, height=self.size[0], width=self.size[1],
                     events=[], tail=_array(events))
            return
        self._packet("events", first, last, "mono", _words(events, events["p"], first)
                     | events["x"].astype("<u8") << np.uint64(32)
                     | events["y"].astype("<u8") << np.uint64(48))

    def triggers(self, triggers: NDArray[Any]) -> None:
        """Write edges of an external signal."""
        first, last = int(triggers["t"][0]), int(triggers["t"][-1])
        self._packet("triggers", first, last, "trigger",
                     _words(triggers, triggers["type"] == RISING, first))

    def _packet(self, topic: str, first: int, last: int, encoding: str,
                words: NDArray[np.uint64]) -> None:
        self.put(topic, PACKET, last, stamp_us=first, height=self.size[0],
                 width=self.size[1], seq=self._counts[topic], time_base=1000 * first,
                 encoding=encoding, is_bigendian=False, events=words.view(np.uint8))

    def close(self) -> None:
        """Complete the bag and give it its name."""
        with self._writing():
            self._bag.close()
            folder = self._bag.path
            whole = folder / f"{folder.name}{self.path.suffix}"
            self._unfinished.finish(whole if whole.is_file() else folder)
        self._unfinished.discard()

    def discard(self) -> None:
        """Remove what is not complete."""
        with contextlib.suppress(Exception):    # of a full disk, once more
            self._bag.abort()
        self._unfinished.discard()

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.close() if kind is None else self.discard()


def _words(samples: NDArray[Any], on: NDArray[Any], first_us: int
           ) -> NDArray[np.uint64]:
    """Return words with times since the first in ns, and the uppermost bit."""
    t = (samples["t"].astype(np.int64) - first_us) * 1000
    words: NDArray[np.uint64] = t.astype("<u8") | on.astype("<u8") << np.uint64(63)
    return words


def _array(events: NDArray[Any]) -> bytes:
    """Return a sequence of dvs_msgs/Event."""
    stride, places = ROS2_EVENTS
    rows = np.zeros(len(events), np.dtype({
        "names": ["x", "y", "s", "ns", "p"], "offsets": places.tolist(),
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"], "itemsize": stride}))
    rows["s"], rows["ns"] = np.divmod(events["t"].astype(np.int64), 1_000_000)
    rows["ns"] *= 1000
    for name in "xyp":
        rows[name] = events[name]
    # The first event has no padding before its seconds, the last one none behind it.
    return struct.pack("<IHH", len(events), events["x"][0], events["y"][0]) + (
        rows.tobytes()[6:-1])


def write_rosbag(path: str | os.PathLike[str], recording: Recording, *,
                 encoding: str = "event_camera_msgs") -> Mapping[str, int]:
    """Write events, frames and triggers; events in one of two packages' messages."""
    kinds = {"event_camera_msgs": PACKET, "dvs_msgs": ARRAY}
    if encoding not in kinds:
        raise ValueError(f"encoding of a bag must be {' or '.join(kinds)}, got "
                         f"{encoding!r}")
    lost: Counter[str] = Counter()
    told = False
    with Bag(path, recording.info.sensor_size) as bag:
        for packet in recording.packets():
            if packet.start_us is None:
                continue
            if not told:
                bag.text(COPIED, packet.start_us, source_text(recording.info))
                told = True
            if len(packet.events):
                bag.events(packet.events, kinds[encoding])
            for frame in packet.frames:
                _put_frame(bag, frame, lost)
            if len(edges := edges_of(packet.triggers, lost)):
                bag.triggers(edges)
            lost["imu"] += len(packet.imu)
    return MappingProxyType({what: n for what, n in lost.items() if n})


def _put_frame(bag: Bag, frame: ApsFrame, lost: Counter[str]) -> None:
    bits = 8 if frame.full_scale_dn == EIGHT_BIT_DN else 16
    pixels, start, end = stored_pixels(frame, bits, lost)
    mid = frame.mid_us
    if start < end:
        bag.put(EXPOSURE, "sensor_msgs/msg/TimeReference", mid, stamp_us=start,
                time_ref=bag.time(end), source=str(frame.available_us))
    bag.camera_info(frame.available_us, mid)
    bag.image("image_raw", frame.available_us, pixels, f"mono{bits}", mid)
