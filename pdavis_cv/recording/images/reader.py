"""ImageRecording: images of a polarization camera as a recording of frames."""
from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import LayoutWarning, PdavisWarning, RecordingError
from pdavis_cv.recording.base import ApsFrame, Packet, RecordingInfo
from pdavis_cv.recording.facts import ASSUMED, CALLER, FILE, MEASURED, Fact, stated
from pdavis_cv.recording.files import FileRecording
from pdavis_cv.recording.images.checks import (
    assumed_full_scale,
    found_colours,
    measured_full_scale,
)
from pdavis_cv.recording.images.names import (
    TIFF_SUFFIXES,
    angles_of,
    by_angle,
    names_of,
)
from pdavis_cv.recording.images.pictures import (
    AlignedPictures,
    FourPictures,
    Pictures,
    Several,
    StackedPictures,
    SteppedPictures,
)
from pdavis_cv.recording.images.stills import ArrayPictures, StillPicture
from pdavis_cv.recording.images.tiff import TiffPictures
from pdavis_cv.recording.images.video import VideoPictures
from pdavis_cv.recording.members import Member, members_of
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.sensor import Layout
from pdavis_cv.steps import AnalyserSteps

STILL_SUFFIXES = (".bmp", ".jp2", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".webp")
ASSUMED_FPS = 25
"""Images per second if neither the file nor the caller states it, as in cv2."""
UNIT_DN = 65535
"""DN of 1, for numbers that are all 0 .. 1."""


