"""The table that takes a network's output to the light, as the paper calibrates it."""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

KNOTS = 33      # of each curve


def response_table(given: ArrayLike, light: ArrayLike) -> NDArray[np.float32]:
    """Fit the table from a network's output to the light, monotone, by channel.

    Parameters
    ----------
    given, light : array_like of shape (4, N)
        Output of the network, and the light, over one period, by place in the cell (see
        `FireNet`).

    Returns
    -------
    ndarray of float32, shape (4, 2, 33)
        For ``FireNet(scaling="table", table=...)``.

    Raises
    ------
    ValueError
        If the arrays do not fit each other or a channel does not vary.
    """
    x, y = np.asarray(given, np.float64), np.asarray(light, np.float64)
    if x.ndim != 2 or len(x) != 4 or x.shape != y.shape or x.shape[1] < 2:
        raise ValueError(
            f"given and light must be (4, N), got {x.shape} and {y.shape}")
    curves = []
    for one, true in zip(x, y, strict=True):
        order = np.argsort(one, kind="stable")
        one, true = one[order], _monotone(true[order])
        if one[0] == one[-1]:
            raise ValueError("given must vary in each channel, got a constant")
        ends = np.linspace(one[0], one[-1], KNOTS)
        known, first = np.unique(one, return_index=True)
        curves.append((ends, np.interp(ends, known, true[first])))
    return np.asarray(curves, np.float32)


def _monotone(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least-squares increasing sequence: pool adjacent violators."""
    blocks: list[tuple[float, int]] = []
    for value in values.tolist():
        mean, n = value, 1
        while blocks and blocks[-1][0] >= mean:
            before, m = blocks.pop()
            mean, n = (before * m + mean * n) / (m + n), m + n
        blocks.append((mean, n))
    return np.repeat([mean for mean, _ in blocks], [n for _, n in blocks])
