"""Bias of DoLP, and what `debias_dolp` leaves of it.

S1 / S0 and S2 / S0 are drawn with equal normal errors of one sigma about a length p.
The docstring of `debias_dolp` states: at p = 0 DoLP reads 1.25 sigma (sqrt(pi / 2)),
the estimator leaves about 1 sigma there, and less than .05 sigma from 2 sigma on.
"""
from __future__ import annotations

import math
import sys

import numpy as np
from common import Found, main

from pdavis_cv import debias_dolp

LENGTHS = (2.0, 2.5, 3.0, 4.0, 6.0, 10.0)
"""True DoLP over sigma where the bias is stated to be below .05 sigma."""


def biases(length: float, draws: int, seed: int = 1) -> tuple[float, float]:
    """Return the mean errors of DoLP and of the estimator, in sigma."""
    rng = np.random.default_rng(seed)
    x = length + rng.standard_normal(draws)
    read = np.hypot(x, rng.standard_normal(draws)).astype(np.float32)
    return (float(read.mean()) - length,
            float(debias_dolp(read, 1.0).mean()) - length)


def study(quick: bool) -> list[Found]:
    """Draw Stokes parameters and average."""
    draws = 400_000 if quick else 10_000_000
    raw, left = biases(0.0, draws)
    worst = max(abs(biases(length, draws)[1]) for length in LENGTHS)
    return [Found("DoLP of light that is not polarized, sigma", raw, 1.25, 0.01),
            Found("its exact value sqrt(pi / 2)", raw, math.sqrt(math.pi / 2), 0.005),
            Found("left of it by debias_dolp, sigma", left, 1.0, 0.2),
            Found("left from 2 sigma on, sigma", worst, 0.05, at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
