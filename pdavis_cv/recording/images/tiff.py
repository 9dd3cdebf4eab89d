"""Images in TIFF files: plain, OME, ImageJ, Micro-Manager; tifffile reads them."""
from __future__ import annotations

import contextlib
import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._opencv import opencv, opencv_name
from pdavis_cv._packages import package
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.images.pictures import (
    Images,
    PictureFacts,
    Pictures,
    one_plane,
    readable,
)
from pdavis_cv.recording.limits import Budget

# Damage is an error of ours, not lines that tifffile prints.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_MICRO_MANAGER = 51123
"""Tag of a page's metadata of Micro-Manager, JSON."""
_BATCH = 1 << 26
"""Bytes of pages that cv2 decodes at a time: it walks to each batch from page 0."""
_FOUR = 4
_IMAGEJ_CHANNELS = 7
"""ImageJ shows no more channels; a stack of more is one of times."""
_UNITS = {"s": 1e6, "sec": 1e6, "second": 1e6, "seconds": 1e6, "ms": 1e3, "msec": 1e3,
          "millisecond": 1e3, "milliseconds": 1e3, "us": 1.0, "\u00b5s": 1.0,
          "\u03bcs": 1.0, "ns": 1e-3, "min": 6e7, "minute": 6e7, "h": 3.6e9,
          "hour": 3.6e9}


