"""Frames of a polarization camera from a video, image files or a TIFF stack."""
from __future__ import annotations

import glob
import itertools
import os
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._opencv import native_capture, opencv
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import (
    ApsFrame,
    Packet,
    Problem,
    Recording,
    RecordingInfo,
)
from pdavis_cv.sensor import Layout, Sensor

__all__ = ["MosaicImages", "MosaicVideo", "open_mosaic"]

IMAGE_SUFFIXES = (".bmp", ".jp2", ".pgm", ".png", ".pnm", ".tif", ".tiff", ".webp")
STACK_SUFFIXES = (".tif", ".tiff")
FPS_WITHOUT_TIMES = 25.0
"""Frame rate of image files if none is given, as in cv2."""

# Intra-frame codecs, in which seeking is exact.
_INTRA = frozenset((
    b"ffv1", b"FFV1", b"MJPG", b"mjpg", b"HFYU", b"hfyu", b"FFVH", b"ffvh",
    b"\0\0\0\0", b"Y800", b"GREY", b"Y16 ", b"png ", b"PNG "))

# FFmpeg's codes, as returned by cv2, for one plane of 8 or 16 bits.
_GREY = tuple(int.from_bytes(code, "little") for code in (b"Y800", b"Y1\0\x10"))


def open_mosaic(
    source: str | os.PathLike[str], *, layout: Layout, fps: float | None = None,
    bad_events: str = "drop", camera: str | None = None,
) -> Recording:
    """Open a video, an image, a pattern of image names or a TIFF stack.

    Parameters
    ----------
    source : path
        ``clip.mkv``, ``shot.png``, ``shot_%04d.png``, ``shot_*.png``, ``stack.tif``.
        Images must be grey with 8 or 16 bits, each pixel behind one polarizer.
    layout : Layout
        Layout of these images, i.e. after any crop or mirroring.
    fps : float, optional
        Images per second; default: the video's, 25 for images.
    bad_events, camera : str, optional
        Not used: images hold no events and belong to one camera.

    Returns
    -------
    Recording
        Frames only, in the file's DN; time starts at 0.

    Raises
    ------
    RecordingError
        If there is no image, or it is not grey.
    """
    text = os.fspath(source)
    if fps is not None and not 0 < fps <= 1_000_000:
        raise ValueError(f"fps must lie in (0, 1000000], got {fps!r}")
    names = _names(text)
    if names is None:
        return MosaicVideo(text, layout, fps)
    return MosaicImages(names, layout, fps, path=text)


def _names(source: str) -> list[str] | None:
    """Return the image files that a source denotes, None if it is a video."""
    path = Path(source)
    if path.is_dir():
        raise RecordingError(
            f"{source}: a folder, give a pattern such as {source}/*.png")
    if path.is_file():
        return [source] if path.suffix.lower() in IMAGE_SUFFIXES else None
    if re.search(r"%0?\d*d", path.name):
        first = next((k for k in (0, 1) if Path(source % k).is_file()), None)
        names = []
        while first is not None and Path(source % first).is_file():
            names.append(source % first)
            first += 1
    else:
        names = sorted(glob.glob(source))
    if not names:
        raise RecordingError(f"{source}: cannot be opened: no such file")
    return names


