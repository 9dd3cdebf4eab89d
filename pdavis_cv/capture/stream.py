"""A cursor for live sources, whose images come once and have no positions."""
from __future__ import annotations

from typing import NoReturn

from pdavis_cv.capture.seeking import Bookmark
from pdavis_cv.fusion import Fusion
from pdavis_cv.live import Session
from pdavis_cv.polarimetry import PolarFrame


class LiveCursor:
    """The images of a live session; the counterpart of `Cursor` for files.

    From now on only the cursor may use the session; `timeout_s` is the longest time to
    wait for an image, s.
    """

    count = -1
    """Number of images: unknown, for which cv2 returns -1."""

    def __init__(self, session: Session, timeout_s: float) -> None:
        self.session, self.timeout_s = session, timeout_s
        self.index = 0
        self.t_us: int | None = None
        self.start_us: int | None = None
        self.previous_us: int | None = None
        self._image: PolarFrame | None = None

    @property
    def fusion(self) -> Fusion:
        """The Fusion that makes the images."""
        return self.session.fusion

    @property
    def fps(self) -> float:
        """Images per second of the stream."""
        return float(self.session.options.fps or 0.0)

    def advance(self) -> bool:
        """Wait for the next image; return False at the end of the stream.

        After a TimeoutError, that none came in time, the call may be repeated.
        """
        image = self.session.read(self.timeout_s)
        if image is None:
            return False
        self._image, self.previous_us, self.t_us = image, self.t_us, image.t_us
        self.start_us = self.t_us if self.start_us is None else self.start_us
        self.index += 1
        return True

    def image(self) -> PolarFrame:
        """Return the image that `advance` waited for."""
        assert self._image is not None
        return self._image

    def seek(self, index: int) -> int:
        """Do nothing if index is the current position; any other is a ValueError."""
        if index != self.index:
            raise ValueError("a live source has no positions: images come once")
        return self.index

    def index_at(self, t_us: float) -> int:
        """Raise ValueError: images come once."""
        self._refuse()

    def rewind(self) -> None:
        """Raise ValueError: images come once."""
        self._refuse()

    def bookmark(self) -> Bookmark:
        """Raise TypeError: a live source cannot be pickled."""
        raise TypeError("cannot pickle a capture of a live source")

    def restore(self, mark: Bookmark) -> None:
        """Raise ValueError: images come once."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise ValueError("a live source has no positions: images come once")
