"""Scenes with structure: fan, tendon, textures, and the user's own."""
from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import MOST_ANGLE, MOST_SIDE, place
from pdavis_cv.sensor import Sensor
from pdavis_cv.simulation import noise
from pdavis_cv.simulation.checks import (
    ANGLE,
    FRACTION,
    LIGHT,
    MOST_HZ,
    MOST_SEED,
    RPM,
    Checked,
    positive,
    require,
    ruled,
    rules,
    that,
    whole,
    within,
)
from pdavis_cv.simulation.scenes import (
    FULL,
    FloatArray,
    Scene,
    Stokes,
    rad_per_us,
    step_of,
)

_MIDDLE = ((Sensor.PDAVIS.size[1] - 1) / 2, (Sensor.PDAVIS.size[0] - 1) / 2)
# exp(2i angle) of the polarizers in sectors -12..5: azimuth (-3..3 sectors) less turn
# (0..6) lies in -9..3, and a soft edge reads the sector before.
_SECTORS = np.exp(1j * (np.pi / 3) * (np.arange(18) % 6))
_KEPT_COLUMNS = 4096    # widest sensor whose columns' cosines are cached
_KEPT_PLACES = 8192     # most pixels of which a wheel's constant maps are cached
_EDGE_SAMPLES = 16      # while a soft edge passes a pixel at the rim
_MOST_WAVES = 1024
_MOST_PX_S = 1e6        # a pixel per tick of the clock
_PX = within(0.01, MOST_SIDE)
"""From the shortest structure of a scene: a hundredth of a pixel."""


def smooth_edge(u: FloatArray) -> FloatArray:
    """Rise from 0 at -1/2 to 1 at 1/2, with two continuous derivatives."""
    s = np.clip(u + 0.5, 0, 1)
    return np.asarray(s * s * s * (10 - s * (15 - 6 * s)))


