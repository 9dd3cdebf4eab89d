"""Timing of events: intervals between them, and their phase in a period."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Events


def pixel_intervals(events: Events, width: int) -> NDArray[np.int64]:
    """Return the times between consecutive events of each pixel.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Time-ordered.
    width : int
        Width of the sensor, pixels.

    Returns
    -------
    ndarray of int64
        Microseconds, one for each event except the first of each pixel; ordered by
        pixel, row after row.
    """
    pixel = events["y"].astype(np.int64) * width + events["x"]
    order = np.argsort(pixel, kind="stable")
    same = np.diff(pixel[order]) == 0
    return np.asarray(np.diff(events["t"][order])[same], np.int64)


def events_by_phase(
    events: Events, period_us: float, bins: int = 72
) -> NDArray[np.int64]:
    """Count events by polarity and phase in a period.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Events of pixels with the same light.
    period_us : float
        Microseconds.
    bins : int
        Number of equal bins of phase.

    Returns
    -------
    ndarray of int64, shape (2, bins)
        Row 0 is OFF, row 1 is ON.
    """
    part = np.floor(events["t"] % period_us / period_us * bins).astype(np.int64)
    part = np.minimum(part, bins - 1)  # rounding may give a phase of one period
    return np.bincount(
        events["p"].astype(np.int64) * bins + part, minlength=2 * bins)[
            :2 * bins].reshape(2, bins)
