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
    """Return the crosstalk kernel of a pixel, equal in all directions.

    Parameters
    ----------
    side, corner : float
        Share of its light that a pixel has from each of the four pixels at its sides,
        and from each of those at its corners.
    """
    middle = 1 - 4 * side - 4 * corner
    return ((corner, side, corner), (side, middle, side), (corner, side, corner))


def check_kernel(name: str, value: Any) -> None:
    """Require three rows of three shares that add to 1."""
    array = np.array(value, np.float64) if np.shape(value) == (3, 3) else None
    require(name, value, array is not None and bool((array >= 0).all())
            and abs(float(array.sum()) - 1) < 1e-9 and float(array[1, 1]) >= 0.5,
            "be three rows of three shares that add to 1, half of it in the middle")


class Neighbours:
    """The pixels of a region and their surrounding neighbours, which exchange light.

    Parameters
    ----------
    shares : sequence of 3 sequences of 3 floats
        Share of a pixel's light that comes from above left, above, ... below right.
    responses : ndarray of float64, shape (H + 2, W + 2, C)
        Responses of each pixel without crosstalk; the first and last rows and columns
        are neighbours of the region, 0 where the sensor ends.
    """

    def __init__(self, shares: Kernel, responses: FloatArray) -> None:
        self.shares, self.responses = shares, responses
        # At the sensor's edge, a pixel keeps the light that it would exchange.
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
            As many as the responses' components, in front of these rows and of the
            pixels around them.
        rows : slice
            Rows of the region.

        Returns
        -------
        ndarray of float64, shape (..., H, W)
        """
        near = np.moveaxis(self.responses[rows.start:rows.stop + 2], -1, 0)
        behind = sum(a * s for a, s in zip(near, stokes, strict=False))
        return self._mixed(np.asarray(behind)) * self._scale[rows]
