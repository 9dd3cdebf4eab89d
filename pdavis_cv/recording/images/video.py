"""Images of a video, read through PyAV: all bits, and the times of the container."""
from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._packages import package
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.images.pictures import Images, PictureFacts, Pictures, readable
from pdavis_cv.recording.limits import Budget

_COUNTED = ("matroska", "mov")
"""Containers that give each image a block with its time."""
_NO_TIMES = 0x80
"""FFmpeg's AVFMT_NOTIMESTAMPS."""
_DECODER = 8
"""Bytes that a decoder takes for each pixel of its images."""
_FULL_RANGE = 2
"""FFmpeg's AVCOL_RANGE_JPEG."""
_GREY_CHROMA = 4
"""Largest distance of a grey video's chroma from its middle, of 256: codecs lose."""
_MONOCHROME = re.compile(rb"\x00\x00\x01\x67[\x64\x6e\x7a\xf4]..(.)|"
                         rb"\xe1..\x67[\x64\x6e\x7a\xf4]..(.)", re.DOTALL)
"""Start of an H.264 parameter set of a high profile, up to its chroma format."""


class VideoPictures(Pictures):
    """Grey images of a video; the log receives what is damaged."""

    def __init__(self, path: str, log: ProblemLog, budget: Budget) -> None:
        self._path, self._log, self._budget = path, log, budget
        with self._opened() as (container, stream):
            codec = stream.codec_context
            name = codec.codec.canonical_name
            self._in_order = not codec.codec.reorder
            # H.264 has no grey format: its decoder adds neutral chroma.
            found = _MONOCHROME.search(codec.extradata or b"")
            self._raw_luma = found is not None and (found[1] or found[2])[0] >> 6 == 3
            rate = stream.average_rate or stream.guessed_rate
            self._period_us = float(1_000_000 / rate) if rate else None
            counted = self._in_order or container.format.name.split(",")[0] in _COUNTED
            # A bare stream has no times: FFmpeg counts 25 per second.
            timed = not container.format.flags & _NO_TIMES
            self._alone = self._counted = False
            times = self._times(container, stream) if counted else []
            lossless = (codec.codec.lossless and not codec.codec.lossy
                        ) or codec.profile == "High 4:4:4 Predictive"
            frame = None if self._counted else next(
                self._frames(container, stream), None)
        if frame is None:
            with self._opened() as (container, stream):
                frame = next(self._frames(container, stream), None)
        if frame is None:
            raise RecordingError(f"{path}: holds no image that can be decoded")
        self._first_us = _time_of(frame) if timed else None
        with readable(path, "video"):
            # Given to the first reader, who need not decode it again.
            self._probe: tuple[float | None, NDArray[Any]] | None = self._timed(frame)
            bits = _planar(frame).format.components[0].bits
        self.facts = PictureFacts(
            kind=f"video {name}, {frame.format.name}", count=len(times) or None,
            elapsed_us=np.array(times) if times and timed else None,
            interval_us=None if self._first_us is None else self._period_us,
            full_scale_dn=None if bits in (16, 32) else 2**bits - 1,
            lossy=None if lossless else codec.codec.long_name)

    @contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        """Open the file; give its container and the first stream of video."""
        av = package("av", f"{self._path}: a video needs PyAV: pip install av (extra "
                     "[frames])")
        # "file:" and a known name keep FFmpeg from reading patterns or protocols.
        with (readable(self._path, "video"),
              av.open(f"file:{self._path}") as container):
            if not container.streams.video or (
                    container.streams.video[0].codec_context is None):
                raise RecordingError(f"{self._path}: holds no video")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            size = stream.width * stream.height
            self._budget.piece(_DECODER * size, "decoding images of a video")
            stream.codec_context.options = {"max_pixels": str(
                self._budget.limits.memory // _DECODER)}
            yield container, stream

    def _times(self, container: Any, stream: Any) -> list[float]:
        """Return the time of each image in us, [] if it takes reading all of them."""
        # Some containers state when to decode, which is the same without reordering.
        index = stream.index_entries
        if self._in_order and len(index) == stream.frames > 0:
            found = [(entry.timestamp, entry.is_keyframe) for entry in index
                     if entry.size and not entry.is_discard]
        elif not stream.frames and stream.codec_context.name == "rawvideo":
            return []       # packets are as large as images: no cheaper to count
        else:
            self._counted = True
            found = [(packet.dts if packet.pts is None and self._in_order else
                      packet.pts, packet.is_keyframe)
                     for packet in container.demux(stream) if packet.size]
        self._alone = all(key for _, key in found)
        times = [time for time, _ in found]
        if None in times or len(set(times)) < len(times):
            return []
        unit = float(1_000_000 * stream.time_base)
        return [time * unit for time in sorted(times)]

    def _frames(self, container: Any, stream: Any) -> Iterator[Any]:
        """Decode to the end; damaged packets are left out."""
        import av
        for packet in container.demux(stream):
            try:
                yield from packet.decode()
            except av.InvalidDataError:
                self._log.damage(packet.pts, "a part of the video cannot be decoded",
                                 offset=packet.pos or 0)

    def images(self, first: int = 0) -> Images:
        """Iterate over the images; see `Pictures`."""
        known = self.facts.elapsed_us
        probe, self._probe = self._probe, None
        if probe is not None and first == 0:
            yield probe
            first = 1
        with self._opened() as (container, stream):
            start: float | None = None
            if first and self._alone and known is not None:
                if first >= len(known):
                    return
                start, first = float(known[first]), 0
                container.seek(round(start), backward=True)
            for k, frame in enumerate(self._frames(container, stream)):
                time = _time_of(frame)
                if k < first or (start is not None and time is not None
                                 and time < start - 1):
                    continue
                yield self._timed(frame)

    def _timed(self, frame: Any) -> tuple[float | None, NDArray[Any]]:
        """Return time and grey plane of a frame."""
        time = _time_of(frame)
        return (None if time is None or self._first_us is None
                else time - self._first_us), self._grey(frame)

    def _grey(self, frame: Any) -> NDArray[Any]:
        """Return the grey plane of a frame, with all its bits."""
        frame = _planar(frame)
        bits = frame.format.components[0].bits
        kind = "<f4" if "f32" in frame.format.name else "<u2" if bits > 8 else "u1"
        planes = [np.frombuffer(plane, kind).reshape(plane.height, -1)[:, :plane.width]
                  for plane in frame.planes]
        if frame.format.name.startswith("gbr"):
            grey = all(np.array_equal(planes[0], plane) for plane in planes[1:3])
        else:
            middle, most = 1 << (bits - 1), _GREY_CHROMA << (bits - 8)
            grey = all(middle - most <= plane.min() and plane.max() <= middle + most
                       for plane in planes[1:3])
        if not grey:
            raise RecordingError(f"{self._path}: the video must be grey, got colour")
        if (len(planes) == 1 or self._raw_luma or frame.format.name.startswith("gbr")
                or "yuvj" in frame.format.name or frame.color_range == _FULL_RANGE):
            planes[0].flags.writeable = False   # so that ApsFrame converts it later
            return planes[0]
        # Luma of video is 16 .. 235 of 256.
        black, top = 16 << (bits - 8), (1 << bits) - 1
        scaled: NDArray[Any] = np.clip((planes[0].astype(np.float32) - black) * (
            top / (219 << (bits - 8))), 0, top)
        return scaled


def _time_of(frame: Any) -> float | None:
    """Return the time of a frame in us, None if it has none."""
    if frame.pts is None:
        return None
    unit = frame.time_base      # products of Fractions are slow
    return float(frame.pts * 1_000_000 * unit.numerator / unit.denominator)


def _planar(frame: Any) -> Any:
    """Return a frame with a plane for each channel, little-endian."""
    name, parts = frame.format.name, frame.format.components
    wide = parts[0].bits > 8
    if name.startswith("gray") and not name.endswith("be"):
        return frame
    if name.startswith("gray"):
        return frame.reformat(format=name[:-2] + "le")
    if frame.format.is_rgb or frame.format.has_palette:
        if name.startswith("gbrp") and not name.endswith("be"):
            return frame
        return frame.reformat(format="gbrp16le" if wide else "gbrp")
    if len(frame.planes) == 3 and not name.endswith("be"):
        return frame
    return frame.reformat(format="yuv444p16le" if wide else "yuv444p")
