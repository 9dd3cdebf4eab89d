"""How far off the line through a pixel's counts is, in the errors stated of it.

Finds `FAR_ERRORS` (_kernels/_redundancy.pyx): beyond so many errors a pixel's ratio of
thresholds is taken for what its events show.  Light is a sum of three waves of random
frequency, phase and contrast, not a polarizer and of no preset; pixels are ideal.  A
line through ON events against all of them tells the ratio with an error that the swing
of the sum of events states; two sigma of what it is really off by, in that error, are
the constant.

    python studies/redundancy_far.py [--quick]
"""
from __future__ import annotations

import re
import sys

import numpy as np
from common import ROOT, Found, main

LINE_ERROR, SPAN = 3.0, 4.0  # of rebalance in the kernel, and light of a range of e^4
THETA = 0.2


def signs(rng: np.random.Generator) -> np.ndarray:
    """Return the polarities of a pixel's events, 1 or 0, under random light."""
    t = np.linspace(0, 1, 4000)
    level = sum(a * np.sin(2 * np.pi * (f * t + p)) for a, f, p in zip(
        rng.uniform(0.2, 1.2, 3), rng.uniform(0.7, 6, 3), rng.random(3), strict=True))
    out, reference = [], level[0]
    for value in level:
        while abs(value - reference) >= THETA:
            up = value > reference
            reference += THETA if up else -THETA
            out.append(int(up))
    return np.array(out)


def errors_off(on: np.ndarray) -> float | None:
    """Return by how many stated errors ln of the ratio is off, None if none is."""
    n = np.arange(1, len(on) + 1)
    all_, ons = n - n.mean(), np.cumsum(on) - np.cumsum(on).mean()
    var, cov, var_on = all_ @ all_, all_ @ ons, ons @ ons
    part = cov / var
    swing = SPAN * (var_on / var - part + 0.25)
    if swing >= 1:
        return None
    least = SPAN / (0.5 * 2 * THETA * len(on) / 2) ** 2
    error = LINE_ERROR * min(max(SPAN * (var_on / var - part * part), least), swing)
    return float(abs(np.log((1 - part) / part)) / error)


def study(quick: bool) -> list[Found]:
    """Print the distribution of the errors."""
    rng = np.random.default_rng(0)
    off = []
    for _ in range(600 if quick else 2000):
        on = signs(rng)
        one = errors_off(on) if len(on) > 8 else None
        off += [] if one is None else [one]
    rms, most = np.sqrt(np.mean(np.square(off))), np.quantile(off, 0.954)
    print(f"{len(off)} pixels: rms {rms:.2f}, two sigma {most:.2f} of the stated error")
    text = (ROOT / "_kernels" / "_redundancy.pyx").read_text()
    code = re.search(r"#define FAR_ERRORS ([\d.]+)", text)
    if code is None:
        raise LookupError("_redundancy.pyx must define FAR_ERRORS, found none")
    return [Found("FAR_ERRORS", float(most), float(code.group(1)), 0.1)]


if __name__ == "__main__":
    sys.exit(main(study))