class ImageRecording(FileRecording):
    """Frames from a video, TIFF files, still images or an array.

    The source is ``clip.mkv``, ``shot.png``, ``shot_%04d.png``, ``shot_*.png``,
    ``stack.tif``, ``planes.npy``, or several files in their order; names that differ
    only in 0, 45, 90, 135 are four planes.  Four planes of each time, I0, I45, I90 and
    I135, are laid out as a mosaic of twice the size, whose demosaicing by superpixels
    returns them unchanged.

    The layout that options state is that of the images after any crop or mirroring;
    four planes need none.  The full scale is by default that of the file, else measured
    from clipped samples, else the smaller of 4095 and 65535 that holds all values.
    Without an image, or if it is not grey, it is a RecordingError; a LayoutWarning, if
    colour filters are found and the layout states none.
    """

    def __init__(
        self, source: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
        options: SourceOptions,
    ) -> None:
        self._names: list[str] | None = None
        if not isinstance(source, str | os.PathLike):
            self._names = [os.fspath(name) for name in source]
            source = self._names[0]
        super().__init__(source, options)

    def _open(self, options: SourceOptions) -> RecordingInfo:
        source = os.fspath(self._path)
        names = self._names or names_of(source)
        self._members = members_of(names)
        self._pictures = pictures = self._opened(names, options)
        first = self._sample(0)
        if first is None:
            raise RecordingError(f"{source}: holds no image")
        self._four, self._size = first.ndim == 3, first.shape
        layout: Layout | None = None
        facts = pictures.facts
        if not self._four:
            layout = self._with_colours(first, options.known_layout)
            if facts.lossy:
                self._log.add(
                    "lossy codec", 0, f"codec {facts.lossy} loses detail that the four "
                    "polarizers of a cell differ in: AoP and DoLP are biased; record "
                    "without loss (FFV1, TIFF, PNG)", warning=PdavisWarning)
        # That of four planes is ours; it does not name their sensor.
        self._layout = options.known_layout or Layout.of(Layout.PDAVIS.stored_angles)
        times = self._set_times(options.source_fps)
        self._exposure_us = options.exposure_us or round(facts.exposure_us or 0)
        full_scale = self._set_full_scale(first, options.known_full_scale_dn)
        height, width = (side * (2 if self._four else 1) for side in first.shape[-2:])
        count = facts.count
        last = self._time(count - 1, None) if count else None
        return RecordingInfo(
            format=f"four planes, {facts.kind}" if self._four else facts.kind,
            **stated(options, sensor_size=(height, width),
                     layout=self._layout if self._four else layout,
                     exposure_us=self._exposure_us or None, frame_times=times,
                     full_scale_dn=full_scale),
            start_us=0, stop_us=None if last is None else last + self._exposure_us + 1,
            event_count=0, frame_count=count, imu_count=0, trigger_count=0,
            demosaic="superpixel" if self._four else None,
            header={"fps": float(self._fps), "dtype": str(first.dtype)})

    def _opened(self, names: Sequence[str], options: SourceOptions) -> Pictures:
        """Return the pictures of files, four of which may be the channels."""
        def one(name: str) -> Pictures:
            suffix = Path(name).suffix.lower()
            if suffix in TIFF_SUFFIXES:
                return TiffPictures(name, self._budget)
            if suffix in STILL_SUFFIXES:
                return StillPicture(name, self._budget)
            return (ArrayPictures(name) if suffix == ".npy"
                    else VideoPictures(name, self._log, self._budget))

        def several(files: Sequence[str]) -> Pictures:
            return one(files[0]) if len(files) == 1 else Several(files, one)

        def aligned(planes: Pictures) -> Pictures:
            if not options.align_planes:
                return planes
            found = AlignedPictures(planes)
            self._log.add("aligned", 0, f"aligned with the first: {found.array}")
            return found

        stated = options.analyser_steps
        if stated is not None:
            if isinstance(stated, str):
                stated = None if stated == "found" else AnalyserSteps(
                    tuple(np.deg2rad(angles_of(stated, names))))
            return SteppedPictures(aligned(StackedPictures(several(names))), stated)
        four = by_angle(names)
        return aligned(several(names) if four is None else FourPictures(
            [several(files) for files in four]))

    def _with_colours(
        self, first: NDArray[Any], layout: Layout | None
    ) -> Layout | None:
        """Return the layout with colours that are found, None for the caller's."""
        if layout is None:
            raise RecordingError(
                f"{self._path}: images of a polarization camera need its layout "
                '(layout="sony"), unless they are four planes I0, I45, I90, I135')
        found = found_colours(first)
        if found is None:
            return None
        if layout.colours:
            if [c == "G" for c in found] != [c == "G" for c in layout.colours]:
                self._log.add(
                    "colours", 0, f"the layout says {layout}, but by their means other "
                    "pixels are green", warning=LayoutWarning)
            return None
        layout = replace(layout, owner=None, colours=found)
        self._log.add(
            "colours", 0, "a mosaic of colours and polarizers (as IMX250MYR), found "
            "from its means, which do not tell red from blue; state "
            f'layout="{layout.stored_angles}", or the same with r and b exchanged',
            warning=LayoutWarning)
        return layout

    def _set_times(self, source_fps: float | None) -> Fact:
        """Set what `_time` needs; return the frames' rate or the kind of times."""
        facts = self._pictures.facts
        self._elapsed: NDArray[np.int64] | None = None
        self._stated = source_fps is None
        if source_fps is not None:
            self._fps = Fraction(source_fps).limit_denominator(1_000_000)
            return Fact(source_fps, CALLER)
        interval = facts.interval_us
        if facts.elapsed_us is not None:
            elapsed = np.rint(facts.elapsed_us - facts.elapsed_us[0]).astype(np.int64)
            if np.all(np.diff(elapsed) > 0):
                self._elapsed = elapsed
                if len(elapsed) > 1:
                    interval = float(elapsed[-1]) / (len(elapsed) - 1)
            else:
                self._log.add("times", 0, "the times that the file states do not "
                              "increase and are not used")
        self._fps = Fraction(ASSUMED_FPS) if interval is None else (
            1_000_000 / Fraction(interval).limit_denominator(1_000_000))
        if self._elapsed is not None or (facts.count is None and interval is not None):
            return Fact("time stamps", FILE)
        return Fact(float(self._fps), ASSUMED if interval is None else FILE)

    def _set_full_scale(self, first: NDArray[Any], given: int | None) -> Fact:
        """Set the largest DN and what numbers are multiplied by; return the former."""
        facts = self._pictures.facts
        self._scale = 1
        self._full_scale = given or facts.full_scale_dn or (
            255 if first.dtype == np.uint8 else 0)
        self._assumed_scale = False
        if self._full_scale:
            return Fact(self._full_scale, FILE)
        count = facts.count or 1
        samples = [first, *(
            image for k in sorted({count // 2, count - 1} - {0})
            if (image := self._sample(k)) is not None)]
        if first.dtype.kind == "f" and max(image.max() for image in samples) <= 1:
            self._scale, samples = UNIT_DN, [image * UNIT_DN for image in samples]
        measured = measured_full_scale(samples)
        self._full_scale = measured or assumed_full_scale(samples)
        self._assumed_scale = measured is None
        return Fact(self._full_scale, ASSUMED if measured is None else MEASURED)

    def _sample(self, k: int) -> NDArray[Any] | None:
        """Return one image, None if there is none."""
        with closing(self._pictures.images(k)) as images:
            return next((image for _, image in images), None)

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the frames with start_us <= time < stop_us."""
        first = 0
        if start_us is not None and start_us > self._exposure_us:
            first = self._number_at(start_us - self._exposure_us)
        for k, (time, image) in enumerate(self._pictures.images(first), first):
            t = self._time(k, time)
            end = t + self._exposure_us
            if stop_us is not None and end >= stop_us:
                return
            if start_us is not None and end < start_us:
                continue
            if image.shape != self._size:
                raise RecordingError(
                    f"{self._path}: image {k} is {image.shape[-1]}x{image.shape[-2]}, "
                    f"the first one is {self._size[-1]}x{self._size[-2]}")
            self._budget.time(t)
            yield Packet(frames=(self._frame(image, t, end),))

    def _frame(self, image: NDArray[Any], start: int, end: int) -> ApsFrame:
        full = self._full_scale
        if self._assumed_scale and image.max() > full:
            full = assumed_full_scale([image])
        if self._four:
            height, width = image.shape[1:]
            mosaic = np.empty((height, 2, width, 2), np.float32)
            for plane, place in zip(image, self._layout.places, strict=True):
                mosaic[:, place // 2, :, place % 2] = plane
            image = mosaic.reshape(2 * height, 2 * width)
        if self._scale != 1:
            image = image * np.float32(self._scale)
        return ApsFrame(image, start, end, full_scale_dn=full)

    def _time(self, k: int, read: float | None) -> int:
        """Return the time of image k in us; `read` is the one that came with it."""
        if self._elapsed is not None and k < len(self._elapsed):
            return int(self._elapsed[k])
        if read is not None and self._stated:
            return round(read)
        return round(k * 1_000_000 / self._fps)

    def _number_at(self, t_us: int) -> int:
        """Return the number of the first image at t_us or later, or one before."""
        if self._elapsed is not None:
            return int(np.searchsorted(self._elapsed, t_us))
        if self._stated and self._pictures.facts.count is None:
            return 0    # their times are known only from reading
        k = int(t_us * self._fps / 1_000_000)
        return k if self._time(k, None) >= t_us else k + 1

    @property
    def members(self) -> tuple[Member, ...]:
        """The files that it is made of."""
        return self._members

    @property
    def name(self) -> str:
        """Short name for people."""
        more = len(self._names or ()) - 1
        return self._path.name + (f" and {more} more" if more > 0 else "")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._names or os.fspath(self._path), self._options)
