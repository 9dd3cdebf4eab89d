"""Scenes: the Stokes vector of the light in closed form, at any time and place."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv.simulation.truth import FloatArray

__all__ = ["RotatingPolarizer"]


@dataclass(frozen=True, kw_only=True)
class RotatingPolarizer:
    """A polarizer turning in front of a uniform lamp; AoP makes two cycles per turn.

    Parameters
    ----------
    rpm : float
        Turns per minute of the polarizer, positive = counter-clockwise as displayed.
    s0 : float
        S0 behind the polarizer in DN per ms.
    start_angle : float
        AoP at time 0, radians.
    dolp : float
        Degree of linear polarization of the light, 0..1.
    """

    rpm: float
    s0: float
    start_angle: float = 0.0
    dolp: float = 1.0

    def stokes(
        self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S0, S1, S2 in DN per ms."""
        t, _, _ = np.broadcast_arrays(np.asarray(t_us, np.float64), x, y)
        double = 2 * (self.start_angle + self.rad_per_us * t)
        polarized = self.s0 * self.dolp
        return (np.full(t.shape, float(self.s0)), polarized * np.cos(double),
                polarized * np.sin(double))

    @property
    def rad_per_us(self) -> float:
        """Speed of the polarizer in radians per microsecond."""
        return 2 * np.pi * self.rpm / 60e6
