"""Receiver of DV's network protocol, as DV and dv-processing send it.

A connection carries one stream: the header of an AEDAT-4 file without its magic, then
packets of int32 stream, int32 size and payload.  Frames come on a second connection.
"""
from __future__ import annotations

import contextlib
import math
import queue
import socket
import ssl
import struct
import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import whole_number
from pdavis_cv._types import Events
from pdavis_cv.errors import DeviceError, RecordingError
from pdavis_cv.events import FAR
from pdavis_cv.live.base import HEARTBEAT_S, Address, LiveSource
from pdavis_cv.live.inbox import MOST_BYTES
from pdavis_cv.live.replay import pieces
from pdavis_cv.live.tls import client_context
from pdavis_cv.recording.aedat4 import samples
from pdavis_cv.recording.aedat4.container import (
    MAX_HEADER,
    MAX_PAYLOAD,
    Stream,
    decompressed,
    parsed_header,
)
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError, Table
from pdavis_cv.recording.base import ApsFrame, Packet, RecordingInfo
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.options import MAX_SIDE
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.timeline import (
    BACKWARD,
    BEFORE,
    FILLED,
    NEVER,
    OUTSIDE,
    SEGMENT_US,
    Clock,
)
from pdavis_cv.sensor import Layout, Sensor

CONNECT_S = 5.0
MARGIN_US = 100_000
"""Assumed delay of the sender while nothing arrives, us: DV sends batches of 10 ms, and
the network delays them.  The stream's time then follows the host's by this much."""
_MOST_WAITING = 2
"""Packets that may wait to be decoded; then the sender waits."""
_FRAME_BYTES = 1 << 10
"""Memory of a frame beside its pixels."""
_PACKET = struct.Struct("<ii")
_Item = tuple[str, memoryview, str] | DeviceError | None
"""Kind, payload and compression of a packet; an error, or None, ends a connection."""


class _Connection:
    """One connection, whose packets are read in a thread of its own."""

    def __init__(self, link: socket.socket, name: str) -> None:
        self.link, self.name = link, name
        self._due_s: float | None = time.monotonic() + CONNECT_S
        size = int.from_bytes(self._exactly(4), "little")
        if not 16 <= size <= MAX_HEADER:
            raise DeviceError(f"{name}: this is no dv stream: its header cannot be "
                              f"{size} bytes long")
        data = struct.pack("<I", size) + self._exactly(size)
        try:
            self.compression, _, streams = parsed_header(data)
        except ValueError as error:
            raise DeviceError(f"{name}: this is no dv stream: {error}") from error
        if not streams:
            raise DeviceError(f"{name}: the header names no stream")
        self.streams: dict[int, Stream] = streams
        link.settimeout(None)
        self._due_s = None

    def _received(self, count: int) -> memoryview:
        """Return the next bytes; fewer only if the sender closed the connection."""
        # Memory that is only announced is not written to.
        data, done = np.empty(count, np.uint8).data, 0
        while done < count and (got := self.link.recv_into(data[done:])):
            done += got
            if self._due_s is not None and time.monotonic() > self._due_s:
                raise DeviceError(f"{self.name}: its header takes too long")
        return data[:done]

    def _exactly(self, count: int) -> bytes:
        data = self._received(count)
        if len(data) < count:
            raise DeviceError(f"{self.name}: the sender closed the connection")
        return bytes(data)

    def read(self, put: Callable[[_Item], None]) -> None:
        """Pass on each packet, at the end the error or the end of the connection."""
        end = None
        try:
            while len(head := self._received(_PACKET.size)) == _PACKET.size:
                number, size = _PACKET.unpack(head)
                if not 0 <= size <= MAX_PAYLOAD:
                    raise DeviceError(f"{self.name}: a packet cannot hold {size} bytes")
                payload = self._received(size)
                if len(payload) == size and number in self.streams:
                    put((self.streams[number].kind, payload, self.compression))
        except DeviceError as error:
            end = error
        except (OSError, ValueError) as error:  # ValueError: TLS, closed meanwhile
            end = DeviceError(f"{self.name}: the connection broke: {error}")
        put(end)


