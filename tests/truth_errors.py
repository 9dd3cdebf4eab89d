"""Errors of super-pixel images relative to the light that was simulated."""
from typing import NamedTuple

import numpy as np

from pdavis_cv.analysis import axial_difference


class Errors(NamedTuple):
    """Mean absolute errors, and the parts of valid pixels that sigmas cover."""

    aop: float
    dolp: float
    valid: float
    aop_coverage: float
    dolp_coverage: float


def errors_of(images, truth):
    """Return the errors of all pixels, valid or not; AoP in radians where DoLP > .2.

    Values that are not finite count as errors of 45 degrees and of 1.
    """
    aop, dolp, valids, covered = [], [], [], ([], [])
    for image in images:
        y, x = 2 * np.mgrid[:image.shape[0], :image.shape[1]] + 0.5
        degree = truth.dolp(image.t_us, x, y)
        off = np.abs(axial_difference(image.aop, truth.aop(image.t_us, x, y)))
        off[~np.isfinite(off)] = np.pi / 4
        miss = np.abs(image.dolp - degree)
        miss[~np.isfinite(miss)] = 1
        strong = degree > 0.2
        aop.append(off[strong])
        dolp.append(miss)
        valids.append(image.valid)
        if image.sigma_aop is not None:
            covered[0].append((off <= image.sigma_aop)[strong & image.valid])
            covered[1].append((miss <= image.sigma_dolp)[image.valid])
    return Errors(*(np.mean(np.concatenate(one, axis=None)) if one else np.nan
                    for one in (aop, dolp, valids, *covered)))
