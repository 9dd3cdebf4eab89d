"""Offset between the clocks of frames and events, constant over a recording."""
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
"""Range and step of the offsets that are tried first: twice what was measured on two
cameras (4 to 7.4 ms), and half the width of the minimum at 1000 RPM."""

_COARSE_PIXELS = 16
"""Number of pixels with which the grid is evaluated."""

_LAW_PIXELS = 128
"""Number of pixels with which laws of the bandwidth are compared, before the likeliest
one is fitted with all of them.  Engineering choice: as all of them do, it tells a lag
of 80 Hz pixels after half a second; with 64, 2 of 8 recordings were not told."""

_FIT_WIDTH_US, _FIT_POINTS = 1800.0, 9
"""Half width of the parabola fitted to -ln L, and number of its points.  It is wide
because within 1 ms -ln L is rough, as it jumps when a frame passes an event.
Engineering choice."""

_MOST_FITS, _NEAR = 4, 0.4
"""Most fits of a parabola; a fit is repeated if its minimum lies farther from the
middle than this fraction of the half width; numerical."""

_LAW_HZ = (60.0, 120.0, 240.0, 480.0)
"""Corner frequencies of a bright pixel, Hz, with which a lag proportional to 1 / light
is tried; a factor of two apart, as -ln L is a parabola in their ln."""

_LAW_EVIDENCE = 20.0
"""Fall of -ln L required to prefer a lag that depends on the light: together with an
offset, or, if the bandwidth follows the light in part, instead of one.  Engineering
choice."""

_LAG_SHARE = 0.2
"""Relative error of the lag that such a fit separates from the delay: 1.3 to 1.8 ms of
7 at 30 RPM where the clocks agree (lab/studies/selfcal_clock_offset.py)."""

_LAG_LIGHT = 0.5
"""Intensity at which the lag is evaluated, relative to a bright pixel's."""

_EVIDENCE = 8.0
"""Fall of -ln L required against a camera whose clocks agree and whose lag is
proportional to 1 / light, which in dim light reaches milliseconds."""

_MUCH_NOISE = 2.0
"""Ratio of event noise to that assumed in the innovations' variances above which the
noise counts as high: half a step of the grid of `fit_event_noise`."""

_CURVATURE_INFLATION = 2.0
"""Factor on the sigma by the curvature of -ln L, because pixels that see the same edge
have the same error.  Engineering choice: before a polarizer .75 is enough
(lab/studies/selfcal_clock_offset.py); before a texture or a fan, with pixels that have
a refractory period, up to 5 was seen."""

_MODEL_US = 150.0
"""Model error of the sum of offset and lag, us.  Engineering choice: the rms error is
52 where the model holds (lab/studies/selfcal_clock_offset.py); a refractory period of
0.5 ms, which is not modelled, shifts it by 300."""

_MOST_US = 12_000.0
"""Greatest offset that is applied, us: 2.4 sigma of the prior.  In less than a turn,
light that has its extremes between frames can look like a larger one."""

_SIGMAS, _LEAST_US = 3.0, 1000.0
"""An offset is significant beyond so many sigmas and so many us; a smaller one is taken
as lag, whose effect is nearly the same.  A delay that the usual bandwidth explains
within so many sigmas of its ln, up to 4.5 times 530 us, is taken as that lag."""


@dataclass(frozen=True)
class ClockOffset:
    """Offset from the frames' clock to the clock of the events.

    Parameters
    ----------
    us : float
        Shift to be added to the frames' stamps, us; positive if events trail frames.
    sigma_us : float
        Standard error: that of the prior if the data give no information, and 0 if the
        offset was stated, not estimated.
    or_lag : bool
        Whether a lag of the photoreceptors would explain the delay equally well.
    decided : bool
        Whether its estimator has weighed the evidence for it, so that it is applied.
    """

    us: float
    sigma_us: float
    or_lag: bool = False
    decided: bool = False

    @property
    def significant(self) -> bool:
        """Whether the offset is significant, and so is applied.

        It is if it was stated or decided, or if it lies beyond 3 sigma and 1 ms but
        within 12 ms and the data give more information than the prior.
        """
        return self.decided or self.sigma_us == 0 or (
            self.sigma_us < CLOCK_OFFSET_SIGMA_US
            and max(_SIGMAS * self.sigma_us, _LEAST_US) < abs(self.us) < _MOST_US)

    @property
    def ambiguous(self) -> bool:
        """Whether a delay of more than 1 ms may be either an offset or a lag."""
        return self.or_lag and not self.significant and abs(self.us) > _LEAST_US

    @property
    def applied_us(self) -> int:
        """Shift to add to the stamps, us: the offset if it is significant, else 0."""
        return round(self.us) if self.significant else 0


class _Fit(NamedTuple):
    """Least -ln L for one law of the bandwidth, and the offset at the minimum."""

    cost: float
    us: float
    sigma_us: float