class DvSource(LiveSource):
    """Source of the streams that DV sends: events, and frames on a second connection.

    The connections, which are closed with the source, are not synchronized.  A frame
    waits until events have reached the end of its readout; a frame that arrives later
    than that is stamped as available when it arrived.
    """

    def __init__(self, name: str, connections: list[socket.socket]) -> None:
        self._connections = [_Connection(link, name) for link in connections]
        super().__init__(self._facts(name), name)
        self._clock = Clock(None)
        self._scale: samples.FrameScale | None = None
        self._last_us: int | None = None
        self._held: deque[ApsFrame] = deque()   # until events reach their time
        self._budget = Budget(name)

    def _facts(self, name: str) -> RecordingInfo:
        streams = [stream for one in self._connections
                   for stream in one.streams.values()]
        kinds = {stream.kind for stream in streams}
        first = streams[0]
        try:
            size = int(first.attributes["sizeY"]), int(first.attributes["sizeX"])
        except (KeyError, ValueError):
            raise DeviceError(f"{name}: the header gives no sensor size") from None
        if not all(0 < side <= MAX_SIDE for side in size):
            raise DeviceError(f"{name}: sensor sides must lie in 1..{MAX_SIDE}, the "
                              f"header says {size[1]}x{size[0]}")
        text, owner = next((
            (s.attributes["polarizerLayout"], s.attributes.get("polarizerSensor"))
            for s in streams if "polarizerLayout" in s.attributes), (None, None))
        try:
            layout = None if text is None else Layout.stored(text, owner)
        except ValueError as error:
            raise DeviceError(f"{name}: polarizerLayout {text!r}: {error}") from None
        return RecordingInfo(
            format="dv stream", sensor_size=size, layout=layout,
            camera=first.source or None,
            sensor=(layout and layout.sensor) or Sensor.of_chip(first.source),
            frame_times="time stamps", event_count=None if "EVTS" in kinds else 0,
            frame_count=None if "FRME" in kinds else 0)

    def _arrivals(self) -> Iterator[Packet]:
        items: queue.Queue[_Item] = queue.Queue(_MOST_WAITING)

        def put(item: _Item) -> None:
            while not self._closed.is_set():
                with contextlib.suppress(queue.Full):
                    return items.put(item, timeout=HEARTBEAT_S)

        for one in self._connections:
            threading.Thread(target=one.read, args=(put,), daemon=True,
                             name="pdavis dv connection").start()
        open_, heard_s = len(self._connections), time.monotonic()
        while open_ and not self._closed.is_set():
            try:
                item = items.get(timeout=HEARTBEAT_S)
            except queue.Empty:
                passed = int(1e6 * (time.monotonic() - heard_s)) - MARGIN_US
                if self._last_us is not None and passed > 0:
                    yield from self._released(self._last_us + passed)
                    yield Packet(until_us=self._last_us + passed)
                continue
            if isinstance(item, DeviceError):
                raise item
            if item is None:
                open_ -= 1
                continue
            heard_s = time.monotonic()
            yield from self._packets(*item)
        yield from self._released(None)

    def _packets(
        self, kind: str, payload: memoryview, compression: str
    ) -> Iterator[Packet]:
        try:
            # Events without compression are decoded from where they were received.
            table = Table(
                payload if (kind, compression) == ("EVTS", "none") else
                decompressed(payload, compression, self._budget), kind.encode())
            if kind == "EVTS":
                yield from self._of_events(table.data, *table.vector(0, samples.EVENT))
            elif kind == "FRME":
                self._held.append(self._frame(table))
                if len(self._held) > max(1, MOST_BYTES // (
                        _FRAME_BYTES + 4 * math.prod(self.info.sensor_size))):
                    self._held.popleft()
                    self._log.add("frames ahead", None, "frames were dropped that came "
                                  "too far ahead of the events")
                if self.info.event_count == 0:
                    yield from self._released(None)
            elif kind == "IMUS":
                yield from pieces(Packet(imu=_sorted(samples.imu_samples(table))))
            elif kind == "TRIG":
                yield from pieces(Packet(triggers=_sorted(samples.triggers(table))))
        except PayloadError as error:
            self._log.add("damage", None, f"a packet could not be read: {error}")
        except RecordingError as error:     # a limit is passed, or a package missing
            raise DeviceError(str(error)) from error

    def _of_events(
        self, data: bytes | memoryview, at: int, count: int
    ) -> Iterator[Packet]:
        clock = self._clock
        out = clock.room(Scratch(), count)
        _kernels.aedat4_events(
            data, at, count, *self.info.sensor_size, False, NEVER, -NEVER, clock.state,
            out)
        found = out["t"][:int(clock.state[FILLED])]
        if len(found) and clock.last - int(np.median(found)) > SEGMENT_US:
            clock.state[BEFORE] = NEVER     # it was reset: a new segment
        events = clock.settled(out, final=True)
        for number, what in ((OUTSIDE, "outside the sensor"),
                             (BACKWARD, "that came late")):
            if clock.state[number]:
                self._log.add(what, None, f"events {what} were dropped",
                              count=int(clock.state[number]))
        if len(events):
            yield from self._with_frames(events)

    def _frame(self, table: Table) -> ApsFrame:
        raw = samples.raw_frame(table)
        if self._scale is None or self._scale.itemsize != raw.pixels.dtype.itemsize:
            self._scale = samples.scale_of(raw.pixels)
        times = samples.exposure_times(raw.times)
        frame = samples.aps_frame(raw, self._scale, times, self.info.sensor_size)
        if self._last_us is not None and self._last_us > frame.available_us:
            return frame.replace(available_us=self._last_us)
        return frame

    def _with_frames(self, events: Events) -> Iterator[Packet]:
        """Yield events, and among them the frames that are available by then."""
        while self._held and self._held[0].available_us <= events["t"][-1]:
            n = bisect_left(events["t"], self._held[0].available_us)
            yield from pieces(Packet(events[:n]))
            self._last_us = int(events["t"][n])
            yield Packet(frames=(self._held.popleft(),))
            events = events[n:]
        self._last_us = int(events["t"][-1])
        yield from pieces(Packet(events))

    def _released(self, until_us: int | None) -> Iterator[Packet]:
        """Yield the waiting frames that are available up to a time."""
        while self._held and (
                until_us is None or self._held[0].available_us <= until_us):
            yield Packet(frames=(self._held.popleft(),))

    def close(self) -> None:
        """Stop, and close the connections."""
        super().close()
        for one in self._connections:
            with contextlib.suppress(OSError):      # not connected any more
                one.link.shutdown(socket.SHUT_RDWR)     # wakes the thread that reads
            one.link.close()


