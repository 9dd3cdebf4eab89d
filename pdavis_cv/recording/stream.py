"""Sources that can be read once: packets from a generator, a socket or a camera."""
from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator

from pdavis_cv import _kernels
from pdavis_cv._checks import typed
from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE, check_inside, check_order
from pdavis_cv.recording.base import (
    Packet,
    PlainSource,
    RecordingInfo,
    Source,
    check_size,
)

_FIRST = -(2**63)
"""A time in us at or before all stamps."""


class StreamSource(PlainSource):
    """A source over an iterable of packets; see `source_from_packets`."""

    def __init__(self, info: RecordingInfo, packets: Iterable[Packet]) -> None:
        self._info = info
        self._packets, self._iterator = packets, iter(packets)
        self._lock = threading.Lock()
        self._begun = self._closed = False

    def packets(self) -> Iterator[Packet]:
        """Iterate over all packets, once; another call is a RecordingError.

        A ValueError names a packet that breaks the rules that `source_from_packets`
        states.
        """
        with self._lock:
            if self._closed:
                raise ValueError("source is closed")
            if self._begun:
                raise RecordingError(
                    "packets() of a Source can be called once, and it was called "
                    "before; a Recording can be read again")
            self._begun = True
        return self._checked()

    def _checked(self) -> Iterator[Packet]:
        last: int | None = None
        for number, packet in enumerate(self._iterator):
            if self._closed:
                raise ValueError("source is closed")
            start, stop = packet.start_us, packet.stop_us
            if start is None and packet.until_us is None:
                continue
            if start is not None and last is not None and start < last:
                raise ValueError(
                    f"packets must be in time order, but packet {number} begins at "
                    f"{start} us after a sample at {last} us")
            self._check(number, packet)
            known = (last, packet.until_us, None if stop is None else stop - 1)
            last = max(t for t in known if t is not None)
            yield packet

    def _check(self, number: int, packet: Packet) -> None:
        size, events = self._info.sensor_size, packet.events
        # The usual packet is checked in one pass; any other one below, with a message.
        good = (events.dtype == EVENT_DTYPE and events.flags.c_contiguous
                and _kernels.check_events(events, _FIRST, *size) == len(events))
        for name in ("imu", "triggers") if good else ("events", "imu", "triggers"):
            check_order(getattr(packet, name), f"{name} of packet {number}")
        if not good:
            check_inside(events, size, f" of packet {number}")
        for frame in packet.frames:
            check_size(frame, size, f"frame of packet {number}")

    def close(self) -> None:
        """Stop reading, and close the iterable if it has a close method."""
        self._closed = True
        close = getattr(self._packets, "close", None)
        if callable(close) and not getattr(self._packets, "gi_running", False):
            close()


def source_from_packets(info: RecordingInfo, packets: Iterable[Packet]) -> Source:
    """Make a source, which can be read once, from an iterable of packets.

    Parameters
    ----------
    info : RecordingInfo
        At least ``format`` and ``sensor_size``; unknown counts are None.
    packets : iterable of Packet
        Any iterable, such as a generator that reads a camera.  It is consumed while the
        source is read, and packets are not stored.  Packets must be in time order and
        not overlap, each frame at its ``available_us``; events have EVENT_DTYPE, are
        time-ordered and lie on the sensor.

    Returns
    -------
    Source

    Raises
    ------
    TypeError
        If `info` is not a RecordingInfo or `packets` cannot be iterated over.

    Examples
    --------
    >>> from pdavis_cv import RecordingInfo, source_from_packets
    >>> info = RecordingInfo(format="mine", sensor_size=(260, 346))
    >>> with source_from_packets(info, iter([])) as source:
    ...     len(list(source.packets()))
    0
    """
    typed("info", info, RecordingInfo, "a RecordingInfo")
    return StreamSource(info, packets)