def fit_clock_offset(
    sample: PixelSample, bandwidth: tuple[float, float, float] | None = None
) -> ClockOffset:
    """Return the offset at which the innovations are likeliest.

    The data determine the sum of offset and lag well, but separate them only as far as
    the lag depends on the light.  So two models are compared: one with the usual
    constant bandwidth, whose uncertainty is propagated to the result, and one with a
    bandwidth proportional to the light, with a free factor.

    Parameters
    ----------
    sample : PixelSample
        The data.
    bandwidth : (float, float, float), optional
        Bandwidth of the photoreceptors, if known: Hz, Hz per DN/ms and standard error
        of the ln; then no other one is tried.
    """
    whole = sample.that_may_move(_REACH_US)
    clean = whole.with_leak_in_frames()
    hz, per_intensity, ln_sigma = bandwidth or TYPICAL_BANDWIDTH
    law = hz, per_intensity
    lag_us = 1e6 / (
        2 * math.pi * (hz + per_intensity * sample.bright * _LAG_LIGHT))
    grid = np.arange(-_REACH_US, _REACH_US + 1, _COARSE_STEP_US, dtype=np.float64)
    every = max(len(sample.pixels) // _COARSE_PIXELS, 1)
    start = vertex(grid, _costs(clean, grid, law, every)
                   + _prior(grid) / every)
    for _ in range(2):      # the choice of samples depends on the offset
        steady = clean.between_like_events(start + lag_us)
        found = _minimum(steady, start, law)
        start = found.us
    found = found._replace(sigma_us=math.hypot(found.sigma_us, ln_sigma * lag_us))
    delay_us = found.us + lag_us
    usual = delay_us > 0 and abs(math.log(delay_us / lag_us)) < _SIGMAS * ln_sigma
    light_dependent = agree = False
    if bandwidth is None:
        by_light, without = _in_proportion(steady, start)
        light_dependent = by_light.cost < found.cost - _LAW_EVIDENCE
        if light_dependent:
            found = by_light._replace(sigma_us=math.hypot(
                by_light.sigma_us, _LAG_SHARE * (delay_us - by_light.us)))
        agree = without < found.cost + _EVIDENCE or (
            not usual and _light_explains(
                whole.between_like_events(start + lag_us), found.cost, start, law))
    if usual or agree:
        found = found._replace(sigma_us=math.hypot(found.sigma_us, found.us))
    return _offset(found, agree and not (light_dependent or usual))


def _offset(found: _Fit, or_lag: bool = False) -> ClockOffset:
    return ClockOffset(found.us, min(math.hypot(
        found.sigma_us, _MODEL_US), CLOCK_OFFSET_SIGMA_US), or_lag)


def _in_proportion(sample: PixelSample, start: float) -> tuple[_Fit, float]:
    """Return the fit with a bandwidth proportional to the light, with a free factor.

    The second value is the least -ln L of such a model with clocks that agree.
    """
    ln_hz = np.log(_LAW_HZ)
    every = max(len(sample.pixels) // _LAW_PIXELS, 1)
    fits = [_minimum(sample, start, (0.0, hz / sample.bright), every)
            for hz in _LAW_HZ]
    best = vertex(ln_hz, np.array([fit.cost for fit in fits]))
    found = _minimum(sample, float(np.interp(best, ln_hz, [fit.us for fit in fits])),
                     (0.0, math.exp(best) / sample.bright))
    without = min(float(_costs(sample, np.zeros(1), (0.0, hz / sample.bright))[0])
                  for hz in (*_LAW_HZ, math.exp(best)))
    return found, without


def _light_explains(
    sample: PixelSample, cost: float, us: float, law: tuple[float, float]
) -> bool:
    """Return whether a lag that depends on the light explains the delay without offset.

    It does if -ln L is lower by `_LAW_EVIDENCE` than the cost with an offset.  If event
    noise is higher than the variances assume, a few samples with errors of a threshold
    dominate -ln L.  Then the lag is also accepted unless the offset us with the usual
    law is likelier, including priors, by at least three standard errors, as many as an
    offset must exceed to be applied.
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
    return gain + 0.5 * away**2 - 0.5 * (us / CLOCK_OFFSET_SIGMA_US)**2 < (
        _SIGMAS * error)


def _minimum(
    sample: PixelSample, us: float, law: tuple[float, float], every: int = 1
) -> _Fit:
    """Return the minimum over the offset near us, by fitting parabolas.

    The cost is that of one in `every` pixels.
    """
    points = np.linspace(-1, 1, _FIT_POINTS)
    for _ in range(_MOST_FITS):
        x = us + _FIT_WIDTH_US * points
        y = _costs(sample, x, law, every) + _prior(x) / every
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
    """Return -ln L of each offset, from one in `every` pixels."""
    candidates = candidates_of([law] * len(us))
    candidates["clock_us"] = np.rint(us)
    return negative_log_likelihood(sample.innovations(candidates, every))


def _prior(us: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (us / CLOCK_OFFSET_SIGMA_US) ** 2
