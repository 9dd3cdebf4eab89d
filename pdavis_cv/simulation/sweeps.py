"""Sweeps of a calibration bench: a polarizer in steps, and rising irradiance."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv.events import FAR
from pdavis_cv.simulation.checks import (
    ANGLE,
    FRACTION,
    LIGHT,
    MOST_LIGHT,
    RPM,
    Checked,
    require,
    ruled,
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

_US = within(1e-3, FAR)
"""From the shortest movement of a stage, far below the clock's microsecond."""
_UW_CM2 = within(1 / MOST_LIGHT, MOST_LIGHT)


def staircase(t_us: FloatArray, hold_us: float, move_us: float) -> FloatArray:
    """Return the index of the held interval, with a smooth rise at its start.

    The rise is a quintic with two continuous derivatives; interval 0 has none.
    """
    step = np.floor(t_us / hold_us)
    inside = np.clip((t_us - step * hold_us) / move_us, 0, 1)
    rise = inside**3 * (10 - inside * (15 - 6 * inside))
    return np.where(step <= 0, step, step - 1 + rise)


@dataclass(frozen=True, kw_only=True)
class MalusSweep(Checked, Scene):
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

    step: float = ruled(math.radians(5), ANGLE)
    hold_us: float = ruled(250_000, _US)
    move_us: float = ruled(20_000, _US)
    s0: float = ruled(FULL, LIGHT)
    dolp: float = ruled(1.0, FRACTION)
    start_angle: float = ruled(0.0, ANGLE)
    uniform = True

    def __post_init__(self) -> None:
        super().__post_init__()
        require("move_us", self.move_us, self.move_us <= self.hold_us,
                "be at most hold_us")

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
class IrradianceSweep(Checked, Scene):
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

    rpm: float = ruled(60.0, RPM)
    low_uw_cm2: float = ruled(0.04, _UW_CM2)
    high_uw_cm2: float = ruled(42_000.0, _UW_CM2)
    levels: int = ruled(13, whole(1, 1_000_000))
    hold_us: float = ruled(2_000_000, _US)
    dn_per_ms: float = ruled(27.0, within(1 / MOST_LIGHT, MOST_LIGHT))
    start_angle: float = ruled(0.0, ANGLE)
    uniform = True

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
