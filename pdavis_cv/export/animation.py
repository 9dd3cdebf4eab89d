"""Animated GIF and WebP for slides, through OpenCV."""
from __future__ import annotations

import contextlib
import itertools
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv._opencv import opencv
from pdavis_cv._types import Facts, Image
from pdavis_cv.export.embedded import embed
from pdavis_cv.export.files import SeriesFile
from pdavis_cv.export.video import VideoFile

ANIMATIONS = (".gif", ".webp")
_MOST_FPS = {".gif": 50.0, ".webp": 60.0}
"""Highest rates.  Programs show pictures of less than 20 ms (GIF, whose unit is 10 ms),
or of up to 10 ms (WebP), for 100 ms each."""
_UNIT_MS = {".gif": 10, ".webp": 1}
_MOST_BYTES = 1 << 31
"""Largest size of the pictures, which are kept in memory until the end; a choice."""
_WEBP_QUALITY = 90
_GIF_DITHERED = 8   # IMWRITE_GIF_QUALITY, 1..8: without dither, 256 colours show bands
_GIF_OWN_COLOURS = 1    # IMWRITE_GIF_COLORTABLE: a table for each picture


class AnimationFile(SeriesFile):
    """Write a looping animation for slides and web pages; it is encoded at the end.

    Parameters
    ----------
    path : path
        ``.gif`` or ``.webp``; appears when it is complete.
    fps : float
        Pictures per second of playback: at most 50 in GIF, 60 in WebP.
    facts : mapping of str to object, optional
        Provenance to embed; `read_embedded` returns it.

    Raises
    ------
    ValueError
        If the suffix is unknown, or programs do not show this rate.
    OSError
        If the file cannot be written.
    """

    def __init__(
        self, path: str | os.PathLike[str], fps: float,
        facts: Facts | None = None,
    ) -> None:
        self.path, self.fps, self.facts = Path(path), float(fps), facts
        suffix = self.path.suffix.lower()
        if suffix not in ANIMATIONS:
            raise ValueError(
                f"animation must end in {', '.join(ANIMATIONS)}, got {suffix!r}")
        if not 0.01 <= fps <= _MOST_FPS[suffix]:
            raise ValueError(
                f"fps must lie in 0.01..{_MOST_FPS[suffix]:g} for {suffix}, got "
                f"{fps:g}; play it slower")
        self._cv2 = opencv()
        if not hasattr(self._cv2, "imencodeanimation"):
            raise ImportError(
                f"an animation ({suffix}; .webm needs less) needs OpenCV 4.12 or "
                f"later, this is {self._cv2.__version__}")
        self._pictures: list[NDArray[np.uint8]] = []
        self._stack = contextlib.ExitStack()
        self._part = self._stack.enter_context(write_beside(self.path))

    @property
    def codec(self) -> str:
        """What the pictures are encoded in."""
        return self.path.suffix[1:].upper()

    @property
    def count(self) -> int:
        """Pictures so far."""
        return len(self._pictures)

    def add(self, picture: Image) -> None:
        """Append a copy of a picture.

        Parameters
        ----------
        picture : ndarray of uint8, shape (H, W, 3)
            BGR; all pictures must have the same shape.

        Raises
        ------
        ValueError
            If the shape differs from the first picture's, or all need more than 2 GiB.
        """
        if self._pictures and picture.shape != self._pictures[0].shape:
            raise ValueError(
                f"picture must have the first one's shape {self._pictures[0].shape}, "
                f"got {picture.shape}")
        if (self.count + 1) * picture.nbytes > _MOST_BYTES:
            raise ValueError(
                f"{self.path.name}: an animation is kept in memory, up to 2 GiB or "
                f"{self.count} pictures of this size; write a .webm")
        self._pictures.append(np.array(picture, np.uint8))

    def _finish(self) -> None:
        if not self._pictures:
            raise ValueError(f"{self.path}: no picture to write")
        cv2 = self._cv2
        animation = cv2.Animation()
        animation.frames, animation.loop_count = self._pictures, 0  # for ever
        suffix = self.path.suffix.lower()
        unit = _UNIT_MS[suffix]     # rounding errors of durations do not accumulate
        ends = [round(k * 1000 / self.fps / unit) * unit for k in range(self.count + 1)]
        animation.durations = [b - a for a, b in itertools.pairwise(ends)]
        options = ([cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY] if suffix == ".webp" else
                   [cv2.IMWRITE_GIF_QUALITY, _GIF_DITHERED,
                    cv2.IMWRITE_GIF_COLORTABLE, _GIF_OWN_COLOURS])
        done, data = cv2.imencodeanimation(suffix, animation, options)
        if not done:
            raise OSError(
                f"{self.path}: OpenCV cannot write {self.count} pictures of "
                f"{self._pictures[0].shape[1]}x{self._pictures[0].shape[0]} here")
        self._part.write_bytes(bytes(data))
        if self.facts is not None:
            embed(self._part, self.facts)


def moving_file(
    path: str | os.PathLike[str], fps: float, facts: Facts | None = None
) -> AnimationFile | VideoFile:
    """Return an `AnimationFile` for ``.gif`` and ``.webp``, else a `VideoFile`.

    Parameters
    ----------
    path, fps, facts
        As in these classes.
    """
    animated = os.fspath(path).lower().endswith(ANIMATIONS)
    return (AnimationFile if animated else VideoFile)(path, fps, facts)
