"""H.264 by PyAV, which slide programs and phones play."""
from __future__ import annotations

import importlib
import os
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

_QUALITY = {"libx264": {"crf": "18", "preset": "veryfast"}}
_BITS_PER_PIXEL = 0.3   # of libopenh264, which has no setting for quality
_BT601 = 6              # the matrix by which RGB is converted, in FFmpeg's numbers
_FINEST = 10_000        # denominator of a rate, so that its numerator fits 32 bits


def h264_encoder() -> str | None:
    """Return the name of an H.264 encoder that PyAV has here, None if there is none."""
    try:
        av = importlib.import_module("av")
    except ImportError:
        return None
    for name in ("libx264", "libopenh264"):
        try:
            return str(av.codec.Codec(name, "w").name)
        except ValueError:      # PyAV was built without it
            continue
    return None


class H264Writer:
    """Write an MP4 file with the methods of ``cv2.VideoWriter``.

    The size is (width, height), both even, as 4:2:0 needs.
    """

    def __init__(
        self, path: str | os.PathLike[str], fps: float, size: tuple[int, int]
    ) -> None:
        self._av, self._failed = importlib.import_module("av"), False
        encoder = h264_encoder()
        self._file = self._av.open(os.fspath(path), "w", format="mp4")
        self._stream = self._file.add_stream(
            encoder, rate=Fraction(fps).limit_denominator(_FINEST),
            options=_QUALITY.get(str(encoder), {}))
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.colorspace = _BT601
        if encoder not in _QUALITY:
            self._stream.bit_rate = round(_BITS_PER_PIXEL * size[0] * size[1] * fps)

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Append a picture, BGR."""
        self._mux(self._av.VideoFrame.from_ndarray(picture, format="bgr24"))

    def release(self) -> None:
        """Complete the file."""
        try:
            self._mux(None)
        finally:
            self._file.close()

    def _mux(self, frame: Any) -> None:
        if self._failed:    # FFmpeg crashes if it goes on after an error
            return
        self._failed = True
        for packet in self._stream.encode(frame):
            self._file.mux(packet)
        self._failed = False
