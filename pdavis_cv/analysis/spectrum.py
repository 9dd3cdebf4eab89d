"""The strongest periodic component of a trace."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import real_number, whole_number
from pdavis_cv.analysis.cycles import inflation
from pdavis_cv.analysis.periodogram import highest_peak
from pdavis_cv.events import FAR

__all__ = [
    "Tone",
    "checked_hz",
    "checked_trace",
    "dominant_tone",
]

FloatArray = NDArray[np.float64]

# Part of a column beyond the span of others that is no more than rounding.
_DEPENDENT = 1e-10

MOST_HZ = 500_000.0
"""Largest frequency: half the rate of a clock of microseconds."""
MOST_HARMONICS = 20
"""A choice: the fit solves for two unknowns of each, and on a busy machine the threads
of LAPACK wait for each other the longer, the more there are."""
_LEAST_CYCLES = 0.05
"""Least cycles of a tone over the record.  A choice: the cosine of fewer cannot be told
from the offset and drift that are fitted with it."""
MOST_OVERSAMPLING = 50
"""Cycles per sample; a choice: the cost grows with it.  Frequencies beyond the sampling
rate are looked for in unevenly sampled traces only."""
_MOST_VALUE = 1e100
"""Bound on the values of a trace: the sums of their squares are finite."""



@dataclass(frozen=True, eq=False)
class Tone:
    """A periodic signal, ``offset + sum_k amplitude[k] cos(2 pi k f (t - t0) + ...)``.

    Errors are standard errors; they allow for correlation from sample to sample.

    Parameters
    ----------
    hz, hz_se : float
        Fundamental frequency.
    offset : float
        Mean value in the middle of the record.
    slope_per_s : float
        Linear drift of the mean.
    amplitude, amplitude_se : ndarray of float64, shape (K,)
        Those of the fundamental and its harmonics.
    phase, phase_se : ndarray of float64, shape (K,)
        Radians, -pi..pi, of the cosine at ``reference_us``.
    reference_us : int
        Time of phase 0, t0.
    false_alarm : float
        Probability that noise alone has such a peak at any frequency.
    residual_sd : float
        Standard deviation of the residuals.
    """

    hz: float
    hz_se: float
    offset: float
    slope_per_s: float
    amplitude: FloatArray
    amplitude_se: FloatArray
    phase: FloatArray
    phase_se: FloatArray
    reference_us: int
    false_alarm: float
    residual_sd: float

    @property
    def distortion(self) -> float:
        """Root sum square of the harmonics divided by the fundamental (THD)."""
        harmonics = float(np.sqrt(np.sum(self.amplitude[1:] ** 2)))
        return harmonics / float(self.amplitude[0]) if self.amplitude[0] > 0 else np.nan


def dominant_tone(
    t_us: ArrayLike, values: ArrayLike, *, lowest_hz: float | None = None,
    highest_hz: float | None = None, harmonics: int = 4,
) -> Tone:
    """Find the strongest periodic component of a trace.

    The peak is found in a least-squares periodogram (Lomb-Scargle), which needs no
    equal spacing; a fit of frequency, harmonics and drift refines it.

    Parameters
    ----------
    t_us : array_like of int, shape (N,)
        Increasing times in microseconds.
    values : array_like, shape (N,)
        The trace; NaN are left out.
    lowest_hz : float, optional
        Default: two cycles in the record.
    highest_hz : float, optional
        Default: half the median sampling rate.
    harmonics : int
        Fundamental and harmonics to fit, 1 to 20; those above half the sampling rate
        are left out.

    Returns
    -------
    Tone

    Raises
    ------
    ValueError
        If fewer than 8 samples are left, a value lies beyond 1e100, the trace is
        constant, or the range of frequencies is empty.
    """
    t, v, reference = _clean(t_us, values)
    span, rate = float(t[-1] - t[0]), 1 / float(np.median(np.diff(t)))
    low = 2 / span if lowest_hz is None else float(lowest_hz)
    high = rate / 2 if highest_hz is None else float(highest_hz)
    if not 0 < low < high:
        raise ValueError(
            "lowest_hz must lie between 0 and highest_hz, got "
            f"{low:g} and {high:g} for a record of {span:g} s at {rate:g} Hz")
    harmonics = whole_number("harmonics", harmonics, 1, MOST_HARMONICS)
    if (high - low) * span > MOST_OVERSAMPLING * len(t):
        raise ValueError(
            "highest_hz - lowest_hz must be at most "
            f"{MOST_OVERSAMPLING * len(t) / span:g} Hz for {len(t)} samples in "
            f"{span:g} s, got {high - low:g}")
    detrended = v - np.polynomial.Polynomial.fit(t, v, 1)(t)
    variance = float(np.var(detrended))
    if variance <= 1e-24 * max(float(np.max(np.abs(v))), 1e-300) ** 2:
        raise ValueError("values must vary, got a constant trace")
    best, power = highest_peak(t, detrended, low, high)
    independent = max(1.0, (high - low) * span)
    z = power / variance * (len(t) - 3) / len(t)
    # exp(-z) is 1 at z = 0, where the logarithm would be infinite.
    false_alarm = float(-np.expm1(independent * np.log1p(-np.exp(-max(z, 1e-9)))))
    return _refine(t, v, reference, best, rate, harmonics, false_alarm)


def checked_trace(t_us: ArrayLike, **values: ArrayLike) -> tuple[NDArray[Any], ...]:
    """Return the times of a trace as int64 and its values as float64, same shapes.

    Raises
    ------
    ValueError
        If a time is too far from 0, or a signal is not one value per time.
    """
    times = np.asarray(t_us)
    if times.ndim != 1 or times.dtype.kind not in "iuf":
        raise ValueError(
            f"t_us must be (N,) integers, got {times.dtype} of shape {times.shape}")
    if not np.all(np.abs(times.astype(np.float64)) <= FAR):
        raise ValueError("t_us must lie within 2**61 us of 0")
    signals = []
    for name, value in values.items():
        signal = np.asarray(value)
        if signal.shape != times.shape or signal.dtype.kind not in "biuf":
            raise ValueError(
                f"{name} must be one per time, got {signal.dtype} of shape "
                f"{signal.shape} at {times.shape} times")
        signals.append(signal.astype(np.float64))
    return times.astype(np.int64), *signals


def checked_hz(hz: float) -> float:
    """Return a frequency, if a clock of microseconds can resolve it.

    Raises
    ------
    ValueError
    """
    # Compared in float16, infinity is at most `MOST_HZ`, which is infinite there.
    number = real_number(hz)
    if not 0 < number <= MOST_HZ:
        raise ValueError(f"hz must be positive and at most {MOST_HZ:g}, got {hz!r}")
    return number


def _clean(t_us: ArrayLike, values: ArrayLike) -> tuple[FloatArray, FloatArray, int]:
    t, v = checked_trace(t_us, values=values)
    if np.any(np.diff(t) <= 0):
        raise ValueError("t_us must increase")
    usable = np.isfinite(v)
    if np.count_nonzero(usable) < 8:
        raise ValueError(
            f"values must hold 8 finite samples, got {np.count_nonzero(usable)}")
    if not np.all(np.abs(v[usable]) <= _MOST_VALUE):
        raise ValueError(
            f"values must lie within {_MOST_VALUE:g} of 0, got "
            f"{np.max(np.abs(v[usable])):g}")
    reference = int(t[0])
    return (t[usable] - reference) / 1e6, v[usable], reference


def _basis(t: FloatArray, hz: float, harmonics: int) -> FloatArray:
    middle = (t[0] + t[-1]) / 2
    columns = [np.ones_like(t), t - middle]
    for k in range(1, harmonics + 1):
        u = 2 * np.pi * k * hz * t
        columns += [np.cos(u), np.sin(u)]
    return np.stack(columns, axis=1)


def _residual(basis: FloatArray, v: FloatArray) -> float:
    """Return the sum of squares that a fit of the columns leaves, by Gram-Schmidt.

    The search for a frequency calls it some 15 times.  `numpy.linalg.lstsq` shares
    even arrays this small among threads, which wait for each other: on a busy machine
    a fit of 63 harmonics took 10 s in place of .03.  `numpy.einsum` has no threads.
    """
    rest, found = v.copy(), np.empty(basis.shape[::-1])
    rank = 0
    for column in basis.T:
        before, left = found[:rank], column.copy()
        for _ in range(2):      # the second time takes what rounding left
            left -= np.einsum("kn,k->n", before, np.einsum("kn,n->k", before, left))
        size = float(np.sqrt(np.einsum("n,n", left, left)))
        if size <= _DEPENDENT * float(np.sqrt(np.einsum("n,n", column, column))):
            continue
        found[rank] = left / size
        rest -= np.einsum("n,n", found[rank], rest) * found[rank]
        rank += 1
    return float(np.einsum("n,n", rest, rest))


def _refine(
    t: FloatArray, v: FloatArray, reference: int, hz: float, rate: float,
    harmonics: int, false_alarm: float,
) -> Tone:
    from scipy.optimize import minimize_scalar
    # At half the sampling rate a cosine and a sine are no longer independent.
    count = max(1, int(min(harmonics, 0.49 * rate / hz, (len(t) - 4) // 2)))
    half = 0.5 / float(t[-1] - t[0])

    def cost(f: float) -> float:
        return _residual(_basis(t, f, count), v)

    hz = float(minimize_scalar(
        cost, bounds=(max(hz - half, _LEAST_CYCLES * 2 * half), hz + half),
        method="bounded",
        options={"xatol": half * 1e-7}).x)
    basis = _basis(t, hz, count)
    solution = np.linalg.lstsq(basis, v, rcond=None)[0]
    residual = v - basis @ solution
    a, b = solution[2::2], solution[3::2]
    slope = np.zeros_like(t)
    for k in range(1, count + 1):
        u = 2 * np.pi * k * hz * t
        slope += 2 * np.pi * k * t * (b[k - 1] * np.cos(u) - a[k - 1] * np.sin(u))
    jacobian = np.column_stack((basis, slope))
    freedom = max(1, len(t) - jacobian.shape[1])
    variance = float(residual @ residual) / freedom
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance * inflation(residual)
    size = np.hypot(a, b)
    se_amplitude, se_phase = np.empty(count), np.empty(count)
    for k in range(count):
        block = covariance[2 + 2 * k:4 + 2 * k, 2 + 2 * k:4 + 2 * k]
        along = np.array([a[k], b[k]]) / size[k] if size[k] > 0 else np.array([1.0, 0])
        across = np.array([-along[1], along[0]])
        se_amplitude[k] = np.sqrt(max(along @ block @ along, 0))
        se_phase[k] = (np.sqrt(max(across @ block @ across, 0)) / size[k]
                       if size[k] > 0 else np.inf)
    return Tone(
        hz=hz, hz_se=float(np.sqrt(max(covariance[-1, -1], 0))),
        offset=float(solution[0]), slope_per_s=float(solution[1]), amplitude=size,
        amplitude_se=se_amplitude, phase=np.arctan2(-b, a), phase_se=se_phase,
        reference_us=reference, false_alarm=min(1.0, false_alarm),
        residual_sd=float(np.sqrt(variance)))
