"""Values of regions of the sensor in one image, each with the error of its mean."""
from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from pdavis_cv.analyser import Analyser
from pdavis_cv.analysis.traces import pixels_per_sample
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.stokes_vector import aop, dolp, propagated

Region = tuple[int, int, int, int]
"""(x, y, width, height) in pixels of the whole sensor."""

MOST_REGIONS = 16
"""Most regions of a page."""


def values(image: PolarFrame, regions: Iterable[Region]) -> list[dict[str, Any]]:
    """Return the mean values of regions (x, y, width, height) of an image.

    The regions are in sensor pixels.  The image's provenance tells which of these it
    shows, and how the channels were interpolated; without, it is the whole sensor.  For
    each region there is ``pixels``, the number of usable image pixels that it touches,
    and of these the angle and degree of the mean Stokes vector, S0 and the mean
    intensities, with the standard errors of these means as they follow from the pixels'
    own variances.  A region that is not wholly inside the image, or has no usable
    pixel, has ``pixels`` = 0 and no values: never those of a part of it.
    """
    facts = image.provenance
    origin = facts.get("roi", (0, 0))[:2]
    demosaic = facts.get("demosaic", "")
    return [_values(image, region, origin, demosaic) for region in regions]


def _values(
    image: PolarFrame, region: Region, origin: tuple[int, int], demosaic: str
) -> dict[str, Any]:
    height, width = image.s0.shape
    step = 2 if demosaic in HALF_SIZE else 1
    x, y = region[0] - origin[0], region[1] - origin[1]
    x0, y0 = x // step, y // step
    x1, y1 = -(-(x + region[2]) // step), -(-(y + region[3]) // step)
    found: dict[str, Any] = {"pixels": 0, "t_us": image.t_us}
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        return found
    part = (slice(y0, y1), slice(x0, x1))
    valid = image.valid[part]
    found["pixels"] = int(np.count_nonzero(valid))
    if not found["pixels"]:
        return found
    stokes = tuple(np.full((1, 1), plane[part][valid].mean(dtype=np.float64))
                   for plane in (image.s0, image.s1, image.s2))
    found |= {
        "s0": stokes[0].item(), "aop_deg": math.degrees(aop(*stokes[1:]).item()),
        "dolp": dolp(*stokes).item(),
        "quad": [float(plane[part][valid].mean()) for plane in image.quad]}
    if image.variance is not None:
        _add_errors(found, image, part, stokes, pixels_per_sample(demosaic))
    return {name: None if isinstance(value, float) and not math.isfinite(value)
            else value for name, value in found.items()}


def _add_errors(
    found: dict[str, Any], image: PolarFrame, part: tuple[slice, slice],
    stokes: tuple[Any, ...], per_sample: tuple[float, float, float],
) -> None:
    """Add the standard errors of a region's mean Stokes vector.

    Interpolated pixels are not independent: the variance of the mean is that of a pixel
    over the number of samples, and never more than a pixel's.
    """
    assert image.variance is not None
    valid = image.valid[part]
    quad = image.quad[(slice(None), *part)][:, valid]
    variance = (image.variance[(slice(None), *part)][:, valid] * quad**2).mean(
        1, dtype=np.float64)
    analyser = image.analyser or Analyser.ideal(image.extinction_ratio)
    solution = analyser.solution
    if solution.ndim == 4:
        solution = solution[(..., *part)][..., valid].mean(-1)
    light, polarized = (
        variance * min(ratio / found["pixels"], 1) for ratio in per_sample[:2])
    found["s0_se"] = math.sqrt(float(np.sum(solution[0]**2 * light)))
    angle, degree, _ = propagated(
        stokes, solution.reshape(3, 4, 1, 1), polarized.reshape(4, 1, 1))
    found["aop_se_deg"], found["dolp_se"] = math.degrees(angle.item()), degree.item()
