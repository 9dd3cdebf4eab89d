"""The strongest frequency of a trace, and of events, which do not alias like frames."""
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import fitting, floats, some
from pdavis_cv.analysis.roi import Roi
from pdavis_cv.recording.base import Recording
from pdavis_cv.sensor import Layout

FloatArray = NDArray[np.float64]

_BIN_US = 2000
"""Events are counted in bins of this length: frequencies up to 250 Hz."""
_MOST_BINS = 10_000
_TILE, _MOST_TILES = 16, 512
"""Least side of the tiles, pixels, in which angles of polarization count as alike, and
how many there may be, as all their bins are held in memory."""
_FINE = 8
"""Frequencies per 1 / span."""
_STANDS_OUT = 15.0
"""Power over its median from which a line is believed.  A choice: the sum over tiles of
the power of white noise reaches twice its median."""
_HARMONICS = 4
"""Fundamental and harmonics that refine a frequency.  A choice."""


def trace_hz(t_us: NDArray[np.int64], values: FloatArray) -> tuple[float, float]:
    """Return the strongest frequency of a trace, and which part of it that explains.

    Parameters
    ----------
    t_us : ndarray of int64, shape (N,)
        Times at regular intervals.
    values : ndarray of float64, shape (N,)
        The trace; NaN are left out.

    Returns
    -------
    hz : float
        With at least two cycles in the trace.
    part : float
        Part of the variance, 0..1.

    Raises
    ------
    ValueError
        If fewer than 8 values are finite, or these are constant.
    """
    values, t_us = floats("values", values), floats("t_us", t_us, np.int64)
    fitting("t_us", t_us, (values.size,))
    known = np.isfinite(values)
    if np.count_nonzero(known) < 8:
        raise ValueError(
            f"values must hold 8 finite samples, got {np.count_nonzero(known)}")
    t = (t_us - t_us[0]) / 1e6
    step = float(np.median(np.diff(t)))
    t, v = t[known], values[known]
    v = v - np.polynomial.Polynomial.fit(t, v, 1)(t)
    energy = float(v @ v)
    if energy <= 1e-24 * len(v) * float(np.max(np.abs(values[known]))) ** 2:
        raise ValueError("values must vary, got a constant trace")
    grid = np.zeros(len(known))
    grid[known] = v
    hz, _ = _peak(_power(grid[None]), step)
    hz = _refined(t, v, hz, 0.5 / (len(grid) * step), 0.49 / step)
    return hz, 1 - _rest(t, v, hz, 0.49 / step) / energy


def event_hz(
    recording: Recording, rois: Sequence[Roi], layout: Layout, start_us: int,
    stop_us: int,
) -> float | None:
    """Return the strongest frequency of S1 and S2 in regions, by signed events.

    Parameters
    ----------
    recording : Recording
    rois : sequence of Roi
        In sensor pixels.
    layout : Layout
        Polarizers, by whose angle events count.
    start_us, stop_us : int
        Interval; of one longer than 20 s the first 20 s.

    Returns
    -------
    float or None
        None if no line stands out.

    Raises
    ------
    ValueError
        If there is no region.
    """
    rois = some("rois", rois)
    if recording.info.event_count == 0:
        return None
    height, width = recording.info.sensor_size
    stop_us = min(stop_us, start_us + _MOST_BINS * _BIN_US)
    bins = (stop_us - start_us) // _BIN_US
    if bins < 16:
        return None
    side = max(_TILE, math.ceil(math.sqrt(height * width / _MOST_TILES)))
    columns = -(-width // side)
    tiles = -(-height // side) * columns
    angle = 2 * np.deg2rad(np.tile(
        layout.angles_deg, (-(-height // 2), -(-width // 2))))
    inside = np.any([roi.mask((height, width)) for roi in rois], axis=0)
    total = np.zeros((2, tiles * bins))
    for packet in recording.packets(start_us, start_us + bins * _BIN_US):
        events = packet.events
        x, y = events["x"], events["y"]
        seen = inside[y, x]
        events, x, y = events[seen], x[seen].astype(np.int64), y[seen].astype(np.int64)
        place = (y // side * columns + x // side) * bins + (
            events["t"] - start_us) // _BIN_US
        sign = 2.0 * events["p"] - 1
        for one, weight in zip(total, (np.cos(angle), np.sin(angle)), strict=True):
            np.add.at(one, place, sign * weight[y, x])
    counts = total.reshape(-1, bins)
    counts = counts[np.any(counts, axis=1)]
    if not len(counts):
        return None
    hz, above = _peak(_power(counts - counts.mean(1, keepdims=True)), _BIN_US * 1e-6)
    return hz if above >= _STANDS_OUT else None


def _power(rows: FloatArray) -> FloatArray:
    """Return the power of signals, summed; frequencies are 1 / `_FINE` spans apart."""
    size = _FINE * rows.shape[1]
    power = np.zeros(size // 2 + 1)
    for row in rows:
        power += np.abs(np.fft.rfft(row, size)) ** 2
    power[:2 * _FINE] = 0.0     # less than two cycles
    return power


def _peak(power: FloatArray, step_s: float) -> tuple[float, float]:
    """Return the frequency of most power, Hz, and its ratio to the median."""
    best = int(np.argmax(power))
    return best / (2 * (len(power) - 1) * step_s), float(
        power[best] / max(float(np.median(power)), 1e-300))


def _refined(t: FloatArray, v: FloatArray, hz: float, by: float, most: float) -> float:
    """Return the frequency within `by` of one whose harmonics explain most."""
    from scipy.optimize import minimize_scalar
    found = minimize_scalar(
        lambda f: _rest(t, v, f, most), bounds=(hz - by, hz + by), method="bounded",
        options={"xatol": by * 1e-7})
    return float(found.x)


def _rest(t: FloatArray, v: FloatArray, hz: float, most: float) -> float:
    """Return the sum of squares that mean, drift and harmonics up to `most` leave."""
    columns = [np.ones_like(t), t]
    for k in range(1, max(1, min(_HARMONICS, int(most / hz), (len(t) - 4) // 2)) + 1):
        columns += [np.cos(2 * np.pi * k * hz * t), np.sin(2 * np.pi * k * hz * t)]
    a = np.stack(columns)
    # Of so few columns: `lstsq` of the whole shares it among threads, which wait.
    found = np.linalg.lstsq(a @ a.T, a @ v, rcond=None)[0]
    return max(float(v @ v - found @ (a @ v)), 0.0)
