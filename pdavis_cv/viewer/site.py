"""What the connections of one server share."""
from __future__ import annotations

import ssl
import threading

from pdavis_cv.capture.outputs import output_named
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.viewer.panes import jpeg, pane
from pdavis_cv.viewer.show import Show

MOST_CLIENTS = 8
"""Most pages, and most players, that get pictures at the same time: a player that does
not read what it is sent keeps its place, while a page asks for each image."""


class Site:
    """What is shown, to whom, and how it is sent.

    Requests must contain the token; None: this machine's own only.  With a TLS context,
    connections are encrypted.
    """

    def __init__(
        self, show: Show, token: str | None, context: ssl.SSLContext | None
    ) -> None:
        self.show, self.token, self.context = show, token, context
        self.closing = threading.Event()
        self.pages, self.players = (
            threading.BoundedSemaphore(MOST_CLIENTS) for _ in range(2))
        self._jpegs: dict[str, tuple[int, bytes]] = {}
        self._encoding = threading.Lock()

    @property
    def scheme(self) -> str:
        """Scheme of the page's address, http or https."""
        return "http" if self.context is None else "https"

    def picture(self, output: str, number: int, image: PolarFrame) -> bytes:
        """Return a picture as JPEG, encoded once for all clients."""
        output = output_named(output).name
        with self._encoding:
            known = self._jpegs.get(output)
            if known is None or known[0] != number:
                known = number, jpeg(pane(output, self.show, image))
                self._jpegs[output] = known
            return known[1]
