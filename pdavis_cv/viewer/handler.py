"""One connection: who may ask, what they may ask for, and how long they may take."""
from __future__ import annotations

import hmac
import io
import json
import logging
import socket
import struct
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from pdavis_cv.viewer.page import page
from pdavis_cv.viewer.panes import PANES, archive, pane, ramp, values

if TYPE_CHECKING:
    from pdavis_cv.viewer.server import Server

__all__ = ["Handler"]

_LOG = logging.getLogger(__name__)

PATIENCE_S = 10.0
"""A request must have arrived, and an answer been taken, in this time; s."""
POLL_S = 1.0
"""Where no image comes, a page is answered, and a stream repeats its last, after this
time; s."""
MOST_BODY = 65_536
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
_FILES = {"/": ("page.html", "text/html; charset=utf-8"),
          "/page.js": ("page.js", "text/javascript; charset=utf-8"),
          "/page.css": ("page.css", "text/css; charset=utf-8")}
_PUBLIC = ("/page.js", "/page.css")
"""What the page loads without a token: the same in every copy of the library."""


class _Refused(Exception):
    """A request that is not answered; status and reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class _Deadline(io.RawIOBase):
    """Bytes of a connection, all of which must arrive before a deadline.

    A socket's own timeout begins anew with each byte: then a byte at a time could
    hold a connection for ever.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.until_s = time.monotonic() + PATIENCE_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self.until_s - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request took too long")
        self._connection.settimeout(left)
        try:
            return self._connection.recv_into(buffer)
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
    def _owner(self) -> Server:
        owner: Server = self.server.owner
        return owner

    def setup(self) -> None:
        """Put a deadline on what is read."""
        super().setup()
        self._deadline = _Deadline(self.connection)
        self.rfile = io.BufferedReader(self._deadline)

    def handle_one_request(self) -> None:
        """Answer a request that arrives in time."""
        self._deadline.until_s = time.monotonic() + PATIENCE_S
        try:
            super().handle_one_request()
        except (ConnectionError, TimeoutError):
            self.close_connection = True

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log for who debugs; a token is no part of it."""
        _LOG.debug("%s %s", self.client_address[0], format.split("?")[0])

    # ---- who may ask ---------------------------------------------------------------

    def do_GET(self) -> None:
        """Answer a GET."""
        self._answer({path: self._file for path in _FILES} | {
            "/frame": self._frame, "/status": self._status,
            "/snapshot.npz": self._snapshot, "/stream.mjpg": self._stream})

    def do_POST(self) -> None:
        """Answer a POST."""
        self._answer({"/command": self._command})

    def _answer(self, known: dict[str, Callable[[], None]]) -> None:
        try:
            address = urlsplit(self.path)
            self.query = {
                name: given[-1] for name, given in parse_qs(address.query).items()}
            self.where = address.path
            self._check()
            if self.where not in known:
                raise _Refused(404, f"there is no {self.command} {self.where[:80]}")
            known[self.where]()
        except _Refused as refused:
            self._refuse(refused.status, str(refused))
        except (TypeError, ValueError, ImportError) as error:
            self._refuse(400, str(error))
        except (ConnectionError, TimeoutError):
            raise
        except OSError as error:
            self._refuse(500, str(error))

    def _check(self) -> None:
        """Refuse what a page from elsewhere, or a stranger, asks for."""
        host = self.headers.get("Host", "")
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        owner = self._owner
        if owner.token is None:
            # A name that a foreign page had resolved to this machine is not ours.
            if name not in _LOOPBACK_NAMES:
                raise _Refused(403, f"Host must be this machine, got {host[:80]!r}")
        elif self.where not in _PUBLIC:
            bearer = self.headers.get("Authorization", "").removeprefix("Bearer ")
            given = self.query.get("token", bearer)
            if not hmac.compare_digest(given.encode(), owner.token.encode()):
                raise _Refused(403, "token is wrong or missing")
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            raise _Refused(403, f"Origin must be http://{host[:80]}, got "
                                f"{origin[:80]!r}")
        # Pictures that a foreign page embeds come without Origin.
        foreign = self.headers.get("Sec-Fetch-Site") == "cross-site"
        if foreign and not (self.where == "/" and self.command == "GET"):
            raise _Refused(403, "requests of other sites are not answered")

    def _refuse(self, status: int, reason: str) -> None:
        self.close_connection = True
        self._send(json.dumps({"error": reason}).encode(), "application/json", status)

    # ---- what is answered ----------------------------------------------------------

    def _send(self, body: bytes, kind: str, status: int = 200) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _file(self) -> None:
        name, kind = _FILES[self.where]
        self._send(page(name), kind)

    def _status(self) -> None:
        told = self._owner.show.status()
        if "ramp" in self.query:        # once for each page, for its legends
            told["ramp"] = ramp()
        self._send(json.dumps(told).encode(), "application/json")

    def _snapshot(self) -> None:
        _, image = self._owner.show.latest(0, POLL_S)
        if image is None:
            raise _Refused(503, "there is no image yet")
        self._send(archive(image), "application/octet-stream")

    def _frame(self) -> None:
        """Send the next image: length of a JSON text, the text, pictures as RGB."""
        names = [name for name in self.query.get("panes", "").split(",") if name]
        if len(names) > len(PANES):
            raise ValueError(f"panes must be at most {len(PANES)}, got {len(names)}")
        after = _whole("after", self.query.get("after", "0"))
        region = self._region()
        with self._place():
            show = self._owner.show
            number, image = show.latest(after, POLL_S)
            told: dict[str, Any] = {"number": number, "panes": [],
                                    "status": show.status()}
            parts = []
            if image is not None:
                told["t_us"] = image.t_us
                for name in names:
                    picture = pane(name, show, image)
                    height, width = picture.shape[:2]
                    told["panes"].append(
                        {"name": name, "width": width, "height": height})
                    parts.append(picture[..., ::-1].tobytes())
                if region is not None:
                    told["values"] = values(image, region)
            text = json.dumps(told).encode()
            text += b" " * (-len(text) % 4)
            self._send(b"".join((struct.pack("<I", len(text)), text, *parts)),
                       "application/octet-stream")

    def _region(self) -> tuple[int, int, int, int] | None:
        text = self.query.get("region")
        if not text:
            return None
        parts = text.split(",")
        if len(parts) != 4:
            raise ValueError(f"region must be x,y,width,height, got {text[:40]!r}")
        x, y, width, height = (_whole("region", part) for part in parts)
        return x, y, width, height

    def _stream(self) -> None:
        """Send pictures one after the other; the last one again where none comes."""
        output = self.query.get("output", "bgr")
        output = "s0" if output == "bgr" else output
        with self._place():
            self.close_connection = True
            sent = 0
            for number, image in self._images():
                data = self._owner.picture(output, number, image)
                if not sent:
                    self.send_response(200)
                    for name, value in _HEADERS.items():
                        self.send_header(name, value)
                    self.send_header(
                        "Content-Type",
                        f"multipart/x-mixed-replace; boundary={BOUNDARY}")
                    self.send_header("Connection", "close")
                    self.end_headers()
                self.wfile.write(
                    f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n"
                    f"Content-Length: {len(data)}\r\n\r\n".encode() + data + b"\r\n")
                sent += 1

    def _images(self) -> Iterator[tuple[int, Any]]:
        number, last = 0, None
        while not self._owner.closing.is_set():
            due_s = time.monotonic() + POLL_S
            number, image = self._owner.show.latest(number, POLL_S)
            if image is None:       # at once where the source has ended
                self._owner.closing.wait(max(due_s - time.monotonic(), 0))
            last = last if image is None else image
            if last is not None:
                yield number, last

    def _place(self) -> _Place:
        return _Place(self._owner)

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
        self._owner.show.command(asked["do"], asked.get("value"))
        self._status()


class _Place:
    """A place among the clients that are sent pictures."""

    def __init__(self, owner: Server) -> None:
        self._owner = owner

    def __enter__(self) -> None:
        if not self._owner.clients.acquire(blocking=False):
            raise _Refused(503, "as many clients as there may be are being served")

    def __exit__(self, *exc: object) -> None:
        self._owner.clients.release()


def _whole(name: str, text: str) -> int:
    if not text.lstrip("-").isdigit() or len(text) > 15:
        raise ValueError(f"{name} must be integer, got {text[:40]!r}")
    return int(text)
