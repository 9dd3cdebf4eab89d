"""Truth: the light in front of the camera, at any time and place."""
from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Scene", "Truth"]

FloatArray = NDArray[np.float64]


class Scene(Protocol):
    """Linearly polarized light in front of the camera, in closed form."""

    def stokes(
        self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S0, S1, S2 at times in us and places in pixels, broadcast together.

        S0 is in DN per ms: what an ideal pixel pair I0 + I90 would count.
        """
        ...


class Truth:
    """What a perfect instrument would measure; exact, evaluated when asked.

    Without ``x`` and ``y`` the answer is for the middle of the sensor, which for
    uniform scenes is the answer everywhere.

    Parameters
    ----------
    scene : Scene
        The light.
    size : (int, int)
        (height, width) of the sensor.
    """

    def __init__(self, scene: Scene, size: tuple[int, int]) -> None:
        self.scene, self.size = scene, size

    def stokes(
        self, t_us: ArrayLike, x: ArrayLike | None = None, y: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S0, S1, S2 in DN per ms, float64, shape of t, x and y broadcast."""
        height, width = self.size
        x = (width - 1) / 2 if x is None else x
        y = (height - 1) / 2 if y is None else y
        return self.scene.stokes(t_us, x, y)

    def s0(self, t_us: ArrayLike, x: Any = None, y: Any = None) -> FloatArray:
        """S0 in DN per ms."""
        return self.stokes(t_us, x, y)[0]

    def aop(self, t_us: ArrayLike, x: Any = None, y: Any = None) -> FloatArray:
        """Angle of polarization in radians, [0, pi)."""
        _, s1, s2 = self.stokes(t_us, x, y)
        return angle(s1, s2)

    def dolp(self, t_us: ArrayLike, x: Any = None, y: Any = None) -> FloatArray:
        """Degree of linear polarization, 0..1; 0 where there is no light."""
        s0, s1, s2 = self.stokes(t_us, x, y)
        polarized = np.hypot(s1, s2)
        return np.divide(polarized, s0, out=np.zeros_like(polarized), where=s0 > 0)

    def image(self, t_us: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S0, S1, S2 of every pixel at one time, each of shape (H, W)."""
        y, x = np.mgrid[: self.size[0], : self.size[1]]
        s0, s1, s2 = self.stokes(t_us, x, y)
        return s0, s1, s2


def angle(s1: FloatArray, s2: FloatArray) -> FloatArray:
    """AoP in radians, [0, pi), of float64 S1 and S2."""
    half = np.mod(np.arctan2(s2, s1) / 2, np.pi)
    return np.where(half >= np.pi, 0.0, half)
