"""Shared code of commands that make videos: times, tone curves, provenance."""
from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import (
    Calibration,
    Layout,
    PdavisWarning,
    PolarFrame,
    Recording,
    export,
    fuse,
    render,
)
from pdavis_cv.calibration.corrected import FrameCorrection
from pdavis_cv.fusion import Fusion
from pdavis_cv.fusion.grid import grid_count, grid_us
from pdavis_cv.quantities import quantity

from ._common import UsageError, covered

_SCREEN = 480, 1280     # rows that an image should have, columns it may have


def grid_times(
    recording: Recording, fps: float, start_us: int | None, stop_us: int | None
) -> NDArray[np.int64]:
    """Return the times of fuse()'s images, so that their number is known in advance.

    The interval is half-open, by default from the first frame's mid-exposure to the
    end, for which the recording is read once.
    """
    # Times do not depend on the layout, but without one fuse would warn.
    start = Fusion(recording, method="frames", start_us=start_us,
                   layout=recording.info.layout or Layout.PDAVIS).start_us
    end = recording.scan().stop_us if stop_us is None else stop_us
    if start is None or end is None or start >= end:
        raise UsageError(
            f"{recording.path or 'the recording'}: no image in the interval asked for: "
            f"{covered(recording)}")
    rate = Fraction(fps)
    return start + np.array([grid_us(k, rate) for k in range(
        grid_count(end - start, rate))], np.int64)


def of_frames(options: dict[str, Any], settings: list[tuple[str, Any]]
              ) -> dict[str, Any]:
    """Return the options of fuse() that apply to the method ``frames``."""
    others = {"thresholds", *(name for name, _ in settings)}
    kept = {name: value for name, value in options.items() if name not in others}
    return {**kept, "method": "frames"}


def tone_of(
    recording: Recording, options: dict[str, Any], name: str, count: int = 6
) -> render.ToneCurve:
    """Fit a tone curve to a quantity of some images, evenly spread over an export."""
    times, shown = options["times_us"], quantity(name)
    # The first image may lie before the first frame has been read out.
    chosen = times[np.linspace(len(times) // 4, len(times) - 1, count).astype(int)]
    images = list(fuse(recording, **{**options, "times_us": np.unique(chosen)}))
    usable = [image for image in images if image.valid.any()]
    top = full_scale(recording)
    if usable:
        return render.ToneCurve.of(
            [shown.of(image) for image in usable],
            [image.valid for image in usable], saturated=top and top / 2)
    if top is None or not any((shown.of(image) >= top / 2).any() for image in images):
        method = str(images[0].provenance["method"])
        raise UsageError(
            "no image has a valid pixel: "
            f"{_why_nothing(recording, method, options['calibration'])}")
    return render.ToneCurve(top, saturated=top / 2)


def full_scale(recording: Recording) -> float | None:
    """Return the intensity at the converter's full scale, None without frames.

    A pixel that is not valid is too bright rather than too dark if its sample is more
    than half of that.
    """
    if recording.info.frame_count == 0:
        return None
    frame = next((f for packet in recording.packets() for f in packet.frames), None)
    return None if frame is None else frame.full_scale_dn / (frame.exposure_ms or 1.0)


def screen_scale(shape: tuple[int, ...]) -> int:
    """Return how many times larger an image fills a screen or a projector's picture."""
    height, width = shape
    return max(1, min(-(-_SCREEN[0] // height), _SCREEN[1] // width))


def told_if_nothing(
    images: Iterator[PolarFrame], recording: Recording,
    calibration: Calibration | None,
) -> Iterator[PolarFrame]:
    """Yield images; at the end, warn if none had a valid pixel, and say why."""
    method = None
    for image in images:
        method = str(image.provenance["method"])
        yield image
        if image.valid.any():
            yield from images
            return
    if method is not None:
        warn_of_nothing(recording, method, calibration)


def warn_of_nothing(
    recording: Recording, method: str, calibration: Calibration | None
) -> None:
    """Warn that no image has a valid pixel, with the likely reason."""
    warnings.warn(
        f"no image has a valid pixel: {_why_nothing(recording, method, calibration)}",
        PdavisWarning, stacklevel=3)


def _why_nothing(
    recording: Recording, method: str, calibration: Calibration | None
) -> str:
    """Return the likely reason why no image has a valid pixel."""
    if method == "turning":
        return "a pixel needs some events within the turns before it"
    frames = list(itertools.islice(
        (frame for packet in recording.packets() for frame in packet.frames), 10))
    if frames:
        saturated = max(
            float(np.mean(frame.dn >= frame.full_scale_dn)) for frame in frames)
        corrected = FrameCorrection(calibration)
        usable = max(float(np.mean(np.asarray(corrected(frame).valid)))
                     for frame in frames)
        if saturated > 0.5:
            return (f"{saturated:.0%} of the pixels of its frames are saturated; "
                    "expose for a shorter time")
        if usable < 0.5:
            return (f"{1 - usable:.0%} of the pixels of its frames cannot be used "
                    "(too bright, or not valid in the file)")
        return (f"method {method!r} has no valid pixel from its frames: does the "
                "interval begin before the readout of the first frame?")
    if method == "events":
        return "too few events in the interval"
    return f"method {method!r} needs frames, and there are none; events needs none"


def facts_of(
    recording: Recording, options: dict[str, Any], **facts: Any
) -> dict[str, Any]:
    """Return the provenance of images that are made with these options."""
    first = next(fuse(recording, **{**options, "times_us": options["times_us"][:1]}))
    return export.provenance(first.provenance, recording, **facts)


def held_at(frames: Iterator[PolarFrame], times: Iterator[int]) -> Iterator[PolarFrame]:
    """Yield, for each time, the last frame at or before it."""
    last = next(frames, None)
    following = next(frames, None)
    if last is None:
        raise UsageError("the second recording has no image")
    for t in times:
        while following is not None and (following.t_us or 0) <= t:
            last, following = following, next(frames, None)
        yield last
