"""Lock-in analysis: amplitude and phase of every pixel at one frequency."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.analysis.spectrum import checked_hz

__all__ = ["LockIn", "LockInMaps"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LockInMaps:
    """Result of a lock-in; every map is float64, shape (H, W).

    Parameters
    ----------
    hz : float
        Frequency.
    reference_us : int
        Time of phase 0, t0.
    mean : ndarray
        Mean value.
    amplitude, amplitude_se : ndarray
        Amplitude in ``mean + amplitude * cos(2 pi f (t - t0) + phase)``, and the
        standard error of each of the two quadratures.  NaN where a pixel was usable
        fewer than five times.
    phase : ndarray
        Radians, -pi..pi.
    count : ndarray
        Number of images in which a pixel was usable.
    """

    hz: float
    reference_us: int
    mean: FloatArray
    amplitude: FloatArray
    amplitude_se: FloatArray
    phase: FloatArray
    count: FloatArray

    def smoothed(self, size: int = 3) -> LockInMaps:
        """Average the quadratures over squares of pixels.

        A pixel of a demosaiced image is not an independent measurement: it shares the
        samples of every channel with its neighbours, while the errors of the polarizers
        differ from sample to sample.  Over 3 x 3 pixels, which hold 9/4 samples of each
        channel, these errors average out.

        Parameters
        ----------
        size : int
            Side of the square, odd; 1 changes nothing.  At the border, and next to
            pixels without an amplitude, the available pixels are averaged.

        Returns
        -------
        LockInMaps
            ``mean`` and both quadratures averaged; ``amplitude_se`` as that of
            size^2 / 4 independent samples.

        Raises
        ------
        ValueError
            If `size` is not odd and positive.
        """
        if size < 1 or size % 2 != 1:
            raise ValueError(f"size must be odd and positive, got {size!r}")
        if size == 1:
            return self
        from scipy.ndimage import uniform_filter
        known = np.isfinite(self.amplitude)

        def averaged(plane: FloatArray) -> FloatArray:
            total = uniform_filter(np.where(known, plane, 0.0), size, mode="constant")
            return np.asarray(np.where(known, total / weight, np.nan))

        weight = np.maximum(
            uniform_filter(known.astype(np.float64), size, mode="constant"),
            0.5 / size ** 2)
        a = averaged(self.amplitude * np.cos(self.phase))
        b = averaged(self.amplitude * np.sin(self.phase))
        samples = np.maximum(weight * size ** 2 / 4, 1)
        se = np.sqrt(averaged(self.amplitude_se ** 2) / samples)
        return LockInMaps(self.hz, self.reference_us, averaged(self.mean),
                          np.hypot(a, b), se, np.arctan2(b, a), self.count)

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Pixels whose amplitude exceeds three times its standard error."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.amplitude > 3 * self.amplitude_se, np.bool_)


class LockIn:
    """Fit mean, cosine and sine at one frequency to every pixel, image by image.

    It keeps sums, not images, so memory is bounded.  Pixels may be invalid in some
    images.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    hz : float
        Frequency.
    reference_us : int
        Time of phase 0.

    Raises
    ------
    ValueError
        If ``hz`` is not positive.
    """

    def __init__(self, shape: tuple[int, int], hz: float, reference_us: int) -> None:
        self.hz, self.reference_us = checked_hz(hz), int(reference_us)
        self.shape = (int(shape[0]), int(shape[1]))
        # Normal equations of 1, cos, sin for all images; invalid pixels are subtracted.
        self._whole = np.zeros((3, 3))
        self._missing = np.zeros((6, *self.shape))
        self._right = np.zeros((3, *self.shape))
        self._square = np.zeros(self.shape)
        self._work = np.empty(self.shape)

    def add(
        self, t_us: int, image: ArrayLike, valid: NDArray[np.bool_] | None = None
    ) -> None:
        """Add an image.

        Parameters
        ----------
        t_us : int
            Its time.
        image : array_like, shape (H, W)
            Values; those that are not finite are left out.
        valid : ndarray of bool, shape (H, W), optional
            True = usable.

        Raises
        ------
        ValueError
            If the image has another shape.
        """
        v = np.asarray(image)
        if v.shape != self.shape:
            raise ValueError(f"image must have shape {self.shape}, got {v.shape}")
        u = 2 * np.pi * self.hz * ((int(t_us) - self.reference_us) / 1e6)
        basis = np.array([1.0, np.cos(u), np.sin(u)])
        product = np.outer(basis, basis)
        self._whole += product
        usable = np.isfinite(v) if valid is None else np.isfinite(v) & valid
        if not usable.all():
            v = np.where(usable, v, 0)
            bad = ~usable
            for i, (a, b) in enumerate(_PAIRS):
                self._missing[i][bad] += product[a, b]
        for plane, weight in zip(self._right, basis, strict=True):
            plane += np.multiply(v, weight, out=self._work)
        self._square += np.multiply(v, v, out=self._work, dtype=np.float64)

    def maps(self) -> LockInMaps:
        """Return the maps of the images so far."""
        matrix = np.empty((*self.shape, 3, 3))
        for i, (a, b) in enumerate(_PAIRS):
            matrix[..., a, b] = matrix[..., b, a] = self._whole[a, b] - self._missing[i]
        count = matrix[..., 0, 0].copy()
        enough = (count >= 5) & (np.linalg.det(matrix) > 1e-9 * count ** 3)
        matrix[~enough] = np.eye(3)
        right = np.moveaxis(self._right, 0, -1)
        inverse = np.linalg.inv(matrix)
        solution = np.einsum("...ij,...j->...i", inverse, right)
        rest = self._square - np.einsum("...i,...i->...", solution, right)
        freedom = np.maximum(count - 3, 1)
        spread = (inverse[..., 1, 1] + inverse[..., 2, 2]) / 2
        se = np.sqrt(np.maximum(rest, 0) / freedom * spread)
        mean, a, b = np.moveaxis(solution, -1, 0)
        gone = np.where(enough, 1.0, np.nan)
        return LockInMaps(
            self.hz, self.reference_us, mean * gone, np.hypot(a, b) * gone, se * gone,
            np.arctan2(-b, a) * gone, count)


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
