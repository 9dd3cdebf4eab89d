"""Less certain states, where a lag, a time stamp or a reset turns out to be wrong."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Records

__all__ = ["inflate_for_lag", "inflate_for_resets", "inflate_for_stamps"]

_DIM_SHARE = 0.12
"""Fraction of a pixel's brightest light at which its lag is evaluated.  The lag goes as
1 / light, and log intensity changes fastest in dim light: weighted by the squared slope
of ln(1 + 0.9 cos), the mean square lag is that at 0.12 of the brightest light."""


def inflate_for_lag(
    states: Records, sigmas: NDArray[np.float64], before: Sequence[float],
    after: Sequence[float], moved_us: float, interval_us: float,
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
    before, after : (float, float, ...)
        Bandwidth so far and from now on: Hz, Hz per intensity.
    moved_us : float
        Added to the time stamps of frames from now on.
    interval_us : float
        The time T between frames.
    """
    wide = np.broadcast_to(
        sigmas[:, None, None] if sigmas.ndim == 1 else sigmas, (2, *states.shape))
    _kernels.kalman_inflate(states, wide, (
        (before[0], before[1]), (after[0], after[1]), _DIM_SHARE, moved_us,
        interval_us))


def inflate_for_stamps(states: Records, error: float) -> None:
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


def inflate_for_resets(states: Records, lost: float) -> None:
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


def _events(states: Records) -> NDArray[np.float64]:
    """Return the mean number of events between two frames so far."""
    counts: NDArray[np.float64] = (states["seen_on"] + states["seen_off"]) / np.maximum(
        states["samples"], 1)
    return counts


def _theta(states: Records) -> NDArray[np.float64]:
    theta: NDArray[np.float64] = 0.5 * (states["theta_on"] + states["theta_off"])
    return theta
