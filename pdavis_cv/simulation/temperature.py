"""Dependence of dark current, leak and thresholds on the chip's temperature."""
from __future__ import annotations

import math
from dataclasses import dataclass

from pdavis_cv.simulation.checks import positive, present, python_numbers, within

__all__ = ["Conditions", "Temperature"]

BOLTZMANN_EV = 8.617333e-5
"""Boltzmann's constant, eV per kelvin."""
ZERO_C = 273.15

Conditions = tuple[float, float, float]
"""Factors on the ON threshold, the OFF threshold and thermal currents."""


@dataclass(frozen=True, kw_only=True)
class Temperature:
    """Temperature of the chip over a recording.

    It rises from `start_c` towards `end_c` as ``1 - exp(-t / rise_s)``.  The parameters
    of a camera's parts, and its exact calibration, are those at `reference_c`.

    Parameters
    ----------
    start_c, end_c : float
        Degrees Celsius, -40 to 125; `end_c` by default `start_c`.
    rise_s : float
        Time constant of the camera body's warm-up; the default is an assumption.
    reference_c : float
        Temperature at which a camera's parameters hold, degrees Celsius.
    activation_ev : float
        Activation energy of the dark current and of the leak, which both follow
        Arrhenius's law [Nozaki 2017].  The default is half of silicon's gap, that of
        generation in a depleted junction [Widenhorn 2002]: a factor of 2 every 9.8 K.
        At most 1.2, that gap and a little.
    threshold_per_k : float
        Relative change of both thresholds per kelvin.  It is 0 if the ratio of the bias
        currents does not depend on temperature [Nozaki 2017]; the default, .1 %, is an
        assumption for a ratio that does.

    Examples
    --------
    >>> warm = Temperature(start_c=25, end_c=45, rise_s=600)
    >>> round(warm.at(600e6), 1), [round(f, 2) for f in warm.conditions(3600e6)]
    (37.6, [1.02, 1.02, 3.92])
    """

    start_c: float = 25.0
    end_c: float | None = None
    rise_s: float = 600.0
    reference_c: float = 25.0
    activation_ev: float = 0.56
    threshold_per_k: float = 0.001

    def __post_init__(self) -> None:
        python_numbers(self)
        within(-40, 125, start_c=self.start_c, reference_c=self.reference_c,
               **present(end_c=self.end_c))
        positive(rise_s=self.rise_s)
        within(0, 1.2, activation_ev=self.activation_ev)
        within(-0.005, 0.005, threshold_per_k=self.threshold_per_k)

    def at(self, t_us: float) -> float:
        """Return the temperature at a time, degrees Celsius."""
        end = self.start_c if self.end_c is None else self.end_c
        return end + (self.start_c - end) * math.exp(-t_us / 1e6 / self.rise_s)

    def current(self, t_us: float) -> float:
        """Return the factor on thermal currents at a time."""
        now, reference = self.at(t_us) + ZERO_C, self.reference_c + ZERO_C    # kelvin
        return math.exp(self.activation_ev / BOLTZMANN_EV * (1 / reference - 1 / now))

    def conditions(self, t_us: float) -> Conditions:
        """Return the factors on ON and OFF thresholds and on thermal currents."""
        threshold = 1 + self.threshold_per_k * (self.at(t_us) - self.reference_c)
        return threshold, threshold, self.current(t_us)
