"""How far off the line through a pixel's counts is, in the units of its stated error.

Finds `LINE_ERROR` and `FAR_ERRORS` (pdavis_cv/reconstruct/redundancy.py).  Light is one
wave, as behind a polarizer that turns, or a sum of two or three: random frequencies,
phases and contrasts, of no preset; pixels are ideal.  A line through ON events against
all of them tells the ratio with an error that the swing of the sum of events, squared,
is a unit for.  `LINE_ERROR` is its root mean square in that unit; beyond `FAR_ERRORS`
such errors, 2 % of the lines, a pixel's ratio is taken for what its events show.

    python lab/studies/redundancy_far.py [--quick]
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found, main

from pdavis_cv.reconstruct.redundancy import FAR_ERRORS, LINE_ERROR, RATIO_SIGMA

SPAN = 4.0  # of rebalance in the kernel: light of a range of e^4
THETA, MOST_WAVES = 0.2, 3
WITHIN = 0.98


def signs(rng: np.random.Generator, waves: int) -> np.ndarray:
    """Return the polarities of a pixel's events, 1 or 0, under random light."""
    t = np.linspace(0, 1, 4000)
    level = sum(a * np.sin(2 * np.pi * (f * t + p)) for a, f, p in zip(
        rng.uniform(0.2, 1.2, waves), rng.uniform(0.7, 6, waves), rng.random(waves),
        strict=True))
    out, reference = [], level[0]
    for value in level:
        while abs(value - reference) >= THETA:
            up = value > reference
            reference += THETA if up else -THETA
            out.append(int(up))
    return np.array(out)


def error_of(on: np.ndarray) -> float | None:
    """Return ln of the ratio, which is 0, in units of its swing; None without any."""
    n = np.arange(1, len(on) + 1)
    all_, ons = n - n.mean(), np.cumsum(on) - np.cumsum(on).mean()
    var, cov, var_on = all_ @ all_, all_ @ ons, ons @ ons
    part = cov / var
    swing = SPAN * (var_on / var - part + 0.25)
    if swing >= 1:
        return None
    rest = SPAN * (var_on / var - part * part)
    least = SPAN / (0.5 * 2 * THETA * len(on) / 2) ** 2
    unit = min(max(swing - RATIO_SIGMA**2 / 4, rest), max(rest, least))
    return float(np.log((1 - part) / part) / unit)


def study(quick: bool) -> list[Found]:
    """Print the distribution of the errors."""
    rng = np.random.default_rng(0)
    off = []
    for pixel in range(900 if quick else 4500):
        on = signs(rng, 1 + pixel % MOST_WAVES)
        one = error_of(on) if len(on) > 8 else None
        off += [] if one is None else [one]
    rms = np.sqrt(np.mean(np.square(off)))
    most = np.quantile(np.abs(off), WITHIN) / rms
    print(f"{len(off)} pixels: rms {rms:.2f}, {WITHIN:.0%} within {most:.2f} rms")
    return [Found("LINE_ERROR", float(rms), LINE_ERROR, 0.1),
            Found("FAR_ERRORS", float(most), FAR_ERRORS, 0.1)]


if __name__ == "__main__":
    sys.exit(main(study))
