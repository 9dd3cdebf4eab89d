"""Silences after an event, of simulated cameras: what a recording's own are shrunk to.

Made by lab/studies/silences.py of 36 cameras of four presets.
"""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.pixel.model import CONTEXTS, RATIOS, PixelModel
from pdavis_cv.pixel.sample import Sampled

# By look-ahead, us: E and B of (2c) by context and ratio.
_TABLES = {
    0: (
        0.230, 0.523, 0.643, 0.232, 0.283,
        0.204, 0.300, 0.508, 0.221, 0.127,
        0.266, 0.449, 0.528, 0.166, 0.281,
        0.743, 0.327, 0.158, 0.279, 0.283,
        0.000, 0.000, 0.000, 0.000, 0.000,
        0.000, 0.000, 0.000, 0.000, 0.000,
        0.000, 0.000, 0.000, 0.000, 0.000,
        0.000, 0.000, 0.000, 0.000, 0.000,
    ),
    50000: (
        0.006, 0.001, 0.010, -0.006, 0.020,
        0.013, -0.010, -0.068, -0.255, -0.244,
        0.044, 0.024, -0.058, -0.076, -0.083,
        0.145, 0.187, -0.052, 0.037, 0.127,
        0.015, 0.019, 0.094, 0.200, 0.635,
        0.044, 0.038, 0.138, 0.360, 0.833,
        0.106, 0.078, 0.149, 0.315, 0.637,
        0.320, 0.245, 0.342, 0.375, 0.326,
    ),
}


def table_of(lookahead_us: int) -> NDArray[np.float64]:
    """Return E and B, shape (2, CONTEXTS, RATIOS), for a look-ahead."""
    values = _TABLES[0 if lookahead_us == 0 else 50000]
    return np.array(values).reshape(2, 4, 5)


STRENGTH, SAME = 30.0, 3.0
"""Silences that others, and a variance of 1/12, count as (lab.studies.constants)."""

SILENCES, PIXELS = 6_000, 2_000
"""Most silences at each look, and pixels (lab.studies.constants)."""

LATER_US = 25_000
"""How much more is known of the frame before than of the time of an image: half of an
interval at 20 frames per second.  The table without a look-ahead has no bow: s = 1."""


SHORTEST, LEAST_LOST, LARGEST_ERROR = 8, 0.02, 0.2
"""Gaps that tell a dead time; the share of time that must be lost in it, and its
largest relative error (lab.studies.constants)."""


def learned_silences(
    data: Sampled, model: PixelModel, lookahead_us: int
) -> PixelModel:
    """Return the model with E, B and var(phi) of a recording's own silences.

    Where a silence that was open (2c) is closed later, (2a, b) say what had passed.
    """
    half = CONTEXTS * RATIOS
    number = np.diff(data.start)
    rng = np.random.default_rng(2)
    pixels = rng.permutation(np.flatnonzero(number >= 4))[:PIXELS].astype(np.int32)
    looks = lookahead_us, lookahead_us + LATER_US
    every, targets = np.zeros((2, SILENCES, 2 * half)), np.zeros((2, SILENCES))
    n = 0
    if len(pixels):
        times = 4 * SILENCES // len(pixels)     # a quarter are open
        at = np.sort(rng.uniform(data.t[0], data.t[-1], times)).astype(np.int64)
        n = sum(_kernels.learning_silences(
            data.events, data.start, pixels, rng.permutation(at), ahead, model.numbers,
            *each) for ahead, *each in zip(looks, every, targets, strict=True))
    rows, target = every.reshape(-1, 2 * half), targets.reshape(-1)
    p = np.concatenate([model.end, model.bow]).ravel()
    ridge = STRENGTH * max(1.0, n / max(len(data.events), 1)) * np.eye(2 * half)
    x = p + np.linalg.solve(rows.T @ rows + ridge, rows.T @ (target - rows @ p))
    basis = rows[:, :half] + rows[:, half:]
    square = ((basis * (target - rows @ x)[:, None]) ** 2).sum(0)
    variance = (square + SAME / 12) / ((basis**4).sum(0) + SAME)
    shape = (CONTEXTS, RATIOS)
    return model.replace(end=x[:half].reshape(shape), bow=x[half:].reshape(shape),
                         open_variance=variance.reshape(shape))


def _gaps(data: Sampled) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which gaps are between events of one pixel, and of them of two signs."""
    number = np.diff(data.start)
    inside = np.diff(np.repeat(np.arange(len(number)), number)) == 0
    return inside, inside & (np.diff(data.events["sign"]) != 0)


def turn_of(data: Sampled) -> float:
    """Return q of (2b) after a run of one event, as the share of such runs tells it.

    If all are, light swings by one to two thresholds, and goes on by a quarter of one
    in the mean before it turns; by almost one if few are, as it swings by almost three.
    Half of one is what else is assumed.
    """
    inside, other = _gaps(data)
    ones = (other[:-1] & other[1:]).sum() / max((other[:-1] & inside[1:]).sum(), 1)
    on = min(1 - 0.75 * ones, 0.5)
    return float((math.sqrt(1 + on) - math.sqrt(on)) ** 2)


def dead_time(data: Sampled) -> float:
    """Return the dead time that the shortest gaps show, s, or 0.

    Gaps to an event of the same and of the other sign must end at the same edge (light
    that turns makes no short gap), known to a fifth, and what is lost must matter.
    """
    gap = 1e-6 * np.diff(data.events["t"])
    inside, other = _gaps(data)
    edges = []
    for chosen in (inside, other):
        few = np.sort(gap[chosen])[:SHORTEST]
        if len(few) < SHORTEST:
            return 0.0
        step = (few[-1] - few[0]) / (SHORTEST - 1)
        edges.append((few[0] - step, math.hypot(step, 1e-6)))
    (edge, _), (of_other, error) = edges
    seconds = 1e-6 * float(data.t[-1] - data.t[0])
    rate = len(data.t) / seconds / max(int((np.diff(data.start) > 0).sum()), 1)
    known = edge * rate > LEAST_LOST and error < LARGEST_ERROR * edge
    return float(edge) if known and of_other - edge < 3 * error else 0.0
