"""From messages to images: all of the node that needs no ROS."""
from __future__ import annotations

from bisect import insort

import numpy as np

from pdavis_cv import EVENT_DTYPE, ApsFrame, Packet, RecordingInfo, render
from pdavis_cv.live import Session
from pdavis_cv.live.base import restated
from pdavis_cv.recording.event_packets import ENCODINGS
from pdavis_cv.recording.options import SourceOptions

QUANTITIES = ("s0", "aop", "dolp")
HORIZON_US = 500_000
"""Longest time by which images wait for events, us."""
_MOST_WAITING = 100
"""Images that may wait: of that time, at twice the rate of the fastest cameras."""
_IMAGES = {"mono8": ("u1", 4, 1020), "8UC1": ("u1", 4, 1020),
           "mono16": ("<u2", 1, 1023), "16UC1": ("<u2", 1, 1023)}
"""Dtype, DN of a step and full scale; 8 bits are the upper ones of 10."""


class Fuser:
    """Fuse messages of events and images as they arrive.

    Parameters
    ----------
    layout : str
        Polarizers of the 2x2 cell.
    exposure_us : int
        Exposure of the images, whose stamps are its middle; 0 = not known.
    **options
        As in `pdavis_cv.live.Session`.

    Attributes
    ----------
    dropped : int
        Number of events and images that came too late.
    """

    def __init__(self, *, layout="pdavis", exposure_us=0, **options):
        self._layout, self._exposure_us, self._options = layout, exposure_us, options
        self._session = None
        self._size = None
        self._last_us = self._events_us = None
        self._frames = []       # by their time
        self.dropped = 0

    def events(self, message):
        """Take an ``event_camera_msgs/EventPacket``; return the images it completes.

        Raises
        ------
        ValueError
            If its encoding is not read.
        """
        if message.encoding not in ENCODINGS or message.is_bigendian:
            raise ValueError(
                f"events in the encoding {message.encoding!r} are not read, "
                f"{', '.join(ENCODINGS)} are")
        height, width = self._begin(message)
        t, x, y, p = ENCODINGS[message.encoding](
            bytes(message.events), message.time_base)
        before = t[0] if self._last_us is None and len(t) else self._last_us
        good = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if before is not None:
            good &= t >= np.maximum.accumulate(np.maximum(t, before))
        self.dropped += len(t) - int(good.sum())
        events = np.empty(int(good.sum()), EVENT_DTYPE)
        for name, column in zip("txyp", (t, x, y, p), strict=True):
            events[name] = column[good]
        if not len(events):
            return []
        self._events_us = int(events["t"][-1])
        images = self._push(Packet(events), self._events_us)
        return images + self._waiting(self._events_us)

    def image(self, message):
        """Take a grey ``sensor_msgs/Image``; return the images it completes.

        Raises
        ------
        ValueError
            If it is not grey, or has another size than the events.
        """
        if message.encoding not in _IMAGES or message.is_bigendian:
            raise ValueError(f"images of {message.encoding!r} are not read, "
                             f"{', '.join(_IMAGES)} are")
        size = self._begin(message)
        if (message.height, message.width) != size:
            raise ValueError(f"images of {message.width}x{message.height} do not fit "
                             f"the sensor of {size[1]}x{size[0]}")
        kind, step, full = _IMAGES[message.encoding]
        row = size[1] * np.dtype(kind).itemsize
        data = np.frombuffer(bytes(message.data), np.uint8)
        if len(data) % size[0] or len(data) < size[0] * row:
            raise ValueError(f"{len(data)} bytes are no image of {size[1]}x{size[0]}")
        dn = data.reshape(size[0], -1)[:, :row].copy().view(kind) * np.float32(step)
        stamp = message.header.stamp
        mid = stamp.sec * 1_000_000 + stamp.nanosec // 1000
        start = mid - self._exposure_us // 2
        frame = ApsFrame(dn, start, start + self._exposure_us, full_scale_dn=full)
        insort(self._frames, frame, key=lambda one: one.available_us)
        if len(self._frames) > _MOST_WAITING:       # the farthest ahead
            self._frames.pop()
            self.dropped += 1
        # Events up to the end of the exposure come first, unless there are none.
        return self._waiting(frame.available_us if self._events_us is None else max(
            self._events_us, mid - HORIZON_US))

    def _waiting(self, until_us):
        """Push the images up to a time; return those that are completed by it."""
        images = []
        while self._frames and self._frames[0].available_us <= until_us:
            frame = self._frames.pop(0)
            now = max(frame.available_us, self._last_us or frame.available_us)
            images += self._push(
                Packet(frames=(frame.replace(available_us=now),)), now)
        return images

    def _begin(self, message):
        """Return the size of the sensor; the first message gives it."""
        if self._session is None:
            self._size = message.height, message.width
            info = restated(RecordingInfo(format="ROS", sensor_size=self._size),
                            SourceOptions(layout=self._layout))
            self._session = Session(info, **self._options)
        return self._size

    def _push(self, packet, now_us):
        self._last_us = now_us
        return self._session.push(packet)

    def close(self):
        """End the session."""
        if self._session is not None:
            self._session.close()


def planes(image):
    """Return what is published of an image: (topic, array, encoding) of each message.

    Parameters
    ----------
    image : PolarFrame
    """
    found = [(name, np.where(image.valid, getattr(image, name), np.nan).astype("<f4"),
              "32FC1") for name in QUANTITIES]
    picture = render.aop_bgr(image.aop, image.valid)
    render.fade_aop(picture, image, ground=render.DARK.ground)
    return [*found, ("picture", picture, "bgr8")]
