"""Scenes: the Stokes vector of the light in closed form, at any time and place.

S0, S1, S2 are those of the light that reaches the sensor, in DN per ms: an ideal
pixel behind an ideal analyser at angle a counts (S0 + S1 cos 2a + S2 sin 2a)/2 per
ms of exposure.  Places are pixels of the full sensor, (0, 0) the middle of the one
at the top left; ``FULL`` is the S0 of fully polarized light that gives 600 DN in 20 ms
behind a parallel analyser of extinction ratio 40.
"""
from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.sensor import Layout
from pdavis_cv.simulation.checks import (
    ANGLE,
    FRACTION,
    LIGHT,
    MOST_HZ,
    RPM,
    Checked,
    instance,
    positive,
    ruled,
    rules,
    that,
    within,
)

FloatArray = NDArray[np.float64]
Stokes = tuple[FloatArray, FloatArray, FloatArray]

FULL = 30.75
_PHASE = 0.04  # radians per sample of the fastest Stokes component


class Scene(ABC):
    """Light in front of the camera: a smooth function of time and place.

    Attributes
    ----------
    uniform : bool
        Whether the light is the same everywhere.
    """

    uniform: bool = False

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
        """Sampling interval in us; inf if the light is constant.

        At 0.04 radians per sample of the fastest component, the cubic between samples
        is exact to 1e-8 of S0.
        """

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return the mask of the places to score: all, unless the scene overrides it.

        `Fan` leaves out its hub, its surround and the soft edges of both.
        """
        return np.ones(np.broadcast_shapes(np.shape(x), np.shape(y)), np.bool_)

    def __add__(self, other: Scene) -> Scene:
        """Return the incoherent sum of two scenes, e.g. with a background."""
        return Sum(self, other)

    def flicker(self, mains_hz: float = 50.0, depth: float = 0.2) -> Scene:
        """Return the scene under a lamp that flickers at twice the mains frequency."""
        return Flicker(self, hz=2 * mains_hz, depth=depth)


_SCENE = instance(Scene)


def same_everywhere(t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Return time as float64, broadcast to the common shape of t, x and y."""
    return np.broadcast_arrays(np.asarray(t_us, np.float64), x, y)[0]


