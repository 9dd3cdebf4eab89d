"""How fast photoreceptors are."""
from __future__ import annotations

from dataclasses import dataclass

__all__ = ["TYPICAL_BANDWIDTH", "Bandwidth"]

TYPICAL_BANDWIDTH = (300.0, 0.0, 0.5)
"""Of a photoreceptor, Hz, until a recording has told more; the relative error counts
in the variance."""


@dataclass(frozen=True)
class Bandwidth:
    """Corner frequency of the photoreceptors: ``hz + hz_per_intensity * I``.

    Parameters
    ----------
    hz : float
        Part that does not depend on the light.
    hz_per_intensity : float
        Per unit of intensity, Hz per DN/ms.
    at_intensity : float
        Intensity in DN/ms at which the sum is known best: a tenth of a bright pixel's,
        since log intensity changes fastest where the light is dim.
    sigma : float
        Standard deviation of the log of the corner frequency there.
    """

    hz: float
    hz_per_intensity: float
    at_intensity: float
    sigma: float

    @property
    def law(self) -> tuple[float, float]:
        """(hz, hz_per_intensity), what `KalmanFilter` takes."""
        return self.hz, self.hz_per_intensity
