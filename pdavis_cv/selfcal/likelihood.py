"""-ln L of candidate cameras, and where a parabola through it is least."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["negative_log_likelihood", "vertex"]

_LEAST_SCALE = 1e-9
"""Of the mean chi squared, so that its log exists; numerical."""


def negative_log_likelihood(found: NDArray[np.void]) -> NDArray[np.float64]:
    """Return -ln L of innovations, shape (C,), up to a constant.

    L is maximised over a common factor of all variances: at high speed they are stated
    tens of times too large, and sum ln v would decide instead of the fit.
    """
    n = found["count"]
    scale = np.log(np.maximum(found["chi2"] / np.maximum(n, 1), _LEAST_SCALE))
    return 0.5 * np.asarray(n * scale + found["log_variance"])


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
