"""The highest peak of a periodogram, in time and memory that grow as N log N."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["highest_peak"]

FloatArray = NDArray[np.float64]

_PER_CYCLE = 8
"""Frequencies per 1 / span, so that a peak, which is about 1 / span wide, cannot lie
between two of them, and samples of the grid per cycle of the highest frequency: cubic
interpolation then keeps 99 % of the amplitude."""
_CANDIDATES = 32
"""Peaks of the approximate periodogram whose power is computed exactly.  A choice: only
peaks within a few percent of each other can change places."""


def highest_peak(
    t: FloatArray, v: FloatArray, lowest_hz: float, highest_hz: float
) -> tuple[float, float]:
    """Return frequency and power of the highest Lomb-Scargle peak in a band.

    Parameters
    ----------
    t : ndarray of float64, shape (N,)
        Increasing times in seconds, not negative.
    v : ndarray of float64, shape (N,)
        Values without offset and drift.
    lowest_hz, highest_hz : float
        The band, ends included.

    Returns
    -------
    hz : float
    power : float
        As of `scipy.signal.lombscargle`: half the reduction of the sum of squares.

    Notes
    -----
    `scipy.signal.lombscargle` takes time and memory proportional to N times the number
    of frequencies, 21 GB for 10,000 samples.  Here the sums over samples are those of
    a grid on to which each sample is spread ("extirpolation") and which is Fourier
    transformed: Press and Rybicki, Astrophys. J. 338, 277 (1989).  Spreading is an
    approximation, so the highest peaks are then evaluated without it.
    """
    from scipy.fft import next_fast_len, rfft
    from scipy.signal import lombscargle
    step = 1 / (_PER_CYCLE * highest_hz)
    length = next_fast_len(math.ceil(_PER_CYCLE * t[-1] / step), real=True)
    d_hz = 1 / (length * step)
    index = np.arange(math.ceil(lowest_hz / d_hz), math.floor(highest_hz / d_hz) + 1)
    hz = np.array([lowest_hz, highest_hz])
    if index.size:
        of_values = rfft(_spread(t / step, v), length)[index]
        of_ones = rfft(_spread(t / step, np.ones_like(t)), length)[2 * index]
        power = _power(of_values, of_ones, len(t))
        before, after = np.r_[-np.inf, power[:-1]], np.r_[power[1:], -np.inf]
        peaks = np.flatnonzero((power >= before) & (power >= after))
        peaks = peaks[np.argsort(power[peaks])[-_CANDIDATES:]]
        hz = np.r_[hz, index[peaks] * d_hz]
    exact = [float(lombscargle(t, v, 2 * np.pi * np.array([one]))) for one in hz]
    best = int(np.argmax(exact))
    return float(hz[best]), exact[best]


def _spread(x: FloatArray, values: FloatArray) -> FloatArray:
    """Return a grid whose sums with a smooth function are those of samples at x.

    Parameters
    ----------
    x : ndarray of float64, shape (N,)
        Places in steps of the grid, not negative.
    values : ndarray of float64, shape (N,)
    """
    first = np.maximum(np.floor(x).astype(np.intp) - 1, 0)
    u = x - first
    size = int(first[-1]) + 4
    grid = np.zeros(size)
    for k in range(4):      # Lagrange's cubic through the places 0, 1, 2, 3
        weight = values.copy()
        for other in range(4):
            if other != k:
                weight *= (u - other) / (k - other)
        grid += np.bincount(first + k, weight, size)
    return grid


def _power(
    of_values: NDArray[np.complex128], of_ones: NDArray[np.complex128], n: int
) -> FloatArray:
    """Return the power at f from the transforms of values at f and of ones at 2 f."""
    # With the phase that makes cosine and sine orthogonal over these samples.
    turned = of_values * np.exp(-0.5j * np.angle(of_ones))
    spread = np.minimum(np.abs(of_ones), n * (1 - 1e-9))
    power: FloatArray = turned.real**2 / (n + spread) + turned.imag**2 / (n - spread)
    return power
