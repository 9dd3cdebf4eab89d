"""Align the clock of a test frame with that of a recording."""
from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import floats
from pdavis_cv.analysis.cycles import inflation
from pdavis_cv.analysis.load import LoadTrace
from pdavis_cv.errors import AnalysisWarning

FloatArray = NDArray[np.float64]

_MOST_SKEW = 2e-3  # relative; real clocks differ by less
_TOLERANCE_S = 2e-3     # largest distance of a matched pulse from the line


@dataclass(frozen=True)
class Clock:
    """A clock: ``t_us = origin_us + 1e6 (offset_s + (1 + skew_ppm / 1e6) t_s)``.

    Parameters
    ----------
    origin_us : int
        Time of the recording relative to which offsets are given.
    offset_s, offset_se_s : float
        The recording's time at the other clock's zero, and its standard error in the
        middle of the compared interval; NaN if unknown.
    skew_ppm, skew_se_ppm : float
        By how much the other clock is slower, parts per million, and standard error.
    how : str
        ``"offset"``, ``"trigger"`` or ``"correlation"``.
    correlation : float
        Correlation of both signals after alignment; NaN if it was not computed.
    """

    origin_us: int
    offset_s: float
    offset_se_s: float = np.nan
    skew_ppm: float = 0.0
    skew_se_ppm: float = np.nan
    how: str = "offset"
    correlation: float = np.nan

    def counted_from(self, origin_us: int) -> Clock:
        """Return the same clock with its offset relative to another time."""
        moved = (self.origin_us - int(origin_us)) / 1e6
        return replace(self, origin_us=int(origin_us), offset_s=self.offset_s + moved)

    def to_us(self, t_s: ArrayLike) -> FloatArray:
        """Convert times of the other clock to the recording's time, us."""
        t = np.asarray(t_s, np.float64)
        return np.asarray(
            self.origin_us + 1e6 * (self.offset_s + (1 + self.skew_ppm * 1e-6) * t))

    def to_seconds(self, t_us: ArrayLike) -> FloatArray:
        """Convert times of the recording to the other clock's time, s."""
        t = (np.asarray(t_us, np.int64) - self.origin_us) / 1e6
        return np.asarray((t - self.offset_s) / (1 + self.skew_ppm * 1e-6))


