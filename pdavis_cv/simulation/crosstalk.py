"""Crosstalk: light that passes one pixel's polarizer and reaches its neighbour."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.simulation.checks import require

__all__ = ["Neighbours", "check_kernel", "kernel"]

FloatArray = NDArray[np.float64]
Kernel = tuple[tuple[float, float, float], ...]


def kernel(side: float, corner: float = 0.0) -> Kernel:
    """Return a crosstalk kernel with the symmetry of the pixel.

    Parameters
    ----------
    side, corner : float
        Fraction of a pixel's light that comes through the polarizer of each of its
        four nearest neighbours, and of each of its four diagonal ones.
    """
    middle = 1 - 4 * side - 4 * corner
    return ((corner, side, corner), (side, middle, side), (corner, side, corner))


def check_kernel(name: str, value: Any) -> None:
    """Require three rows of three shares that add to 1."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    require(name, value, array.shape == (3, 3) and bool((array >= 0).all())
            and abs(float(array.sum()) - 1) < 1e-9 and float(array[1, 1]) >= 0.5,
            "be three rows of three shares that add to 1, half of it in the middle")


class Neighbours:
    """Crosstalk of the pixels of a region with each other and those around it.

    Parameters
    ----------
    shares : sequence of 3 sequences of 3 floats
        The kernel: fraction of a pixel's light that comes through the polarizer above
        left, above, ... below right.
    responses : ndarray of float64, shape (H + 2, W + 2, C)
        Responses of each pixel without crosstalk; the first and last rows and columns
        are neighbours of the region, 0 where the sensor ends.
    """

    def __init__(self, shares: Kernel, responses: FloatArray) -> None:
        self.shares, self.responses = shares, responses
        # At the sensor's edge the kernel is renormalised to the pixels that exist.
        self._scale = 1 / self._mixed((responses[..., 0] > 0).astype(np.float64))

    def _mixed(self, light: FloatArray) -> FloatArray:
        height, width = light.shape[-2] - 2, light.shape[-1] - 2
        total = np.zeros((*light.shape[:-2], height, width))
        for row, shares in enumerate(self.shares):
            for column, share in enumerate(shares):
                if share:
                    total += share * light[
                        ..., row:row + height, column:column + width]
        return total

    def uniform(self) -> FloatArray:
        """Return the responses of the region's pixels to uniform light, (H, W, C)."""
        mixed = self._mixed(np.moveaxis(self.responses, -1, 0)) * self._scale
        return np.ascontiguousarray(np.moveaxis(mixed, 0, -1))

    def light(self, stokes: tuple[FloatArray, ...], rows: slice) -> FloatArray:
        """Return the light on rows of the region.

        Parameters
        ----------
        stokes : tuple of ndarray of float64, shape (..., H + 2, W + 2)
            S0, S1, ... as far as the responses go, on these rows and one pixel around.
        rows : slice
            Rows of the region.

        Returns
        -------
        ndarray of float64, shape (..., H, W)
        """
        near = np.moveaxis(self.responses[rows.start:rows.stop + 2], -1, 0)
        behind = sum(a * s for a, s in zip(near, stokes, strict=False))
        return self._mixed(np.asarray(behind)) * self._scale[rows]
