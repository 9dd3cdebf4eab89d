"""Events of pixels at rest by intensity: leak, and noise events."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.selfcal.window import USABLE_DN, PixelWindow

__all__ = ["RestRates", "fit_rest_rates"]

_STEADY, _FAR = 0.05, 0.15
"""Largest standard deviation of the ln of a pixel's samples, and largest distance from
their median, at which the pixel counts as at rest.  Engineering choice: light that
moves by so little crosses no threshold of usual cameras, .15 to .4."""

_MOST_HZ = 30.0
"""Rate of events above which a pixel is not at rest, or is hot: light that repeats at
the rate of the frames looks steady in them, but makes hundreds per second.  Engineering
choice: noisy pixels make up to 15."""

_LEAST_FRAMES, _LEAST_SECONDS = 5, 0.25
"""Least number of samples of a pixel, and time (s) that they must span.  Engineering
choice."""

_CLASS, _LEAST_PIXELS = 2.0, 20
"""Ratio of the ends of a class of intensity, and the least number of its pixels: the
standard error is that of the mean of so many, by their scatter.  Engineering choice."""


class RestRates(NamedTuple):
    """Events of pixels at rest, in classes of their intensity.

    Parameters
    ----------
    light : ndarray of float64, shape (N,)
        Mean intensity of the pixels of each class, DN/ms.
    leak_hz, leak_sigma : ndarray of float64, shape (N,)
        Excess of ON over OFF events per pixel and second, and its standard error.
        A pixel that noise resets before its leak has reached the threshold makes no
        leak event, so with much noise the leak itself is larger.
    noise_hz, noise_sigma : ndarray of float64, shape (N,)
        Noise events of both signs, twice the OFF events, likewise.
    leak_law, leak_law_sigma : (float, float) or None
        Leak in the dark (Hz) and its increase (Hz per DN/ms), least squares over the
        pixels, and standard errors; None: one class of intensity does not tell it.
    """

    light: NDArray[np.float64]
    leak_hz: NDArray[np.float64]
    leak_sigma: NDArray[np.float64]
    noise_hz: NDArray[np.float64]
    noise_sigma: NDArray[np.float64]
    leak_law: tuple[float, float] | None
    leak_law_sigma: tuple[float, float] | None


def fit_rest_rates(window: PixelWindow) -> RestRates | None:
    """Return the rates of the pixels of a window that frames show to be at rest.

    A pixel makes leak events, all ON, and noise events, half of them ON
    [Nozaki 2017, Hu 2021].

    Returns
    -------
    RestRates or None
        None if no class of intensity has enough pixels at rest.
    """
    intervals = window.intervals
    if len(intervals) < _LEAST_FRAMES:
        return None
    first, last = intervals[0].exposure_us[1], intervals[-1].exposure_us[1]
    seconds = float(np.mean(last - first)) * 1e-6
    if seconds < _LEAST_SECONDS:
        return None
    light, usable = _samples(window)
    # Events since the first frame.
    off, on = np.stack([each.counts[:, 0] for each in intervals[1:]]).sum(
        axis=0, dtype=np.int64)
    middle = np.median(light, 0)
    away = np.abs(np.log(light / middle))
    rests = (usable & (np.sqrt(np.mean(away**2, 0)) < _STEADY)
             & (away.max(0) < _FAR) & (on + off < _MOST_HZ * seconds))
    if not rests.any():
        return None
    level, leak, noise = middle[rests], (on - off)[rests] / seconds, (
        2 * off[rests] / seconds)
    number = np.floor(np.log(level / level.min()) / np.log(_CLASS)).astype(int)
    rows = []
    for k in np.unique(number):
        mine = number == k
        count = int(mine.sum())
        if count >= _LEAST_PIXELS:
            # No event in any of the pixels: as if there were one.
            least = 1 / (count * seconds)
            rows.append((level[mine].mean(), *(
                figure for rate in (leak[mine], noise[mine]) for figure in (
                    rate.mean(), max(rate.std(ddof=1) / count**0.5, least)))))
    if not rows:
        return None
    classes = np.array(rows).T
    return RestRates(classes[0], classes[1], classes[2], classes[3], classes[4],
                     *_law(level, leak, len(rows)))


def _samples(window: PixelWindow) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the samples (frames, pixels), DN/ms, and which pixels have all of them."""
    intervals, columns = window.intervals, window.pixels % window.shape[1]
    light = np.empty((len(intervals), len(window.pixels)))
    usable = np.ones(len(window.pixels), np.bool_)
    for row, each in zip(light, intervals, strict=True):
        begin, _, end = each.exposure_us
        # Lower samples are not usable, whatever their logarithm.
        row[:] = np.maximum(each.dn, USABLE_DN) / ((end - begin) / 1000)[columns]
        usable &= each.usable & (each.dn >= USABLE_DN)
    return light, usable


def _law(
    level: NDArray[np.float64], leak: NDArray[np.float64], classes: int,
) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
    """Fit a line to the leak of pixels; errors by their scatter [White 1980]."""
    if classes < 2:
        return None, None
    a = np.stack([np.ones_like(level), level], 1)
    inverse = np.linalg.inv(a.T @ a)
    found = inverse @ (a.T @ leak)
    weighted = a * (leak - a @ found)[:, np.newaxis]
    at_dark, slope = np.sqrt(np.diag(inverse @ (weighted.T @ weighted) @ inverse))
    return (float(found[0]), float(found[1])), (float(at_dark), float(slope))
