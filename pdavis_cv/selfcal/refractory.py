"""Refractory period: how long a pixel is held in reset after an event."""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.selfcal.likelihood import negative_log_likelihood
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of
from pdavis_cv.selfcal.priors import TYPICAL_BANDWIDTH

__all__ = ["Refractory", "fit_refractory"]

_GAPS = 8
"""Shortest gaps that the edge is told by; an engineering choice: 1 noise event per
second and 10,000 events leave one per 100 us."""

_AGREE, _SIGMAS = 0.1, 3.0
"""Edges of all gaps and of those to an event of the other sign agree within this part
and so many sigmas: 12 % is the most on `nominal` cameras.  Light that turns makes no
short gap, so without noise the second lies far beyond: 2.7 times on the real
DAVIS346."""

_LEAST_US = 50.0
"""A shorter period cannot be told from resolution of stamps and waits for the bus."""

_LEAST_SHARE = 0.02
"""A period that pixels spend less of their time in loses less than the scale of the
thresholds is known to."""

_EVIDENCE, _FALL = 40.0, 0.1
"""Fall of -ln L of the frames that is required, as for the common scale, and relative
fall of the innovations' mean square: interpolation errs alike in every frame, so the
evidence that it fakes grows with their number.  Engineering choice: on `nominal`
cameras a period of 1 to 3 ms makes 16 % and more of it where it matters."""

_CLOCK_STEP_US, _SCALE_STEP = 1500.0, 0.2
"""Steps of the offset of the clocks, half the width of its minimum, and of the ln of
the scale of the thresholds, each tried on both sides of what is stated: no period is
preferred for what either of these does."""

# Up to 9 ms either way.
_CLOCKS_US = _CLOCK_STEP_US * np.arange(-6, 7)
# Up to a factor of 2.2 either way.
_LN_SCALES = _SCALE_STEP * np.arange(-4, 5)

_COARSE_PIXELS, _PIXELS = 16, 64
"""Pixels that offsets and scales are tried with."""


class Refractory(NamedTuple):
    """How long a pixel is held in reset after an event.

    Parameters
    ----------
    us : float
        0 where frames do not confirm any.
    sigma_us : float
        Standard deviation; where there is none, the shortest gap between two events.
    """

    us: float
    sigma_us: float


def edge_of(gaps_us: NDArray[np.int64]) -> tuple[float, float]:
    """Return the least gap that pixels can make, and its standard deviation.

    Noise comes at any time, so gaps are as dense as noise is from the edge on: of the
    shortest n, the first lies by the mean distance of two beyond it.

    Parameters
    ----------
    gaps_us : ndarray of int64
        Between consecutive events of one pixel, of some pixels; 2 or more.
    """
    n = min(_GAPS, len(gaps_us))
    shortest = np.sort(np.partition(gaps_us, n - 1)[:n])
    step = float(shortest[-1] - shortest[0]) / (n - 1)
    return float(shortest[0]) - step, math.hypot(step, 1.0)


def fit_refractory(sample: PixelSample) -> Refractory | None:
    """Return the refractory period, None if events are too few to tell.

    No gap is shorter than it.  But where there is little noise none is shorter either
    than light takes from one threshold to the next: then gaps to an event of the other
    sign have no such edge.  Frames confirm it: they contradict the sum of the events
    without what is lost, or with what is not.
    """
    gaps, turned = sample.gaps_us
    if np.count_nonzero(turned) < _GAPS:
        return None
    us, sigma = edge_of(gaps)
    other, other_sigma = edge_of(gaps[turned])
    if (us < _LEAST_US or us * sample.events_per_s < 1e6 * _LEAST_SHARE
            or other - us > _AGREE * us + _SIGMAS * other_sigma):
        return Refractory(0.0, float(gaps.min()))
    clean = sample.without_dim_samples()
    without, count = _least(clean, 0.0)
    evidence = without - _least(clean, us)[0]
    if evidence < max(_EVIDENCE, -0.5 * count * math.log1p(-_FALL)):
        return Refractory(0.0, float(gaps.min()))
    return Refractory(us, sigma)


def _least(sample: PixelSample, refractory_us: float) -> tuple[float, float]:
    """Return the least -ln L over offsets of the clocks, then scales.

    And the number of innovations that tell it.
    """
    sample = sample.with_refractory(refractory_us)
    count = len(sample.pixels)
    candidates = candidates_of([TYPICAL_BANDWIDTH[:2]] * len(_CLOCKS_US))
    candidates["clock_us"] = _CLOCKS_US
    costs = negative_log_likelihood(sample.innovations(
        candidates, max(count // _COARSE_PIXELS, 1)))
    clock_us = _CLOCKS_US[np.argmin(costs)]
    candidates = candidates_of([TYPICAL_BANDWIDTH[:2]] * len(_LN_SCALES))
    candidates["clock_us"] = clock_us
    candidates["scale_on"] = candidates["scale_off"] = np.exp(_LN_SCALES)
    found = sample.innovations(candidates, max(count // _PIXELS, 1))
    return float(negative_log_likelihood(found).min()), float(found["count"][0])
