"""Write videos and PNG; odd sides are padded for the codec."""
from __future__ import annotations

import contextlib
import importlib
import os
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv._opencv import opencv, opencv_name, set_log_level
from pdavis_cv._types import Facts, Image
from pdavis_cv.export.embedded import embed, embed_png
from pdavis_cv.export.files import SeriesFile
from pdavis_cv.render import even, png_of

# Browsers play VP8 in WebM and VP9 in MP4, and every OpenCV wheel can write both; none
# can write H.264, which slide programs need: that is PyAV's, where it is installed.  At
# equal size and quality VP9 takes 8 times as long as VP8, as OpenCV leaves its encoder
# in a slow mode that the writer cannot change.
_CODECS = {".webm": "VP80", ".mp4": "vp09", ".m4v": "mp4v", ".mkv": "mp4v",
           ".avi": "MJPG"}
LEAST_FPS = 0.01
_AHEAD = 2  # pictures in the queue: one is being encoded, one evens out delays
_MOST_FPS = {".webm": 1000, ".mp4": 60_000, ".m4v": 60_000, ".mkv": 1000, ".avi": 1000}
"""Highest frame rate of each container, as measured."""
_QUALITY = {"libx264": {"crf": "18", "preset": "veryfast"}}
_BITS_PER_PIXEL = 0.3   # of libopenh264, which has no setting for quality
_BT601 = 6              # the matrix by which RGB is converted, in FFmpeg's numbers
_FINEST = 10_000        # denominator of a rate, so that its numerator fits 32 bits


class VideoFile(SeriesFile):
    """Write a colour video, picture by picture.

    While it is open, OpenCV's log is silenced.

    Parameters
    ----------
    path : path
        ``.webm``, ``.mp4``, ``.m4v``, ``.mkv`` or ``.avi``; appears when it is
        complete.  Browsers play the first two.  ``.mp4`` and ``.m4v`` are H.264, which
        slide programs play, if PyAV is installed with an encoder, else VP9 and MPEG-4.
    fps : float
        Pictures per second of playback.
    facts : mapping of str to object, optional
        Provenance to embed; `read_embedded` returns it.

    Raises
    ------
    ValueError
        If the suffix is unknown, or the container does not support the rate.
    OSError
        On writing, if the codec cannot write the file.
    """

    def __init__(
        self, path: str | os.PathLike[str], fps: float,
        facts: Facts | None = None,
    ) -> None:
        self.facts = facts
        self.path = Path(opencv_name(path))
        suffix = self.path.suffix.lower()
        if suffix not in _CODECS:
            raise ValueError(
                f"video file must end in {', '.join(_CODECS)}, got {suffix!r}")
        self._fourcc = _CODECS[suffix]
        self._h264 = h264_encoder() if suffix in (".mp4", ".m4v") else None
        most = _MOST_FPS[suffix]
        if not LEAST_FPS <= fps <= most:
            raise ValueError(
                f"fps must lie in {LEAST_FPS:g}..{most:g} for {suffix}, got {fps:g}")
        self.fps, self.count = float(fps), 0
        self._cv2 = opencv()
        self._stack = contextlib.ExitStack()
        self._part = self._stack.enter_context(write_beside(
            self.path, ".mkv" if suffix == ".webm" else None))
        try:
            self._part.touch()  # to get the system's error message, if it fails
        except OSError as error:
            self._stack.__exit__(type(error), error, error.__traceback__)
            raise
        self._writer: Any = None
        self._shape: tuple[int, ...] = ()
        # Once per file instead of per picture, as each call waits for the GIL.
        self._stack.enter_context(_silent())
        # OpenCV encodes without the GIL, while the caller makes the next picture.
        self._encoder = self._stack.enter_context(ThreadPoolExecutor(1))
        self._waiting: deque[Future[None]] = deque()

    @property
    def codec(self) -> str:
        """What the pictures are encoded in."""
        return f"H.264 ({self._h264})" if self._h264 else self._fourcc

    def add(self, picture: Image) -> None:
        """Append a copy of a picture.

        Parameters
        ----------
        picture : ndarray of uint8, shape (H, W, 3)
            BGR; all pictures must have the same shape.

        Raises
        ------
        ValueError
            If the shape differs from the first picture's.
        OSError
            If no video of this size can be written.
        """
        if self._writer is None:
            self._shape = picture.shape
            self._open(even(picture).shape)
        elif picture.shape != self._shape:
            raise ValueError(
                f"picture must have the first one's shape {self._shape}, got "
                f"{picture.shape}")
        if len(self._waiting) == _AHEAD:
            self._encoded()
        self._waiting.append(self._encoder.submit(
            self._writer.write, np.array(even(picture), order="C")))
        self.count += 1

    def _encoded(self) -> None:
        try:
            self._waiting.popleft().result()
        except OSError as error:
            raise self._unwritten() from error

    def _unwritten(self) -> OSError:
        return OSError(f"{self.path}: the {self.count} pictures could not all be "
                       "written: is the disk full?")

    def _wait(self) -> None:
        while self._waiting:
            self._encoded()

    def _open(self, shape: tuple[int, ...]) -> None:
        if self._h264:
            self._writer = H264Writer(self._part, self.fps, (shape[1], shape[0]))
            return
        cv2 = self._cv2
        self._writer = cv2.VideoWriter(
            str(self._part), cv2.CAP_FFMPEG,
            cv2.VideoWriter_fourcc(*self._fourcc), self.fps, (shape[1], shape[0]))
        if not self._writer.isOpened():
            raise OSError(
                f"{self.path}: OpenCV cannot write {self._fourcc} of "
                f"{shape[1]}x{shape[0]} here")

    def _readable(self) -> bool:
        """Return whether all pictures can be read back.

        FFmpeg writes nothing after an error.  So the file is complete if its index,
        which comes last, lists every picture, and the last picture can be read.
        """
        if not _ended(self._part):
            return False  # FFmpeg would print an error message
        cv2 = self._cv2
        reader = cv2.VideoCapture(str(self._part), cv2.CAP_FFMPEG)
        whole: bool = (
            round(reader.get(cv2.CAP_PROP_FRAME_COUNT)) == self.count
            and reader.set(cv2.CAP_PROP_POS_FRAMES, self.count - 1)
            and reader.grab() and not reader.grab())
        reader.release()
        return whole

    def _finish(self) -> None:
        """Check that the file can be read to its end."""
        if self._writer is None:
            raise ValueError(f"{self.path}: no picture to write")
        self._wait()
        with contextlib.suppress(OSError):  # the file says whether it is whole
            self._writer.release()
        if self.path.suffix.lower() == ".webm":
            _call_webm(self._part)
        if not self._readable():  # VideoWriter reports no error of its own
            raise self._unwritten()
        if self.facts is not None:
            embed(self._part, self.facts)

    def _abandon(self) -> None:
        if self._writer is not None:
            with contextlib.suppress(Exception):  # the error in the block is reported
                self._wait()
            with contextlib.suppress(OSError):
                self._writer.release()


