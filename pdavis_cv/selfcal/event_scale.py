"""Common scale of the thresholds, from events alone.

Intensities summed from events satisfy I0 + I90 = I45 + I135 only with the right
thresholds: with thresholds that are all wrong by a factor they are powers of the light,
and no gains of the four pixels make the sum fit (docs/theory/selfcal.md).
"""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.redundancy import (
    STEP_US,
    VALID_QUALITY,
    WINDOW,
    EventRedundancy,
)
from pdavis_cv.selfcal.likelihood import vertex
from pdavis_cv.selfcal.window import CellWindow

__all__ = ["EventScale", "fit_event_scale"]

_GRID = np.linspace(-math.log(3), math.log(3), 9)
"""ln of the scale where the misfit is first evaluated, as for the scale from frames."""

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
when such cameras had become worse (docs/theory/selfcal.md)."""

_LEAST_FALL, _LEAST_GAIN, _SIGMAS = 0.12, 1.8, 4.0
"""Least `fall` and `gain` at which the nominal thresholds are given up, and standard
errors that the fall must have (engineering choice).  Light with structure makes a wrong
scale fit better by .08 at most; passing stripes, if a scale were searched in them, with
a gain of .7.  True scales beyond a third have a fall of .14 and a gain of 2.4 at least
(lab/studies/event_scale.py)."""


class EventScale(NamedTuple):
    """Factor on the nominal thresholds of all pixels, ON and OFF.

    Parameters
    ----------
    ln : float
        Its ln.
    sigma : float
        Standard error of the ln.
    fall : float
        Fall of the mean ln of the misfit against the nominal thresholds.
    gain : float
        `fall` relative to the squared ln of the scale with the least misfit.
    significant : bool
        Whether they suffice to reject the nominal thresholds.
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


def fit_event_scale(
    window: CellWindow, nominal: tuple[ArrayLike, ArrayLike]
) -> EventScale | None:
    """Return the scale with which the four channels agree best.

    The misfit is the quality of `EventRedundancy`: 0 if one set of gains explains all
    data.

    Parameters
    ----------
    window : CellWindow
        The window that holds the events.
    nominal : (on, off)
        Thresholds, scalars or (H, W).

    Returns
    -------
    EventScale or None
        None if there are too few events, or no light that they agree on.
    """
    misfit = _misfit_of(window, nominal)
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


class _Misfit:
    """Mean ln of the misfit of each macropixel, as a function of ln of the scale.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Events of macropixels that lie side by side, in order of time.
    on, off : ndarray of float64, shape (2, 2 n)
        Nominal thresholds.
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
    window: CellWindow, nominal: tuple[ArrayLike, ArrayLike]
) -> _Misfit | None:
    """Return the misfit of the macropixels with the most events, None if too few."""
    events = window.events
    y, x = (2 * part[:, None] + offset for part, offset in zip(
        window.cells, ([0, 0, 1, 1], [0, 1, 0, 1]), strict=True))
    on, off = (np.broadcast_to(np.asarray(theta, np.float64), window.shape)[y, x]
               for theta in nominal)
    fell, rose = (np.bincount(
        events["x"][events["p"] == sign], minlength=y.size).reshape(y.shape)
        for sign in (0, 1))
    balance = np.log(np.maximum(rose, 1) * on / (np.maximum(fell, 1) * off))
    counts = np.where(np.abs(balance) <= _MAX_BALANCE, fell + rose, 0).min(1)
    chosen = np.argsort(-counts, kind="stable")[:_CELLS]
    chosen = chosen[counts[chosen] >= _LEAST_EVENTS]
    if len(chosen) < _LEAST_CELLS:
        return None
    place = np.full(len(counts), -1, np.intp)
    place[chosen] = np.arange(len(chosen))
    mine = place[events["x"] // 4]
    last = np.flatnonzero(mine >= 0)
    t = events["t"][last]
    recent = last[t >= t[-1] - _LEAST_US]
    if len(recent) > _MOST_EVENTS:
        chosen = chosen[:max(_MOST_EVENTS * len(chosen) // len(recent), _LEAST_CELLS)]
        last = recent[mine[recent] < len(chosen)]
    else:
        last = last[-_MOST_EVENTS:]
    # The pixels of macropixel i become columns 2 i and 2 i + 1 of two rows.
    events, mine = events[last], mine[last]
    moved = np.empty(len(events), EVENT_DTYPE)
    moved["t"], moved["p"] = events["t"], events["p"]
    moved["x"], moved["y"] = 2 * mine + events["x"] % 2, events["x"] // 2 % 2
    on, off = (theta[chosen].reshape(-1, 2, 2).transpose(1, 0, 2).reshape(2, -1)
               for theta in (on, off))
    return _Misfit(moved, on, off)