def polarized(s0: ArrayLike, dolp: ArrayLike, aop: FloatArray) -> Stokes:
    """Return S0, S1, S2 of light of this intensity, DoLP and AoP (radians)."""
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
class Sum(Checked, Scene):
    """The incoherent sum of two scenes.

    Parameters
    ----------
    first, second : Scene
        Scenes; the mask `lit` is that of the first.
    """

    first: Scene = field(metadata=rules(_SCENE))
    second: Scene = field(metadata=rules(_SCENE))

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        """Whether the light of both is the same everywhere."""
        return self.first.uniform and self.second.uniform

    @property
    def step_us(self) -> float:
        """Smaller sampling interval of the two, us."""
        return min(self.first.step_us, self.second.step_us)

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        a, b = self.first.stokes(t_us, x, y), self.second.stokes(t_us, x, y)
        return a[0] + b[0], a[1] + b[1], a[2] + b[2]

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return the mask of the first scene."""
        return self.first.lit(x, y)


@dataclass(frozen=True)
class Coloured(Checked, Scene):
    """Light of three colours, of which a pixel sees that of its filter.

    It is for cameras whose `Optics` have the same layout.  The truth of a colour is
    that of its scene.

    Parameters
    ----------
    red, green, blue : Scene
        The light that passes each filter.
    layout : Layout
        Of the whole sensor, with colours.
    """

    red: Scene = field(metadata=rules(_SCENE))
    green: Scene = field(metadata=rules(_SCENE))
    blue: Scene = field(metadata=rules(_SCENE))
    layout: Layout = field(metadata=rules(instance(Layout), that(
        lambda layout: layout.colours is not None, "have colours")))

    @property
    def step_us(self) -> float:
        """Smallest sampling interval of the three, us."""
        return min(self.red.step_us, self.green.step_us, self.blue.step_us)

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms, behind the filter at each place."""
        cell = np.array(["RGB".index(c) for c in self.layout.colours or ()])
        row, column = (np.rint(place).astype(np.int64) % 4 for place in (y, x))
        colour = cell[4 * row + column]
        red, green, blue = (scene.stokes(t_us, x, y)
                            for scene in (self.red, self.green, self.blue))
        s0, s1, s2 = (np.choose(colour, planes)
                      for planes in zip(red, green, blue, strict=True))
        return s0, s1, s2

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return the mask of the green scene."""
        return self.green.lit(x, y)


@dataclass(frozen=True)
class Flicker(Checked, Scene):
    """A scene under a lamp whose light is 1 + depth cos(2 pi hz t).

    Parameters
    ----------
    scene : Scene
        The scene that the lamp lights.
    hz : float
        100 or 120 for a lamp on the mains; at most 500,000.
    depth : float
        0..1, 1 excluded where the light must not vanish.
    """

    scene: Scene = field(metadata=rules(_SCENE))
    hz: float = ruled(100.0, positive, within(0, MOST_HZ))
    depth: float = ruled(0.2, FRACTION)

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        """Whether the scene's light is the same everywhere."""
        return self.scene.uniform

    @property
    def step_us(self) -> float:
        """Smaller sampling interval of scene and lamp, us."""
        return min(self.scene.step_us, step_of(2e-6 * math.pi * self.hz))

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        lamp = 1 + self.depth * np.cos(
            2e-6 * np.pi * self.hz * np.asarray(t_us, np.float64))
        s0, s1, s2 = self.scene.stokes(t_us, x, y)
        return s0 * lamp, s1 * lamp, s2 * lamp

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return the mask of the scene."""
        return self.scene.lit(x, y)


@dataclass(frozen=True, kw_only=True)
class FlatLight(Checked, Scene):
    """Constant, uniform light; ``s0=0`` is darkness.

    Parameters
    ----------
    s0 : float
        DN per ms, at most 1e9.
    dolp, aop : float
        Degree and angle (radians, within 1e6 of 0) of linear polarization.
    """

    s0: float = ruled(FULL, LIGHT)
    dolp: float = ruled(0.0, FRACTION)
    aop: float = ruled(0.0, ANGLE)
    uniform = True

    @property
    def step_us(self) -> float:
        """Infinite: the light is constant."""
        return math.inf

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t = same_everywhere(t_us, x, y)
        return polarized(self.s0, self.dolp, np.full(t.shape, float(self.aop)))


@dataclass(frozen=True, kw_only=True)
class _Turning(Checked, Scene):
    """What turns before a uniform lamp."""

    rpm: float = field(metadata=rules(RPM))
    s0: float = ruled(FULL, LIGHT)
    start_angle: float = ruled(0.0, ANGLE)
    uniform = True
    cycles = 2      # of the light in a turn

    @property
    def step_us(self) -> float:
        """Interval at which sampling the light loses nothing."""
        return step_of(self.cycles * self.rad_per_us)

    @property
    def rad_per_us(self) -> float:
        """Speed in radians per microsecond."""
        return rad_per_us(self.rpm)

    def _angle(
        self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> NDArray[np.float64]:
        return self.start_angle + self.rad_per_us * same_everywhere(t_us, x, y)


@dataclass(frozen=True, kw_only=True)
class RotatingPolarizer(_Turning):
    """A polarizer turning in front of a uniform lamp; AoP makes two cycles per turn.

    Parameters
    ----------
    rpm : float
        Turns per minute of the polarizer, positive = counter-clockwise as displayed;
        within 3e7 of 0: half a turn takes one tick of the clock.
    s0 : float
        S0 behind the polarizer in DN per ms, at most 1e9.
    start_angle : float
        AoP at time 0, radians; within 1e6 of 0.
    dolp : float
        Degree of linear polarization of the light, 0..1.
    """

    dolp: float = ruled(1.0, FRACTION)

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        return polarized(self.s0, self.dolp, self._angle(t_us, x, y))


@dataclass(frozen=True, kw_only=True)
class PolarizerBeforePlate(_Turning):
    """A turning polarizer before a fixed retarder (Haessig, supplement S1.2).

    With a quarter-wave plate DoLP makes four cycles per turn, and AoP jumps between
    the plate's axis and 90 degrees from it.

    Parameters
    ----------
    rpm : float
        Turns per minute of the polarizer, within 3e7 of 0.
    s0 : float
        S0 behind both, DN per ms, at most 1e9.
    start_angle, axis : float
        Angle of the polarizer at time 0 and of the plate's fast axis, radians, within
        1e6 of 0.
    retardance : float
        Radians, within 1e6 of 0; pi/2 for a quarter-wave plate.
    """

    axis: float = ruled(0.0, ANGLE)
    retardance: float = ruled(math.pi / 2, ANGLE)

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        return behind_plate(
            self.s0, self._angle(t_us, x, y), self.axis, self.retardance)


@dataclass(frozen=True, kw_only=True)
class RotatingPlate(_Turning):
    """A turning retarder behind a fixed polarizer.

    With a quarter-wave plate DoLP and AoP both make four cycles per turn, and the
    means of the four channels differ.

    Parameters
    ----------
    rpm : float
        Turns per minute of the plate, within 3e7 of 0.
    s0 : float
        S0 behind both, DN per ms, at most 1e9.
    start_angle, polarizer : float
        Angle of the plate's fast axis at time 0 and of the polarizer, radians, within
        1e6 of 0.
    retardance : float
        Radians, within 1e6 of 0; pi/2 for a quarter-wave plate.
    """

    polarizer: float = ruled(0.0, ANGLE)
    retardance: float = ruled(math.pi / 2, ANGLE)
    cycles = 4

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        return behind_plate(
            self.s0, self.polarizer, self._angle(t_us, x, y), self.retardance)


def behind_plate(
    s0: float, polarizer: ArrayLike, axis: ArrayLike, retardance: float
) -> Stokes:
    """S0, S1, S2 of light behind a polarizer and a retarder.

    The Stokes component along the retarder's axis passes; that at 45 degrees to it is
    multiplied by cos(retardance), the rest becomes circular.
    """
    axis = np.asarray(axis, np.float64)
    turn = 2 * (np.asarray(polarizer, np.float64) - axis)
    along, across = np.cos(turn), np.sin(turn) * math.cos(retardance)
    cos, sin = np.cos(2 * axis), np.sin(2 * axis)
    s1, s2 = along * cos - across * sin, along * sin + across * cos
    return np.full(s1.shape, float(s0)), s0 * s1, s0 * s2
