"""Scenes: the Stokes vector of the light in closed form, at any time and place.

S0, S1, S2 are those of the light that reaches the sensor, in DN per ms: an ideal
pixel behind an ideal analyser at angle a counts (S0 + S1 cos 2a + S2 sin 2a)/2 per
ms of exposure.  Places are pixels of the full sensor, (0, 0) the middle of the one
at the top left; ``FULL`` is a fully polarized light of 600 DN in 20 ms at the most
behind an analyser of extinction ratio 40.
"""
from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.simulation.checks import at_least_zero, fraction, positive

__all__ = [
    "FULL",
    "FlatLight",
    "Flicker",
    "RotatingPolarizer",
    "Scene",
    "Sum",
]

FloatArray = NDArray[np.float64]
Stokes = tuple[FloatArray, FloatArray, FloatArray]

FULL = 30.75
_PHASE = 0.02  # radians of a Stokes component's phase per sample


class Scene(ABC):
    """Light in front of the camera: a function of time and place.

    Attributes
    ----------
    uniform : bool
        Whether the light is the same everywhere.
    linear : bool
        Whether light is linear between samples (recorded scenes); else it is smooth
        and sampled finely enough for a cubic between samples.
    """

    uniform: bool = False
    linear: bool = False

    @abstractmethod
    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms.

        Parameters
        ----------
        t_us, x, y : array_like
            Times in us and places in pixels of the sensor, broadcast together.

        Returns
        -------
        tuple of ndarray of float64
        """

    @property
    @abstractmethod
    def step_us(self) -> float:
        """Interval at which sampling the light loses nothing; inf if it is constant.

        Between samples the light is a cubic; at a phase of 0.02 radians per sample
        of its fastest part that is exact to 1e-9 of S0.
        """

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Where the scene shows what it is about: everywhere, unless it says."""
        return np.ones(np.broadcast_shapes(np.shape(x), np.shape(y)), np.bool_)

    def __add__(self, other: Scene) -> Scene:
        """Light of two scenes together, e.g. over a background."""
        return Sum(self, other)

    def flicker(self, mains_hz: float = 50.0, depth: float = 0.2) -> Scene:
        """Return the scene under a lamp on the mains, which flickers at twice that."""
        return Flicker(self, hz=2 * mains_hz, depth=depth)


def same_everywhere(t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Return time as float64 in the shape that t, x and y have together."""
    return np.broadcast_arrays(np.asarray(t_us, np.float64), x, y)[0]


def polarized(s0: ArrayLike, dolp: ArrayLike, aop: FloatArray) -> Stokes:
    """Stokes vector of light of an intensity, degree and angle of polarization."""
    full = np.broadcast_to(np.asarray(s0, np.float64), aop.shape)
    part = full * np.asarray(dolp, np.float64)
    return full, part * np.cos(2 * aop), part * np.sin(2 * aop)


def step_of(rate: float) -> float:
    """Return the sampling interval in us for a rate of phase in radians per us."""
    return _PHASE / abs(rate) if rate else math.inf


def rad_per_us(rpm: float) -> float:
    """Return turns per minute as radians per microsecond."""
    return 2 * math.pi * rpm / 60e6


@dataclass(frozen=True)
class Sum(Scene):
    """Light of two scenes together.

    Parameters
    ----------
    first, second : Scene
        ``lit`` is that of the first.
    """

    first: Scene
    second: Scene

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        """Whether both are the same everywhere."""
        return self.first.uniform and self.second.uniform

    @property
    def linear(self) -> bool:  # type: ignore[override]
        """Whether either is linear between samples."""
        return self.first.linear or self.second.linear

    @property
    def step_us(self) -> float:
        """The finer of both."""
        return min(self.first.step_us, self.second.step_us)

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        a, b = self.first.stokes(t_us, x, y), self.second.stokes(t_us, x, y)
        return a[0] + b[0], a[1] + b[1], a[2] + b[2]

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Where the first scene is lit."""
        return self.first.lit(x, y)


@dataclass(frozen=True)
class Flicker(Scene):
    """A scene under a lamp whose light is 1 + depth cos(2 pi hz t).

    Parameters
    ----------
    scene : Scene
        What the lamp lights.
    hz : float
        100 or 120 for a lamp on the mains.
    depth : float
        0..1, 1 excluded where the light must not vanish.
    """

    scene: Scene
    hz: float = 100.0
    depth: float = 0.2

    def __post_init__(self) -> None:
        positive(hz=self.hz)
        fraction(depth=self.depth)

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        """As the scene."""
        return self.scene.uniform

    @property
    def linear(self) -> bool:  # type: ignore[override]
        """As the scene."""
        return self.scene.linear

    @property
    def step_us(self) -> float:
        """The finer of scene and lamp."""
        return min(self.scene.step_us, step_of(2e-6 * math.pi * self.hz))

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        lamp = 1 + self.depth * np.cos(
            2e-6 * np.pi * self.hz * np.asarray(t_us, np.float64))
        s0, s1, s2 = self.scene.stokes(t_us, x, y)
        return s0 * lamp, s1 * lamp, s2 * lamp

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Where the scene is lit."""
        return self.scene.lit(x, y)


@dataclass(frozen=True, kw_only=True)
class FlatLight(Scene):
    """Constant light, the same everywhere; ``s0=0`` is the dark.

    Parameters
    ----------
    s0 : float
        DN per ms.
    dolp, aop : float
        Degree and angle (radians) of linear polarization.
    """

    s0: float = FULL
    dolp: float = 0.0
    aop: float = 0.0
    uniform = True

    def __post_init__(self) -> None:
        at_least_zero(s0=self.s0)
        fraction(dolp=self.dolp)

    @property
    def step_us(self) -> float:
        """It is constant."""
        return math.inf

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t = same_everywhere(t_us, x, y)
        return polarized(self.s0, self.dolp, np.full(t.shape, float(self.aop)))


@dataclass(frozen=True, kw_only=True)
class RotatingPolarizer(Scene):
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
    s0: float = FULL
    start_angle: float = 0.0
    dolp: float = 1.0
    uniform = True

    def __post_init__(self) -> None:
        at_least_zero(s0=self.s0)
        fraction(dolp=self.dolp)

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t = same_everywhere(t_us, x, y)
        return polarized(
            self.s0, self.dolp, self.start_angle + self.rad_per_us * t)

    @property
    def step_us(self) -> float:
        """Interval at which sampling the light loses nothing."""
        return step_of(2 * self.rad_per_us)

    @property
    def rad_per_us(self) -> float:
        """Speed of the polarizer in radians per microsecond."""
        return rad_per_us(self.rpm)
