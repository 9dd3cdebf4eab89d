"""Another prior of the thresholds, put in place of the one they were learned with."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Records

__all__ = ["change_spread"]

# Rows of the sensor that are changed together: their records fit into the cache.
_BAND = 32


def change_spread(
    states: Records, before: NDArray[np.float64], after: NDArray[np.float64]
) -> None:
    """Replace the prior sigmas that the thresholds were learned with.

    A narrower prior of the same mean is a measurement of the thresholds: it adds the
    information ``1 / after**2 - 1 / before**2``.  A wider one takes that away.  What
    frames have told is kept.  Where more would be taken away than is left, as drift has
    made the thresholds less certain, they begin again from the prior.

    Parameters
    ----------
    states : ndarray of STATE_DTYPE
        Changed in place.
    before, after : ndarray of float64, shape (2,) or (2, H, W)
        Prior standard deviations of theta_on and of theta_off, ln units.
    """
    sigmas = [np.broadcast_to(each, states.shape) for each in (*before, *after)]
    for first in range(0, len(states), _BAND):
        rows = slice(first, first + _BAND)
        old_on, old_off, on, off = (each[rows] for each in sigmas)
        _change_one(states[rows], ("on", "off"), old_on, on)
        _change_one(states[rows], ("off", "on"), old_off, off)


def _change_one(
    states: Records, names: tuple[str, str], before: NDArray[Any],
    after: NDArray[Any],
) -> None:
    """Replace the prior sigma of the first of two thresholds."""
    name, other = names
    var, square = states[f"var_{name}"].copy(), after**2
    with np.errstate(divide="ignore", invalid="ignore"):
        information = 1 / square - 1 / before**2
        growth = 1 + information * var
        gain = information / growth
        kept = np.isfinite(gain) & ((information >= 0) | (
            (growth > 0) & (var <= growth * square)))
    gain[~kept] = 0
    error = states[f"prior_{name}"] - states[f"theta_{name}"]
    cov_base = states[f"cov_base_{name}"].copy()
    cov_other = states["cov_on_off"].copy()
    states["base"] += gain * cov_base * error
    states[f"theta_{name}"] += gain * var * error
    states[f"theta_{other}"] += gain * cov_other * error
    states["var_base"] -= gain * cov_base**2
    states[f"var_{name}"] -= gain * var**2
    states[f"var_{other}"] -= gain * cov_other**2
    states[f"cov_base_{name}"] -= gain * cov_base * var
    states[f"cov_base_{other}"] -= gain * cov_base * cov_other
    states["cov_on_off"] -= gain * cov_other * var
    again = ~kept
    states[f"theta_{name}"][again] = states[f"prior_{name}"][again]
    states[f"var_{name}"][again] = square[again]
    states[f"cov_base_{name}"][again] = 0
    states["cov_on_off"][again] = 0
