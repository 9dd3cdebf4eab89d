"""Sender of DV's network protocol: events and frames for DV and dv-processing."""
from __future__ import annotations

import logging
import select
import socket
import ssl
import threading
from collections import deque

from pdavis_cv._checks import whole_number
from pdavis_cv._types import Closing
from pdavis_cv.recording.aedat4.writer import EVENTS, FRAMES, StreamEncoder
from pdavis_cv.recording.base import Packet, RecordingInfo

_LOG = logging.getLogger(__name__)

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Addresses of this machine that no other can reach."""

MOST_BYTES = 64 * 2**20
"""Most bytes that wait for a slow client; beyond, its oldest packets are dropped."""
MOST_CLIENTS = 8
GREET_S = 5.0
"""Longest time that a client may take for the TLS handshake, s."""
SEND_S = 10.0
"""A client that receives nothing for this long is disconnected, s."""


class _Client:
    """One connection: a queue of data, and the thread that sends them."""

    def __init__(self, link: socket.socket, head: bytes) -> None:
        self.link = link
        self.dropped = 0
        self.gone = False
        self._waiting: deque[bytes] = deque([head])
        self._bytes = len(head)
        self._change = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(
            target=self._send, name="pdavis dv client", daemon=True)
        self._thread.start()

    def put(self, data: bytes) -> None:
        with self._change:
            while self._bytes + len(data) > MOST_BYTES and len(self._waiting) > 1:
                # The first item is kept: it may be the header, or half sent.
                self._bytes -= len(self._waiting[1])
                del self._waiting[1]
                self.dropped += 1
            self._waiting.append(data)
            self._bytes += len(data)
            self._change.notify()

    def _send(self) -> None:
        self.link.settimeout(SEND_S)
        try:
            while True:
                with self._change:
                    while not self._waiting:
                        if self._ended:
                            return
                        self._change.wait()
                    data = self._waiting[0]
                self.link.sendall(data)
                with self._change:
                    self._waiting.popleft()
                    self._bytes -= len(data)
        except OSError:
            pass
        finally:
            self.gone = True
            self.link.close()

    def end(self) -> None:
        """Send the waiting data, then close the connection."""
        with self._change:
            self._ended = True
            self._change.notify()
        self._thread.join()


class DvServer(Closing):
    """Sends packets to all connected clients: events, and frames on a second port.

    Parameters
    ----------
    info : RecordingInfo
        Information on the stream to send.
    events, frames : int or None
        Port, 0 = any that is free; None: not sent.
    compression : {"none", "lz4", "zstd"}
        Compression of packets.
    host : str
        Address to listen on.  Any but this machine's own addresses needs `context`.
    context : ssl.SSLContext, optional
        Result of `server_context`: connections are encrypted, and clients must show a
        certificate.

    Attributes
    ----------
    ports : dict of str to int
        Of ``"events"`` and of ``"frames"``.
    dropped : int
        Packets that were dropped because a client was slow.

    Raises
    ------
    OSError
        If a port is in use.
    ValueError
        If other machines could connect without a certificate.
    """

    def __init__(
        self, info: RecordingInfo, events: int | None = 0,
        frames: int | None = None, *, compression: str = "none",
        host: str = LOOPBACK[0], context: ssl.SSLContext | None = None,
    ) -> None:
        if host not in LOOPBACK and (
                context is None or context.verify_mode != ssl.CERT_REQUIRED):
            raise ValueError(f"host {host!r} is beyond this machine: clients need a "
                             "certificate, and so does the server")
        self._context = context
        self._greeting = threading.BoundedSemaphore(MOST_CLIENTS)
        self.ports: dict[str, int] = {}
        self._listeners: list[tuple[socket.socket, StreamEncoder]] = []
        self._clients: dict[StreamEncoder, list[_Client]] = {}
        self._lock = threading.Lock()
        self._change = threading.Condition(self._lock)
        self._closed = threading.Event()
        self.dropped = 0
        try:
            for name, stream, port in (
                    ("events", EVENTS, events), ("frames", FRAMES, frames)):
                if port is not None:
                    port = whole_number(name, port, 0, 65535)
                    link = socket.create_server((host, port), family=(
                        socket.AF_INET6 if ":" in host else socket.AF_INET))
                    encoder = StreamEncoder(stream, info, compression)
                    self._listeners.append((link, encoder))
                    self._clients[encoder] = []
                    self.ports[name] = link.getsockname()[1]
        except BaseException:
            self._hang_up()
            raise
        self._thread = threading.Thread(
            target=self._accept, name="pdavis dv server", daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        links = {link: encoder for link, encoder in self._listeners}
        while not self._closed.is_set():
            ready, _, _ = select.select(list(links), [], [], 0.1)
            for listener in ready:
                link, _ = listener.accept()
                if self._context is None:
                    self._take(link, links[listener])
                elif self._greeting.acquire(blocking=False):
                    # A silent client must not keep others waiting.
                    threading.Thread(
                        target=self._greet, args=(link, links[listener]),
                        name="pdavis dv greeting", daemon=True).start()
                else:
                    link.close()

    def _greet(self, link: socket.socket, encoder: StreamEncoder) -> None:
        """Do the TLS handshake and add the client; runs in a thread of its own."""
        assert self._context is not None
        try:
            link.settimeout(GREET_S)
            try:
                safe = self._context.wrap_socket(link, server_side=True)
            except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
                _LOG.info("a client was refused: %s", error)
                link.close()
                return
            self._take(safe, encoder)
        finally:
            self._greeting.release()

    def _take(self, link: socket.socket, encoder: StreamEncoder) -> None:
        with self._change:
            known = self._clients[encoder]
            known[:] = [client for client in known if not client.gone]
            if len(known) >= MOST_CLIENTS or self._closed.is_set():
                link.close()
                return
            known.append(_Client(link, encoder.head))
            self._change.notify_all()

    def wait_for_clients(self, timeout: float | None = None) -> bool:
        """Wait until each stream has a client; return False after the timeout.

        Parameters
        ----------
        timeout : float, optional
            Longest wait, s.
        """
        with self._change:
            return self._change.wait_for(lambda: all(self._clients.values()), timeout)

    def add(self, packet: Packet) -> None:
        """Send a packet to all clients.

        Parameters
        ----------
        packet : Packet
            Packet to send.
        """
        for _, encoder in self._listeners:
            with self._lock:
                clients = list(self._clients[encoder])
            if not clients:
                continue
            for data in encoder.encoded(packet):
                for client in clients:
                    client.put(data)

    def close(self) -> None:
        """Send the waiting packets, and stop."""
        self._closed.set()
        self._thread.join()
        for clients in self._clients.values():
            for client in clients:
                client.end()
                self.dropped += client.dropped
        self._hang_up()

    def _hang_up(self) -> None:
        for link, _ in self._listeners:
            link.close()
