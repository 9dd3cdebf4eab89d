"""Polarization background of an instrument without a sample."""
from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.polarimetry import PolarFrame

__all__ = ["Background", "background"]


class Background(NamedTuple):
    """Polarization of the empty instrument.

    Attributes
    ----------
    stokes : ndarray of float32, shape (H, W, 3)
        Mean S0, S1, S2, divided by S0.
    dolp, dolp_sigma : float
        Degree of linear polarization of the mean over the valid pixels, and its
        standard error.  It should be 0 for illumination through a circular polarizer.
    aop : float
        Angle of polarization of that mean, radians.
    circular_purity : float
        sqrt(1 - DoLP^2), the largest possible degree of circular polarization.
    frames : int
        Number of images used.
    """

    stokes: NDArray[np.float32]
    dolp: float
    dolp_sigma: float
    aop: float
    circular_purity: float
    frames: int


def background(images: Iterable[PolarFrame]) -> Background:
    """Average images without a sample.

    Parameters
    ----------
    images : iterable of PolarFrame
        Full-resolution images of the illumination alone.

    Raises
    ------
    ValueError
        If there is no image, or no pixel is ever valid.
    """
    n = 0
    total: NDArray[np.float64] | None = None
    count: NDArray[np.int64] | None = None
    each: list[tuple[float, float]] = []
    for image in images:
        planes = np.stack([image.s0, image.s1, image.s2]).astype(np.float64)
        valid = image.valid
        if total is None or count is None:
            total, count = np.zeros_like(planes), np.zeros(valid.shape, np.int64)
        total += np.where(valid, planes, 0)
        count += valid
        if valid.any():
            s0, s1, s2 = planes[:, valid].mean(1)
            each.append((s1 / s0, s2 / s0))
        n += 1
    if total is None or count is None or not each:
        raise ValueError(f"a background needs images with valid pixels, got {n} images")
    q, u = np.mean(each, 0)
    # From the spread of the images' means, which includes drift of the lamp but not
    # the fixed pattern.
    error = float(np.hypot(*np.std(each, 0)) / np.sqrt(max(len(each), 1)))
    degree = float(np.hypot(q, u))
    mean = total / np.maximum(count, 1)
    relative = np.where((count > 0) & (mean[0] > 0),
                        mean / np.where(mean[0] > 0, mean[0], 1), [[[1]], [[q]], [[u]]])
    return Background(
        np.moveaxis(relative, 0, 2).astype(np.float32), degree, error,
        float(np.arctan2(u, q) / 2 % np.pi),
        float(np.sqrt(max(1 - degree**2, 0))), n)