class _Silence:
    """Silence OpenCV's own messages about failures, which this library reports.

    Several videos may be open at a time: the level is restored at the end of the last.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count, self._level = 0, 0

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._count == 0:
                self._level = set_log_level(0)
            self._count += 1
        try:
            yield
        finally:
            with self._lock:
                self._count -= 1
                if self._count == 0:
                    set_log_level(self._level)


_silent = _Silence()


def _call_webm(path: Path) -> None:
    """Say in a Matroska file that it is WebM, which it is: VP8 and nothing else.

    Asked for WebM itself, OpenCV prints a line about a tag that WebM has not.  The
    name of the type is padded with zeros, as RFC 8794 has it.
    """
    with path.open("r+b") as file:
        at = file.read(64).find(b"\x42\x82\x88matroska")
        if at >= 0:
            file.seek(at + 3)
            file.write(b"webm".ljust(8, b"\0"))


def _ended(path: Path) -> bool:
    """Return whether a video has what is written last: an index, or its length."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4096)
        if head[:4] == b"RIFF":
            length = int.from_bytes(head[4:8], "little")
            return 0 < length <= size - 8
        if head[:4] == b"\x1aE\xdf\xa3":  # Matroska: EBML, then one Segment
            at = head.find(b"\x18\x53\x80\x67") + 4
            length = int.from_bytes(head[at + 1:at + 8], "big")
            return at > 3 and head[at] == 1 and at + 8 + length == size
        at = 0
        file.seek(0)
        while len(head := file.read(16)) >= 8:
            if head[4:8] == b"moov":
                return True
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:], "big")
            if length < 8:
                return False
            at += length
            file.seek(at)
    return False


def write_png(
    path: str | os.PathLike[str], picture: Image,
    facts: Facts | None = None,
) -> None:
    """Write a picture as PNG.

    Parameters
    ----------
    path : path
        File to write; appears when it is whole.
    picture : ndarray of uint8 or uint16, shape (H, W, 3) or (H, W)
        BGR or grey.
    facts : mapping of str to object, optional
        Provenance to embed; `read_embedded` returns it.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    png = png_of(picture)
    with write_beside(path) as part:
        part.write_bytes(png if facts is None else embed_png(png, facts))


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
