"""Common scale of all pixels' thresholds: tests whether the nominal ones hold."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.selfcal.bandwidth import fit_bandwidth
from pdavis_cv.selfcal.likelihood import negative_log_likelihood, vertex
from pdavis_cv.selfcal.noise import fit_event_noise
from pdavis_cv.selfcal.pixel_sample import PixelSample, candidates_of
from pdavis_cv.selfcal.priors import USUAL_BANDWIDTH

__all__ = ["CommonScale", "fit_common_scale"]

_GRID = np.linspace(-math.log(3), math.log(3), 9)
"""ln of the scale where -ln L is first evaluated: the prior is flat within a factor of
three, which holds the published thresholds of a DAVIS (.1 to .5) about a nominal .2."""

_COARSE_PIXELS = 16
"""Number of pixels with which the grid is evaluated."""

_BANDWIDTH_PIXELS = 128
"""Number of pixels at least with which the bandwidth is fitted again with each scale.
It is the largest part of the estimate's time, and only the scale is kept."""

_LN_RATIOS = (-0.4, 0.0, 0.4)
"""ln of the ratio of the factors where -ln L is first evaluated: with a wrong ratio the
scale's minimum can vanish."""

_IN_EXPOSURE = 3
"""Number of events in an exposure from which on errors of interpolation average out; a
frame with fewer is used only if three successive events about its middle have one sign.
Without this alternative, at 1000 RPM only the steepest parts of the light would remain,
and thresholds be estimated up to a third too small."""

_STEPS = (0.4, 0.2, 0.1, 0.05)
"""Steps (ln) of the parabolas that refine the scale and the ratio."""

_SAME = 1e-3
"""Difference of ln of the scale, and of the ratio, below which two searches have ended
at one minimum: much less than its standard error; numerical."""

_EVIDENCE = 40.0
"""Fall of -ln L at which the nominal thresholds are given up: model selection between
"nominal" and "anything within a factor of three".  Engineering choice: more than the
fall where thresholds are stated correctly (up to 28 on `nominal` and `realistic`, 30 to
1000 RPM; lab/studies/selfcal_common_scale.py)."""

_LEAST_GAIN = 0.33
"""Least `CommonScale.gain`: innovations grow with the square of the error of the
thresholds.  Where a tenth of the events is lost, sums of events are noise at 1000 RPM,
and a scale of one half is likelier than the nominal thresholds, but with a gain of .12
only; true scales have .62 to 6.5 (lab/studies/selfcal_least_gain.py; .23, and .54 to 8,
on the specimens on which the limit was chosen), that of the real DAVIS346 has 2.1."""

_NO_EVENTS = -3.0
"""ln of a scale with which events almost vanish (5 % of their size); an engineering
choice.  If frames are as likely with it, the events do not follow the light (leak and
noise at rest) and give no information."""

_MAX_NOISE_SHARE, _NOISE_SIGMAS = 0.05, 3.0
"""Greatest event noise (thresholds^2 per second) relative to the rate of events: the
first value, of the order of the scale's own sigma, or the ln of the scale divided by
the second, if that is more.  Noise in the predictor attenuates a regression, here the
scale, by about this share, which is added to its sigma.  Engineering choice."""

_MAX_SIGMA = 0.05
"""Greatest sigma (ln) by the curvature of -ln L with which a scale is usable; of the
order of the models' error (`_MODEL_SIGMA`)."""

_MODEL_SIGMA = 0.03
"""Error of the scale (ln) by the models of frames and interpolation: rms error where
thresholds are stated correctly (lab/studies/selfcal_common_scale.py)."""

_LEAST_CURVATURE = 1.0
"""Least second derivative of -ln L by the ln of the scale, so that a flat minimum has a
finite sigma, a factor of e; numerical."""

_MIN_CHANGE = 0.08
"""Least |ln| of a scale that is applied.  A smaller one may be an effect of de-blurring
and of offsets of the frames (up to .07, lab/studies/selfcal_common_scale.py), and lies
within `THRESHOLD_SIGMA` of each pixel anyway."""


_DIM, _LEAST_HZ = 0.1, 20.0
"""Fraction of a bright pixel's light at which the lag is evaluated, as for the
bandwidth, and least corner frequency that is assumed there, Hz (a lag of 8 ms)."""


class CommonScale(NamedTuple):
    """Factors on the nominal thresholds of all pixels.

    Parameters
    ----------
    on, off : float
        Factors on the ON and OFF thresholds.
    sigma : float
        Standard error of the ln of both.
    evidence : float
        Fall of -ln L against the nominal thresholds.
    gain : float
        `evidence` per sample, relative to the squared ln of the scale and a quarter of
        that of the ratio.
    significant : bool
        Whether the evidence suffices to reject the nominal thresholds.
    """

    on: float
    off: float
    sigma: float
    evidence: float
    gain: float
    significant: bool

    @property
    def ln(self) -> tuple[float, float]:
        """ln(on off) / 2 and ln(on / off)."""
        return math.log(self.on * self.off) / 2, math.log(self.on / self.off)

    @property
    def determined(self) -> bool:
        """Whether -ln L is curved enough to determine the scale."""
        return self.sigma < math.hypot(_MAX_SIGMA, _MODEL_SIGMA)

    @property
    def off_nominal(self) -> bool:
        """Whether the factors differ from 1 by more than errors of the models."""
        return max(map(abs, self.ln)) > _MIN_CHANGE

    @property
    def error_of_nominal(self) -> float:
        """Root mean square error of the ln of the nominal thresholds, if they are kept.

        What was found, and its standard error; of the two thresholds, the larger one.
        """
        return math.hypot(
            self.sigma, max(abs(math.log(self.on)), abs(math.log(self.off))))