class TiffPictures(Pictures):
    """Images in a TIFF file; four channels of one time are the four angles.

    `four` tells whether it holds four channels of each time; other axes are a
    RecordingError.
    """

    def __init__(self, path: str, budget: Budget | None = None) -> None:
        self._path, self._budget = path, budget or Budget(path)
        # Some writers describe each page alone: a stack of pages all the same.
        self._alone = False
        with self._opened() as tiff, readable(path, "TIFF"):
            shape = _shaped(tiff).get("shape", ())
            self._alone = len(shape) > 0 and math.prod(shape) == tiff.pages.first.size
        with self._opened() as tiff, readable(path, "TIFF"):
            self._describe(tiff, tiff.series[0])

    def _opened(self) -> Any:
        tifffile = package("tifffile", f"{self._path}: TIFF needs a package: pip "
                           "install tifffile (extra [frames])")
        with readable(self._path, "TIFF"):
            flags: dict[str, Any] = {"is_shaped": False} if self._alone else {}
            return tifffile.TiffFile(self._path, **flags)

    def _describe(self, tiff: Any, series: Any) -> None:
        page = series.keyframe
        self._budget.piece(page.nbytes, "a page")
        axes, shape = _labelled(series, tiff.is_imagej)
        size = {axis: math.prod(n for a, n in zip(axes, shape, strict=True)
                                if a == axis) for axis in "TZCS"}
        if size["Z"] > 1 and size["T"] > 1:
            raise RecordingError(
                f"{self._path}: a hyperstack of {size['T']} times with {size['Z']} "
                "slices each; save one slice of each time as a stack")
        channels = size["C"] * size["S"]
        colour = page.photometric.name == "RGB" and page.planarconfig.name == "CONTIG"
        self.four = channels == _FOUR and not colour
        if not self.four and size["C"] > 1:
            raise RecordingError(
                f"{self._path}: {channels} channels at each time; save that of the "
                "polarization camera alone, or the four I0, I45, I90, I135")
        # Axes before the rows count planes, which are read one by one.
        rows = axes.index("Y")
        channel_axes = [k for k in range(rows) if axes[k] in "CS"]
        times = [k for k in range(rows) if axes[k] not in "CS"]
        self._planes = np.arange(math.prod(shape[:rows])).reshape(
            shape[:rows]).transpose(times + channel_axes).reshape(
                -1, math.prod(shape[k] for k in channel_axes))
        self._plane = shape[rows:]
        self._in_page = size["S"] if "S" in axes[:rows] else 1
        self._dtype = np.dtype(tiff.byteorder + series.dtype.char)
        self._offsets = self._places(series)
        self.facts = self._stated(tiff, page, len(self._planes))

    def _places(self, series: Any) -> NDArray[np.int64] | None:
        """Return the byte at which each plane begins, None if they are compressed."""
        size = math.prod(self._plane) * self._dtype.itemsize
        places: NDArray[np.int64]
        if series.dataoffset is not None:
            places = series.dataoffset + size * np.arange(self._planes.size)
            return places
        if not all(page is not None and page.is_contiguous and (
                page.parent is series.keyframe.parent) for page in series.pages):
            return None     # an OME-TIFF may consist of several files
        pages = np.array([page.dataoffsets[0] for page in series.pages], np.int64)
        parts = np.arange(self._in_page, dtype=np.int64) * size
        places = (pages[:, np.newaxis] + parts).ravel()
        return places

    def _stated(self, tiff: Any, page: Any, count: int) -> PictureFacts:
        """Return what the file's metadata state."""
        kind, found = "TIFF", {}
        if tiff.is_ome:
            kind, found = "OME-TIFF", _ome(tiff.ome_metadata, count)
        elif tiff.is_imagej:
            kind, found = "TIFF of ImageJ", _of_keys(tiff.imagej_metadata)
        else:
            found = _of_keys(_shaped(tiff))
        if _MICRO_MANAGER in page.tags:
            with self._opened() as again:   # of its own: a series skips tags of pages
                found = {**_micro_manager([
                    one.tags.valueof(_MICRO_MANAGER) for one in again.pages], count),
                    **found}
        bits = found.pop("bits", page.bitspersample)
        if self._dtype.kind in "ui" and bits not in (16, 32):
            found["full_scale_dn"] = 2**int(bits) - 1
        return PictureFacts(kind=kind, count=count, **found)

    def images(self, first: int = 0) -> Images:
        """Iterate over the images; see `Pictures`."""
        opened = self._pages if self._offsets is None else self._in_place
        with readable(self._path, "TIFF"), opened() as plane:
            for k in range(first, len(self._planes)):
                planes = [plane(int(n)) for n in self._planes[k]]
                # One plane has its channels, if any, as the last axis.
                image = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
                yield None, (np.moveaxis(image, -1, 0) if self.four
                             else one_plane(image, f"{self._path}: image {k}"))

    @contextlib.contextmanager
    def _in_place(self) -> Iterator[Callable[[int], NDArray[Any]]]:
        """Give a function that reads a plane by its number, without tifffile."""
        assert self._offsets is not None
        offsets = self._offsets.tolist()
        size = math.prod(self._plane) * self._dtype.itemsize
        reader = FileReader(self._path)

        def plane(n: int) -> NDArray[Any]:
            data = reader.read(offsets[n], size)
            if len(data) < size:
                raise RecordingError(
                    f"{self._path}: the file ends before plane {n} does")
            return np.frombuffer(data, self._dtype).reshape(self._plane)

        try:
            yield plane
        finally:
            reader.close()

    @contextlib.contextmanager
    def _pages(self) -> Iterator[Callable[[int], NDArray[Any]]]:
        """Give a function that reads a plane by its number."""
        with self._opened() as tiff:
            pages = tiff.series[0].pages
            for page in pages:      # files of a set are closed; tiff closes them again
                page.parent.filehandle.open()
                self._budget.piece(sum(page.databytecounts), "a page in the file")
            by_opencv = _lacks_codec(pages[0]) and _by_opencv(self._path, pages)

            def plane(n: int) -> NDArray[Any]:
                page, part = divmod(n, self._in_page)
                image = by_opencv(page) if by_opencv else pages[page].asarray()
                found: NDArray[Any] = np.reshape(
                    image, (self._in_page, *self._plane))[part]
                return found

            yield plane


def _labelled(series: Any, imagej: bool) -> tuple[list[str], tuple[int, ...]]:
    """Return the axes and the shape of a series; four of something are channels."""
    axes, shape = list(series.axes), tuple(series.shape)
    last = axes.index("Y") - 1
    if imagej and last >= 0 and axes[last] == "C" and shape[last] > _IMAGEJ_CHANNELS:
        axes[last] = "T"
    if last > 0 and axes[last] in "QI" and shape[last] == _FOUR:
        axes[last] = "C"
    return axes, shape