@dataclass(frozen=True, kw_only=True)
class Fan(Checked, Scene):
    """Six polarizers in a wheel, 30 degrees apart, one half of it lit far brighter.

    Sector k covers 60 degrees; its polarizer stands at 30 k degrees on the wheel and
    turns with it, so that AoP at a place is that of the sector that passes.

    Parameters
    ----------
    rpm : float
        Turns per minute, positive = counter-clockwise as displayed; within 3e7 of 0.
    s0 : float
        S0 behind the wheel in the dim half, DN per ms, at most 1e9.
    bright : float
        How much brighter the left half is, at most 1e9; the paper's scene has 2000.
    start_angle : float
        Angle of sector 0's first edge at time 0, radians; within 1e6 of 0.
    centre : (float, float)
        x and y of the axis in pixels of the sensor, within 65,536 of 0.
    radius, hub : float
        Radii of the wheel and of its opaque hub, pixels, at most 65,536.
    edge : float
        Width of the soft edges, .01 to 65,536 pixels.
    opaque : float
        Unpolarized S0 of hub and surround, relative to S0 behind the wheel.
    """

    rpm: float = field(metadata=rules(RPM))
    s0: float = ruled(FULL, positive, LIGHT)
    bright: float = ruled(2000.0, positive, LIGHT)
    start_angle: float = ruled(0.0, ANGLE)
    centre: tuple[float, float] = ruled(_MIDDLE, place)
    radius: float = ruled(125.0, _PX)
    hub: float = ruled(20.0, positive)
    edge: float = ruled(2.0, _PX)
    opaque: float = ruled(0.05, FRACTION)

    def __post_init__(self) -> None:
        super().__post_init__()
        require("radius", self.radius, self.radius > self.hub, "exceed hub")

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t, u, v = (np.asarray(each, np.float64) for each in (t_us, x, y))
        around = np.broadcast_shapes(u.shape, v.shape)
        still = _still if math.prod(around) > _KEPT_PLACES else _still_of_rows
        place, steep, s0, light = still(
            (*self.centre, self.hub, self.radius, self.edge, self.s0, self.bright,
             self.opaque), (u.shape, u.tobytes()), (v.shape, v.tobytes()))
        turned = self.start_angle + rad_per_us(self.rpm) * t
        turns = np.mod(turned * (3 / np.pi), 6)
        rotation = np.exp(2j * turned)
        shape = np.broadcast_shapes(t.shape, around)
        s1, s2 = np.empty(shape), np.empty(shape)
        if t.shape == (*shape[:1], 1, 1):
            sectors = np.array([_SECTORS * each for each in rotation[:, 0]])
            sectors = sectors.reshape(-1, len(_SECTORS))
            _kernels.fan_stokes(
                turns.reshape(-1), np.ascontiguousarray(sectors.real),
                np.ascontiguousarray(sectors.imag), place.reshape(-1),
                steep.reshape(-1), light.reshape(-1), s1.reshape(len(t), -1),
                s2.reshape(len(t), -1))
        else:
            polarized = rotation * self._polarized(place - turns, steep, _SECTORS)
            np.multiply(light, polarized.real, out=s1)
            np.multiply(light, polarized.imag, out=s2)
        return np.broadcast_to(s0, shape), s1, s2

    @staticmethod
    def _polarized(
        place: FloatArray, steep: FloatArray, sectors: NDArray[np.complex128]
    ) -> NDArray[np.complex128]:
        """s1 + i s2 at azimuths -9..3 in sectors; steep: sector width / edge width."""
        first = np.floor(place)
        part = place - first
        seen = np.asarray(sectors.take(first.astype(np.intp) + 12))
        edge = np.minimum(part, 1 - part) * steep < 0.5
        if edge.any():
            place = place[edge]
            nearest = np.rint(place)
            weight = smooth_edge(
                (place - nearest) * np.broadcast_to(steep, edge.shape)[edge])
            k = nearest.astype(np.intp) + 12
            seen[edge] = sectors[k - 1] + weight * (sectors[k] - sectors[k - 1])
        return seen

    def lit(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return the mask of the wheel between hub and rim, without soft edges."""
        r = np.hypot(np.asarray(x) - self.centre[0], np.asarray(y) - self.centre[1])
        return np.asarray((r > self.hub + self.edge) & (r < self.radius - self.edge))

    @property
    def step_us(self) -> float:
        """Sampling interval in us of an edge's passage at the rim, or of the turn."""
        speed = rad_per_us(self.rpm)
        if speed == 0:
            return math.inf
        passage = self.edge / (abs(speed) * self.radius)
        return min(passage / _EDGE_SAMPLES, step_of(2 * speed))


def _still(
    wheel: tuple[float, ...], x: tuple[tuple[int, ...], bytes],
    y: tuple[tuple[int, ...], bytes],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the maps that do not turn with the wheel, for places x and y.

    They are the azimuth in sectors, the width of a sector over that of an edge, S0, and
    the polarized part of S0.  x and y are shape and bytes of arrays, to be hashable.
    """
    column, row, hub, radius, edge, s0, bright, opaque = wheel
    u, v = (np.frombuffer(of).reshape(shape) for shape, of in (x, y))
    u, v = u - column, row - v
    r = np.hypot(u, v)
    light = s0 * (1 + (bright - 1) * smooth_edge(-u / edge))
    seen = smooth_edge((r - hub) / edge) * smooth_edge((radius - r) / edge)
    return (np.arctan2(v, u) * (3 / np.pi), r * (np.pi / 3 / edge),
            light * (seen + (1 - seen) * opaque), light * seen)


_still_of_rows = functools.lru_cache(maxsize=64)(_still)


@dataclass(frozen=True, kw_only=True)
class Tendon(Checked, Scene):
    """Circularly polarized light through a fibre sheet that is pulled in cycles.

    A birefringent fibre of retardance d whose axis stands at angle f turns circular
    light into s1 = -sin d sin 2f, s2 = sin d cos 2f: DoLP is abs(sin d), AoP f + 45
    degrees.  Pulling stretches the sheet, straightens the crimp of the fibres and
    raises their retardance.

    Parameters
    ----------
    hz : float
        Cycles per second, at most 500,000; the paper pulls at 1, 5 and 10 Hz.
    strain_low, strain_high : float
        Strain between which it moves, 0..1; 2 % and 3 %.
    s0 : float
        Mean of S0, DN per ms, at most 1e9.
    retardance, gain : float
        Retardance in radians at the middle of the cycle, at most 1e6, and its relative
        change from there to the end.
    fibre_angle, fibre_width : float
        Direction in radians, within 1e6 of 0, and width in pixels of the fibres, .01 to
        65,536.
    crimp_angle, crimp_length : float
        Amplitude of the fibres' waviness in radians at the lowest strain, 0 to pi/2,
        and its period in pixels, .01 to 65,536.
    contrast : float
        Depth of the dark lines between fibres, 0..1.
    fixed : (float, float)
        x and y of the point that does not move, pixels of the sensor, within 65,536 of
        0.
    """

    hz: float = ruled(1.0, positive, within(0, MOST_HZ))
    strain_low: float = ruled(0.02, FRACTION)
    strain_high: float = ruled(0.03, FRACTION)
    s0: float = ruled(FULL, positive, LIGHT)
    retardance: float = ruled(0.5, within(0, MOST_ANGLE))
    gain: float = ruled(0.4, FRACTION)
    fibre_angle: float = ruled(0.1, ANGLE)
    fibre_width: float = ruled(9.0, _PX)
    crimp_angle: float = ruled(0.25, within(0, math.pi / 2))
    crimp_length: float = ruled(60.0, _PX)
    contrast: float = ruled(0.4, FRACTION)
    fixed: tuple[float, float] = ruled((0.0, _MIDDLE[1]), place)

    def __post_init__(self) -> None:
        super().__post_init__()
        require("strain_high", self.strain_high, self.strain_high > self.strain_low,
                f"exceed strain_low = {self.strain_low}")

    def strain(self, t_us: ArrayLike) -> FloatArray:
        """Strain of the sheet: a sine between its two ends."""
        middle = (self.strain_low + self.strain_high) / 2
        swing = (self.strain_high - self.strain_low) / 2
        phase = 2e-6 * np.pi * self.hz * np.asarray(t_us, np.float64)
        return np.asarray(middle - swing * np.cos(phase))

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        strain = self.strain(t_us)
        pull = (strain - self.strain_low) / (self.strain_high - self.strain_low)
        cos, sin = math.cos(self.fibre_angle), math.sin(self.fibre_angle)
        u = np.asarray(x, np.float64) - self.fixed[0]
        v = self.fixed[1] - np.asarray(y, np.float64)
        along = (u * cos + v * sin) / (1 + strain)  # place on the sheet at rest
        across = v * cos - u * sin
        wave = 2 * np.pi / self.crimp_length
        slope = self.crimp_angle * (1 - 0.6 * pull)
        axis = self.fibre_angle + slope * np.cos(wave * along)
        across = across - slope / wave * np.sin(wave * along)
        line = 2 * np.pi * across / self.fibre_width
        depth = self.retardance * (1 + self.gain * (2 * pull - 1)) * (
            1 + 0.25 * np.cos(line / 3.7 + 1.0))
        s0 = self.s0 * (1 - self.contrast * (0.5 + 0.5 * np.cos(line)))
        linear = s0 * np.sin(depth)
        return s0, -linear * np.sin(2 * axis), linear * np.cos(2 * axis)

    @property
    def step_us(self) -> float:
        """Sampling interval in us; the far end crosses fibres faster than the cycle."""
        travel = Sensor.PDAVIS.size[1] * (self.strain_high - self.strain_low)
        cycle = 2 * math.pi * 1e-6 * self.hz
        phase = 1 + travel * 2 * math.pi * (
            self.crimp_angle / self.fibre_width + 1 / self.crimp_length)
        return step_of(cycle * phase) * 2


@functools.lru_cache(maxsize=64)
def _waves(
    seed: int, name: str, waves: int, longest: float, shortest: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return amplitudes, wave numbers along x and y, and phases of a field's waves."""
    index = np.arange(waves)

    def draw(what: str) -> FloatArray:
        return noise.uniform(seed, f"texture {name} {what}", index)

    # Equal power per octave: amplitude falls as 1/f.
    wavelength = shortest * (longest / shortest) ** (
        (index + draw("wavelength")) / waves)
    direction, phase = 2 * np.pi * draw("direction"), 2 * np.pi * draw("phase")
    k = 2 * np.pi / wavelength
    weight = wavelength / math.sqrt(float(np.sum(wavelength**2)) / 2)
    return weight, k * np.cos(direction), k * np.sin(direction), phase


def _curves(k: bytes, x: bytes) -> tuple[FloatArray, FloatArray]:
    """Return cosine and sine of k x, shape (n, W); float64 arrays as bytes."""
    across = np.frombuffer(k)[:, None] * np.frombuffer(x)
    return np.cos(across), np.sin(across)


_curves_of_columns = functools.lru_cache(maxsize=16)(_curves)


def _plane_waves(
    weight: FloatArray, k: FloatArray, x: FloatArray, down: FloatArray
) -> FloatArray:
    """Sum of weight cos(k x + down) over waves; (n,), (n,), (W,), (n, H) -> (H, W)."""
    curves = _curves_of_columns if len(x) <= _KEPT_COLUMNS else _curves
    cos, sin = curves(k.tobytes(), x.tobytes())
    cos_down, sin_down = weight[:, None] * np.cos(down), weight[:, None] * np.sin(down)
    total = np.empty((down.shape[1], len(x)))
    _kernels.plane_waves(cos_down, sin_down, cos, sin, total)
    return total


@dataclass(frozen=True, kw_only=True)
class Texture(Checked, Scene):
    """A random texture of S0, DoLP and AoP that moves as a whole, amplitudes 1/f.

    Each is a function of a sum of plane waves: the exponential (S0), the sine (DoLP)
    and the sum itself (AoP).

    Parameters
    ----------
    velocity : (float, float)
        Pixels per second, x to the right and y down; each within 1e6 of 0, a pixel per
        tick of the clock.
    s0, contrast : float
        Geometric mean of S0 in DN per ms, at most 1e9, and rms of its natural log, at
        most 10.
    dolp, dolp_spread : float
        Mean of DoLP, and its largest deviation from it.
    aop, aop_spread : float
        Mean of AoP in radians, within 1e6 of 0, and its rms spread, at most pi.
    longest, shortest : float
        Wavelengths in pixels, .01 to 65,536.
    waves : int
        Plane waves per field, 1 to 1024.
    seed : int
        Seed of the texture, 0 to 2**64 - 1.
    """

    velocity: tuple[float, float] = ruled(
        (200.0, 60.0), lambda name, value: place(name, value, _MOST_PX_S))
    s0: float = ruled(FULL, positive, LIGHT)
    contrast: float = ruled(0.5, within(0, 10))
    dolp: float = ruled(0.5, FRACTION)
    dolp_spread: float = ruled(0.4, FRACTION)
    aop: float = ruled(0.8, ANGLE)
    aop_spread: float = ruled(0.6, within(0, math.pi))
    longest: float = ruled(120.0, _PX)
    shortest: float = ruled(8.0, _PX)
    waves: int = ruled(12, whole(1, _MOST_WAVES))
    seed: int = ruled(0, whole(0, MOST_SEED))

    def __post_init__(self) -> None:
        super().__post_init__()
        require("shortest", self.shortest, self.shortest <= self.longest,
                f"be at most longest = {self.longest}")
        require("dolp", self.dolp,
                self.dolp_spread <= self.dolp <= 1 - self.dolp_spread,
                "stay in 0..1 within dolp_spread")

    def _field(
        self, name: str, t: FloatArray, x: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return a field of mean 0 and rms 1."""
        weight, kx, ky, phase = _waves(
            self.seed, name, self.waves, self.longest, self.shortest)
        rate = kx * self.velocity[0] + ky * self.velocity[1]
        shape = np.broadcast_shapes(t.shape, x.shape, y.shape)
        rest = np.broadcast_shapes(t.shape, y.shape)
        if x.size > 1 and x.shape[-1:] == (x.size,) and rest[-1:] == (1,):
            # cos(a + b) by columns and rows: no cosine per pixel.
            down = (ky[:, None] * np.broadcast_to(y, rest).ravel() + phase[:, None]
                    - rate[:, None] * np.broadcast_to(t, rest).ravel())
            return _plane_waves(weight, kx, x.ravel(), down).reshape(shape)
        total = np.zeros(shape)
        for i in range(self.waves):
            total += weight[i] * np.cos(kx[i] * x + ky[i] * y + phase[i] - rate[i] * t)
        return total

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        at = (np.asarray(t_us, np.float64) * 1e-6, np.asarray(x, np.float64),
              np.asarray(y, np.float64))
        s0, s1, s2 = (self._field(name, *at) for name in ("intensity", "dolp", "aop"))
        _kernels.texture_stokes(
            s0.reshape(-1), s1.reshape(-1), s2.reshape(-1), self.s0, self.contrast,
            self.dolp, self.dolp_spread, self.aop, self.aop_spread)
        return s0, s1, s2

    @property
    def step_us(self) -> float:
        """Sampling interval in us of the shortest wave's passage."""
        speed = math.hypot(*self.velocity) * 1e-6
        return step_of(2 * math.pi * speed / self.shortest) * 2


@dataclass(frozen=True)
class FunctionScene(Checked, Scene):
    """A scene given by a function of time and place.

    Parameters
    ----------
    function : callable
        ``function(t_us, x, y) -> (s0, s1, s2)`` of arrays that broadcast together.
    sampling_us : float
        Sampling interval, positive; the cubic between samples is off by at most
        sampling_us^4 / 384 times the largest fourth derivative.
    uniform : bool
        Whether the light is the same everywhere, which is faster to simulate.
    """

    function: Callable[[FloatArray, FloatArray, FloatArray], Stokes] = field(
        metadata=rules(that(callable, "be callable")))
    sampling_us: float = ruled(100.0, positive)
    uniform: bool = False

    def stokes(self, t_us: ArrayLike, x: ArrayLike, y: ArrayLike) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t, u, v = (np.asarray(a, np.float64) for a in (t_us, x, y))
        shape = np.broadcast_shapes(t.shape, u.shape, v.shape)
        s0, s1, s2 = (np.broadcast_to(np.asarray(s, np.float64), shape)
                      for s in self.function(t, u, v))
        return s0, s1, s2

    @property
    def step_us(self) -> float:
        """``sampling_us``."""
        return self.sampling_us
