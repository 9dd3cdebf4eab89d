"""-ln L of candidate cameras, and where a parabola through it is least."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["LONG_TAILED", "NORMAL", "negative_log_likelihood", "vertex"]

NORMAL, LONG_TAILED = 2.0, 1.5
"""Powers p of the innovations' density, exp(-|r / s|^p) with r = e / sqrt(v): a normal
distribution, and one with tails between its and those of a double exponential.  Noise
events and turns between frames make a few large innovations that no candidate explains;
with p = 2 they decide, and thresholds come out up to a fifth too small
(studies/selfcal_tails.py)."""

_SUMS = {LONG_TAILED: "deviation", NORMAL: "chi2"}
"""Field of `INNOVATIONS_DTYPE` that has the sum of |r|^p."""

_LEAST_SCALE = 1e-9
"""Of the mean of |r|^p, so that its log exists; numerical."""


def negative_log_likelihood(
    found: NDArray[np.void], power: float = LONG_TAILED
) -> NDArray[np.float64]:
    """Return -ln L of innovations, shape (C,), up to a constant.

    Only those of one power may be compared.  L is maximised over a common factor of all
    deviations: at high speed they are stated several times too large, and sum ln v
    would decide instead of the fit.
    """
    n = found["count"]
    mean = np.maximum(found[_SUMS[power]] / np.maximum(n, 1), _LEAST_SCALE)
    return np.asarray(n / power * np.log(mean) + 0.5 * found["log_variance"])


def vertex(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return where the parabola through the least y and its neighbours is least.

    No farther out than those neighbours.
    """
    at = min(max(int(np.argmin(y)), 1), len(y) - 2)
    left, right = x[at - 1] - x[at], x[at + 1] - x[at]
    down, up = (y[at - 1] - y[at]) / left, (y[at + 1] - y[at]) / right
    bend = (up - down) / (right - left)
    if not bend > 0:
        return float(x[np.argmin(y)])
    return float(x[at] + min(max(bend * left - down, left * 2 * bend),
                             right * 2 * bend) / (2 * bend))
