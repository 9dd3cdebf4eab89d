"""Bandwidth of the photoreceptors: its law, and its estimation from a pixel sample."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.selfcal.likelihood import (
    LONG_TAILED,
    NORMAL,
    evidence,
    negative_log_likelihood,
    vertex,
)
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of
from pdavis_cv.selfcal.priors import TYPICAL_BANDWIDTH, USUAL_BANDWIDTH

__all__ = ["Bandwidth", "combine_bandwidths", "fit_bandwidth", "likeliest_by_light"]


@dataclass(frozen=True)
class Bandwidth:
    """Corner frequency of the photoreceptors: ``hz + hz_per_intensity * I``.

    Parameters
    ----------
    hz : float
        Part that does not depend on the light.
    hz_per_intensity : float
        Part proportional to the intensity I, Hz per DN/ms.
    at_intensity : float
        Intensity in DN/ms at which the sum is known best: a tenth of a bright pixel's,
        since log intensity changes fastest where the light is dim.
    sigma : float
        Standard error of the ln of the corner frequency there.
    """

    hz: float
    hz_per_intensity: float
    at_intensity: float
    sigma: float

    @property
    def law(self) -> tuple[float, float]:
        """(hz, hz_per_intensity), what `KalmanFilter` takes."""
        return self.hz, self.hz_per_intensity


_MAX_SIGMAS_APART = 3.0
"""Difference, in standard deviations, beyond which the bias currents are assumed to
have been changed since the calibration, whose bandwidth is then ignored."""


def combine_bandwidths(stated: Sequence[float], found: Bandwidth) -> Bandwidth:
    """Combine the bandwidth of a calibration with that of a recording.

    The ln of both corner frequencies are averaged, weighted by inverse variance; the
    share proportional to the light is that of the one with the smaller variance.  If
    they differ by more than 3 standard deviations, the recording's is returned.

    Parameters
    ----------
    stated : (hz, hz_per_intensity, sigma)
        Bandwidth of the calibration.
    found : Bandwidth
        Bandwidth estimated from the recording.

    Returns
    -------
    Bandwidth
    """
    hz, slope, sigma = stated
    at = found.at_intensity
    there = found.hz + found.hz_per_intensity * at
    if not (hz + slope * at > 0 and there > 0):
        return found
    difference = math.log((hz + slope * at) / there)
    both = math.hypot(sigma, found.sigma)
    if abs(difference) > _MAX_SIGMAS_APART * both or both == 0:
        return found
    weight = (found.sigma / both) ** 2  # weight of the stated bandwidth
    best = found
    if sigma < found.sigma:
        best = Bandwidth(hz, slope, at, sigma)
        difference, weight = -difference, 1 - weight
    factor = math.exp(weight * difference)
    return replace(
        best, hz=best.hz * factor, hz_per_intensity=best.hz_per_intensity * factor,
        sigma=sigma * found.sigma / both)


_LN_HZ, _LN_HZ_SIGMA = math.log(USUAL_BANDWIDTH[0]), USUAL_BANDWIDTH[2]

_GRID_HZ = (30.0, 80.0, 160.0, 300.0, 600.0, 2000.0)
"""Corner frequencies at which the likelihood is first evaluated, Hz."""

# Standard error of the ln: inflation over that by the curvature of -ln L, and relative
# error of the model.
_CURVATURE_INFLATION, _MODEL_SIGMA = 1.2, 0.016

# Bias where the light turns: interpolation over the gap between two events looks like
# a lag of dt = 0.3 ms * (72 Hz / r)^4, r = events per second and pixel, at least 1.
_TURN_LAG_S, _TURN_RATE_HZ, _TURN_POWER, _LEAST_RATE_HZ = 0.3e-3, 72.0, 4, 1.0

_LAW_EVIDENCE = 8.0
"""Gain of ln L that a bandwidth that depends on the light must have over a constant one
(see `evidence`).  Errors of interpolation and de-blurring cause up to 7 before a fan;
where the bandwidth does follow the light it is 41 or more, except in the dimmest light
(lab/studies/selfcal_law.py)."""

_GRID_SHARES = np.array([0.0, 0.5, 0.8, 1.0])
"""Shares of the bandwidth, proportional to the light, where -ln L is first tried."""

_COARSE_PIXELS = 16
"""Number of pixels for the grid, which need only find the region of the minimum."""

_COARSE_STEPS, _FINE_STEPS = 0.25 * np.arange(-3, 4), (0.25, 0.1)
"""Steps in ln hz about a minimum: of the search, as slow pixels make the minimum 0.2
wide; and of two parabolas with all pixels, of which the second gives the curvature."""

_ROUGH = 2.0
"""Least rise of -ln L, summed over both sides of a parabola (one sigma each), at which
its curvature is used instead of that of a wider one.  On a smaller scale -ln L is
rough, as it jumps when a frame passes an event; numerical."""

_SHARE_STEP = 0.25
"""Step by which the share is refined: of the ln of the ratio of the corner frequencies
in dim and in bright light."""

_FINE_SHARES = 201
"""Number of shares over which the posterior mean is computed; numerical."""

_DIM = 0.1
"""Dim light, as a fraction of a bright pixel's: there log intensity changes fastest."""


