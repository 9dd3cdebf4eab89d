"""The lens: its polarization, and oblique incidence on the sensor's polarizers."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import MOST_ANGLE
from pdavis_cv.simulation.checks import (
    fraction,
    python_numbers,
    require,
    within,
)
from pdavis_cv.simulation.mueller import diattenuator, retarder

__all__ = ["Lens"]

FloatArray = NDArray[np.float64]

# Quadrature over the pupil: exact for r^2, and for azimuthal orders up to 7.
_RINGS, _SPOKES = 3, 8


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A lens in front of the polarizers; the default changes nothing.

    Parameters
    ----------
    f_number : float
        The half-angle of the cone on a pixel is ``asin(1 / (2 f_number))``.
    chief_ray : float
        Angle of incidence of the chief ray at the sensor's corners, radians; its
        tangent is proportional to the distance from the middle.  0: telecentric.
    half_ratio : float
        Angle of incidence, radians, at which a polarizer's extinction ratio is halved:
        ``ER / (1 + (angle / half_ratio)^2)``.
    diattenuation, retardance : float
        Of the glass at the sensor's corners, 0..1 and radians within 1e6 of 0;
        proportional to the square of the distance from the middle, as Fresnel's
        equations are to that of the angle.  The axis of larger transmission, and the
        fast one, is radial.

    Notes
    -----
    docs/theory/optics.md has the equations.
    """

    f_number: float = math.inf
    chief_ray: float = 0.0
    half_ratio: float = math.inf
    diattenuation: float = 0.0
    retardance: float = 0.0

    def __post_init__(self) -> None:
        python_numbers(self)
        within(0.5, math.inf, f_number=self.f_number)
        within(0, math.inf, chief_ray=self.chief_ray, half_ratio=self.half_ratio)
        require("chief_ray", self.chief_ray, self.chief_ray < math.radians(60),
                "be below 60 degrees")
        require("half_ratio", self.half_ratio, self.half_ratio > 0, "be positive")
        fraction(diattenuation=self.diattenuation)
        require("diattenuation", self.diattenuation, self.diattenuation < 1,
                "be below 1")
        within(-MOST_ANGLE, MOST_ANGLE, retardance=self.retardance)

    def mueller(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the Mueller matrix of the glass at places in the image.

        Parameters
        ----------
        x, y : array_like
            To the right and up from the middle; a corner is at distance 1.

        Returns
        -------
        ndarray of float64, shape (..., 4, 4)
        """
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        square, radial = x**2 + y**2, np.arctan2(y, x)
        return (retarder(self.retardance * square, radial)
                @ diattenuator(np.minimum(self.diattenuation * square, 1), radial))

    def seen(
        self, angle: FloatArray, ratio: FloatArray, x: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return the responses of the sensor's polarizers to S0..S3 before the lens.

        Parameters
        ----------
        angle, ratio : ndarray of float64
            Angle, radians, and extinction ratio of each polarizer at normal incidence.
        x, y : ndarray of float64
            Places, as for `mueller`; all broadcast together.

        Returns
        -------
        ndarray of float64, shape (..., 4)
            The response to S0 is about a half.
        """
        slope = math.tan(self.chief_ray)
        cone = math.tan(math.asin(1 / (2 * self.f_number)))
        total = np.zeros((*np.broadcast_shapes(angle.shape, x.shape, y.shape), 3))
        total[..., 0] = 0.5
        rays = [(0.0, 0.0)] if cone == 0 else [
            (math.sqrt((ring + 0.5) / _RINGS) * cone, 2 * math.pi * spoke / _SPOKES)
            for ring in range(_RINGS) for spoke in range(_SPOKES)]
        for size, direction in rays:
            right = slope * x + size * math.cos(direction)
            up = slope * y + size * math.sin(direction)
            incidence = np.arctan(np.hypot(right, up))
            plane = np.arctan2(up, right)
            at = ratio / (1 + (incidence / self.half_ratio)**2)
            contrast = (at - 1) / (at + 1) / (2 * len(rays))
            # Oblique incidence foreshortens the axis in the plane of incidence.
            turned = 2 * (plane + np.arctan2(np.sin(angle - plane) * np.cos(incidence),
                                             np.cos(angle - plane)))
            total[..., 1] += contrast * np.cos(turned)
            total[..., 2] += contrast * np.sin(turned)
        return np.asarray(np.einsum(
            "...i,...ij->...j", total, self.mueller(x, y)[..., :3, :]))
