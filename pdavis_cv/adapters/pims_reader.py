"""Reader for pims (and so for trackpy): recordings as sequences of frames."""
from __future__ import annotations

import os
import threading
from typing import Any

import numpy as np
import pims
from numpy.typing import NDArray

from pdavis_cv.capture import VideoCapture
from pdavis_cv.capture.constants import CAP_PDAVIS_S0, CAP_PROP_PDAVIS_POS_US
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.registry import suffixes

_POS_FRAMES, _FRAME_COUNT = 1, 7


class PdavisSequence(pims.FramesSequence):  # type: ignore[misc]
    """The images of a recording, by number, with slices and pipelines of pims.

    ``pims.open("run.aedat4")`` uses it after this module has been imported.

    Parameters
    ----------
    filename : path or Recording
    output : int
        ``CAP_PDAVIS_*``; default: S0, float32.
    **parameters
        Parameters of `VideoCapture`, e.g. ``fps``.

    Raises
    ------
    OSError
        If the recording cannot be opened.
    """

    class_priority = 20

    @classmethod
    def class_exts(cls) -> set[str]:
        """Return the suffixes that ``pims.open`` passes to this class."""
        return {suffix[1:] for suffix in suffixes()}

    def __init__(
        self, filename: str | os.PathLike[str] | Recording, *,
        output: int = CAP_PDAVIS_S0, **parameters: Any,
    ) -> None:
        self._capture = VideoCapture(filename, output=output, **parameters)
        if not self._capture.isOpened():
            raise OSError(self._capture.last_error)
        # Several threads may use pims at once, but the capture has one position.
        self._lock = threading.Lock()
        self._count = int(self._capture.get(_FRAME_COUNT))
        first, _ = self._image(0) if self._count else (np.empty((0, 0), np.uint8), 0)
        self._shape, self._dtype = first.shape, first.dtype

    def __len__(self) -> int:
        return self._count

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """(height, width), or (height, width, channels)."""
        return self._shape

    @property
    def pixel_type(self) -> np.dtype[Any]:
        """The images' dtype."""
        return self._dtype

    def get_frame(self, ind: int) -> pims.Frame:
        """Return image number ind, with ``t_us`` in its metadata."""
        image, t = self._image(ind)
        return pims.Frame(image, frame_no=ind, metadata={"t_us": t})

    def _image(self, k: int) -> tuple[NDArray[Any], int]:
        with self._lock:
            if self._capture.get(_POS_FRAMES) != k:
                self._capture.set(_POS_FRAMES, k)
            ok, image = self._capture.read()
            if not ok or image is None:
                raise OSError(f"image {k}: {self._capture.last_error}")
            return image, int(self._capture.get(CAP_PROP_PDAVIS_POS_US))

    def close(self) -> None:
        """Close the recording."""
        self._capture.release()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock())