def fit_bandwidth(sample: PixelSample) -> Bandwidth:
    """Return the bandwidth at which the innovations are likeliest.

    -ln L is evaluated on a grid of (ln corner frequency, share of it proportional to
    the light) with some of the pixels, and refined by parabolas with all of them.
    Innovations are taken as normal: with longer tails, pixels of 250 Hz before a fan
    were estimated as 222.

    Parameters
    ----------
    sample : PixelSample

    Returns
    -------
    Bandwidth
    """
    cost = _Cost(sample)
    least = cost.minima()
    constant, best = least[0], min(least, key=_cost)
    # The law is extrapolated to other light, as where frames saturate.  So without
    # evidence for a dependence on the light the bandwidth is taken as constant.
    if best.share > 0:
        best = constant if cost.evidence(best, constant) < _LAW_EVIDENCE else (
            cost.with_mean_share(least))
    hz, slope = _law(best.share, best.ln_hz, sample.bright)
    at = _DIM * sample.bright
    rate_hz = max(sample.events_per_s, _LEAST_RATE_HZ)
    lag_s = _TURN_LAG_S * (_TURN_RATE_HZ / rate_hz) ** _TURN_POWER
    sigma = math.hypot(_CURVATURE_INFLATION * best.sigma, _MODEL_SIGMA,
                       2 * np.pi * (hz + slope * at) * lag_s)
    return Bandwidth(float(hz), float(slope), at, min(sigma, _LN_HZ_SIGMA))


def likeliest_by_light(
    sample: PixelSample,
) -> tuple[float, tuple[float, float] | None]:
    """Return the least -ln L with a bandwidth that follows the light, and its law.

    Innovations have long tails, as in the fit of the clock offset.  -ln L is infinite
    if a constant bandwidth is likelier, or if the corner frequency of bright pixels
    would be more than 3 standard deviations from the usual one.  The law, (hz,
    hz_per_intensity), is the likeliest one within these; None if there is none.

    Parameters
    ----------
    sample : PixelSample
        The data.
    """
    found = _Cost(sample, LONG_TAILED).minima()
    likely = [each for each in found if each.share > 0 and _is_usual(each.ln_hz)]
    if not likely:
        return math.inf, None
    best = min(likely, key=_cost)
    hz, slope = _law(best.share, best.ln_hz, sample.bright)
    least = best.cost if best.cost <= min(map(_cost, found)) else math.inf
    return least, (float(hz), float(slope))


class _Minimum(NamedTuple):
    """Minimum of -ln L at a share, with the standard error of ln hz by curvature."""

    share: float
    ln_hz: float
    cost: float
    sigma: float


def _cost(each: _Minimum) -> float:
    return each.cost


def _by_share(found: Sequence[_Minimum]) -> list[_Minimum]:
    """Return the likeliest minimum of each share, in order of the share."""
    best: dict[float, _Minimum] = {}
    for each in sorted(found, key=_cost, reverse=True):
        best[each.share] = each
    return [best[share] for share in sorted(best)]


def _between(known: Sequence[_Minimum], share: float) -> float:
    """Interpolate ln hz at a share between known minima, in order of the share.

    It is linear in the ln of the corner frequency in dim over that in bright light.
    """
    return float(np.interp(-_ln_dim(share), [-_ln_dim(each.share) for each in known],
                           [each.ln_hz for each in known]))


def _is_usual(ln_hz: float) -> bool:
    """Return whether a bright pixel's corner frequency is within 3 prior sigmas."""
    hz, _, sigma = TYPICAL_BANDWIDTH
    return abs(ln_hz - math.log(hz)) < _MAX_SIGMAS_APART * sigma


