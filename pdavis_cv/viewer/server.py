"""serve(): the page and the stream of pictures, from the standard library's server."""
from __future__ import annotations

import contextlib
import os
import secrets
import socket
import ssl
import threading
from http.server import ThreadingHTTPServer
from typing import Any, Unpack

from pdavis_cv._checks import whole_number
from pdavis_cv._types import Closing
from pdavis_cv.fusion.options import AllKeywords
from pdavis_cv.live import LOOPBACK
from pdavis_cv.viewer.handler import PATIENCE_S, Handler
from pdavis_cv.viewer.show import Show, show_of
from pdavis_cv.viewer.site import Site

PORT = 8346
MOST_CONNECTIONS = 64
"""Most connections of any kind; of more, those are closed that ask for nothing."""


class _Listener(ThreadingHTTPServer):
    """Accepts connections, at most `MOST_CONNECTIONS` at a time.

    A further one takes the place of the one that has been silent the longest:
    otherwise clients that ask for nothing would lock out all others.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], site: Site) -> None:
        self.site = site
        self._lock = threading.Lock()
        self._open: dict[Any, bool] = {}    # whether each is being answered, in order
        super().__init__(address, Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Accept a connection, unless too many are being answered."""
        with self._lock:
            if len(self._open) >= MOST_CONNECTIONS:
                oldest = next((one for one, busy in self._open.items() if not busy),
                              None)
                if oldest is None:
                    self.shutdown_request(request)
                    return
                del self._open[oldest]
                with contextlib.suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)       # wakes its thread
            self._open[request] = False
        super().process_request(request, client_address)

    def note(self, request: Any, busy: bool) -> None:
        """Note that a connection is being answered from now on, or silent."""
        with self._lock:
            if self._open.pop(request, None) is not None:
                self._open[request] = busy

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection in its own thread."""
        try:
            if self.site.context is not None:
                try:
                    request.settimeout(PATIENCE_S)
                    link = self.site.context.wrap_socket(request, server_side=True)
                except (OSError, ValueError):   # ssl.SSLError is an OSError
                    self.shutdown_request(request)
                    return
                with self._lock:
                    if self._open.pop(request, None) is not None:
                        self._open[link] = False
                request = link
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of a connection: a client may leave at any time."""


class Server(Closing):
    """A page and a stream of pictures; `serve` makes it.

    Use as a context manager, or call `close`.  In a notebook it shows the page.

    Parameters
    ----------
    show : Show
        Closed with the server.
    host : str
    port : int
        0 = any that is free.
    token : str or None
        Token that requests must contain; needed unless `host` is a loopback address.
    context : ssl.SSLContext or None
        TLS context for encrypted connections.

    Attributes
    ----------
    url : str
        Address of the page.
    """

    def __init__(
        self, show: Show, host: str, port: int, token: str | None,
        context: ssl.SSLContext | None = None,
    ) -> None:
        self.host, self.site = host, Site(show, token, context)
        self._listener = _Listener((host, port), self.site)
        self.port = int(self._listener.server_address[1])
        self._thread = threading.Thread(
            target=self._listener.serve_forever, kwargs={"poll_interval": 0.1},
            name="pdavis server", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        token = self.site.token
        return f"{self.site.scheme}://{host}:{self.port}/" + (
            "" if token is None else f"?token={token}")

    def close(self) -> None:
        """Stop answering, and stop what is shown."""
        self.site.closing.set()
        self._listener.shutdown()
        self._listener.server_close()
        self._thread.join()
        self.site.show.close()

    def wait(self) -> None:
        """Serve until `close` is called, or an interrupt."""
        while not self.site.closing.wait(3600):
            pass

    def _repr_html_(self) -> str:
        return (f'<iframe src="{self.url}" width="100%" height="640" '
                'style="border:0"></iframe>')


def serve(
    where: Any, *, host: str = "127.0.0.1", port: int = PORT,
    record_to: str | os.PathLike[str] = ".", context: ssl.SSLContext | None = None,
    **fuse_parameters: Unpack[AllKeywords],
) -> Server:
    """Show a recording or a live source in browsers, and stream it as MJPEG.

    The page is at ``http://127.0.0.1:8346/``; ``/stream.mjpg?output=aop_bgr`` there
    opens in ``cv2.VideoCapture`` and other players.  Returns at once.

    Parameters
    ----------
    where : path, address, Source or Session
        As in `open_source`; a Session stays the caller's.
    host : str
        Address to answer on.  Any other than this machine's own makes a random token,
        part of ``Server.url``, without which nothing is answered.
    port : int
        0 = any that is free.
    record_to : path
        Folder for what the page's button records.
    context : ssl.SSLContext, optional
        Of a server, with its certificate: what is sent is encrypted.
    **fuse_parameters
        Options of `fuse`; 60 images per second by default.

    Returns
    -------
    Server

    Raises
    ------
    OSError
        If the source cannot be opened, or the port is taken.
    TypeError, ValueError
        If an option does not fit.

    Examples
    --------
    >>> from pdavis_cv import Layout, serve
    >>> from pdavis_cv.data import example_recording
    >>> with serve(example_recording(), port=0, layout=Layout.PDAVIS) as server:
    ...     server.url.startswith("http://127.0.0.1:")
    True
    """
    port = whole_number("port", port, 0, 65535)
    token = None if host in LOOPBACK else secrets.token_urlsafe(16)
    show = show_of(where, record_to, dict(fuse_parameters))
    try:
        return Server(show, host, port, token, context)
    except BaseException:
        show.close()
        raise


def view(where: Any, **fuse_parameters: Unpack[AllKeywords]) -> Server:
    """Show a recording or a live source in a notebook; `serve` on any free port.

    Parameters
    ----------
    where : path, address, Source or Session
    **fuse_parameters
        As in `serve`.

    Returns
    -------
    Server
        A notebook shows it as the page.
    """
    return serve(where, port=0, **fuse_parameters)
