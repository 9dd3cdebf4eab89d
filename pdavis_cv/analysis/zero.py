"""The zero of the angle, from light of a known direction of polarization."""
from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from pdavis_cv._checks import MOST_ANGLE, real_number
from pdavis_cv.polarimetry import PolarFrame


def found_zero(
    images: Iterable[PolarFrame], known: float, *, least_dolp: float = 0.1
) -> tuple[float, float]:
    """Return what has to be added to AoP for it to be the known one, and its error.

    For a `TurningAnalyser` and for `AnalyserSteps` it is to be added to their angles.

    Parameters
    ----------
    images : iterable of PolarFrame
        Of a region that a polarizer of known direction fills.
    known : float
        AoP of its light, radians.
    least_dolp : float
        Pixels below it do not count.

    Returns
    -------
    zero, sigma : float
        Radians, the former in (-pi/2, pi/2].  The error is that of the mean of images,
        or of one image's pixels, as independent.

    Raises
    ------
    ValueError
        If no pixel is valid and polarized, or `known` is no angle.
    """
    if not abs(real_number(known)) <= MOST_ANGLE:
        raise ValueError(f"known must lie within {MOST_ANGLE:g} of 0, got {known!r}")
    means, parts = [], []
    for image in images:
        seen = np.exp(2j * image.aop[image.valid & (image.dolp >= least_dolp)])
        if seen.size:
            means.append(complex(seen.mean()))
            parts.append(seen)
    whole = sum(means)
    if not means or abs(whole) == 0:
        raise ValueError(
            f"images must show light with a DoLP of {least_dolp:g} or more, got none")
    sample = np.array(means) if len(means) > 1 else parts[0]
    around = np.angle(sample * np.conj(whole)) / 2
    sigma = float(around.std() / math.sqrt(max(len(around) - 1, 1)))
    zero = math.remainder(2 * known - float(np.angle(whole)), 2 * math.pi) / 2
    return (zero if zero > -math.pi / 2 else -zero), sigma
