"""Offset between the clocks of frames and events: stamps wrong by a constant."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.selfcal.bandwidth import likeliest_by_light
from pdavis_cv.selfcal.likelihood import (
    BLOCKS,
    evidence,
    negative_log_likelihood,
    vertex,
)
from pdavis_cv.selfcal.noise import fit_event_noise
from pdavis_cv.selfcal.pixel_sample import FILTER_NOISE, PixelSample, candidates_of
from pdavis_cv.selfcal.priors import CLOCK_OFFSET_SIGMA_US, TYPICAL_BANDWIDTH

__all__ = ["ClockOffset", "fit_clock_offset"]

_REACH_US, _COARSE_STEP_US = 15_000, 1500
"""Offsets that are tried at first: twice what was measured on two cameras (4 to 7.4
ms), and by half the width of the minimum at 1000 RPM."""

_COARSE_PIXELS = 16
"""Pixels that the grid is evaluated with."""

_FIT_WIDTH_US, _FIT_POINTS = 1800.0, 9
"""Half width of the parabola that -ln L is fitted with, and its points.  Wide: within 1
ms -ln L is rough, as one frame or another passes an event; an engineering choice."""

_MOST_FITS, _NEAR = 4, 0.4
"""A parabola is fitted again, at most so often, if its least point lies farther from
the middle than this part of the half width; numerical."""

_LAW_HZ = (60.0, 120.0, 240.0, 480.0)
"""Corner frequencies of a bright pixel that a lag in proportion to 1 / light is tried
with, Hz; a factor of two apart, as -ln L is a parabola in their ln."""

_LAW_EVIDENCE = 20.0
"""By how much -ln L must fall for a lag that depends on the light to be preferred: with
an offset, or, if its bandwidth follows the light in part, in place of one; an
engineering choice."""

_LAG_SHARE = 0.2
"""Error of the lag that such a camera makes of the delay, relative: 1.3 to 1.8 ms of 7
at 30 RPM where the clocks agree (studies/selfcal_clock_offset.py)."""

_EVIDENCE = 8.0
"""By how much -ln L must fall against a camera whose clocks agree and whose lag is in
proportion to 1 / light: in dim light it reaches milliseconds."""

_MUCH_NOISE = 2.0
"""Event noise beyond so many times what the innovations' variances state is much: half
a step of the grid that it is found on (`fit_event_noise`)."""

_CURVATURE_INFLATION = 2.0
"""Of the sigma by the curvature of -ln L, an engineering choice: pixels that see the
same edge err alike.  Before a polarizer .75 is enough
(studies/selfcal_clock_offset.py), before a texture or a fan, with pixels that have a
refractory period, up to 5 was seen."""

_MODEL_US = 150.0
"""What models have wrong in the sum of offset and lag, us: an engineering choice.  rms
error 52 where the model holds (studies/selfcal_clock_offset.py); a refractory period of
.5 ms, which is not modelled, moves it by 300."""

_MOST_US = 12_000.0
"""More, 2.4 sigma of the prior, is not believed: in a part of a turn, light that passes
its extremes at other times than the frames see looks like it."""

_SIGMAS, _LEAST_US = 3.0, 1000.0
"""An offset counts beyond so many sigmas, and so many us: less is taken for lag, which
nearly does the same.  A delay that the lag of the usual bandwidth makes within so many
sigmas of its ln, up to 4.5 times 530 us, is that lag: clocks agree."""


@dataclass(frozen=True)
class ClockOffset:
    """By how much frames' stamps must be moved to the clock of the events.

    Parameters
    ----------
    us : float
        To be added to the stamps, microseconds; positive where events trail frames.
    sigma_us : float
        Standard deviation.  Where nothing is told, that of the prior; 0 where it was
        stated and not estimated.
    or_lag : bool
        Whether a lag of the photoreceptors would explain the delay as well.
    """

    us: float
    sigma_us: float
    or_lag: bool = False

    @property
    def counts(self) -> bool:
        """Whether it is told from 0: stated, or beyond 3 sigma and 1 ms, within 12 ms.

        Where nothing is told but the prior, nothing counts.
        """
        return self.sigma_us == 0 or (
            self.sigma_us < CLOCK_OFFSET_SIGMA_US
            and max(_SIGMAS * self.sigma_us, _LEAST_US) < abs(self.us) < _MOST_US)

    @property
    def ambiguous(self) -> bool:
        """Whether a delay of more than 1 ms may be one of the clocks or a lag."""
        return self.or_lag and not self.counts and abs(self.us) > _LEAST_US

    @property
    def applied_us(self) -> int:
        """What to add to the stamps: the offset if it counts, else 0."""
        return round(self.us) if self.counts else 0


class _Fit(NamedTuple):
    """Least -ln L of a law of the bandwidth, and the offset there."""

    cost: float
    us: float
    sigma_us: float


def fit_clock_offset(
    sample: PixelSample, bandwidth: tuple[float, float, float] | None = None
) -> ClockOffset:
    """Return the offset at which innovations are likeliest.

    Offset and lag add up to a delay, which frames tell well; what of it is lag they
    tell only as far as the lag depends on the light.  So two cameras are tried: one of
    the usual bandwidth in any light, whose uncertainty counts in the result, and one
    whose bandwidth is in proportion to the light, of any factor.

    Parameters
    ----------
    sample : PixelSample
    bandwidth : (float, float, float), optional
        Of the photoreceptors, where it is known: Hz, Hz per DN/ms and the standard
        deviation of the ln; then no other is tried.
    """
    whole = sample.that_may_move(_REACH_US)
    clean = whole.with_leak_in_frames()
    hz, per_intensity, ln_sigma = bandwidth or TYPICAL_BANDWIDTH
    law = hz, per_intensity
    lag_us = 1e6 / (2 * math.pi * (hz + per_intensity * sample.bright / 2))
    grid = np.arange(-_REACH_US, _REACH_US + 1, _COARSE_STEP_US, dtype=np.float64)
    every = max(len(sample.pixels) // _COARSE_PIXELS, 1)
    start = vertex(grid, _costs(clean, grid, law, every)
                   + _prior(grid) / every)
    for _ in range(2):      # which samples are between like events depends on it
        steady = clean.between_like_events(start + lag_us)
        found = _minimum(steady, start, law)
        start = found.us
    found = found._replace(sigma_us=math.hypot(found.sigma_us, ln_sigma * lag_us))
    delay_us = found.us + lag_us
    usual = delay_us > 0 and abs(math.log(delay_us / lag_us)) < _SIGMAS * ln_sigma
    told = agree = False
    if bandwidth is None:
        by_light, without = _in_proportion(steady, start)
        told = by_light.cost < found.cost - _LAW_EVIDENCE
        if told:
            found = by_light._replace(sigma_us=math.hypot(
                by_light.sigma_us, _LAG_SHARE * (delay_us - by_light.us)))
        agree = without < found.cost + _EVIDENCE or (
            not usual and _light_explains(
                whole.between_like_events(start + lag_us), found.cost, start, law))
    if usual or agree:
        found = found._replace(sigma_us=math.hypot(found.sigma_us, found.us))
    return _offset(found, agree and not (told or usual))


def _offset(found: _Fit, or_lag: bool = False) -> ClockOffset:
    return ClockOffset(found.us, min(math.hypot(
        found.sigma_us, _MODEL_US), CLOCK_OFFSET_SIGMA_US), or_lag)


def _in_proportion(sample: PixelSample, start: float) -> tuple[_Fit, float]:
    """Return the fit with a bandwidth in proportion to the light, of any factor.

    And the least -ln L of such a camera whose clocks agree.
    """
    ln_hz = np.log(_LAW_HZ)
    fits = [_minimum(sample, start, (0.0, hz / sample.bright)) for hz in _LAW_HZ]
    best = vertex(ln_hz, np.array([fit.cost for fit in fits]))
    found = _minimum(sample, float(np.interp(best, ln_hz, [fit.us for fit in fits])),
                     (0.0, math.exp(best) / sample.bright))
    without = min(float(_costs(sample, np.zeros(1), (0.0, hz / sample.bright))[0])
                  for hz in (*_LAW_HZ, math.exp(best)))
    return found, without


def _light_explains(
    sample: PixelSample, cost: float, us: float, law: tuple[float, float]
) -> bool:
    """Return whether clocks that agree and a lag by the light explain the delay.

    They do if -ln L falls by `_LAW_EVIDENCE` from the cost of an offset.  Where event
    noise is more than the variances state, a few samples that it puts off by a
    threshold decide: there the offset of us with the usual law must be likelier,
    priors included, by one standard error (the rule of Breiman et al., Classification
    and Regression Trees, 1984).
    """
    least, other = likeliest_by_light(sample)
    if least < cost - _LAW_EVIDENCE or other is None:
        return other is not None
    clean = sample.with_leak_in_frames()
    noise = fit_event_noise(clean.with_frames_moved(round(us)), law)
    if noise <= _MUCH_NOISE * FILTER_NOISE[1]:
        return False
    candidates = candidates_of([law, other])
    candidates["clock_us"][0] = round(us)
    gain, error = evidence(*clean.innovations_by_time(candidates, BLOCKS))
    hz, _, sigma = TYPICAL_BANDWIDTH
    away = math.log((other[0] + other[1] * sample.bright) / hz) / sigma
    return gain + 0.5 * away**2 - 0.5 * (us / CLOCK_OFFSET_SIGMA_US)**2 < error


def _minimum(sample: PixelSample, us: float, law: tuple[float, float]) -> _Fit:
    """Return the minimum over the offset, near us, by parabolas."""
    points = np.linspace(-1, 1, _FIT_POINTS)
    for _ in range(_MOST_FITS):
        x = us + _FIT_WIDTH_US * points
        y = _costs(sample, x, law) + _prior(x)
        square, slope, level = np.polyfit(points, y, 2)
        at = (float(np.clip(-slope / (2 * square), -1, 1)) if square > 0
              else float(points[np.argmin(y)]))
        us += _FIT_WIDTH_US * at
        if abs(at) < _NEAR:
            break
    sigma = _CURVATURE_INFLATION * _FIT_WIDTH_US / math.sqrt(2 * square) if (
        square > 0) else CLOCK_OFFSET_SIGMA_US
    return _Fit(float(level + slope * at + square * at * at), us, sigma)


def _costs(
    sample: PixelSample, us: NDArray[np.float64], law: tuple[float, float],
    every: int = 1,
) -> NDArray[np.float64]:
    """Return -ln L of each offset, by one in `every` pixels."""
    candidates = candidates_of([law] * len(us))
    candidates["clock_us"] = np.rint(us)
    return negative_log_likelihood(sample.innovations(candidates, every))


def _prior(us: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (us / CLOCK_OFFSET_SIGMA_US) ** 2
