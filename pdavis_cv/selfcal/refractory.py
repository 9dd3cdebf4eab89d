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
"""Number of shortest gaps from which the edge is estimated.  Engineering choice: with 1
noise event per second and 10,000 events there is one such gap per 100 us."""

_AGREE, _SIGMAS = 0.1, 3.0
"""The edge of all gaps and that of gaps to an event of the other sign must agree within
this fraction plus so many sigmas: they differ by 12 % at most on `nominal` cameras.
Light that turns causes no short gaps, so without noise the second edge is far larger:
2.7 times on the real DAVIS346."""

_STAMP_US = 1.0
"""Resolution of the stamps, us, a part of the edge's standard error."""

_LEAST_US = 50.0
"""Shortest period, us, that differs from the resolution of stamps and bus delays."""

_LEAST_SHARE = 0.02
"""Least fraction of time that pixels spend in reset; below it, the loss is smaller than
the uncertainty of the thresholds' scale."""

_EVIDENCE, _FALL = 40.0, 0.1
"""Required fall of -ln L of the frames, as for the common scale, and required relative
fall of the innovations' mean square.  The latter is needed because interpolation errs
alike in every frame, so that false evidence grows with their number.  Engineering
choice: on `nominal` cameras a period of 1 to 3 ms causes a fall of 16 % and more where
it matters."""

_CLOCK_STEP_US, _SCALE_STEP = 1500.0, 0.2
"""Steps of the clock offset (half the width of its minimum) and of the ln of the
thresholds' scale.  Both are tried on both sides of the stated value, so that a period
is not accepted for an effect of either."""

# Up to 9 ms either way.
_CLOCKS_US = _CLOCK_STEP_US * np.arange(-6, 7)
# Up to a factor of 2.2 either way.
_LN_SCALES = _SCALE_STEP * np.arange(-4, 5)

_COARSE_PIXELS, _PIXELS = 16, 64
"""Number of pixels with which offsets, and scales, are tried."""


class Refractory(NamedTuple):
    """How long a pixel is held in reset after an event.

    Parameters
    ----------
    us : float
        Refractory period; 0 if frames do not confirm any.
    sigma_us : float
        Standard error; if there is no period, the shortest gap between two events.
    """

    us: float
    sigma_us: float


def edge_of(gaps_us: NDArray[np.int64]) -> tuple[float, float]:
    """Return the least possible gap between events of a pixel, and its standard error.

    Noise events come at any time, so the density of gaps is constant from the edge on.
    The shortest of n gaps then lies beyond the edge by their mean spacing.

    Parameters
    ----------
    gaps_us : ndarray of int64
        Gaps between consecutive events of one pixel, from some pixels; 2 or more.
    """
    n = min(_GAPS, len(gaps_us))
    shortest = np.sort(np.partition(gaps_us, n - 1)[:n])
    step = float(shortest[-1] - shortest[0]) / (n - 1)
    return float(shortest[0]) - step, math.hypot(step, _STAMP_US)


def fit_refractory(sample: PixelSample) -> Refractory | None:
    """Return the refractory period, None if there are too few events.

    No gap between events is shorter than the period.  With little noise, however, the
    shortest gap may be the time that the light takes from one threshold to the next;
    then gaps to an event of the other sign do not have the same edge.  The frames must
    confirm the period: sums of events agree with them only if the loss is restored.
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
    """Return the least -ln L over clock offsets, then over scales.

    The second value is the number of innovations.
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
