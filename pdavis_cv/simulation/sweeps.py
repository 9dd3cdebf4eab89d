"""Sweeps of a calibration bench: a polarizer in steps, and rising irradiance."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv._checks import MOST_ANGLE
from pdavis_cv.events import FAR
from pdavis_cv.simulation.checks import (
    MOST_LIGHT,
    fraction,
    python_numbers,
    require,
    turning,
    whole,
    within,
)
from pdavis_cv.simulation.scenes import (
    FULL,
    FloatArray,
    Scene,
    Stokes,
    polarized,
    rad_per_us,
    same_everywhere,
    step_of,
)

_LEAST_US = 1e-3    # shortest movement of a stage, far below the clock's microsecond


def staircase(t_us: FloatArray, hold_us: float, move_us: float) -> FloatArray:
    """Return the index of the held interval, with a smooth rise at its start.

    The rise is a quintic with two continuous derivatives; interval 0 has none.
    """
    step = np.floor(t_us / hold_us)
    inside = np.clip((t_us - step * hold_us) / move_us, 0, 1)
    rise = inside**3 * (10 - inside * (15 - 6 * inside))
    return np.where(step <= 0, step, step - 1 + rise)


@dataclass(frozen=True, kw_only=True)
class MalusSweep(Scene):
    """A polarizer that is turned in steps and held, as on a calibration bench.

    Parameters
    ----------
    step : float
        Radians, within 1e6 of 0; the paper's bench makes 5 degrees.
    hold_us : float
        Time from one step to the next, at most 2**61 us.
    move_us : float
        Duration of a step's rotation, at the start of ``hold_us``; at least .001.
    s0, dolp, start_angle : float
        S0 (DN per ms, at most 1e9) and DoLP behind the polarizer, and its first angle,
        radians, within 1e6 of 0.
    """

    step: float = math.radians(5)
    hold_us: float = 250_000
    move_us: float = 20_000
    s0: float = FULL
    dolp: float = 1.0
    start_angle: float = 0.0
    uniform = True

    def __post_init__(self) -> None:
        python_numbers(self)
        within(_LEAST_US, FAR, hold_us=self.hold_us, move_us=self.move_us)
        require("move_us", self.move_us, self.move_us <= self.hold_us,
                "be at most hold_us")
        within(-MOST_ANGLE, MOST_ANGLE, step=self.step, start_angle=self.start_angle)
        within(0, MOST_LIGHT, s0=self.s0)
        fraction(dolp=self.dolp)

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t = same_everywhere(t_us, x, y)
        angle = self.start_angle + self.step * staircase(t, self.hold_us, self.move_us)
        return polarized(self.s0, self.dolp, angle)

    @property
    def step_us(self) -> float:
        """A hundredth of ``move_us``, or less for a large ``step``."""
        return min(self.move_us / 100, step_of(4 * self.step / self.move_us))


@dataclass(frozen=True, kw_only=True)
class IrradianceSweep(Scene):
    """A rotating polarizer under irradiance that rises in equal ratios.

    Parameters
    ----------
    rpm : float
        Turns per minute of the polarizer, within 3e7 of 0; the paper's measurement has
        60.
    low_uw_cm2, high_uw_cm2 : float
        Irradiance on the sensor at the first and the last level, microwatt per cm2,
        1e-9 to 1e9.
    levels : int
        Number of levels, 1 to 1,000,000.
    hold_us : float
        Time at each level, .001 to 2**61 us.
    dn_per_ms : float
        S0 in DN per ms at 1 microwatt per cm2: 27 for the PDAVIS (18.5 um pixels,
        24 % quantum efficiency at 520 nm, 80 electrons per DN), 0.68 for the Sony
        (4095 DN at 300 microwatt per cm2 in 20 ms; Haessig, figure S9); 1e-9 to 1e9.
    start_angle : float
        AoP at time 0, radians, within 1e6 of 0.
    """

    rpm: float = 60.0
    low_uw_cm2: float = 0.04
    high_uw_cm2: float = 42_000.0
    levels: int = 13
    hold_us: float = 2_000_000
    dn_per_ms: float = 27.0
    start_angle: float = 0.0
    uniform = True

    def __post_init__(self) -> None:
        python_numbers(self)
        turning(self.rpm, start_angle=self.start_angle)
        within(1 / MOST_LIGHT, MOST_LIGHT, low_uw_cm2=self.low_uw_cm2,
               high_uw_cm2=self.high_uw_cm2, dn_per_ms=self.dn_per_ms)
        whole(self, 1, 1_000_000, "levels")
        within(_LEAST_US, FAR, hold_us=self.hold_us)

    def irradiance(self, t_us: ArrayLike) -> FloatArray:
        """Irradiance in microwatt per cm2."""
        t = np.asarray(t_us, np.float64)
        level = staircase(t, self.hold_us, self.hold_us / 20)
        part = np.clip(level / max(self.levels - 1, 1), 0, 1)
        ratio = self.high_uw_cm2 / self.low_uw_cm2
        return np.asarray(self.low_uw_cm2 * ratio**part)

    def stokes(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> Stokes:
        """S0, S1, S2 in DN per ms."""
        t = same_everywhere(t_us, x, y)
        return polarized(self.dn_per_ms * self.irradiance(t), 1.0,
                         self.start_angle + rad_per_us(self.rpm) * t)

    @property
    def step_us(self) -> float:
        """Smaller sampling interval of the turn and of a rise, us."""
        return min(step_of(2 * rad_per_us(self.rpm)), self.hold_us / 2000)
