"""Pictures: grey images of one size in order, and what their file states of them."""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.camera_array import AnalyserArray
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.images.checks import measured_full_scale
from pdavis_cv.steps import AnalyserSteps

Images = Generator[tuple[float | None, NDArray[Any]], None, None]
"""See `Pictures.images`."""


@dataclass(frozen=True, kw_only=True)
class PictureFacts:
    """What a file states of its images; None where it states nothing.

    `kind` is the format, for people; `elapsed_us` the time of each image, float64 (N,),
    `interval_us` that between two; `full_scale_dn` the largest value that the camera's
    converter gives; `lossy` the name of the codec, if it loses detail.
    """

    kind: str
    count: int | None = None
    elapsed_us: NDArray[np.float64] | None = None
    interval_us: float | None = None
    exposure_us: float | None = None
    full_scale_dn: int | None = None
    lossy: str | None = None


class Pictures(ABC):
    """Images of one size in order."""

    facts: PictureFacts

    @abstractmethod
    def images(self, first: int = 0) -> Images:
        """Iterate over the images from number `first` on.

        Each is a time, us, where it is known only from reading, else None, and one
        mosaic, (H, W), or the intensities I0, I45, I90, I135, (4, H, W).
        """


class Several(Pictures):
    """Files that follow each other, each opened by its name."""

    def __init__(self, names: Sequence[str], open_one: Callable[[str], Pictures]
                 ) -> None:
        self._names, self._open = names, open_one
        first = open_one(names[0]).facts
        self._each = first.count or 1
        count: int | None = len(names)
        elapsed: NDArray[np.float64] | None = None
        # One image a file is the rule; only other files are all opened beforehand.
        if self._each > 1 or first.elapsed_us is not None:
            every = [first, *(open_one(name).facts for name in names[1:])]
            if {one.count for one in every} != {self._each}:
                raise RecordingError(
                    f"{names[0]}: files that follow each other must hold the same "
                    f"number of images, got {[one.count for one in every]}")
            count = len(names) * self._each
            times = [one.elapsed_us for one in every if one.elapsed_us is not None]
            elapsed = np.concatenate(times) if len(times) == len(every) else None
        self.facts = replace(first, count=count, elapsed_us=elapsed)

    def images(self, first: int = 0) -> Images:
        """Iterate over the images; see `Pictures`."""
        number, within = divmod(first, self._each)
        for k, name in enumerate(self._names[number:], number):
            one = self._open(name)
            if one.facts.count != self._each:
                raise RecordingError(
                    f"{name}: holds {one.facts.count} images, the first file of the "
                    f"sequence {self._each}")
            yield from one.images(within if k == number else 0)


class FourPictures(Pictures):
    """Four sequences, I0, I45, I90, I135 in this order, as one with four planes."""

    def __init__(self, four: Sequence[Pictures]) -> None:
        self._four = four
        counts = {one.facts.count for one in four}
        if len(counts) > 1:
            raise RecordingError(
                f"the four channels must have equal numbers of images, got {counts}")
        self.facts = four[0].facts

    def images(self, first: int = 0) -> Images:
        """Iterate over the images; see `Pictures`."""
        for four in zip(*(one.images(first) for one in self._four), strict=True):
            planes = [image for _, image in four]
            if len({plane.shape for plane in planes}) > 1:
                raise RecordingError(
                    "the four channels must have equal sizes, got "
                    f"{[plane.shape for plane in planes]}")
            yield four[0][0], np.stack(planes)


class AlignedPictures(Pictures):
    """Planes of each time, laid over the first one as those of the first time are."""

    def __init__(self, pictures: Pictures) -> None:
        self._pictures, self.facts = pictures, pictures.facts
        with closing(pictures.images()) as images:
            first = next(images)[1]
        if first.ndim != 3:
            raise RecordingError(
                "align_planes needs four planes, as of files that differ only in "
                "0, 45, 90, 135 in their names, or analyser_steps")
        self.array = AnalyserArray.found(first)

    def images(self, first: int = 0) -> Images:
        """Iterate over the images; see `Pictures`."""
        for t, planes in self._pictures.images(first):
            yield t, self.array.aligned(planes)


class StackedPictures(Pictures):
    """All pictures as the planes of one time."""

    def __init__(self, pictures: Pictures) -> None:
        self._pictures = pictures
        self.facts = replace(pictures.facts, count=1, elapsed_us=None, interval_us=None)

    def images(self, first: int = 0) -> Images:
        """Iterate over the one stack; see `Pictures`."""
        if not first:
            yield None, np.stack([image for _, image in self._pictures.images()])


class SteppedPictures(Pictures):
    """Planes of one time, one for each angle of an analyser, as four planes.

    Without `steps`, the angles are found.
    """

    def __init__(self, pictures: Pictures, steps: AnalyserSteps | None) -> None:
        self._pictures, self._steps = pictures, steps
        self.facts = replace(
            pictures.facts, kind=f"stepped analyser, {pictures.facts.kind}")

    def images(self, first: int = 0) -> Images:
        """Iterate over the image; see `Pictures`."""
        for t, stack in self._pictures.images(first):
            steps = AnalyserSteps.found(stack) if self._steps is None else self._steps
            full = self.facts.full_scale_dn or measured_full_scale(list(stack)) or (
                255 if stack.dtype == np.uint8 else None)
            image = steps.polarization(stack, None if full is None else stack < full)
            # Where too few are not clipped, nothing is known.
            yield t, np.where(image.valid, image.quad, np.float32(full or 0))


@contextmanager
def readable(path: str, kind: str) -> Iterator[None]:
    """Turn anything that a package raises for a damaged file into RecordingError."""
    try:
        yield
    except (RecordingError, ImportError, MemoryError):
        raise
    except Exception as error:
        raise RecordingError(f"{path}: not a {kind} that can be read: {error}"
                             ) from error


def one_plane(image: NDArray[Any], name: str) -> NDArray[Any]:
    """Return the grey plane of an image whose last axis may be colour channels."""
    if image.ndim == 3:
        planes = [image[..., k] for k in range(min(image.shape[2], 3))]
        # A grey image that was stored as colour has three equal channels; a second or
        # fourth one is opacity.
        if image.shape[2] in (1, 2):
            planes = planes[:1]
        if not all(np.array_equal(planes[0], plane) for plane in planes[1:]):
            raise RecordingError(
                f"{name}: the image must be grey, got {image.shape[2]} channels")
        image = planes[0]
    if image.ndim != 2 or image.dtype.kind not in "uif" or not image.size:
        raise RecordingError(
            f"{name}: an image must be rows and columns of numbers, got shape "
            f"{image.shape}, {image.dtype}")
    return np.ascontiguousarray(image)
