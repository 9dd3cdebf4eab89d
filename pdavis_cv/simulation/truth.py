"""Truth: the light in front of the camera, at any time and place."""
from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv.simulation.scenes import FloatArray, Scene


class Truth:
    """Exact truth of a simulated recording, evaluated on request.

    Times are microseconds on the recording's clock, places are pixels of the
    recording; ``x`` and ``y`` default to its middle.

    Parameters
    ----------
    scene : Scene
        The light.
    size : (int, int)
        (height, width) of the recording.
    origin : (int, int)
        (row, column) of its first pixel on the sensor.
    stop_us : int
        End of the recording.

    Attributes
    ----------
    bus_t_us, bus_load, bus_lost : ndarray, shape (N,)
        End of each piece of the recording, the fraction of it in which the
        read-out bus was busy, and the events lost in it; empty without a bus.
    """

    def __init__(
        self, scene: Scene, size: tuple[int, int], origin: tuple[int, int] = (0, 0),
        stop_us: int = 0,
    ) -> None:
        self.scene, self.size, self.origin, self.stop_us = scene, size, origin, stop_us
        self.bus_t_us: NDArray[np.int64] = np.empty(0, np.int64)
        self.bus_load: FloatArray = np.empty(0)
        self.bus_lost: NDArray[np.int64] = np.empty(0, np.int64)

    def stokes(
        self, t_us: ArrayLike, x: ArrayLike | None = None, y: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S0, S1, S2 in DN per ms, float64, shape of t, x and y broadcast."""
        height, width = self.size
        x = (width - 1) / 2 if x is None else x
        y = (height - 1) / 2 if y is None else y
        row, column = self.origin
        return self.scene.stokes(t_us, np.add(x, column), np.add(y, row))

    def s0(self, t_us: ArrayLike, x: Any = None, y: Any = None) -> FloatArray:
        """S0 in DN per ms."""
        return self.stokes(t_us, x, y)[0]

    def aop(self, t_us: ArrayLike, x: Any = None, y: Any = None) -> FloatArray:
        """Angle of polarization in radians, [0, pi)."""
        _, s1, s2 = self.stokes(t_us, x, y)
        half = np.mod(np.arctan2(s2, s1) / 2, np.pi)
        return np.where(half >= np.pi, 0.0, half)

    def dolp(self, t_us: ArrayLike, x: Any = None, y: Any = None) -> FloatArray:
        """Degree of linear polarization, 0..1; 0 where there is no light."""
        s0, s1, s2 = self.stokes(t_us, x, y)
        polarized = np.hypot(s1, s2)
        return np.divide(polarized, s0, out=np.zeros_like(polarized), where=s0 > 0)

    def image(self, t_us: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S0, S1, S2 of every pixel at one time, each of shape (H, W)."""
        y, x = np.mgrid[: self.size[0], : self.size[1]]
        return self.stokes(t_us, x, y)

    def lit(self) -> NDArray[np.bool_]:
        """Return the mask of the pixels to score (`Scene.lit`), bool (H, W)."""
        y, x = np.mgrid[: self.size[0], : self.size[1]]
        return self.scene.lit(x + self.origin[1], y + self.origin[0])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a NumPy archive of the truth at the middle pixel, every millisecond.

        Parameters
        ----------
        path : path_like
            The file, usually ``RECORDING.truth.npz``; appears only when whole.

        Notes
        -----
        ``t_us`` int64 (N,), ``aop`` and ``dolp`` and ``s0`` float64 (N,), radians
        and DN per ms; ``roi`` (x, y, width, height) that shares this truth: the whole
        recording for uniform scenes, else the pixel; ``lit`` bool (H, W);
        ``bus_t_us``, ``bus_load``, ``bus_lost``.
        """
        t = np.arange(0, max(self.stop_us, 1), 1000, dtype=np.int64)
        height, width = self.size
        x, y = (width - 1) // 2, (height - 1) // 2
        roi = (0, 0, width, height) if self.scene.uniform else (x, y, 1, 1)
        with write_beside(path) as part, part.open("wb") as file:
            np.savez_compressed(
                file, t_us=t, aop=self.aop(t, x, y), dolp=self.dolp(t, x, y),
                s0=self.s0(t, x, y), roi=np.array(roi), lit=self.lit(),
                bus_t_us=self.bus_t_us, bus_load=self.bus_load,
                bus_lost=self.bus_lost)
