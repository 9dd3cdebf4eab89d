"""What events alone tell of the pixels: spread of their ratios, scale of thresholds.

For `EventRedundancy`.  A line through a pixel's ON events against all its events tells
its ratio, with an error that the light causes.  Two neighbouring pixels of one channel
see nearly the same light, so their lines differ by their ratios; and what differs
equally in two halves of the data is a property of the chip.  Intensities summed from
events satisfy I0 + I90 = I45 + I135 only with the right thresholds: with thresholds
that are all wrong by a factor they are powers of the light, and no gains of the four
pixels make the sum fit (docs/theory/events.md).
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.pixel.sample import PixelSample, Sampled
from pdavis_cv.reconstruct.redundancy import (
    PART_LEAST,
    RATIO_SIGMA,
    STEP_US,
    VALID_QUALITY,
    WINDOW,
    EventRedundancy,
)

LEAST_SPREAD = 0.03
"""Least spread of ln(theta_on / theta_off): 2.1 % of each threshold, the smallest
mismatch that was published (Lichtsteiner et al. 2008)."""

_MIN_PAIRS, _MIN_EVENTS = 12, 8
"""Least number of pairs of neighbours, and of events of each pixel in each half."""

_MAD_PER_SIGMA, _CLIP_SIGMAS = 0.6745, 3.0
"""Median of the absolute value of a standard normal number; differences beyond so many
robust standard deviations are left out, as they are those of hot pixels."""

_GRID = np.linspace(-math.log(3), math.log(3), 9)
"""ln of the scale where the misfit is first evaluated."""

_STEPS = (0.14, 0.07)
"""Steps (ln) of the parabolas that refine it."""

_CELLS, _COARSE_CELLS, _LEAST_CELLS = 32, 8, 12
"""Most macropixels, those with the most events; those for the grid; the fewest.
Engineering choice: what the estimate costs."""

_LEAST_EVENTS, _MOST_EVENTS = 20, 20_000
"""Fewest events of each pixel, about a swing of the light and back, and most of all of
them, the last ones.  Engineering choice."""

_EVERY_US = round(WINDOW) * STEP_US
"""Interval at which the misfit is read: the memory of the moments."""

_LEAST_US = 4 * _EVERY_US
"""Least time whose events are used, with fewer macropixels if need be."""

_MAX_BALANCE = 0.5
"""Greatest distance of ln(ON / OFF events) from the nominal ratio.  In light that makes
pixels leak, events say little of thresholds.  Engineering choice."""

_BIAS, _MODEL_SIGMA = 0.06, 0.05
"""What the least misfit's scale (ln) is too small by, because noise of the events is
smaller relative to a power of the light below 1, and the rest of its error: mean and
standard deviation over cameras and speeds (lab/studies/event_scale.py)."""

_QUALITY_LEAST = 1e-4
"""Least ratio of eigenvalues, so that its ln is finite; numerical."""

_APART = 3.0
"""Standard errors by which a scale that is applied is larger than the nominal one.  A
smaller one is not applied: a low bandwidth, jitter of stamps, and events that are lost
also make intensities look like a power of the light below 1.  Engineering choice, made
when such cameras had become worse."""

_LEAST_FALL, _LEAST_GAIN, _SIGMAS = 0.12, 1.8, 4.0
"""Least `fall` and `gain` at which the nominal thresholds are given up, and standard
errors that the fall must have (engineering choice).  Light with structure makes a wrong
scale fit better by .08 at most; passing stripes, if a scale were searched in them, with
a gain of .7.  True scales beyond a third have a fall of .14 and a gain of 2.4 at least
(lab/studies/event_scale.py)."""


class RatioSpread(NamedTuple):
    """Spread of ln(theta_on / theta_off) over the pixels, relative to the prior's.

    `sigma` is its standard deviation, `error` the standard error of sigma^2.
    """

    sigma: float
    error: float


class EventScale(NamedTuple):
    """Factor on the nominal thresholds of all pixels, ON and OFF.

    `ln` is its ln, `sigma` the standard error of that; `fall` is the fall of the mean
    ln of the misfit against the nominal thresholds, `gain` that relative to the squared
    ln of the scale with the least misfit; `significant` tells whether they suffice to
    reject the nominal thresholds.
    """

    ln: float
    sigma: float
    fall: float
    gain: float
    significant: bool

    @property
    def factor(self) -> float:
        """The factor itself."""
        return math.exp(self.ln)


def ratio_spread(
    sample: PixelSample, nominal: tuple[ArrayLike, ArrayLike]
) -> RatioSpread | None:
    """Return the spread of the pixels' ratios, None if there are too few events.

    It is counted from the ratio of the nominal thresholds (on, off), scalars or (H, W).
    """
    data = sample.sampled()
    if not len(data.t):
        return None
    pixel, t = _pixel_of(data), data.events["t"]
    rose = data.events["sign"] > 0
    early = t < (int(data.t[0]) + int(data.t[-1])) // 2
    on, off = (np.broadcast_to(np.asarray(theta, np.float64), sample.shape).ravel()[
        sample.pixels] for theta in nominal)
    ratios = [line_ratios(pixel[half], rose[half], on, off) for half in (early, ~early)]
    # Each pixel, and the next of its channel below and to the right.
    first, second = np.concatenate([data.places[:, [0, 5]], data.places[:, [0, 7]]]).T
    first, second = first[second >= 0], second[second >= 0]
    difference = np.array([ratio[second] - ratio[first] for ratio in ratios])
    difference = difference[:, np.isfinite(difference).all(0)]
    if difference.size:
        bound = _CLIP_SIGMAS / _MAD_PER_SIGMA * np.median(np.abs(difference), axis=1)
        difference = difference[:, (np.abs(difference) <= bound[:, None]).all(0)]
    if difference.shape[1] < _MIN_PAIRS:
        return None
    # Each pixel is in up to four pairs, so that half as many are independent.
    pairs = difference.shape[1] / 2
    common = float(difference.prod(0).mean()) / 2
    each = (difference**2).mean(1) / 2
    error = (float(each.prod()) + common**2) / pairs
    # The prior's sigma is known to about a factor of two: one degree of freedom.
    prior = 2 * RATIO_SIGMA**4
    square = (RATIO_SIGMA**2 * error + common * prior) / (prior + error)
    return RatioSpread(
        max(math.sqrt(max(square, 0)), LEAST_SPREAD),
        math.sqrt(prior * error / (prior + error)))


def _pixel_of(data: Sampled) -> NDArray[np.intp]:
    """Return the number of the pixel of each of the sorted events."""
    return np.repeat(np.arange(len(data.start) - 1), np.diff(data.start))


def line_ratios(
    pixel: NDArray[np.intp], rose: NDArray[np.bool_], on: NDArray[np.float64],
    off: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return each pixel's ln(theta_on / theta_off) by its line, less the prior's.

    It is the ratio that ``rebalance`` (_kernels/_redundancy.pyx) has after all events;
    NaN where a pixel has too few, or the light changed in one sense only.  `pixel`,
    sorted, and `rose`, whether it is ON, are those of each event, (N,), of a pixel by
    time; `on` and `off`, (K,), the prior's thresholds.
    """
    polarity = rose.astype(np.float64)
    n = np.bincount(pixel, minlength=len(on)).astype(np.float64)
    start = (np.cumsum(n) - n).astype(np.intp)
    number = np.arange(len(pixel)) - start[pixel] + 1.0
    counts = np.append(0.0, np.cumsum(polarity))
    count = counts[1:] - counts[start[pixel]]

    def total(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        return np.bincount(pixel, values, len(on)).astype(np.float64)

    with np.errstate(invalid="ignore", divide="ignore"):
        middle, mean = (n + 1) / 2, total(count) / n
        var_all = total(number**2) / n - middle**2
        part = (total(number * count) / n - middle * mean) / var_all
        usual = off / (on + off)
        swing = 4 * ((total(count**2) / n - mean**2) / var_all
                     - 2 * usual * part + usual**2)
        ratio = np.log((1 - part) / part) - np.log(on / off)
        # The redundancy limits the part; where events have one sign, it has no line.
        told = (part > PART_LEAST) & (part < 1 - PART_LEAST)
    ratio[~(told & (swing < 1) & (n >= _MIN_EVENTS))] = np.nan
    return ratio


def event_scale(
    sample: PixelSample, nominal: tuple[ArrayLike, ArrayLike]
) -> EventScale | None:
    """Return the scale of the thresholds with which the four channels agree best.

    The misfit is the quality of `EventRedundancy`: 0 if one set of gains explains all
    data.  The nominal thresholds (on, off) are scalars or (H, W).  None if there are
    too few events, or no light that they agree on.
    """
    misfit = _misfit_of(sample, nominal)
    if misfit is None:
        return None
    few = misfit.part(_COARSE_CELLS)
    if few(0.0).mean() > math.log(VALID_QUALITY):
        return None     # noise: with thresholds stated too small it is far less
    scale = vertex(_GRID, np.array([few(x).mean() for x in _GRID]))
    for step in _STEPS:
        x = scale + step * np.array([-1.0, 0.0, 1.0])
        found = np.array([misfit(one) for one in x])
        scale = vertex(x, found.mean(1))
    # Macropixels are independent: each has a minimum of its own.
    each = np.array([vertex(x, one) for one in found.T])
    falls = misfit(0.0) - misfit(scale)
    n = math.sqrt(len(falls))
    fall = float(falls.mean())
    gain = fall / max(scale * scale, _MODEL_SIGMA**2)
    ln, sigma = scale + _BIAS, math.hypot(float(each.std()) / n, _MODEL_SIGMA)
    return EventScale(
        ln, sigma, fall, gain, ln > _APART * sigma and gain > _LEAST_GAIN
        and fall > max(_LEAST_FALL, _SIGMAS * float(falls.std()) / n))


def vertex(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the minimum of the parabola through the least y and its neighbours.

    It is limited to the interval of those neighbours.
    """
    at = min(max(int(np.argmin(y)), 1), len(y) - 2)
    left, right = x[at - 1] - x[at], x[at + 1] - x[at]
    down, up = (y[at - 1] - y[at]) / left, (y[at + 1] - y[at]) / right
    bend = (up - down) / (right - left)
    if not bend > 0:
        return float(x[np.argmin(y)])
    return float(x[at] + min(max(bend * left - down, left * 2 * bend),
                             right * 2 * bend) / (2 * bend))


class _Misfit:
    """Mean ln of the misfit of each macropixel, as a function of ln of the scale.

    The events are of macropixels that lie side by side, in order of time; the nominal
    thresholds are float64 (2, 2 n).
    """

    def __init__(
        self, events: NDArray[np.void], on: NDArray[np.float64],
        off: NDArray[np.float64],
    ) -> None:
        self._on, self._off = on, off
        t = events["t"]
        cuts = np.searchsorted(t, np.arange(t[0], t[-1], _EVERY_US))
        self._parts = np.split(events, cuts[1:])

    def part(self, n: int) -> _Misfit:
        """Return the misfit of the first n macropixels, or of all."""
        events = np.concatenate(self._parts)
        n = min(n, self._on.shape[1] // 2)
        return _Misfit(events[events["x"] < 2 * n], self._on[:, :2 * n],
                       self._off[:, :2 * n])

    def __call__(self, ln: float) -> NDArray[np.float64]:
        """Return the misfit, shape (n,)."""
        factor = math.exp(ln)
        method = EventRedundancy(
            self._on.shape, theta_on=factor * self._on, theta_off=factor * self._off)
        total = np.zeros(self._on.shape[1] // 2)
        for number, part in enumerate(self._parts):
            method.add_events(part)
            if number:      # the gains have been solved for
                total += np.log(np.maximum(method.quality[0, ::2], _QUALITY_LEAST))
        return total / max(len(self._parts) - 1, 1)


def _misfit_of(
    sample: PixelSample, nominal: tuple[ArrayLike, ArrayLike]
) -> _Misfit | None:
    """Return the misfit of the macropixels with the most events, None if too few."""
    data = sample.sampled()
    y, x = np.divmod(sample.pixels, sample.shape[1])
    # By macropixel: the sampled pixels at its four places, row by row.
    cells = data.places[(y % 2 == 0) & (x % 2 == 0), :4]
    cells = cells[(cells >= 0).all(1)]
    pixel, rose = _pixel_of(data), data.events["sign"] > 0
    on, off = (np.broadcast_to(np.asarray(theta, np.float64), sample.shape).ravel()[
        sample.pixels][cells] for theta in nominal)
    down, up = (np.bincount(pixel[part], minlength=len(y))[cells]
                for part in (~rose, rose))
    balance = np.log(np.maximum(up, 1) * on / (np.maximum(down, 1) * off))
    counts = np.where(np.abs(balance) <= _MAX_BALANCE, down + up, 0).min(1)
    chosen = np.argsort(-counts, kind="stable")[:_CELLS]
    chosen = chosen[counts[chosen] >= _LEAST_EVENTS]
    if len(chosen) < _LEAST_CELLS:
        return None
    place = np.full(len(y), -1, np.intp)
    place[cells[chosen]] = np.arange(4 * len(chosen)).reshape(-1, 4)
    mine = np.flatnonzero(place[pixel] >= 0)
    mine = mine[np.argsort(data.events["t"][mine], kind="stable")]
    t = data.events["t"][mine]
    recent = mine[t >= t[-1] - _LEAST_US]
    if len(recent) > _MOST_EVENTS:
        chosen = chosen[:max(_MOST_EVENTS * len(chosen) // len(recent), _LEAST_CELLS)]
        mine = recent[place[pixel[recent]] < 4 * len(chosen)]
    else:
        mine = mine[-_MOST_EVENTS:]
    # The pixels of macropixel i become columns 2 i and 2 i + 1 of two rows.
    at = place[pixel[mine]]
    events = np.empty(len(mine), EVENT_DTYPE)
    events["t"], events["p"] = data.events["t"][mine], rose[mine]
    events["x"], events["y"] = at // 4 * 2 + at % 2, at // 2 % 2
    on, off = (theta[chosen].reshape(-1, 2, 2).transpose(1, 0, 2).reshape(2, -1)
               for theta in (on, off))
    return _Misfit(events, on, off)