class _MosaicRecording(Recording):
    """Frames at a constant rate, without time stamps."""

    def __init__(
        self, path: str, layout: Layout, fps: Fraction, count: int | None,
        first: NDArray[Any], kind: str,
    ) -> None:
        self._source, self._fps, self._count = path, fps, count
        shape = first.shape
        self._info = RecordingInfo(
            format=kind, sensor_size=(shape[0], shape[1]), layout=layout,
            # Cameras without events have Sony's sensor.
            sensor=Sensor.PDAVIS if shape == Sensor.PDAVIS.size else Sensor.SONY,
            start_us=0,
            stop_us=None if count is None else self._time(count - 1) + 1,
            event_count=0, frame_count=count, imu_count=0, trigger_count=0,
            header={"fps": float(fps), "dtype": str(first.dtype)})
        self._full_scale = 255 if first.dtype == np.uint8 else self._sixteen_bits(first)

    def _sixteen_bits(self, first: NDArray[Any]) -> int:
        """Return the full scale of uint16 images, which may hold only 10 or 12 bits."""
        n = self._count or 1
        later = {n // 2, n - 1} - {0}
        samples = [first, *(image for k in later for image in itertools.islice(
            self._images(k), 1))]
        brightest = max(int(image.max(initial=0)) for image in samples)
        return 4095 if brightest <= 4095 else 65535

    @property
    def info(self) -> RecordingInfo:
        """Facts from the file."""
        return self._info

    @property
    def problems(self) -> Sequence[Problem]:
        """Always empty: an image that cannot be decoded raises RecordingError."""
        return ()

    @property
    def path(self) -> Path | None:
        """The file or the pattern."""
        return Path(self._source)

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the frames with start_us <= time < stop_us."""
        first = 0
        if start_us is not None and start_us > 0:
            first = int(start_us * self._fps / 1_000_000)
            while self._time(first) < start_us:
                first += 1
        for k, image in enumerate(self._images(first), first):
            t = self._time(k)
            if stop_us is not None and t >= stop_us:
                return
            if image.shape != self._info.sensor_size:
                raise RecordingError(
                    f"{self._source}: image {k} is {image.shape[1]}x{image.shape[0]}, "
                    "the first one is "
                    f"{self._info.sensor_size[1]}x{self._info.sensor_size[0]}")
            full = self._full_scale
            if full < 65535 and image.dtype == np.uint16 and image.max() > full:
                full = 65535
            yield Packet(frames=(ApsFrame(image, t, t, full_scale_dn=full),))

    def _time(self, k: int) -> int:
        return round(k * 1_000_000 / self._fps)

    @abstractmethod
    def _images(self, first: int) -> Iterator[NDArray[Any]]:
        """Yield the images from number first on."""

    def close(self) -> None:
        """Do nothing: the file is open only during reading."""


class MosaicImages(_MosaicRecording):
    """Image files, in order, or the pages of one TIFF file.

    Parameters
    ----------
    names : sequence of path
        One file may hold several pages.
    layout : Layout
    fps : float, optional
        Default 25.
    path : str, optional
        Name of the recording; default: the first name.
    """

    def __init__(
        self, names: Sequence[str | os.PathLike[str]], layout: Layout,
        fps: float | None = None, *, path: str | None = None,
    ) -> None:
        self._names = [os.fspath(name) for name in names]
        if not self._names:
            raise RecordingError("an image sequence needs at least one file")
        self._pages = len(self._names)
        first_name = self._names[0]
        if len(self._names) == 1 and first_name.lower().endswith(STACK_SUFFIXES):
            self._pages = int(opencv().imcount(first_name))
        first = next(self._images(0), None)
        if first is None:
            raise RecordingError(f"{first_name}: holds no image")
        super().__init__(
            path or first_name, layout, Fraction(fps or FPS_WITHOUT_TIMES),
            self._pages, first, "mosaic images")

    def _images(self, first: int) -> Iterator[NDArray[Any]]:
        cv2 = opencv()
        for k in range(first, self._pages):
            if len(self._names) > 1 or self._pages == 1:
                image = cv2.imread(self._names[k], cv2.IMREAD_UNCHANGED)
            else:
                _, pages = cv2.imreadmulti(
                    self._names[0], start=k, count=1, flags=cv2.IMREAD_UNCHANGED)
                image = pages[0] if pages else None
            name = self._names[min(k, len(self._names) - 1)]
            yield _checked(image, name, k)


class MosaicVideo(_MosaicRecording):
    """A grey video, 8 or 16 bits (FFV1), read through cv2.

    Parameters
    ----------
    path : path
    layout : Layout
    fps : float, optional
        Default: the video's.
    """

    def __init__(
        self, path: str | os.PathLike[str], layout: Layout, fps: float | None = None
    ) -> None:
        self._file = os.fspath(path)
        cv2, video = opencv(), self._opened()
        try:
            rate = fps or video.get(cv2.CAP_PROP_FPS)
            count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
            code = int(video.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
            self._intra = code.to_bytes(4, "little") in _INTRA
            ok, image = video.read()
        finally:
            video.release()
        if not ok:
            raise RecordingError(f"{path}: holds no image that cv2 can decode")
        rate = rate if 0 < rate <= 1_000_000 else FPS_WITHOUT_TIMES
        super().__init__(
            self._file, layout, Fraction(rate).limit_denominator(1_000_000),
            count if count > 0 else None, _checked(image, self._file, 0),
            "mosaic video")

    def _opened(self) -> Any:
        cv2 = opencv()
        video = native_capture()(self._file)
        if not video.isOpened():
            raise RecordingError(f"{self._file}: not a video that cv2 can open")
        if int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) in _GREY:
            # Otherwise cv2 converts grey to BGR and 16 bits to 8.  It warns of formats
            # that are not grey.
            level = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
            video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
            cv2.utils.logging.setLogLevel(level)
        return video

    def _images(self, first: int) -> Iterator[NDArray[Any]]:
        cv2, video = opencv(), self._opened()
        try:
            if self._intra:
                video.set(cv2.CAP_PROP_POS_FRAMES, first)
            else:  # cv2 does not seek exactly in codecs with inter-frame prediction
                for _ in range(first):
                    if not video.grab():
                        return
            k = first
            while self._count is None or k < self._count:
                ok, image = video.read()
                if not ok:
                    return
                yield _checked(image, self._file, k)
                k += 1
        finally:
            video.release()


def _checked(image: Any, name: str, k: int) -> NDArray[Any]:
    """Return one grey plane of an image that cv2 decoded."""
    if image is None:
        raise RecordingError(f"{name}: image {k} cannot be decoded")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    if image.ndim == 3:
        # A grey video that was stored as colour has three equal channels.
        if image.shape[2] == 3 and np.array_equal(
                image[..., 0], image[..., 1]) and np.array_equal(
                image[..., 1], image[..., 2]):
            image = image[..., 0]
        else:
            raise RecordingError(
                f"{name}: image {k} must be grey, got {image.shape[2]} channels")
    if image.dtype not in (np.uint8, np.uint16):
        raise RecordingError(
            f"{name}: image {k} must have 8 or 16 bits, got {image.dtype}")
    return np.ascontiguousarray(image)