def fit_common_scale(
    sample: PixelSample, law: tuple[float, float], *, learn_bandwidth: bool = True,
    clock_us: int = 0, before: CommonScale | None = None,
) -> CommonScale:
    """Return the factors at which the innovations are likeliest.

    Parameters
    ----------
    sample : PixelSample
    law : (float, float)
        Bandwidth that fits the nominal thresholds best, or is known: hz,
        hz_per_intensity.
    learn_bandwidth : bool
        Whether the bandwidth is fitted again with each scale.  The search then also
        starts from the usual bandwidth, as the one that fits wrong thresholds best may
        be far off.
    clock_us : int
        Shift of the frames with which nominal thresholds fit best, us.
    before : CommonScale, optional
        Result with other time stamps, from which the search starts as well.
    """
    clean = sample.without_dim_samples().with_leak_in_frames()
    # Other frames have interpolation errors of up to a threshold, which attenuate the
    # scale.
    hz = max(law[0] + law[1] * _DIM * sample.bright, _LEAST_HZ)
    steady = clean.between_like_events(1e6 / (2 * math.pi * hz), _IN_EXPOSURE)
    every = max(len(sample.pixels) // _COARSE_PIXELS, 1)
    tried: list[tuple[float, float, float, float, _Cost]] = []
    starts = [(cost, *cost.coarse(every)) for cost in (
        _Cost(steady, start) for start in (
            (law, USUAL_BANDWIDTH[:2]) if learn_bandwidth else (law,)))]
    if before is not None:
        starts.append((starts[0][0], *before.ln))
    few = sample.thinned(_BANDWIDTH_PIXELS)
    for cost, scale, ratio in _minima(starts):
        if learn_bandwidth:
            cost = _Cost(steady, fit_bandwidth(
                few.with_thresholds_scaled(*_factors(scale, ratio))).law)
        scale, ratio, curvature = cost.minimum(scale, ratio, _STEPS[1:])
        least = float(cost(np.array([scale]), np.array([ratio]))[0])
        tried.append((least, scale, ratio, curvature, cost))
    found, scale, ratio, curvature, cost = min(tried, key=lambda each: each[0])
    without, = cost(np.array([_NO_EVENTS]), np.zeros(1))
    nominal, = _Cost(steady, law, clock_us)(np.zeros(1), np.zeros(1))
    on, off = _factors(scale, ratio)
    evidence = float(nominal - found)
    weight = steady.samples * (scale * scale + ratio * ratio / 4)
    result = CommonScale(
        on, off, math.hypot(max(curvature, _LEAST_CURVATURE)**-0.5, _MODEL_SIGMA),
        evidence, evidence / weight if weight else 0.0, False)
    if not (evidence > _EVIDENCE and without - found > _EVIDENCE
            and result.gain > _LEAST_GAIN and result.determined and result.off_nominal):
        return result
    noise = fit_event_noise(clean.with_thresholds_scaled(on, off), cost.law)
    share = noise / sample.events_per_s
    return result._replace(
        sigma=math.hypot(result.sigma, share),
        significant=share <= max(_MAX_NOISE_SHARE, abs(scale) / _NOISE_SIGMAS))


def _minima(
    starts: Sequence[tuple[_Cost, float, float]]
) -> list[tuple[_Cost, float, float]]:
    """Return the minima that are reached from the starts, each of them once."""
    found: list[tuple[_Cost, float, float]] = []
    for cost, scale, ratio in starts:
        scale, ratio, _ = cost.minimum(scale, ratio, _STEPS)
        if not any(cost is other and max(abs(scale - x), abs(ratio - y)) < _SAME
                   for other, x, y in found):
            found.append((cost, scale, ratio))
    return found


class _Cost:
    """-ln L as a function of ln(on off) / 2 and ln(on / off), scale and ratio."""

    def __init__(
        self, sample: PixelSample, law: tuple[float, float], clock_us: int = 0
    ) -> None:
        self._sample, self.law, self._clock_us = sample, law, clock_us

    def __call__(
        self, scale: NDArray[np.float64], ratio: NDArray[np.float64], every: int = 1
    ) -> NDArray[np.float64]:
        """Return -ln L, shape (C,), from one in `every` pixels."""
        candidates = candidates_of([self.law] * len(scale))
        candidates["clock_us"] = self._clock_us
        candidates["scale_on"] = np.exp(scale + ratio / 2)
        candidates["scale_off"] = np.exp(scale - ratio / 2)
        return negative_log_likelihood(self._sample.innovations(candidates, every))

    def coarse(self, every: int) -> tuple[float, float]:
        """Return the likeliest scale and ratio of the grid by one in `every` pixels."""
        rows = [self(_GRID, np.full_like(_GRID, ratio), every) for ratio in _LN_RATIOS]
        row = int(np.argmin([y.min() for y in rows]))
        return vertex(_GRID, rows[row]), _LN_RATIOS[row]

    def minimum(
        self, scale: float, ratio: float, steps: tuple[float, ...]
    ) -> tuple[float, float, float]:
        """Return scale and ratio at the minimum nearby, and the curvature in scale."""
        curvature = 0.0
        for step in steps:
            around = step * np.array([-1.0, 0.0, 1.0])
            ratio = vertex(ratio + around, self(np.full(3, scale), ratio + around))
            y = self(scale + around, np.full(3, ratio))
            curvature = float(y[0] + y[2] - 2 * y[1]) / step**2
            scale = vertex(scale + around, y)
        return scale, ratio, curvature


def _factors(scale: float, ratio: float) -> tuple[float, float]:
    return math.exp(scale + ratio / 2), math.exp(scale - ratio / 2)
