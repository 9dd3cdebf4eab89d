"""Responses of the four polarizers, and the solution for the Stokes parameters."""
from __future__ import annotations

import math
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import floats, real_number
from pdavis_cv.sensor import CHANNELS


class Analyser:
    """Responses of the four channels to the Stokes parameters, and their solution.

    ``stokes`` and ``PolarFrame`` accept the plain array too; an Analyser that is used
    repeatedly avoids solving for it each time.

    Parameters
    ----------
    response : array_like, shape (4, 3) or (4, 3, H, W)
        ``I[k] = sum(response[k, j] * S[j])``, channels in the order of ``CHANNELS``;
        an ideal polarizer at angle a has (1, cos 2a, sin 2a) / 2.

    Attributes
    ----------
    response : ndarray of float64, read-only
    solution : ndarray of float32, shape (3, 4) or (3, 4, H, W), read-only
        ``S[j] = sum(solution[j, k] * I[k])`` is the least-squares solution.

    Raises
    ------
    ValueError
        If the shape is another, or the responses do not determine the Stokes
        parameters somewhere; the message names the first such pixel.
    """

    __slots__ = ("response", "solution")

    response: NDArray[np.float64]
    solution: NDArray[np.float32]

    def __init__(self, response: ArrayLike) -> None:
        a = floats("analyser", response)
        if a.shape[:2] != (4, 3) or a.ndim not in (2, 4):
            raise ValueError(
                f"analyser must have shape (4, 3) or (4, 3, H, W), got {a.shape}")
        self.response = a
        self.solution = _least_squares(a)
        self.response.flags.writeable = self.solution.flags.writeable = False

    @classmethod
    def ideal(cls, extinction_ratio: float | None = None) -> Self:
        """Return four polarizers of this extinction ratio (None: perfect)."""
        angle = np.deg2rad(np.array(CHANNELS, np.float64))
        purity = 1 / stokes_gain(extinction_ratio)
        rows = [np.ones(4), purity * np.cos(2 * angle), purity * np.sin(2 * angle)]
        return cls(np.stack(rows, 1) / 2)

    def null(self) -> NDArray[np.float32]:
        """Return n with n . I = 0 for all light: the left null vector of `response`.

        Returns
        -------
        ndarray of float32, shape (4,) or (4, H, W)
            Of arbitrary length; proportional to (1, -1, 1, -1) for equal channels.
        """
        a = self.response
        rows = []
        for k in range(4):
            p, q, r = (a[j] for j in range(4) if j != k)
            minor = (p[0] * (q[1] * r[2] - q[2] * r[1])
                     - p[1] * (q[0] * r[2] - q[2] * r[0])
                     + p[2] * (q[0] * r[1] - q[1] * r[0]))
            rows.append(minor if k % 2 == 0 else -minor)
        return np.array(rows, np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.response,)

    def __repr__(self) -> str:
        kind = "one for all pixels" if self.response.ndim == 2 else "per pixel"
        return f"Analyser({kind}, shape {self.response.shape})"


def _least_squares(a: NDArray[np.float64]) -> NDArray[np.float32]:
    """Solve the normal equations by Cramer's rule: the same bits on every machine."""
    normal = [[(a[:, i] * a[:, j]).sum(0) for j in range(3)] for i in range(3)]

    def cofactor(i: int, j: int) -> NDArray[np.float64]:
        p, q = (i + 1) % 3, (i + 2) % 3
        r, s = (j + 1) % 3, (j + 2) % 3
        return np.asarray(normal[p][r] * normal[q][s] - normal[p][s] * normal[q][r])

    minors = [[cofactor(i, j) for j in range(3)] for i in range(3)]
    determinant = sum(normal[0][j] * minors[0][j] for j in range(3))
    scale = normal[0][0] * normal[1][1] * normal[2][2]
    with np.errstate(invalid="ignore"):
        bad = np.argwhere(~(np.asarray(determinant) > 1e-9 * scale))
    if len(bad):
        where = f" at (y={bad[0][0]}, x={bad[0][1]})" if a.ndim == 4 else ""
        raise ValueError(
            "analyser must determine S0, S1 and S2, but its rows are linearly "
            f"dependent{where}")
    rows = [[sum(minors[i][j] * a[k, j] for j in range(3)) / determinant
             for k in range(4)] for i in range(3)]
    return np.array(rows, np.float32)


def stokes_gain(extinction_ratio: float | None) -> float:
    """Return the factor for S1 and S2 that corrects the polarizers' leakage.

    The extinction ratio, above 1, is that of largest to smallest response to linearly
    polarized light; None: infinite.
    """
    if extinction_ratio is None or extinction_ratio == math.inf:
        return 1.0
    if not real_number(extinction_ratio) > 1:
        raise ValueError(
            f"extinction_ratio must be greater than 1, got {extinction_ratio!r}")
    return (extinction_ratio + 1) / (extinction_ratio - 1)