def _sorted(found: NDArray[Any]) -> Events:
    """Return samples in order of time, without those at impossible times."""
    found = found[np.abs(found["t"]) < FAR]
    return found[np.argsort(found["t"], kind="stable")]


def open_tcp(address: Address, *, frames: int = 0) -> DvSource:
    """Open ``dv+tcp://HOST:PORT``; `frames` is a second port."""
    return _connected(address, frames, lambda link, host: link)


def open_tls(
    address: Address, *, frames: int = 0, certificate: str = "", key: str = "",
    authority: str = "", check_name: bool = True,
) -> DvSource:
    """Open ``dv+tls://HOST:PORT?certificate=PEM&key=PEM&authority=PEM``."""
    for name, file in (("certificate", certificate), ("key", key),
                       ("authority", authority)):
        if not file:
            raise ValueError(f"{name}=FILE is needed: the sender and this side show "
                             "each other certificates")
    context = client_context(certificate, key, authority, check_name)
    return _connected(address, frames, lambda link, host: context.wrap_socket(
        link, server_hostname=host))


def _connected(
    address: Address, frames: int,
    greet: Callable[[socket.socket, str], socket.socket],
) -> DvSource:
    host, _, port = address.target.removeprefix("//").rstrip("/").rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError("//HOST:PORT is needed after the first colon")
    host = host.strip("[]")
    ports = [whole_number("port", each, 1, 65535)
             for each in (int(port), *([frames] if frames else []))]
    links: list[socket.socket] = []
    try:
        for number in ports:
            links.append(socket.create_connection((host, number), CONNECT_S))
            links[-1] = greet(links[-1], host)
        return DvSource(address.text, links)
    except BaseException as error:
        for link in links:
            link.close()
        if isinstance(error, ssl.SSLError):
            raise DeviceError(f"{address.text}: no trust: {_refusal(error)}") from error
        if isinstance(error, OSError) and not isinstance(error, DeviceError):
            raise DeviceError(f"{address.text}: cannot be reached: {error}") from error
        raise


def _refusal(error: ssl.SSLError) -> str:
    """Return in one line why one side does not trust the other."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the sender's certificate: {error.verify_message.rstrip('.')}"
    reason = (error.reason or str(error)).replace("_", " ").lower()
    return f"the sender refused this side: {reason}" if "alert" in reason else reason
