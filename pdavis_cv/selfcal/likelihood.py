"""Negative log-likelihood of candidate cameras, and its minimum by a parabola."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["BLOCKS", "LONG_TAILED", "NORMAL", "evidence", "negative_log_likelihood",
           "vertex"]

NORMAL, LONG_TAILED = 2.0, 1.5
"""Powers p of the innovations' density, exp(-|r / s|^p) with r = e / sqrt(v): a normal
distribution, and one with tails between its and those of a double exponential.  Noise
events and turns between frames cause a few large innovations that no candidate
explains; with p = 2 they dominate, and thresholds are estimated up to a fifth too small
(lab/studies/selfcal_tails.py)."""

BLOCKS = 20
"""Number of time blocks whose scatter gives the standard error of evidence, to 16 %.
Engineering choice: with 2 s of frames each block has two."""

_SUMS = {LONG_TAILED: "deviation", NORMAL: "chi2"}
"""Field of `INNOVATIONS_DTYPE` that holds the sum of |r|^p, by power."""

_LEAST_SCALE = 1e-9
"""Lower bound of the mean of |r|^p, so that its log exists; numerical."""


def negative_log_likelihood(
    found: NDArray[np.void], power: float = LONG_TAILED
) -> NDArray[np.float64]:
    """Return -ln L of innovations, shape (C,), up to a constant.

    Only values of the same power can be compared.  L is maximised over a common factor
    on all standard deviations: at high speed the stated ones are several times too
    large, and the term sum ln v would dominate instead of the fit.
    """
    n = found["count"]
    mean = np.maximum(found[_SUMS[power]] / np.maximum(n, 1), _LEAST_SCALE)
    return np.asarray(n / power * np.log(mean) + 0.5 * found["log_variance"])


def evidence(
    one: NDArray[np.void], other: NDArray[np.void], power: float = LONG_TAILED,
    least: float = 0.0,
) -> tuple[float, float]:
    """Return the gain of ln L of one camera over another, and its standard error.

    Each ln L is maximised over a common factor on all standard deviations.  The
    standard error of the difference is that of a sum over independent blocks, from
    their scatter (Vuong, Econometrica 57, 307, 1989).

    Parameters
    ----------
    one, other : ndarray of INNOVATIONS_DTYPE, shape (B,)
        Innovations of the same samples, by blocks of time.
    power : float
        Power p of the innovations' density.
    least : float
        Lower bound of the factor to the power p.  With 1, innovations smaller than
        stated are no evidence: errors of de-blurring and interpolation repeat in every
        frame, and a smaller factor would count them as independent.
    """
    rows = []
    for found in (one, other):
        n, sums = found["count"], found[_SUMS[power]] / _unit(power)
        factor = max(sums.sum() / max(n.sum(), 1), least, _LEAST_SCALE)
        rows.append(sums / (power * factor) + n / power * math.log(factor)
                    + 0.5 * found["log_variance"])
    gain = rows[1] - rows[0]
    scatter = float(gain.std(ddof=1)) if len(gain) > 1 else math.inf
    return float(gain.sum()), math.sqrt(len(gain)) * scatter


def _unit(power: float) -> float:
    """Return the mean of |r|^p if r has the density of that power and variance 1."""
    ratio = math.gamma(1 / power) / math.gamma(3 / power)
    return math.pow(ratio, power / 2) / power


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