def align_by_triggers(
    trigger_us: ArrayLike, trigger_s: ArrayLike, *, resolution_s: float = 0.0,
) -> Clock:
    """Align by pulses that both clocks recorded.

    One pulse on each side determines the offset.  With more pulses, the two sequences
    are matched by their intervals, and a straight line through them also gives the
    skew.  Pulses may be missing at the ends of either sequence, at most half of the
    shorter one.  The widest match is taken.

    Parameters
    ----------
    trigger_us : array_like of int, shape (N,)
        Increasing times of pulses in the recording.
    trigger_s : array_like of float, shape (M,)
        Increasing times on the other clock.
    resolution_s : float
        Interval at which the other side samples its trigger: each of its pulses lies
        anywhere in one, all of them perhaps at the same place.

    Returns
    -------
    Clock

    Raises
    ------
    ValueError
        If a side has no pulse, or no match lies within the tolerance.

    Warns
    -----
    AnalysisWarning
        If pulses are missing and another match lies within the tolerance too, as with
        evenly spaced pulses; the standard error then covers it.
    """
    ours, theirs = floats("trigger_us", trigger_us, np.int64), floats(
        "trigger_s", trigger_s)
    for name, pulses in (("trigger_us", ours), ("trigger_s", theirs)):
        if pulses.ndim != 1 or not len(pulses):
            raise ValueError(f"{name} must hold at least one pulse, got none")
        if np.any(np.diff(pulses) <= 0):
            raise ValueError(f"{name} must increase")
    origin = int(ours[0])
    seconds = (ours - origin) / 1e6
    if len(ours) == 1 and len(theirs) == 1:
        return Clock(origin, -float(theirs[0]), _TOLERANCE_S, how="trigger")
    fewer = min(len(ours), len(theirs))
    needed = max(2, min(3, fewer), -(-fewer // 2))
    matches: list[tuple[int, float, FloatArray, FloatArray]] = []
    for shift in range(1 - len(theirs), len(ours)):
        a = seconds[max(shift, 0):shift + len(theirs)]
        b = theirs[max(-shift, 0):max(-shift, 0) + len(a)]
        if len(a) < needed:
            continue
        # A skew near 1 % means that the shift is wrong.
        line = np.polynomial.Polynomial.fit(b, a, 1).convert().coef
        worst = float(np.max(np.abs(a - line[0] - line[1] * b)))
        if abs(line[1] - 1) > 0.01 or worst > _TOLERANCE_S:
            continue
        matches.append((-len(a), worst, a, b))
    if not matches:
        raise ValueError(
            f"trigger_s must match trigger_us within {_TOLERANCE_S:g} s, but the "
            f"intervals of {len(theirs)} and {len(ours)} pulses do not")
    matches.sort(key=lambda match: match[:2])
    _, _, a, b = matches[0]
    slope, offset, slope_se, offset_se = _line(b, a)
    if len(matches) > 1 and not len(a) == len(ours) == len(theirs):
        _, _, c, d = matches[1]
        other = float(c.mean() - d.mean() * slope)
        warnings.warn(
            f"the pulses also match with an offset of {other:.3f} s in place of "
            f"{offset:.3f} s, as some are missing: space them unevenly",
            AnalysisWarning, stacklevel=3)
        offset_se = float(np.hypot(np.nan_to_num(offset_se), other - offset))
    offset_se = float(np.hypot(offset_se, resolution_s / np.sqrt(12)))
    return Clock(
        origin, offset, offset_se, (slope - 1) * 1e6, slope_se * 1e6, "trigger")


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float, float, float]:
    """Return slope, intercept, and the errors of the slope and at the mean of x."""
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    intercept = float(y.mean() - slope * x.mean())
    rest = y - intercept - slope * x
    variance = float(rest @ rest) / (len(x) - 2) if len(x) > 2 else np.nan
    return (slope, intercept, float(np.sqrt(variance / spread)),
            float(np.sqrt(variance / len(x))))


def align_by_correlation(
    t_us: ArrayLike, values: ArrayLike, load: LoadTrace, *, sign: int = 0,
    expected_s: float | None = None, within_s: float | None = None,
) -> Clock:
    """Align a trace with a load by their correlation; find offset and skew.

    The maximum of the cross-correlation, normalised over each overlap, gives the
    offset.  Least squares for the offset, the skew and a linear relation of the signals
    refines it.  The trace is assumed to follow the load without delay.

    Parameters
    ----------
    t_us : array_like of int, shape (N,)
        Increasing times of the trace.
    values : array_like, shape (N,)
        The trace, e.g. DoLP; NaN are left out.
    load : LoadTrace
        Force, or displacement without force.
    sign : {0, 1, -1}
        1 if the trace increases with the load, -1 if it decreases, 0 if unknown.
    expected_s, within_s : float, optional
        Expected offset from the first time of the trace, and largest deviation.  Of
        equal solutions the nearest is taken; without them, that of the widest overlap.

    Returns
    -------
    Clock
        ``origin_us`` is the first time of the trace.  If another offset fits nearly as
        well, ``offset_se_s`` covers the nearest one.

    Raises
    ------
    ValueError
        If the signals overlap in fewer than 16 samples at every allowed offset, are
        constant, or fit only with a skew of 2000 ppm or more.

    Warns
    -----
    AnalysisWarning
        If another offset fits nearly as well, e.g. for a load of equal cycles.
    """
    if sign not in (0, 1, -1):
        raise ValueError(f"sign must be 0, 1 or -1, got {sign!r}")
    times, v = floats("t_us", t_us, np.int64), floats("values", values)
    usable = np.isfinite(v)
    if times.shape != v.shape or np.count_nonzero(usable) < 16:
        raise ValueError("values must hold 16 finite samples, one per time")
    origin = int(times[0])
    t, v = ((times - origin) / 1e6)[usable], v[usable]
    if np.ptp(v) == 0 or np.ptp(load.primary) == 0:
        raise ValueError("values and load must vary, got a constant signal")
    lags, score = _correlations(t, v, load)
    if expected_s is not None and within_s is not None:
        score = np.where(np.abs(lags - expected_s) <= within_s, score, np.nan)
    score = score if sign == 1 else -score if sign == -1 else np.abs(score)
    if np.all(np.isnan(score)):
        raise ValueError("the trace and the load must overlap in 16 samples, got fewer")
    peaks = _peaks(score)

    def common(offset: float) -> int:
        return int(np.count_nonzero(~load.inside_gap(t - offset)))

    # Equal cycles all have similar scores: try those with the widest overlaps too.
    alike = [i for i in peaks if score[i] > score[peaks[0]] - 0.05]
    alike.sort(key=lambda i: -common(float(lags[i])))
    fits = [fit for i in dict.fromkeys((*peaks[:8], *alike[:4]))
            if (fit := _refine(t, v, load, float(lags[i]), sign)) is not None]
    if expected_s is not None and within_s is not None:
        # A fit that starts at the edge of the range may leave it.
        fits = [fit for fit in fits
                if abs(fit.offset_s - expected_s) <= within_s] or fits
    if not fits:
        raise ValueError("the trace and the load must overlap in 16 samples, got fewer")
    # Candidates are compared by their residuals, not by the coarse score; if these
    # differ only by chance, the expected one or that of the widest overlap is chosen.
    fits.sort(key=lambda fit: -abs(fit.correlation))
    least = 1 - fits[0].correlation ** 2
    chance = max(0.15, 4 * np.sqrt(2 / max(common(fits[0].offset_s), 1)))
    equal = [fit for fit in fits if 1 - fit.correlation ** 2 <= (1 + chance) * least]
    best = (max(equal, key=lambda fit: common(fit.offset_s)) if expected_s is None else
            min(equal, key=lambda fit: abs(fit.offset_s - expected_s)))
    if abs(best.skew_ppm) > 0.95e6 * _MOST_SKEW:
        raise ValueError(
            "no offset explains the trace by the load: is the time of one of them in "
            "another unit, or the trace sampled in step with the load? (the clocks "
            f"would differ by {best.skew_ppm:.0f} ppm)")
    rivals = [fit for fit in equal
              if abs(fit.offset_s - best.offset_s) > 2 * np.median(np.diff(t))]
    error = best.offset_se_s
    if rivals:
        rival = min(rivals, key=lambda fit: abs(fit.offset_s - best.offset_s))
        warnings.warn(
            f"an offset of {rival.offset_s:.3f} s fits nearly as well as "
            f"{best.offset_s:.3f} s: give a trigger, or the offset to expect",
            AnalysisWarning, stacklevel=3)
        error = float(np.hypot(error, rival.offset_s - best.offset_s))
    return Clock(origin, best.offset_s, error, best.skew_ppm,
                 best.skew_se_ppm, "correlation", best.correlation)


def _correlations(
    t: FloatArray, v: FloatArray, load: LoadTrace
) -> tuple[FloatArray, FloatArray]:
    """Return the correlation normalised over each overlap, without gaps."""
    step = float(np.median(np.diff(t)))
    ours = np.arange(0, t[-1], step)
    a = np.interp(ours, t, v)
    theirs = np.arange(load.t_s[0], load.t_s[-1], step)
    b = np.interp(theirs, load.t_s, load.primary)
    known = (~load.inside_gap(theirs)).astype(np.float64)
    mean = np.average(b, weights=known)
    a, b = a - a.mean(), (b - mean) * known
    # Sums of samples, values, squares and products over the overlap at each lag; what
    # scipy.signal has for it takes half a second to load.
    x, y = (np.fft.rfft(np.stack(each), len(a) + len(b) - 1) for each in (
        (np.ones_like(a), a, a * a), (known[::-1], b[::-1], b[::-1] ** 2)))
    (n, sb, sbb), (sa, sab, _), (saa, _, _) = np.fft.irfft(
        x[:, None] * y, len(a) + len(b) - 1)
    n = np.maximum(np.rint(n), 1)
    va, vb = saa - sa * sa / n, sbb - sb * sb / n
    enough = n >= max(16, 0.25 * min(len(a), float(known.sum())))
    floor_a, floor_b = 1e-3 * np.var(a) * n, 1e-3 * np.var(b) * n
    score = np.full(n.shape, np.nan)
    ok = enough & (va > floor_a) & (vb > floor_b)
    score[ok] = (sab - sa * sb / n)[ok] / np.sqrt(va[ok] * vb[ok])
    lags = (np.arange(len(n)) - (len(b) - 1)) * step - load.t_s[0]
    return lags, score


def _peaks(score: FloatArray) -> list[int]:
    filled = np.where(np.isnan(score), -np.inf, score)
    left = np.concatenate(([-np.inf], filled[:-1]))
    right = np.concatenate((filled[1:], [-np.inf]))
    top = np.flatnonzero((filled >= left) & (filled > right))
    return [int(i) for i in top[np.argsort(-filled[top])]]


def _refine(
    t: FloatArray, v: FloatArray, load: LoadTrace, offset: float, sign: int
) -> Clock | None:
    """Fit v = a + g tau + b load((t - offset - shift) - tau skew) near an offset."""
    from scipy.optimize import least_squares
    step = float(np.median(np.diff(t)))
    signal = _smooth(load, step)
    slope = signal.derivative()
    inside = ~load.inside_gap(t - offset - 2 * step) & ~load.inside_gap(
        t - offset + 2 * step)
    if np.count_nonzero(inside) < 16:
        return None
    tau, v = t[inside] - t[inside].mean(), v[inside]
    theirs = t[inside] - offset
    one = np.ones_like(tau)
    line = np.stack((one, tau), axis=1)
    start = np.linalg.lstsq(np.column_stack((line, signal(theirs))), v, rcond=None)[0]

    def residual(p: FloatArray) -> FloatArray:
        return np.asarray(p[2] + p[3] * tau + p[4] * signal(theirs - p[0] - p[1] * tau)
                          - v)

    def jacobian(p: FloatArray) -> FloatArray:
        at = theirs - p[0] - p[1] * tau
        down = -p[4] * slope(at)
        return np.stack((down, down * tau, one, tau, signal(at)), axis=1)

    free = np.inf
    found = least_squares(
        residual, np.array([0.0, 0.0, *start]), jacobian,
        x_scale=[step, 1e-4, 1.0, 1.0, 1.0],
        bounds=([-2 * step, -_MOST_SKEW, -free, -free, -free],
                [2 * step, _MOST_SKEW, free, free, free]))
    shift, skew, _, _, gain = (float(value) for value in found.x)
    if sign and np.sign(gain) != sign:
        return None
    rest = np.asarray(found.fun, np.float64)
    total = v - line @ np.linalg.lstsq(line, v, rcond=None)[0]
    energy = float(rest @ rest)
    explained = 1 - energy / max(float(total @ total), 1e-300)
    variance = energy / max(1, len(v) - 5) * float(inflation(rest))
    matrix = jacobian(found.x)
    size = np.sqrt((matrix ** 2).sum(axis=0))
    # If samples are locked to the load's phase, the offset is undetermined.  A
    # pseudo-inverse would assign it no error, so eigenvalues are checked instead.
    low, turn = np.linalg.eigh((matrix / size).T @ (matrix / size))
    inverse = (turn / np.maximum(low, 1e-12)) @ turn.T
    covariance = inverse * variance / np.outer(size, size)
    # The recording's time at the other clock's zero; tau is 0 at the mean time.
    rate = 1 / (1 - skew)
    zero = (offset + shift - float(t[inside].mean()) * skew) * rate
    return Clock(
        0, zero, float(np.sqrt(covariance[0, 0])), (rate - 1) * 1e6,
        float(np.sqrt(covariance[1, 1])) * 1e6, "correlation",
        float(np.sign(gain) * np.sqrt(max(explained, 0.0))))


def _smooth(load: LoadTrace, step: float) -> Any:
    """Interpolate the load, smoothed over a sample of the trace, but 5 ms at most.

    Noise of a load with a higher sampling rate would otherwise dominate the derivative.
    The kernel is symmetric, so that it causes no delay, and short, so that it keeps a
    load that aliases.
    """
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d
    fine = min(step / 2, max(float(np.median(np.diff(load.t_s))), step / 16))
    grid = np.arange(load.t_s[0], load.t_s[-1] + fine / 2, fine)
    values = np.interp(grid, load.t_s, load.primary)
    width = min(step, max(5e-3, 2 * fine))
    return CubicSpline(grid, gaussian_filter1d(values, width / fine, mode="nearest"))
