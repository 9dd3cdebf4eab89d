"""Errors of polarization images relative to known light and to their own sigmas."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import PolarFrame
from pdavis_cv.analysis import axial_difference

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """Mean absolute errors of images, and related numbers; angles in radians.

    Parameters
    ----------
    images : int
        Number of images.
    aop_error, dolp_error : float
        Errors of all pixels, valid or not.  Values that are not finite count as errors
        of 45 degrees, the mean error of a guess, and of 1.
    roi_aop_error, roi_dolp_error : float
        Errors of the region's mean Stokes vector; NaN if the truth varies within it.
    roi_dolp : float
        DoLP of that mean.
    roi_aop_range : float
        Largest minus smallest AoP of that mean: close to pi if the polarization turns.
    aop_coverage, dolp_coverage : float
        Fraction of the valid pixels whose error is at most their sigma; 0.68 if sigmas
        are correct.  NaN if images have none.
    valid : float
        Fraction of valid pixels.
    """

    images: int
    aop_error: float
    dolp_error: float
    roi_aop_error: float
    roi_dolp_error: float
    roi_dolp: float
    roi_aop_range: float
    aop_coverage: float
    dolp_coverage: float
    valid: float


class Scorer:
    """Accumulate errors of images relative to known light.

    Parameters
    ----------
    truth : object
        The light in front of the camera: its methods aop and dolp take times in us and
        places in pixels, such as those of `simulation.Truth`.
    shape : (int, int)
        (height, width) of the images.
    scale : int
        Recording pixels per image pixel; 2 for super-pixel images.
    mask : ndarray of bool, shape (H, W), optional
        Pixels to score; default all.
    least_dolp : float
        AoP is scored where the true DoLP exceeds this.
    margin : float
        Pixels closer than this to an edge, where the true AoP jumps by more than 2
        degrees, are left out; pixels.
    """

    def __init__(
        self, truth: Any, shape: tuple[int, int], *,
        scale: int = 2, mask: NDArray[np.bool_] | None = None, least_dolp: float = 0.2,
        margin: float = 0.0,
    ) -> None:
        self._truth, self._least, self._margin = truth, least_dolp, margin
        self._mask = np.ones(shape, np.bool_) if mask is None else mask
        y, x = np.nonzero(self._mask)
        self._x, self._y = ((at + 0.5) * scale - 0.5 for at in (x, y))
        # Sums and counts of five values: errors of AoP and DoLP, errors of the region's
        # AoP and DoLP, and the region's DoLP.
        self._sum, self._count = np.zeros(5), np.zeros(5)
        self._covered, self._claimed = np.zeros(2), np.zeros(2)
        self._valid = self._seen = self._images = 0
        self._span = (np.inf, -np.inf)

    def add(self, image: PolarFrame) -> None:
        """Score one image, which has a time."""
        assert image.t_us is not None
        angle = self._truth.aop(image.t_us, self._x, self._y)
        degree = self._truth.dolp(image.t_us, self._x, self._y)
        counts = self._away_from_edges(image.t_us, angle)
        off = np.abs(axial_difference(image.aop[self._mask], angle))
        off[~np.isfinite(off)] = np.pi / 4
        miss = np.abs(image.dolp[self._mask] - degree)
        miss[~np.isfinite(miss)] = 1
        polarized = counts & (degree > self._least)
        valid = image.valid[self._mask]
        self._take(0, off[polarized])
        self._take(1, miss[counts])
        self._images += 1
        self._seen += int(counts.sum())
        self._valid += int(valid[counts].sum())
        if image.sigma_aop is not None and image.sigma_dolp is not None:
            for i, (error, sigma, where) in enumerate((
                    (off, image.sigma_aop[self._mask], polarized & valid),
                    (miss, image.sigma_dolp[self._mask], counts & valid))):
                self._covered[i] += (error[where] <= sigma[where]).sum()
                self._claimed[i] += where.sum()
        if np.ptp(degree) < 1e-9 and np.ptp(angle) < 1e-9:
            self._add_region(image, float(angle[0]), float(degree[0]))

    def _add_region(self, image: PolarFrame, angle: float, degree: float) -> None:
        s0, s1, s2 = (float(plane[self._mask].mean(dtype=np.float64))
                      for plane in (image.s0, image.s1, image.s2))
        aop = np.arctan2(s2, s1) / 2 % np.pi
        if not np.isfinite([s0, s1, s2]).all():
            self._take(3, np.ones(1))
            if degree > self._least:
                self._take(2, np.full(1, np.pi / 4))
            return
        dolp = np.hypot(s1, s2) / s0 if s0 > 0 else 0.0
        self._take(3, np.array([abs(dolp - degree)]))
        self._take(4, np.array([dolp]))
        if degree > self._least:
            self._take(2, np.abs(axial_difference(np.array([aop]), angle)))
            self._span = min(self._span[0], aop), max(self._span[1], aop)

    def _take(self, i: int, values: FloatArray) -> None:
        self._sum[i] += values.sum(dtype=np.float64)
        self._count[i] += len(values)

    def _away_from_edges(self, t_us: int, angle: FloatArray) -> NDArray[np.bool_]:
        away = np.ones(angle.shape, np.bool_)
        if self._margin:
            for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                near = self._truth.aop(
                    t_us, self._x + dx * self._margin, self._y + dy * self._margin)
                away &= np.abs(axial_difference(near, angle)) < np.deg2rad(2)
        return away

    @property
    def score(self) -> Score:
        """Means over what was added; NaN where nothing counted."""
        def part(sums: FloatArray, counts: FloatArray) -> list[float]:
            return [float(s / n) if n else np.nan
                    for s, n in zip(sums, counts, strict=True)]

        low, high = self._span
        aop, dolp, roi_aop, roi_dolp, itself = part(self._sum, self._count)
        aop_coverage, dolp_coverage = part(self._covered, self._claimed)
        return Score(
            images=self._images, aop_error=aop, dolp_error=dolp,
            roi_aop_error=roi_aop, roi_dolp_error=roi_dolp,
            roi_dolp=itself,
            roi_aop_range=float(high - low) if high >= low else np.nan,
            aop_coverage=aop_coverage, dolp_coverage=dolp_coverage,
            valid=self._valid / self._seen if self._seen else np.nan)
