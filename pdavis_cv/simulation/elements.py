"""Elements that light passes before it reaches the lens: wave plates and others."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import MOST_ANGLE
from pdavis_cv.simulation.checks import (
    instance,
    python_numbers,
    require,
    whole,
    within,
)
from pdavis_cv.simulation.mueller import is_physical, retarder
from pdavis_cv.simulation.scenes import FloatArray, Scene, Stokes

__all__ = ["Behind", "Waveplate", "quartz_birefringence"]

_MOST_ORDER = 10_000    # a plate of 0.6 m of quartz
_MOST_GAIN = 1e6        # on a matrix's elements: the largest gain of an amplifier


def quartz_birefringence(wavelength_nm: float) -> float:
    """Return n_e - n_o of crystalline quartz at room temperature [Ghosh 1999].

    Parameters
    ----------
    wavelength_nm : float
        200 to 2000.
    """
    within(200, 2000, wavelength_nm=wavelength_nm)
    square = (wavelength_nm / 1000) ** 2
    ordinary = (1.28604141 + 1.07044083 * square / (square - 1.00585997e-2)
                + 1.10202242 * square / (square - 100))
    extraordinary = (1.28851804 + 1.09509924 * square / (square - 1.02101864e-2)
                     + 1.15662475 * square / (square - 100))
    return math.sqrt(extraordinary) - math.sqrt(ordinary)


@dataclass(frozen=True, kw_only=True)
class Waveplate:
    """A linear retarder, whose retardance depends on the wavelength.

    Parameters
    ----------
    retardance : float
        Radians at `design_nm`: pi/2 for a quarter-wave plate, pi for a half-wave one;
        within 1e6 of 0.
    axis : float
        Angle of the fast axis, radians, within 1e6 of 0.
    design_nm : float
        Wavelength that the plate is made for, 200 to 2000.
    order : int
        Whole waves of retardance on top of it, at most 10,000: 0 for a zero-order
        plate.
    achromatic : bool
        Whether the retardance is the same at each wavelength; else that of quartz.

    Examples
    --------
    >>> plate = Waveplate(design_nm=550)
    >>> [round(math.degrees(plate.retardance_at(nm)), 1) for nm in (450, 550, 650)]
    [112.7, 90.0, 75.0]
    """

    retardance: float = math.pi / 2
    axis: float = 0.0
    design_nm: float = 550.0
    order: int = 0
    achromatic: bool = False

    def __post_init__(self) -> None:
        python_numbers(self)
        within(200, 2000, design_nm=self.design_nm)
        within(-MOST_ANGLE, MOST_ANGLE, retardance=self.retardance, axis=self.axis)
        whole(self, 0, _MOST_ORDER, "order")

    def retardance_at(self, wavelength_nm: float) -> float:
        """Return the retardance at a wavelength, radians, whole waves included."""
        whole = 2 * math.pi * self.order + self.retardance
        if self.achromatic:
            return whole
        return (whole * self.design_nm / wavelength_nm
                * quartz_birefringence(wavelength_nm)
                / quartz_birefringence(self.design_nm))

    def mueller(self, wavelength_nm: float | None = None) -> FloatArray:
        """Return the Mueller matrix, (4, 4); default at the design's wavelength."""
        nm = self.design_nm if wavelength_nm is None else wavelength_nm
        return retarder(self.retardance_at(nm), self.axis)


@dataclass(frozen=True, eq=False)
class Behind(Scene):
    """The light of a scene behind a static optical element.

    Parameters
    ----------
    scene : Scene
        The light in front of the element.
    matrix : array_like, shape (4, 4)
        Mueller matrix of the element, as `Waveplate.mueller` gives it; its elements lie
        within 1e6 of 0.

    Raises
    ------
    ValueError
        If no element can have this matrix.
    """

    scene: Scene
    matrix: ArrayLike
    circular = True

    def __post_init__(self) -> None:
        instance(Scene, scene=self.scene)
        try:
            matrix = np.array(self.matrix, np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        require("matrix", self.matrix, matrix.shape == (4, 4)
                and bool((np.abs(matrix) <= _MOST_GAIN).all()) and is_physical(matrix),
                "be the Mueller matrix of an element")
        matrix.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        """Whether the scene's light is the same everywhere."""
        return self.scene.uniform

    @property
    def linear(self) -> bool:  # type: ignore[override]
        """Whether the scene's light is linear between samples."""
        return self.scene.linear

    @property
    def step_us(self) -> float:
        """Sampling interval of the scene, us."""
        return self.scene.step_us

    def times_us(self, start_us: float, stop_us: float) -> FloatArray:
        """Kinks of the scene."""
        return self.scene.times_us(start_us, stop_us)

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        before = (*self.scene.stokes(t_us, x, y), self.scene.s3(t_us, x, y))
        s0, s1, s2 = (self._row(j, before) for j in range(3))
        return s0, s1, s2

    def s3(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """S3 in DN per ms."""
        return self._row(3, (*self.scene.stokes(t_us, x, y),
                             self.scene.s3(t_us, x, y)))

    def _row(self, j: int, before: tuple[FloatArray, ...]) -> FloatArray:
        row = np.asarray(self.matrix)[j]
        return np.asarray(sum(m * s for m, s in zip(row, before, strict=True)))

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return the scene's mask: the element moves nothing."""
        return self.scene.lit(x, y)
