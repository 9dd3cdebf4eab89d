"""The noise of a recording's own frames."""
from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.pixel.sample import Sampled

FRAMES, DEGREE = 5, 3
"""A cubic through five samples of a pixel leaves noise: light that frames can tell is
smoother."""

LEAST, MOST = 100, 100_000
"""Samples that are looked at, at least and at most: a tenth of a sigma, and the time it
takes (lab.studies.constants)."""

FAR = 9.0
"""Squared sigmas that what is left counts as at most (lab.studies.constants)."""

DIM_DN = 26.0
"""Light below which the prior's noise is a fifth of it.  There it stays: it has room
for offsets of pixels, which are no noise but err as much (lab.studies.constants)."""


def learned_frame_noise(data: Sampled, model: PixelModel) -> PixelModel:
    """Return the model with the noise of a recording's own frames.

    That of the model is an upper bound, as light that is fast looks like noise.
    """
    groups = [data.frames[k:k + FRAMES] for k in range(len(data.frames) - FRAMES + 1)]
    every = 1 + len(groups) * (len(data.start) - 1) // MOST
    means, squares = [np.empty(0)], [np.empty(0)]
    for k, group in enumerate(groups):
        some = slice(k % every, None, every)
        length = np.stack([np.diff(one.exposure[:, some], axis=0)[0] for one in group])
        whole = np.all([one.usable[some] for one in group], 0) & (
            np.ptp(length, 0) <= 0.01 * length.max(0))
        dn = np.stack([one.dn[some][whole] for one in group])
        t = np.array([one.middle_us for one in group], np.float64)
        powers = np.vander((t - t[0]) / np.ptp(t), DEGREE + 2, increasing=True)
        left = np.linalg.qr(powers)[0][:, -1]   # no cubic has a part in it
        means.append(dn.mean(0))
        squares.append((left @ dn) ** 2)
    dn, square = np.concatenate(means), np.concatenate(squares)
    if len(dn) < LEAST or np.median(dn) < DIM_DN:
        return model
    x = np.stack([np.ones_like(dn), dn], 1)
    noise = told = np.array([model.read_variance, model.shot])
    for _ in range(10):
        variance = x @ noise
        noise = _fitted(x / variance[:, None], np.minimum(square / variance, FAR))
    if np.mean((x @ noise) / (x @ told)) > 1:
        return model
    return model.replace(read_variance=float(noise[0]), shot=float(noise[1]))


def _fitted(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return least squares of y, none of them negative."""
    square = x.T @ x
    return nonnegative(
        square + 1e-12 * np.trace(square) * np.eye(2), x.T @ y) + 1e-6


def nonnegative(
    square: NDArray[np.float64], right: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the x >= 0 of the least x square x - 2 right x: each may be 0 or not.

    For two or three unknowns, whose subsets are few.  SciPy's `nnls` does the same, but
    importing it takes as long as learning a camera.
    """
    best, most = np.zeros(len(right)), 0.0
    for some in itertools.product((False, True), repeat=len(right)):
        keep = np.array(some)
        x = np.linalg.solve(square[np.ix_(keep, keep)], right[keep])
        if (x >= 0).all() and x @ right[keep] > most:
            best, most = np.zeros(len(right)), float(x @ right[keep])
            best[keep] = x
    return best
