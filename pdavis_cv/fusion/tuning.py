"""The camera's parameters that a method is made with."""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdavis_cv._types import Parameters
from pdavis_cv.calibration.thresholds import Theta
from pdavis_cv.pixel.learn import LearnedPixels
from pdavis_cv.pixel.model import PixelModel

_UNSET = object()


@dataclass(frozen=True, eq=False)
class Tuning:
    """The camera's parameters that a method is made with, as known at one time.

    Parameters
    ----------
    theta_on, theta_off : float or ndarray of float32, shape (H, W)
        Contrast thresholds, natural-log units.
    parameters : mapping of str to object
        Further parameters of the method.
    clock_us : int
        Offset of the frames' clock, which is added to their exposure times, us.
    pixels : LearnedPixels or None
        What `parameters` and the offset were learned as, with their errors.
    """

    theta_on: Theta
    theta_off: Theta
    parameters: Parameters
    clock_us: int
    pixels: LearnedPixels | None = None

    @property
    def photoreceptors(self) -> tuple[Theta, Theta, tuple[float, float] | None]:
        """Thresholds, ON and OFF, and bandwidth, by whichever the method knows."""
        model: PixelModel | None = self.parameters.get("model")
        if model is None:
            return self.theta_on, self.theta_off, self.parameters.get("bandwidth")
        return float(model.thresholds[1]), float(model.thresholds[0]), model.bandwidth

    def changes(self, before: Tuning) -> dict[str, Any]:
        """Return the parameters to `retune` a method with that has another tuning."""
        out = {name: value for name, value in self.parameters.items()
               if not np.array_equal(value, before.parameters.get(name, _UNSET))}
        for name in ("theta_on", "theta_off"):
            value = getattr(self, name)
            if not np.array_equal(value, getattr(before, name)):
                out[name] = value
        return out

    def changed(self, **parameters: Any) -> Tuning:
        """Return the tuning with other parameters."""
        return dataclasses.replace(self, parameters={**self.parameters, **parameters})