class _Cost:
    """-ln L of a share proportional to the light and ln hz in bright light."""

    def __init__(self, sample: PixelSample, power: float = NORMAL) -> None:
        self._sample, self._power = sample.with_leak_in_frames(), power

    def __call__(
        self, share: ArrayLike, ln_hz: NDArray[np.float64], every: int = 1,
    ) -> NDArray[np.float64]:
        """Return -ln L, shape (C,), from one in `every` pixels."""
        found = self._sample.innovations(candidates_of(np.transpose(
            _law(np.broadcast_to(share, ln_hz.shape), ln_hz, self._sample.bright))),
            every)
        prior = 0.5 * ((ln_hz - _LN_HZ) / _LN_HZ_SIGMA) ** 2
        return negative_log_likelihood(found, self._power) + prior

    def evidence(self, one: _Minimum, other: _Minimum) -> float:
        """Return the gain in ln L over another, with variances at least as stated."""
        found = self._sample.innovations(candidates_of(
            [_law(each.share, each.ln_hz, self._sample.bright)
             for each in (one, other)]))
        return evidence(found[:1], found[1:], self._power, least=1.0)[0]

    def coarse(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return ln hz of the minimum and its -ln L for each of `_GRID_SHARES`.

        It uses some of the pixels and scales their -ln L up to the whole sample.
        """
        every = max(len(self._sample.pixels) // _COARSE_PIXELS, 1)
        grid, ends = np.log(_GRID_HZ), _GRID_SHARES[[0, -1]]
        rows = self(np.repeat(ends, len(grid)), np.tile(grid, 2), every)
        first, last = (vertex(grid, row) + _ln_dim(share)
                       for row, share in zip(rows.reshape(2, -1), ends, strict=True))
        # In dim light, which is most informative, the corner frequency hardly depends
        # on the share: start on a line between the two ends.
        start = first + _GRID_SHARES * (last - first) - _ln_dim(_GRID_SHARES)
        x = start[:, None] + _COARSE_STEPS
        y = self(np.repeat(_GRID_SHARES, len(_COARSE_STEPS)), x.ravel(), every)
        y = y.reshape(x.shape)
        return (np.array([vertex(*each) for each in zip(x, y, strict=True)]),
                every * y.min(1))

    def minima(self) -> list[_Minimum]:
        """Return the minimum of a constant bandwidth, then those of likely shares."""
        ln_hz, costs = self.coarse()
        dim = _ln_dim(_GRID_SHARES)
        shares = {0.0, float(_GRID_SHARES[1 + np.argmin(costs[1:])]),
                  _share(-vertex(-dim, costs))}

        def least(share: float, ln_dim_hz: float) -> _Minimum:
            return self.minimum(share, ln_dim_hz - float(_ln_dim(share)))

        found = [least(share, float(np.interp(-_ln_dim(share), -dim, ln_hz + dim)))
                 for share in sorted(shares)]
        best = min(found, key=_cost)
        if best.share > 0:
            middle = float(_ln_dim(best.share))
            beside = [least(_share(u), best.ln_hz + middle)
                      for u in (middle - _SHARE_STEP, middle + _SHARE_STEP)]
            three = np.array([(_ln_dim(each.share), each.cost)
                              for each in (beside[0], best, beside[1])])
            if len(np.unique(three[:, 0])) == len(three):
                beside.append(least(_share(vertex(*three.T)), best.ln_hz + middle))
            found += beside
        return found

    def with_mean_share(self, found: list[_Minimum]) -> _Minimum:
        """Return the minimum at the posterior mean of the share, with a uniform prior.

        -ln L is interpolated linearly between the minima found and those at the other
        `_GRID_SHARES`.  The mean is used because where -ln L is flat, the likeliest
        share is often 1, which means no bandwidth at all in the dark.
        """
        known = _by_share(found)
        found = found + [
            self.minimum(share, _between(known, share)) for share in
            _GRID_SHARES.tolist() if share not in {each.share for each in known}]
        known = _by_share(found)
        fine = np.linspace(0, 1, _FINE_SHARES)
        costs = np.interp(fine, [each.share for each in known],
                          [each.cost for each in known])
        weight = np.exp(costs.min() - costs)
        mean = float(weight @ fine / weight.sum())
        return self.minimum(mean, _between(known, mean))

    def minimum(self, share: float, ln_hz: float) -> _Minimum:
        """Return the minimum near ln_hz at a share, from all pixels."""
        information = 0.0
        for step in _FINE_STEPS:
            x = ln_hz + step * np.array([-1.0, 0.0, 1.0])
            y = self(share, x)
            ln_hz = vertex(x, y)
            rise = y[0] + y[2] - 2 * y[1]
            curvature = rise / step**2
            if rise > _ROUGH or information == 0.0:
                information = curvature
        fall = 0.5 * curvature * (ln_hz - x[1])**2 if curvature > 0 else 0.0
        return _Minimum(share, ln_hz, float(min(y[1] - fall, y.min())),
                        1 / math.sqrt(max(information, 1 / _LN_HZ_SIGMA**2)))


def _law(share: Any, ln_hz: Any, bright: float) -> tuple[Any, Any]:
    """Return hz and hz_per_intensity from share and ln hz in bright light."""
    hz = np.exp(ln_hz)
    return hz * (1 - share), hz * share / bright


def _share(ln_dim: float) -> float:
    """Return the share, between 0 and 1, from its `_ln_dim`."""
    return min(max((1 - math.exp(ln_dim)) / (1 - _DIM), 0.0), 1.0)


def _ln_dim(share: Any) -> Any:
    """Return the ln of the ratio of the corner frequencies in dim and bright light."""
    return np.log(1 - share + share * _DIM)
