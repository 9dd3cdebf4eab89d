"""Spread of the pixels' threshold ratios over the chip, from events alone.

A line through a pixel's ON events against all its events tells its ratio, with an error
that the light causes.  Two neighbouring pixels of one channel see nearly the same
light, so their lines differ by their ratios; and what differs equally in two halves of
the data is a property of the chip (docs/theory/events.md).
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.reconstruct.redundancy import PART_LEAST, RATIO_SIGMA
from pdavis_cv.selfcal.window import MAX_US, PixelWindow

__all__ = ["LEAST_SPREAD", "RatioSpread", "fit_ratio_spread"]

LEAST_SPREAD = 0.03
"""Least spread of ln(theta_on / theta_off): 2.1 % of each threshold, the smallest
mismatch that was published (Lichtsteiner et al. 2008)."""

_CELL = 2
"""Distance in pixels to the next pixel of the same polarizer."""

_MIN_PAIRS, _MIN_EVENTS = 12, 8
"""Least number of pairs of neighbours, and of events of each pixel in each half."""

_MAD_PER_SIGMA, _CLIP_SIGMAS = 0.6745, 3.0
"""Median of the absolute value of a standard normal number; differences beyond so many
robust standard deviations are left out, as they are those of hot pixels."""


class RatioSpread(NamedTuple):
    """Spread of ln(theta_on / theta_off) over the pixels, relative to the prior's.

    Parameters
    ----------
    sigma : float
        Standard deviation.
    error : float
        Standard error of sigma^2.
    """

    sigma: float
    error: float


def fit_ratio_spread(
    window: PixelWindow, nominal: tuple[ArrayLike, ArrayLike]
) -> RatioSpread | None:
    """Return the spread of the pixels' ratios; the events of the first 10 s are used.

    Parameters
    ----------
    window : PixelWindow
        The window that holds the events.
    nominal : (on, off)
        Thresholds, scalars or (H, W), from whose ratio the spread is counted.

    Returns
    -------
    RatioSpread or None
        None if there are too few events for an estimate.
    """
    events = window.events
    if not len(events):
        return None
    start = int(events["t"][0])
    events = events[:np.searchsorted(events["t"], start + MAX_US)]
    half = np.searchsorted(events["t"], (start + int(events["t"][-1])) // 2)
    on, off = (np.broadcast_to(np.asarray(theta, np.float64), window.shape).ravel()[
        window.pixels] for theta in nominal)
    first, second = _neighbours(window)
    ratios = [_line_ratios(part, on, off) for part in (events[:half], events[half:])]
    difference = np.array([ratio[second] - ratio[first] for ratio in ratios])
    difference = difference[:, np.isfinite(difference).all(0)]
    if difference.size:
        bound = _CLIP_SIGMAS / _MAD_PER_SIGMA * np.median(np.abs(difference), axis=1)
        difference = difference[:, (np.abs(difference) <= bound[:, None]).all(0)]
    if difference.shape[1] < _MIN_PAIRS:
        return None
    # Each pixel is in up to four pairs, so that half as many are independent.
    pairs = difference.shape[1] / 2
    common = float(difference.prod(0).mean()) / 2
    each = (difference**2).mean(1) / 2
    error = (float(each.prod()) + common**2) / pairs
    # The prior's sigma is known to about a factor of two: one degree of freedom.
    prior = 2 * RATIO_SIGMA**4
    square = (RATIO_SIGMA**2 * error + common * prior) / (prior + error)
    return RatioSpread(
        max(math.sqrt(max(square, 0)), LEAST_SPREAD),
        math.sqrt(prior * error / (prior + error)))


def _neighbours(window: PixelWindow) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of kept pixels that are next to each other in their channel."""
    height, width = window.shape
    place = np.full((height, width), -1, np.intp)
    place.ravel()[window.pixels] = np.arange(len(window.pixels))
    pairs = np.concatenate([
        np.stack([place[:-_CELL].ravel(), place[_CELL:].ravel()]),
        np.stack([place[:, :-_CELL].ravel(), place[:, _CELL:].ravel()])], axis=1)
    first, second = pairs[:, (pairs >= 0).all(0)]
    return first, second


def _line_ratios(
    events: NDArray[np.void], on: NDArray[np.float64], off: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return each pixel's ln(theta_on / theta_off) by its line, less the prior's.

    It is the ratio that ``rebalance`` (_kernels/_redundancy.pyx) has after all events;
    NaN where a pixel has too few, or the light changed in one sense only.
    """
    pixel = events["x"].astype(np.intp)
    order = np.argsort(pixel, kind="stable")
    pixel, polarity = pixel[order], events["p"][order].astype(np.float64)
    n = np.bincount(pixel, minlength=len(on)).astype(np.float64)
    start = (np.cumsum(n) - n).astype(np.intp)
    number = np.arange(len(pixel)) - start[pixel] + 1.0
    counts = np.append(0.0, np.cumsum(polarity))
    count = counts[1:] - counts[start[pixel]]

    def total(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        return np.bincount(pixel, values, len(on)).astype(np.float64)

    with np.errstate(invalid="ignore", divide="ignore"):
        middle, mean = (n + 1) / 2, total(count) / n
        var_all = total(number**2) / n - middle**2
        part = (total(number * count) / n - middle * mean) / var_all
        usual = off / (on + off)
        swing = 4 * ((total(count**2) / n - mean**2) / var_all
                     - 2 * usual * part + usual**2)
        ratio = np.log((1 - part) / part) - np.log(on / off)
        # The redundancy limits the part; where events have one sign, it has no line.
        told = (part > PART_LEAST) & (part < 1 - PART_LEAST)
    ratio[~(told & (swing < 1) & (n >= _MIN_EVENTS))] = np.nan
    return ratio
