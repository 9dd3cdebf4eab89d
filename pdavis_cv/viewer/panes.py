"""Pictures and values of one image, for the page and the stream."""
from __future__ import annotations

import io
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._opencv import opencv
from pdavis_cv.capture.outputs import output_named
from pdavis_cv.capture.picture import colour, event_counts, events_bgr
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import INTENSITY, QUANTITIES, Quantity, quantity
from pdavis_cv.render import ToneCurve, aop_bgr, dolp_bgr, grey_bgr, known_aop
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

__all__ = ["archive", "jpeg", "missing", "palettes", "pane", "planes", "values"]

JPEG_QUALITY = 95


NONE = 255
"""Value of a pixel without an estimate in a plane."""
_PARTS = 255    # values 0 .. 254 of a plane
_HIDDEN = 254   # of an angle whose standard deviation is too large; others are below
_GREY = 64      # of a picture that the method does not give


def _numbers(count: int, parts: int) -> NDArray[np.uint8]:
    """Return a colour table whose `count` entries are plane values below `parts`."""
    number = (np.arange(count) * parts // count).astype(np.uint8)
    return table_of(np.repeat(number[:, None], 3, axis=1), (NONE,) * 3, (NONE,) * 3)


_HUES = _numbers(len(HUE_TABLE) - 2, _HIDDEN)
_RAMP = _numbers(_PARTS, _PARTS)


def _plane(one: Quantity, show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    """Return a quantity as numbers that the page colours itself.

    Pictures would take three times as long to receive.  Numbers of intensities and of
    events are grey values; those of others map the quantity's range to 0 .. 254, or are
    `NONE`.
    """
    if one.light or one.colours == "events":
        return np.ascontiguousarray(
            pane(f"{one.name}_bgr", show, image)[..., 0])
    values = one.plane(image)
    if values is None:
        return np.full(image.s0.shape, NONE, np.uint8)
    values = one.of(image)
    if one.colours == "hue":
        picture = through_table(
            _kernels.hue_bgr, values, image.valid, AOP_SCALE, _HUES)
        picture[image.valid & ~known_aop(image)] = _HIDDEN
    else:
        low, high = one.ends(show.white if one.unit == INTENSITY else 1.0)
        picture = through_table(
            _kernels.ramp_bgr, (values - np.float32(low)) / np.float32(high - low),
            image.valid, _PARTS - 1, _RAMP)
    return np.ascontiguousarray(picture[..., 0])


def planes(names: Iterable[str], show: Show, image: PolarFrame
           ) -> dict[str, NDArray[np.uint8]]:
    """Return the planes that a page needs; AoP also needs DoLP, which fades it.

    Parameters
    ----------
    names : iterable of str
        Names of quantities.
    show : Show
        The source of events and settings.
    image : PolarFrame
        The image.

    Returns
    -------
    dict of str to ndarray of uint8, shape (H, W)

    Raises
    ------
    ValueError
        If there is no such quantity.
    """
    wanted = [quantity(name) for name in names]
    if any(one.colours == "hue" for one in wanted):
        wanted.append(quantity("dolp"))
    return {one.name: _plane(one, show, image) for one in dict.fromkeys(wanted)}


def missing(names: Iterable[str], image: PolarFrame) -> list[str]:
    """Return the names of those quantities that the image's method does not give."""
    return [one.name for one in map(quantity, names)
            if one.colours != "events" and one.plane(image) is None]


def palettes() -> dict[str, Any]:
    """Return the quantities that a page offers, and the RGB colours of their planes.

    Returns
    -------
    dict
        ``quantities``: name, title, colours and the texts at the ends of the legend of
        each; ``colours``: 256 colours of a plane's numbers, by the name of the colours;
        ``full_dolp``: DoLP from which AoP has its full colour.
    """
    middle = (np.arange(_HIDDEN, dtype=np.float32) + 0.5) * np.float32(
        math.pi / _HIDDEN)
    steps = np.arange(_PARTS, dtype=np.float32) / np.float32(_PARTS - 1)
    tones = [[grey] * 3 for grey in range(256)]

    def rgb(colours: NDArray[np.uint8]) -> list[list[int]]:
        found: list[list[int]] = colours[0, :, ::-1].tolist()
        return [*found, [*INVALID[::-1]]]

    return {
        "quantities": [
            {"name": one.name, "title": one.title, "ends": _ends(one),
             "colours": "tone" if one.light or one.colours == "events" else one.colours}
            for one in QUANTITIES.usable().values() if one.pane],
        "colours": {"tone": tones, "hue": rgb(np.append(
                        aop_bgr(middle[None]), np.zeros((1, 1, 3), np.uint8), 1)),
                    "viridis": rgb(dolp_bgr(steps[None])),
                    "grey": rgb(grey_bgr(steps[None], 1.0))},
        "full_dolp": FULL_COLOUR_DOLP}


def _ends(one: Quantity) -> list[str]:
    """Return the texts at the ends of a quantity's legend."""
    if one.light:
        return ["0", "full scale"]
    if one.unit == "rad":
        return [f"{math.degrees(end):.0f}\N{DEGREE SIGN}" for end in one.range]
    return [f"{end:g} {'' if one.unit == '1' else one.unit}".rstrip()
            for end in one.range]


def pane(name: str, show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    """Return a picture of an image by the name of an output of `VideoCapture`.

    Raises
    ------
    ValueError
        If there is no such picture.
    """
    output = output_named(name)
    if not output.picture:
        raise ValueError(
            f"output must be a picture, such as {output.name}_bgr, got {name!r}")
    if output.quantity.colours == "events":
        assert image.t_us is not None
        provenance = show.fusion.provenance
        step = 2 if provenance["demosaic"] in HALF_SIZE else 1
        return events_bgr(event_counts(
            show.events(image.t_us), provenance["roi"], step))
    if output.quantity.plane(image) is None:
        return np.full((*image.s0.shape, 3), _GREY, np.uint8)
    return colour(image, output, ToneCurve(show.white))


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
