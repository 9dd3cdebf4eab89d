"""Jitter of the events' time stamps, from events alone.

Where light changes steadily, a pixel's events of one sign follow each other in gaps
that change little.  The third difference of four stamps leaves out a constant rate, and
a linear change of the gaps; what remains is jitter (docs/theory/kalman.md).
"""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.selfcal.window import PixelWindow

__all__ = ["Jitter", "fit_jitter"]

_MOST_EVENTS = 200_000
"""Most events used, the latest; 20 ms of work."""

_FOUR = 4
"""Number of stamps in a third difference."""

_PER_JITTER = 0.6745 * math.sqrt(1 + 9 + 9 + 1)
"""Median of |t3 - 3 t2 + 3 t1 - t0|, of independent normal errors of unit sigma."""

_SHUFFLED, _POWER = 1.85, 6
"""Jitter longer than a gap changes the order of events, so that the third difference
grows less: fitted to lab/studies/stamp_jitter.py, within 10 % up to `_TOLD`."""

_TOLD, _TOLD_JITTER = 1.5, 0.65
"""Largest median third difference that tells the jitter, and that jitter, in gaps."""

_OCTAVES, _SHUFFLED_OCTAVES = range(5, 15), range(5, 11)
"""Mean gaps are sorted by powers of two of a microsecond: 32 us to 32 ms.  Up to 2 ms a
large third difference means that stamps have lost their order; in longer gaps light may
have turned."""

_MIN_RUNS, _MIN_SHARE = 100, 0.25
"""Least number of runs of one sign in an octave, and their least share of all runs: it
is 1/8 where signs are random, as those of noise events.  Engineering choice."""

_MEDIAN_ERROR = 1.166
"""Relative standard error of the median of n absolute values of normal numbers, times
sqrt(n).  As runs overlap, a fourth of them counts."""

_SIGMAS = 2.0
"""Standard errors by which a third difference must be below `_TOLD`.  Engineering
choice."""


class Jitter(NamedTuple):
    """Random error of the events' time stamps.

    Parameters
    ----------
    us : float
        Standard deviation.  It includes what the light's changes contribute to third
        differences, and where stamps have lost their order, it may be larger.
    sigma_us : float
        Standard error; equal to `us` if that is only a lower bound.
    """

    us: float
    sigma_us: float


def fit_jitter(window: PixelWindow) -> Jitter | None:
    """Return the jitter of the events' time stamps.

    Each octave of gaps between events gives an estimate; the smallest one is taken, as
    changes of the light only add to third differences.

    Parameters
    ----------
    window : PixelWindow
        The window that holds the events.

    Returns
    -------
    Jitter or None
        None if no pixel has enough events of one sign in a row.
    """
    events = window.events[-_MOST_EVENTS:]
    if len(events) < _FOUR:
        return None
    order = np.argsort(events["x"], kind="stable")
    pixel, p = events["x"][order], events["p"][order]
    t = events["t"][order].astype(np.int64)
    t0, t1, t2, t3 = (t[i:len(t) - (_FOUR - 1) + i] for i in range(_FOUR))
    gap = (t3 - t0) / (_FOUR - 1)
    usable = (pixel[_FOUR - 1:] == pixel[:1 - _FOUR]) & (gap >= 1)
    same = usable.copy()
    for i in range(1, _FOUR):
        same &= p[i:len(p) - (_FOUR - 1) + i] == p[:1 - _FOUR]
    octave = np.zeros(len(gap), np.intp)
    np.log2(gap, out=gap, where=usable)
    octave[usable] = gap[usable]
    everything = np.bincount(octave[usable], minlength=_OCTAVES.stop)
    octave, third = octave[same], np.abs(t3 - 3 * t2 + 3 * t1 - t0)[same]
    mean = np.exp2(gap[same])
    found: list[Jitter] = []
    least = 0.0
    for each in _OCTAVES:
        here = octave == each
        runs = int(here.sum())
        if runs < max(_MIN_RUNS, _MIN_SHARE * everything[each]):
            continue
        typical = float(np.median(mean[here]))
        ratio = float(np.median(third[here])) / typical
        error = _MEDIAN_ERROR / math.sqrt(runs / _FOUR)
        if ratio > _TOLD and each in _SHUFFLED_OCTAVES:
            least = _TOLD_JITTER * typical
        if ratio * (1 + _SIGMAS * error) <= _TOLD:
            us = typical * float(_jitter_of(ratio))
            found.append(Jitter(us, us * error))
    if found:
        return min(found)
    return Jitter(least, least) if least else None


def _jitter_of(ratio: ArrayLike) -> NDArray[np.float64]:
    """Return the jitter at median third differences up to `_TOLD`, both in gaps."""
    ratio = np.asarray(ratio, np.float64)
    jitter: NDArray[np.float64] = ratio / (
        _PER_JITTER * (1 - (ratio / _SHUFFLED)**_POWER))
    return jitter
