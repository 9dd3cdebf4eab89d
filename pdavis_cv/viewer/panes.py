"""Pictures and values of one image, for the page and the stream."""
from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._opencv import opencv
from pdavis_cv.capture.picture import event_counts, events_bgr
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.render import ToneCurve, aop_bgr, dolp_bgr, fade
from pdavis_cv.render.colours import (
    AOP_SCALE,
    FULL_COLOUR_DOLP,
    HUE_TABLE,
    INVALID,
    table_of,
    through_table,
)
from pdavis_cv.stokes_vector import aop, dolp
from pdavis_cv.viewer.show import Show

__all__ = [
    "PANES", "PLANES", "archive", "jpeg", "palettes", "pane", "planes", "values"]

LARGEST_SIGMA_RAD = math.pi / 4
"""Standard deviation of AoP at the end of the colour scale; that of an unknown angle is
pi / sqrt(12), 52 degrees."""
JPEG_QUALITY = 95


def _events(show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    assert image.t_us is not None
    provenance = show.fusion.provenance
    step = 2 if provenance["demosaic"] in HALF_SIZE else 1
    return events_bgr(event_counts(show.events(image.t_us), provenance["roi"], step))


def _aop(show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    picture = aop_bgr(image.aop, image.valid)
    fade(picture, image.dolp, image.valid)
    return picture


def _uncertainty(show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    sigma = image.sigma_aop
    if sigma is None:           # the method gives none
        return np.full((*image.s0.shape, 3), 64, np.uint8)
    return dolp_bgr(sigma / np.float32(LARGEST_SIGMA_RAD), image.valid)


PANES: dict[str, Callable[[Show, PolarFrame], NDArray[np.uint8]]] = {
    "s0": lambda show, image: ToneCurve(show.white).bgr(
        image.s0 * np.float32(0.5), invalid=(0, 0, 0)),
    "aop": _aop,
    "dolp": lambda show, image: dolp_bgr(image.dolp, image.valid),
    "events": _events,
    "uncertainty": _uncertainty,
    "aop_bgr": lambda show, image: aop_bgr(image.aop, image.valid),
}
"""Pictures by name, uint8 (H, W, 3), BGR: grey S0, AoP faded by DoLP, DoLP, events
since the image before, the standard deviation of AoP, and AoP in full colour."""

NONE = 255
"""Value of a pixel without an estimate in a plane."""
_PARTS = 255    # values 0 .. 254 of a plane


def _numbers(count: int) -> NDArray[np.uint8]:
    """Return a colour table whose entries are plane values, for `count` colours."""
    number = (np.arange(count) * _PARTS // count).astype(np.uint8)
    return table_of(np.repeat(number[:, None], 3, axis=1), (NONE,) * 3, (NONE,) * 3)


_HUES, _RAMP = _numbers(len(HUE_TABLE) - 2), _numbers(_PARTS)


def _grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(picture[..., 0])


def _ramp_plane(
    value: NDArray[np.float32], valid: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    return _grey(through_table(
        _kernels.ramp_bgr, value, valid, _PARTS - 1, _RAMP))


def _uncertainty_plane(show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    sigma = image.sigma_aop
    if sigma is None:           # the method gives none
        return np.full(image.s0.shape, NONE, np.uint8)
    return _ramp_plane(sigma / np.float32(LARGEST_SIGMA_RAD), image.valid)


PLANES: dict[str, Callable[[Show, PolarFrame], NDArray[np.uint8]]] = {
    "s0": lambda show, image: _grey(PANES["s0"](show, image)),
    "aop": lambda show, image: _grey(through_table(
        _kernels.hue_bgr, image.aop, image.valid, AOP_SCALE, _HUES)),
    "dolp": lambda show, image: _ramp_plane(image.dolp, image.valid),
    "events": lambda show, image: _grey(_events(show, image)),
    "uncertainty": _uncertainty_plane,
}
"""Planes that the page colours itself, by name; uint8 (H, W).  S0 and events are grey
values; the others map 0 to 180 degrees, 0 to 1 or 0 to `LARGEST_SIGMA_RAD` to 0 .. 254,
or are `NONE`.  Coloured pictures would take three times as long to receive."""


def planes(names: Iterable[str], show: Show, image: PolarFrame
           ) -> dict[str, NDArray[np.uint8]]:
    """Return the planes that a page needs; AoP also needs DoLP, which fades it.

    Parameters
    ----------
    names : iterable of str
        Names of `PLANES`.
    show : Show
        The source of events and settings.
    image : PolarFrame
        The image.

    Raises
    ------
    ValueError
        If there is no such picture.
    """
    wanted = list(names)
    for name in wanted:
        if name not in PLANES:
            raise ValueError(f"panes must be of {', '.join(PLANES)}, got {name!r}")
    if "aop" in wanted:
        wanted.append("dolp")
    return {name: PLANES[name](show, image) for name in dict.fromkeys(wanted)}


def palettes() -> dict[str, Any]:
    """Return the RGB colours of the planes' values, and the DoLP of full colour."""
    middle = (np.arange(_PARTS, dtype=np.float32) + 0.5) * np.float32(math.pi / _PARTS)
    steps = np.arange(_PARTS, dtype=np.float32) / np.float32(_PARTS - 1)

    def rgb(colours: NDArray[np.uint8]) -> list[list[int]]:
        found: list[list[int]] = colours[0, :, ::-1].tolist()
        return [*found, [*INVALID[::-1]]]

    return {"aop": rgb(aop_bgr(middle[None])), "ramp": rgb(dolp_bgr(steps[None])),
            "full_dolp": FULL_COLOUR_DOLP}


def pane(name: str, show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    """Return a picture of an image by name, with or without the suffix ``_bgr``.

    Raises
    ------
    ValueError
        If there is no such picture.
    """
    found = PANES.get(name) or PANES.get(name.removesuffix("_bgr"))
    if found is None:
        raise ValueError(f"output must be one of {', '.join(PANES)}, got {name!r}")
    return found(show, image)


def jpeg(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture as JPEG 4:4:4, because subsampled colour distorts AoP.

    Raises
    ------
    ImportError
        If no OpenCV is installed.
    """
    cv2 = opencv()
    done, data = cv2.imencode(".jpg", picture, [
        cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444])
    if not done:
        raise ValueError("cv2 could not encode a picture")
    return bytes(data)


def values(image: PolarFrame, region: tuple[int, int, int, int]) -> dict[str, Any]:
    """Return the mean values of a region of an image, for a trace or a pointer.

    Parameters
    ----------
    image : PolarFrame
        The image.
    region : (int, int, int, int)
        (x, y, width, height) in the image's pixels; clamped to it.

    Returns
    -------
    dict of str to number or None
        Angle and degree of the mean Stokes vector over valid pixels, and the root mean
        square of the pixels' sigmas, which is that of a single pixel, not of the mean.
    """
    height, width = image.s0.shape
    x = min(max(region[0], 0), width - 1)
    y = min(max(region[1], 0), height - 1)
    part = (slice(y, min(max(y + region[3], y + 1), height)),
            slice(x, min(max(x + region[2], x + 1), width)))
    valid = image.valid[part]
    count = int(np.count_nonzero(valid))
    found: dict[str, Any] = {"x": x, "y": y, "pixels": count, "t_us": image.t_us}
    if not count:
        return found
    s0, s1, s2 = (np.array([[plane[part][valid].mean(dtype=np.float64)]])
                  for plane in (image.s0, image.s1, image.s2))
    found |= {"s0": s0.item(), "aop_deg": math.degrees(aop(s1, s2).item()),
              "dolp": dolp(s0, s1, s2).item(),
              "quad": [float(plane[part][valid].mean()) for plane in image.quad]}
    for name, sigma, scale in (("aop_sigma_deg", image.sigma_aop, 180 / math.pi),
                               ("dolp_sigma", image.sigma_dolp, 1.0)):
        if sigma is not None:
            rms = math.sqrt(float(np.mean(np.square(sigma[part][valid], dtype=float))))
            found[name] = scale * rms if math.isfinite(rms) else None
    return {name: None if isinstance(value, float) and not math.isfinite(value)
            else value for name, value in found.items()}


def archive(image: PolarFrame) -> bytes:
    """Return all data of an image as the bytes of an .npz file."""
    arrays: dict[str, Any] = {
        "quad": image.quad, "s0": image.s0, "aop_rad": image.aop,
        "dolp": image.dolp, "valid": image.valid, "t_us": np.array(image.t_us)}
    for name, sigma in (("sigma_aop_rad", image.sigma_aop),
                        ("sigma_dolp", image.sigma_dolp)):
        if sigma is not None:
            arrays[name] = sigma
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()
