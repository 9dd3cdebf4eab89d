"""Less certain states, where a lag, a time stamp or a reset turns out to be wrong."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["inflate_for_lag", "inflate_for_resets", "inflate_for_stamps"]

# Rows of the sensor that are changed together: their records fit into the cache.
_BAND = 32


def inflate_for_lag(
    states: NDArray[Any], sigmas: NDArray[np.float64], errors: NDArray[np.float64],
) -> None:
    """Inflate the thresholds' covariance by the error that a wrong lag caused.

    A lag wrong by dt shifts a sample by dt times the slope of log intensity.  Between
    two samples T apart the light changes by about slope * T, so thresholds fitted to
    both have a relative error of up to 2 dt / T.  The new error is ``kept`` times the
    old one plus an independent part of the prior's distribution with that variance, at
    most the prior's: the covariance stays positive definite.

    Parameters
    ----------
    states : ndarray of STATE_DTYPE, shape (H, W)
        Changed in place.
    sigmas : ndarray of float64, shape (2,) or (2, H, W)
        Prior standard deviations of theta_on and of theta_off, ln units.
    errors : ndarray of float64, shape (H, W)
        The relative error of the thresholds, 2 dt / T.
    """
    wide = [np.broadcast_to(sigma, states.shape) for sigma in sigmas]
    for first in range(0, len(states), _BAND):
        rows = slice(first, first + _BAND)
        some, relative = states[rows], errors[rows]
        for name, sigma in zip(("on", "off"), (each[rows] for each in wide),
                               strict=True):
            prior = some[f"prior_{name}"].copy()
            share = np.divide(relative * prior, sigma, where=sigma > 0,
                              out=np.zeros_like(prior))
            part = np.minimum(share**2, 1)
            kept = np.sqrt(1 - part)
            some[f"theta_{name}"] = prior + kept * (some[f"theta_{name}"] - prior)
            some[f"var_{name}"] = (1 - part) * some[f"var_{name}"] + part * sigma**2
            some[f"cov_base_{name}"] *= kept
            some["cov_on_off"] *= kept


def inflate_for_stamps(states: NDArray[Any], error: float) -> None:
    """Inflate the variance of the bases for frames whose stamps were wrong.

    Their error is the time error times the slope of log intensity, which is taken from
    the mean number of events between frames so far.

    Parameters
    ----------
    states : ndarray of STATE_DTYPE
        Changed in place.
    error : float
        Error of the stamps, in intervals between frames.
    """
    states["var_base"] += (error * _events(states) * _theta(states))**2


def inflate_for_resets(states: NDArray[Any], lost: float) -> None:
    """Inflate the variance of the bases for a wrong refractory period.

    After each event the light changes unseen for that time.  The sum of these losses is
    largest if all of them have one sign, which is assumed.

    Parameters
    ----------
    states : ndarray of STATE_DTYPE
        Changed in place.
    lost : float
        Error of the refractory period, in intervals between frames.
    """
    states["var_base"] += (lost * _events(states)**2 * _theta(states))**2


def _events(states: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean number of events between two frames so far."""
    counts: NDArray[np.float64] = (states["seen_on"] + states["seen_off"]) / np.maximum(
        states["samples"], 1)
    return counts


def _theta(states: NDArray[Any]) -> NDArray[np.float64]:
    theta: NDArray[np.float64] = 0.5 * (states["theta_on"] + states["theta_off"])
    return theta
