"""What a method is made with, as far as it is known of the camera."""
from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdavis_cv.calibration.thresholds import Theta
from pdavis_cv.selfcal import ClockOffset

__all__ = ["Tuning"]

_UNSET = object()


@dataclass(frozen=True, eq=False)
class Tuning:
    """What a method is made with, as far as it is known.

    Parameters
    ----------
    theta_on, theta_off : float or ndarray of float32, shape (H, W)
        Contrast thresholds, natural-log units.
    parameters : mapping of str to object
        Further parameters of the method.
    clock : ClockOffset
        What is added to the frames' exposure times, if it counts.
    """

    theta_on: Theta
    theta_off: Theta
    parameters: Mapping[str, Any]
    clock: ClockOffset

    @property
    def clock_us(self) -> int:
        """What is added to the frames' exposure times."""
        return self.clock.applied_us

    def changes(self, before: Tuning) -> dict[str, Any]:
        """Return what a method made with another tuning is to be retuned with."""
        out = {name: value for name, value in self.parameters.items()
               if not np.array_equal(value, before.parameters.get(name, _UNSET))}
        for name in ("theta_on", "theta_off"):
            value = getattr(self, name)
            if not np.array_equal(value, getattr(before, name)):
                out[name] = value
        return out

    def has_thresholds_of(self, other: Tuning) -> bool:
        """Return whether the thresholds are those of another tuning."""
        return (np.array_equal(self.theta_on, other.theta_on)
                and np.array_equal(self.theta_off, other.theta_off))

    def changed(self, **parameters: Any) -> Tuning:
        """Return the tuning with other parameters."""
        return dataclasses.replace(
            self, parameters={**self.parameters, **parameters})
