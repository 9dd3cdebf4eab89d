"""Pictures of one image, for the page and the stream."""
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
from pdavis_cv.viewer.show import Show

JPEG_QUALITY = 95
_JPEG_SAMPLING, _JPEG_444 = 7, 0x111111
"""IMWRITE_JPEG_SAMPLING_FACTOR and its value, which OpenCV before 4.7 ignores."""
PERCENTILES = (0.5, 99.5)
"""Of S0's pixels, shown black and white unless the page says.  Saturated ones count, as
they are bright at least."""
_MOST_SAMPLES = 100_000

NONE = 255
"""Value of a pixel without an estimate in a plane."""
_PARTS = 255    # values 0 .. 254 of a plane
_HIDDEN = 254   # of an angle whose standard deviation is too large; others are below
_GREY = 64      # of a picture that the method does not give


def _numbers(count: int, parts: int) -> NDArray[np.uint8]:
    """Return a colour table whose `count` entries are plane values below `parts`."""
    number = (np.arange(count) * parts // count).astype(np.uint8)
    return table_of(np.repeat(number[:, None], 3, axis=1), (NONE,) * 3, (NONE,) * 3)


_HUES = _numbers(len(HUE_TABLE) - 4, _HIDDEN)
_RAMP = _numbers(_PARTS, _PARTS)


def levels_of(show: Show, image: PolarFrame) -> tuple[float, float]:
    """Return the values of S0 to show black and white, from `PERCENTILES` of an image.

    The second is the larger; where no pixel is known, the white level of `show` stands
    in.
    """
    known = image.s0[np.isfinite(image.s0) & (image.s0 > 0)]
    if not known.size:
        return 0.0, 2 * show.white
    known = known[::-(-known.size // _MOST_SAMPLES)]
    low, high = (float(value) for value in np.percentile(known, PERCENTILES))
    return low, max(high, low + 1e-3 * abs(low) + 1e-9)


def saturated(show: Show, image: PolarFrame) -> float:
    """Return the part of the pixels whose S0 / 2 reaches the converter's full scale."""
    return float(np.mean(image.s0 >= 2 * 254.5 / 255 * show.white))


def _plane(
    one: Quantity, show: Show, image: PolarFrame, levels: tuple[float, float]
) -> NDArray[np.uint8]:
    """Return a quantity as numbers that the page colours itself.

    Pictures would take three times as long to receive.  Numbers of events are grey
    values; those of others map the quantity's range, or S0's levels, to 0 .. 254, or
    are `NONE`.
    """
    if one.of_events:
        return np.ascontiguousarray(pane(f"{one.name}_bgr", show, image)[..., 0])
    values = one.plane(image)
    if values is None:
        return np.full(image.s0.shape, NONE, np.uint8)
    values = one.of(image)
    if one.colours == "hue":
        picture = through_table(_kernels.hue_bgr, values, image.valid, AOP_SCALE, _HUES)
        picture[image.valid & ~known_aop(image)] = _HIDDEN
    else:
        low, high = levels if one.name == "s0" else one.ends(
            show.white if one.unit == INTENSITY else 1.0)
        picture = through_table(
            _kernels.ramp_bgr, (values - np.float32(low)) / np.float32(high - low),
            image.valid, _PARTS - 1, _RAMP)
    return np.ascontiguousarray(picture[..., 0])


def planes(
    names: Iterable[str], show: Show, image: PolarFrame,
    levels: tuple[float, float] | None = None,
) -> dict[str, NDArray[np.uint8]]:
    """Return the planes of quantities that a page needs, uint8 (H, W), by name.

    AoP also needs DoLP, which fades it.  `levels` are the values of S0 that are shown
    black and white, by default those of `levels_of`.
    """
    wanted = [quantity(name) for name in names]
    if any(one.colours == "hue" for one in wanted):
        wanted.append(quantity("dolp"))
    if levels is None and any(one.name == "s0" for one in wanted):
        levels = levels_of(show, image)
    return {one.name: _plane(one, show, image, levels or (0.0, 1.0))
            for one in dict.fromkeys(wanted)}


def missing(names: Iterable[str], image: PolarFrame) -> list[str]:
    """Return the names of those quantities that the image's method does not give."""
    return [one.name for one in map(quantity, names)
            if not one.of_events and one.plane(image) is None]


def palettes() -> dict[str, Any]:
    """Return the quantities that a page offers, and the RGB colours of their planes.

    ``quantities``: name, symbol, title, unit, colours and the texts at the ends of the
    legend of each; ``colours``: 256 colours of a plane's numbers, by the name of the
    colours; ``stripes``: the two colours of pixels that are not valid; ``full_dolp``:
    DoLP from which AoP has its full colour.
    """
    middle = (np.arange(_HIDDEN, dtype=np.float32) + 0.5) * np.float32(
        math.pi / _HIDDEN)
    steps = np.arange(_PARTS, dtype=np.float32) / np.float32(_PARTS - 1)
    stripes = [[*colour[::-1]] for colour in INVALID]
    tones = [[grey] * 3 for grey in range(256)]

    def rgb(colours: NDArray[np.uint8]) -> list[list[int]]:
        found: list[list[int]] = colours[0, :, ::-1].tolist()
        return [*found, stripes[0]]      # transparent on the page

    return {
        "quantities": [
            {"name": one.name, "symbol": one.symbol or one.name, "title": one.title,
             "unit": one.unit, "ends": _ends(one),
             "colours": "tone" if one.of_events else one.colours}
            for one in QUANTITIES.usable().values() if one.pane],
        "colours": {"tone": tones, "hue": rgb(np.append(
                        aop_bgr(middle[None]), np.zeros((1, 1, 3), np.uint8), 1)),
                    "viridis": rgb(dolp_bgr(steps[None])),
                    "grey": rgb(grey_bgr(steps[None], 1.0))},
        "stripes": stripes, "full_dolp": FULL_COLOUR_DOLP}


def _ends(one: Quantity) -> list[str]:
    """Return the texts at the ends of a quantity's legend."""
    if one.name == "s0":        # the page has fields for its levels there
        return ["", ""]
    if one.light:
        return ["0", "full scale"]
    if one.unit == "rad":
        return [f"{math.degrees(end):.0f}\N{DEGREE SIGN}" for end in one.range]
    return [f"{end:g} {'' if one.unit == '1' else one.unit}".rstrip()
            for end in one.range]


def pane(name: str, show: Show, image: PolarFrame) -> NDArray[np.uint8]:
    """Return a picture of an image by the name of an output of `VideoCapture`."""
    output = output_named(name)
    if not output.picture:
        raise ValueError(
            f"output must be a picture, such as {output.name}_bgr, got {name!r}")
    if output.quantity.of_events:
        assert image.t_us is not None
        provenance = show.fusion.provenance
        step = 2 if provenance["demosaic"] in HALF_SIZE else 1
        return events_bgr(event_counts(
            [show.events(image.t_us)], provenance["roi"], step))
    if output.quantity.plane(image) is None:
        return np.full((*image.s0.shape, 3), _GREY, np.uint8)
    return colour(image, output, ToneCurve(show.white))


def jpeg(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture as JPEG 4:4:4, because subsampled colour distorts AoP.

    OpenCV 4.6 can only write 4:2:0.
    """
    cv2 = opencv()
    done, data = cv2.imencode(".jpg", picture, [
        cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, _JPEG_SAMPLING, _JPEG_444])
    if not done:
        raise ValueError("cv2 could not encode a picture")
    return bytes(data)


def archive(image: PolarFrame) -> bytes:
    """Return all data of an image as the bytes of an .npz file."""
    arrays: dict[str, Any] = {
        "quad": image.quad, "s0": image.s0, "aop_rad": image.aop,
        "dolp": image.dolp, "valid": image.valid, "t_us": np.array(image.t_us),
        "sigma_aop_rad": image.sigma_aop, "sigma_dolp": image.sigma_dolp}
    out = io.BytesIO()
    np.savez(out, **{name: one for name, one in arrays.items() if one is not None})
    return out.getvalue()
