"""Handler of one connection: access checks, requests and time limits."""
from __future__ import annotations

import contextlib
import functools
import hmac
import io
import json
import logging
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import QUANTITIES
from pdavis_cv.viewer.panes import (
    archive,
    levels_of,
    missing,
    palettes,
    planes,
    saturated,
)
from pdavis_cv.viewer.regions import MOST_REGIONS, Region, values
from pdavis_cv.viewer.site import Site
from pdavis_cv.viewer.socket import accepted_key, binary, closing, received

_LOG = logging.getLogger(__name__)

PATIENCE_S = 10.0
"""Longest time for a request to arrive, and for an answer to be received, s."""
LINGER_S = 1.0
"""Longest time for which a connection that is closed is still read, s."""
POLL_S = 1.0
"""Longest wait for an image, s; after it a page gets an answer without one, and a
stream repeats its last picture."""
LOOK_S = 0.05
"""Interval at which a waiting page is checked for a new request, s."""
MOST_BODY = 65_536
MOST_WHOLE = 10**15
BOUNDARY = "pdavis"
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_HEADERS = {
    # Nothing from elsewhere; a notebook of this machine may frame the page.
    "Content-Security-Policy":
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'self' http://localhost:* http://127.0.0.1:*",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",       # a token stands in the page's address
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_SCRIPTS = ("pictures.js", "regions.js", "page.js")
_FILES = {"/": ("page.html", "text/html; charset=utf-8"),
          "/page.css": ("page.css", "text/css; charset=utf-8"),
          **{f"/{name}": (name, "text/javascript; charset=utf-8")
             for name in _SCRIPTS}}
_PUBLIC = tuple(_FILES.keys() - {"/"})
"""Files that are served without a token, as every copy of the library has them."""


@functools.cache
def _file(name: str) -> bytes:
    """Return a file of the page, which is in the package."""
    return files("pdavis_cv.viewer").joinpath(name).read_bytes()


class _Refused(Exception):
    """A request that is refused, with HTTP status and reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class _Deadline(io.RawIOBase):
    """Byte stream of a connection with a deadline for all of it.

    A socket's own timeout restarts with each byte, so that a client sending single
    bytes could hold a connection for ever.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.until_s = time.monotonic() + PATIENCE_S
        self.waits = True

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        left = self.until_s - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request took too long")
        self._connection.settimeout(left if self.waits else 0)
        try:
            return self._connection.recv_into(buffer)
        except (BlockingIOError, ssl.SSLWantReadError):
            return None
        finally:
            self._connection.settimeout(PATIENCE_S)


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "pdavis_cv", ""
    timeout = PATIENCE_S
    disable_nagle_algorithm = True
    server: Any

    @property
    def _site(self) -> Site:
        site: Site = self.server.site
        return site

    def setup(self) -> None:
        """Set up reading with a deadline."""
        super().setup()
        self._deadline = _Deadline(self.connection)
        self.rfile = self._buffered = io.BufferedReader(self._deadline)

    def finish(self) -> None:
        """Send what is left, and receive what the client still sends.

        The system resets a connection that is closed with bytes unread, and the client
        may then lose the answer that tells it why.
        """
        super().finish()
        until_s = time.monotonic() + LINGER_S
        with contextlib.suppress(OSError, ValueError):
            self.connection.shutdown(socket.SHUT_WR)
            while not self._site.closing.is_set() and (
                    left := until_s - time.monotonic()) > 0:
                self.connection.settimeout(left)
                if not self.connection.recv(1 << 16):
                    return

    def handle_one_request(self) -> None:
        """Answer the next request; close the connection if it is late."""
        self._deadline.until_s = time.monotonic() + PATIENCE_S
        try:
            super().handle_one_request()
        except (ConnectionError, TimeoutError):
            self.close_connection = True

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log a request at debug level, without the token."""
        _LOG.debug("%s %s", self.client_address[0], format.split("?")[0])

    # ---- who may ask ---------------------------------------------------------------

    def do_GET(self) -> None:
        """Answer a GET."""
        self._answer(self._readable() | {"/images": self._images_asked})

    def do_HEAD(self) -> None:
        """Answer a HEAD: as a GET, without the body."""
        self._answer(self._readable())

    def do_POST(self) -> None:
        """Answer a POST."""
        self._answer({"/command": self._command})

    def _readable(self) -> dict[str, Callable[[], None]]:
        return {path: self._file for path in _FILES} | {
            "/status": self._status,
            "/snapshot.npz": self._snapshot, "/stream.mjpg": self._stream}

    def _answer(self, known: dict[str, Callable[[], None]]) -> None:
        try:
            address = urlsplit(self.path)
            self.query = {
                name: given[-1] for name, given in parse_qs(address.query).items()}
            self.where = address.path
            self._check()
            if self.where not in known:
                raise _Refused(404, f"there is no {self.command} {self.where[:80]}")
            self.server.note(self.connection, True)
            known[self.where]()
            self.server.note(self.connection, False)
        except _Refused as refused:
            self._refuse(refused.status, str(refused))
        except (TypeError, ValueError, ImportError) as error:
            self._refuse(400, str(error))
        except (ConnectionError, TimeoutError):
            raise
        except OSError as error:
            self._refuse(500, str(error))

    def _check(self) -> None:
        """Refuse requests of other sites' pages and of clients without the token."""
        host = self.headers.get("Host", "")
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        site = self._site
        if site.token is None:
            # Another site's name that resolves to this machine (DNS rebinding).
            if name not in _LOOPBACK_NAMES:
                raise _Refused(403, f"Host must be this machine, got {host[:80]!r}")
        elif self.where not in _PUBLIC:
            bearer = self.headers.get("Authorization", "").removeprefix("Bearer ")
            given = self.query.get("token", bearer)
            if not hmac.compare_digest(given.encode(), site.token.encode()):
                raise _Refused(403, "token is wrong or missing")
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"{site.scheme}://{host}":
            raise _Refused(403, f"Origin must be {site.scheme}://{host[:80]}, got "
                                f"{origin[:80]!r}")
        # Requests for pictures that another site's page embeds have no Origin.
        foreign = self.headers.get("Sec-Fetch-Site") == "cross-site"
        if foreign and not (self.where == "/" and self.command in ("GET", "HEAD")):
            raise _Refused(403, "requests of other sites are not answered")

    def _refuse(self, status: int, reason: str) -> None:
        self.close_connection = True
        self._send(json.dumps({"error": reason}).encode(), "application/json", status)

    # ---- what is answered ----------------------------------------------------------

    def _send(self, body: bytes, kind: str, status: int = 200) -> None:
        headers = {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}
        if self.close_connection:
            headers["Connection"] = "close"
        self._begin(status, headers)
        if self.command != "HEAD":
            self.wfile.write(body)

    def _begin(self, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def _file(self) -> None:
        name, kind = _FILES[self.where]
        self._send(_file(name), kind)

    def _status(self) -> None:
        told = self._site.show.status()
        if "palettes" in self.query:        # once for each page
            told["palettes"] = palettes()
        self._send(json.dumps(told).encode(), "application/json")

    def _snapshot(self) -> None:
        _, image = self._site.show.latest(0, POLL_S)
        if image is None:
            raise _Refused(503, "there is no image yet")
        self._send(archive(image), "application/octet-stream")

    def _images_asked(self) -> None:
        """Send an image for each request over a WebSocket, until the page is gone."""
        key = accepted_key(dict(self.headers.items()))
        with self._place(self._site.pages):
            self.close_connection = True
            self._begin(101, {"Upgrade": "websocket", "Connection": "Upgrade",
                              "Sec-WebSocket-Accept": key})
            try:
                while (text := self._message()) is not None:
                    asked = _Asked.of(json.loads(text))
                    found = self._image(asked)
                    if found is None:
                        continue
                    parts = self._parts(asked, *found)
                    self.connection.settimeout(PATIENCE_S)
                    self.wfile.write(b"".join(
                        (binary(sum(memoryview(part).nbytes for part in parts)),
                         *parts)))
            except (ImportError, RecursionError, ValueError) as error:
                self.wfile.write(closing(str(error)))

    def _message(self) -> bytes | None:
        if self._site.closing.is_set():
            return None
        self._deadline.until_s = time.monotonic() + PATIENCE_S
        return received(self._buffered)

    def _image(self, asked: _Asked) -> tuple[int, PolarFrame | None] | None:
        """Wait for an image; return None if the page sends a new request first."""
        due_s = time.monotonic() + POLL_S
        while True:
            found = self._site.show.latest(asked.after, LOOK_S)
            if found[1] is not None:
                return found
            if self._heard():
                return None
            left = due_s - time.monotonic()
            if left <= 0 or self._site.closing.is_set():
                return found
            if self._site.show.over:       # `latest` returns at once
                self._site.closing.wait(min(left, LOOK_S))

    def _heard(self) -> bool:
        """Tell whether the client has sent something."""
        self._deadline.waits = False
        try:
            return bool(self._buffered.peek(1))
        finally:
            self._deadline.waits = True

    def _parts(
        self, asked: _Asked, number: int, image: PolarFrame | None
    ) -> list[bytes | memoryview]:
        """Return an image in the page's format.

        This is the length of a JSON text, the text, and the planes that it names, with
        one byte per pixel.
        """
        show = self._site.show
        told: dict[str, Any] = {"number": number, "id": asked.id, "planes": [],
                                "status": show.status()}
        parts: list[bytes | memoryview] = []
        if image is not None:
            assert image.t_us is not None       # of fuse(), each has a time
            told["t_us"] = image.t_us
            told["height"], told["width"] = image.s0.shape
            told["missing"] = missing(asked.panes, image)
            told["levels"] = levels = asked.levels or levels_of(show, image)
            told["saturated"] = saturated(show, image)
            told["events_per_s"] = len(show.events(image.t_us)) / show.period_us * 1e6
            for name, plane in planes(asked.panes, show, image, levels).items():
                told["planes"].append(name)
                parts.append(plane.data)
            told["values"] = values(image, asked.regions)
        text = json.dumps(told).encode()
        text += b" " * (-len(text) % 4)
        return [struct.pack("<I", len(text)), text, *parts]

    def _stream(self) -> None:
        """Send pictures one after the other; repeat the last one if none comes."""
        output = self.query.get("output", "bgr")
        with self._place(self._site.players):
            self.close_connection = True
            sent = 0
            for number, image in self._images():
                data = self._site.picture(output, number, image)
                if not sent:
                    self._begin(200, {
                        **_HEADERS, "Content-Type":
                        f"multipart/x-mixed-replace; boundary={BOUNDARY}",
                        "Connection": "close"})
                if self.command == "HEAD":
                    return
                self.wfile.write(
                    f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n"
                    f"Content-Length: {len(data)}\r\n\r\n".encode() + data + b"\r\n")
                sent += 1

    def _images(self) -> Iterator[tuple[int, Any]]:
        number, last = 0, None
        while not self._site.closing.is_set():
            due_s = time.monotonic() + POLL_S
            number, image = self._site.show.latest(number, POLL_S)
            if image is None:       # returned at once if the source has ended
                self._site.closing.wait(max(due_s - time.monotonic(), 0))
            last = last if image is None else image
            if last is not None:
                yield number, last

    @contextlib.contextmanager
    def _place(self, places: threading.BoundedSemaphore) -> Iterator[None]:
        """Take one of the places for clients that get pictures."""
        if not places.acquire(blocking=False):
            raise _Refused(503, "as many clients as there may be are being served")
        try:
            yield
        finally:
            places.release()

    def _command(self) -> None:
        kind = self.headers.get("Content-Type", "").partition(";")[0]
        if kind != "application/json":
            raise _Refused(415, f"Content-Type must be application/json, got {kind!r}")
        length = self.headers.get("Content-Length", "")
        if not length.isdigit():
            raise _Refused(411, "Content-Length is needed")
        if int(length) > MOST_BODY:
            raise _Refused(413, f"a body is at most {MOST_BODY} bytes, got {length}")
        try:
            asked = json.loads(self.rfile.read(int(length)))
        except RecursionError:
            raise ValueError("the body is nested too deeply") from None
        if not isinstance(asked, dict) or not isinstance(asked.get("do"), str):
            raise ValueError('the body must be {"do": name, "value": ...}')
        self._site.show.command(asked["do"], asked.get("value"))
        self._status()


@dataclass(frozen=True)
class _Asked:
    """A page's request.

    The number of its last image, the panes to draw, regions in sensor pixels, and the
    values of S0 to show black and white (None: those of the image itself).
    """

    after: int
    panes: tuple[str, ...]
    regions: tuple[Region, ...]
    levels: tuple[float, float] | None
    id: int

    @classmethod
    def of(cls, given: Any) -> _Asked:
        """Parse a request from a JSON value; raise ValueError if it is invalid."""
        if not isinstance(given, dict):
            raise ValueError('what is asked for must be {"after": number, ...}')
        panes, regions = (_listed(name, given, most) for name, most in (
            ("panes", len(QUANTITIES)), ("regions", MOST_REGIONS)))
        if not all(isinstance(name, str) for name in panes):
            raise ValueError("panes must be a list of names")
        return cls(_integer("after", given.get("after", 0)), tuple(panes),
                   tuple(_region(one) for one in regions),
                   _levels(given.get("levels")), _integer("id", given.get("id", 0)))


def _listed(name: str, given: dict[str, Any], most: int) -> list[Any]:
    value = given.get(name, [])
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list, got {str(value)[:40]!r}")
    if len(value) > most:
        raise ValueError(f"{name} must be at most {most}, got {len(value)}")
    return value


def _region(given: Any) -> Region:
    if not isinstance(given, list) or len(given) != 4:
        raise ValueError(f"regions must be x,y,width,height, got {str(given)[:40]!r}")
    x, y, width, height = (_integer("regions", part) for part in given)
    if width < 1 or height < 1:
        raise ValueError(f"regions must not be empty, got {width}x{height}")
    return x, y, width, height


def _levels(given: Any) -> tuple[float, float] | None:
    if given is None:
        return None
    if not isinstance(given, list) or len(given) != 2 or not all(
            isinstance(value, (int, float)) and abs(value) < MOST_WHOLE
            for value in given) or not given[0] < given[1]:
        raise ValueError("levels must be two numbers, black below white, got "
                         f"{str(given)[:40]!r}")
    return float(given[0]), float(given[1])


def _integer(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > MOST_WHOLE:
        raise ValueError(f"{name} must be integer, got {str(value)[:40]!r}")
    return value
