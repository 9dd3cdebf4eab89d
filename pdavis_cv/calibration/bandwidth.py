"""How fast photoreceptors are."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

__all__ = ["TYPICAL_BANDWIDTH", "Bandwidth", "combined"]

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


# So many standard deviations apart, a calibration is of other biases.
_STALE = 3.0


def combined(stated: Sequence[float], found: Bandwidth) -> Bandwidth:
    """Put together what a calibration states and what a recording tells.

    Means are of the logs, by their variances; whether it follows the light is taken
    from what is known better.  One recording errs this way at one speed and that way
    at another, so both together are better than each.  Where they cannot both be
    right, the recording is.

    Parameters
    ----------
    stated : (hz, hz_per_intensity, sigma)
    found : Bandwidth

    Returns
    -------
    Bandwidth
    """
    hz, slope, sigma = stated
    at = found.at_intensity
    there = found.hz + found.hz_per_intensity * at
    if not (hz + slope * at > 0 and there > 0):
        return found
    apart = math.log((hz + slope * at) / there)
    both = math.hypot(sigma, found.sigma)
    if abs(apart) > _STALE * both or both == 0:
        return found
    share = (found.sigma / both) ** 2  # of what is stated
    best = found
    if sigma < found.sigma:
        best, apart, share = Bandwidth(hz, slope, at, sigma), -apart, 1 - share
    by = math.exp(share * apart)
    return replace(best, hz=best.hz * by, hz_per_intensity=best.hz_per_intensity * by,
                   sigma=sigma * found.sigma / both)