def _lacks_codec(page: Any) -> bool:
    """Return whether tifffile can decode a page only with the package imagecodecs."""
    try:
        page.asarray()
    except ValueError as error:
        return "imagecodecs" in str(error)
    return False


def _by_opencv(path: str, pages: Sequence[Any]) -> Callable[[int], NDArray[Any]]:
    """Return a function that decodes a page by its number, in batches.

    cv2 walks to each batch from the first page.
    """
    cv2 = opencv()
    batch = max(_BATCH // max(pages[0].nbytes, 1), 1)
    decoded: dict[int, NDArray[Any]] = {}

    def page_at(n: int) -> NDArray[Any]:
        if n not in decoded:
            decoded.clear()
            _, found = cv2.imreadmulti(
                opencv_name(path), start=n, count=min(batch, len(pages) - n),
                flags=cv2.IMREAD_UNCHANGED)
            decoded.update(enumerate(found, n))
        if n not in decoded:
            raise RecordingError(
                f"{path}: page {n} cannot be decoded ({pages[n].compression.name}; "
                "pip install imagecodecs reads more kinds)")
        return decoded[n]

    return page_at


# ---- metadata ----------------------------------------------------------------


def _microseconds(value: Any, unit: Any) -> float | None:
    """Return a time of metadata in us, None if it is none or of an unknown unit."""
    try:
        us = float(value) * _UNITS[str(unit).strip().lower()]
    except (KeyError, TypeError, ValueError):
        return None
    return us if math.isfinite(us) else None


def _shaped(tiff: Any) -> dict[str, Any]:
    """Return the metadata that tifffile writes into the first page, {} if none."""
    text = tiff.pages.first.description
    found = json.loads(text) if text.startswith("{") else {}
    return found if isinstance(found, dict) else {}


def _positive(**found: float | None) -> dict[str, Any]:
    """Return those that are numbers above 0; 0 means that a file does not know."""
    return {name: value for name, value in found.items() if value and value > 0}


def _elapsed(times: Sequence[float | None], count: int) -> dict[str, Any]:
    """Return the times of the images, if there is one for each."""
    if len(times) != count or None in times:
        return {}
    return {"elapsed_us": np.array(times, np.float64)}


def _ome(text: str, count: int) -> dict[str, Any]:
    """Return what OME-XML states of the first image."""
    pixels = next((one for one in ElementTree.fromstring(text).iter()
                   if one.tag.endswith("Pixels")), None)
    if pixels is None:
        return {}

    def time(of: Any, name: str) -> float | None:
        return _microseconds(of.get(name), of.get(name + "Unit", "s"))

    planes = sorted(
        (one for one in pixels if one.tag.endswith("Plane") and one.get("TheC") == "0"),
        key=lambda one: (int(one.get("TheT", 0)), int(one.get("TheZ", 0))))
    bits = pixels.get("SignificantBits")
    return {
        **_positive(interval_us=time(pixels, "TimeIncrement"),
                    exposure_us=time(planes[0], "ExposureTime") if planes else None,
                    bits=int(bits) if bits else None),
        **_elapsed([time(one, "DeltaT") for one in planes], count)}


def _of_keys(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the keys of ImageJ, or those given to tifffile, state."""
    return _positive(
        interval_us=(_microseconds(keys.get("finterval"), keys.get("tunit", "s"))
                     or _microseconds(keys.get("TimeIncrement"),
                                      keys.get("TimeIncrementUnit", "s"))),
        bits=keys.get("SignificantBits"))


def _micro_manager(pages: Sequence[Any], count: int) -> dict[str, Any]:
    """Return what the metadata of the pages state."""
    every = [json.loads(one) if isinstance(one, (str, bytes)) else one or {}
             for one in pages]
    step = max(len(every) // count, 1)      # of channels, the first counts
    first = every[0]
    return {
        **_positive(exposure_us=_microseconds(first.get("Exposure-ms"), "ms"),
                    interval_us=_microseconds(first.get("Interval_ms"), "ms"),
                    bits=first.get("BitDepth")),
        **_elapsed([_microseconds(one.get("ElapsedTime-ms"), "ms")
                    for one in every[::step]], count)}
