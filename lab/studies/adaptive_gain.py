"""Adaptive gain of the complementary filter: its numbers from the paper's limits.

Haessig et al., supplement, "Complementary Filter": lambda = 0.1, limits 10 and 200 on
the 8-bit scale; between a limit and the end of the range (1 and 255) the weight falls
linearly in the log of the sample (Scheerlinck et al., ACCV 2018, section 4.1).
"""
from __future__ import annotations

import math
import sys

import numpy as np
from common import Found, kernel_constant, main

from pdavis_cv import ApsFrame, ComplementaryFilter

LOW, HIGH, END, FLOOR = 10.0, 200.0, 255.0, 0.1
"""Limits and end of the 8-bit scale, and lambda: the paper's."""


def gain(v: float) -> float:
    """Return what the rate towards a sample v is multiplied by."""
    low = math.log(max(v, 1.0)) / math.log(LOW)
    high = (math.log(END) - math.log(max(v, 1.0))) / (math.log(END) - math.log(HIGH))
    return FLOOR + (1 - FLOOR) * min(max(min(low, high), 0.0), 1.0)


def measured(v: float) -> float:
    """Return the gain that the filter shows: how fast it relaxes to a second frame."""
    first, second = (np.full((1, 1), 4 * value, np.float32) for value in (v * 0.9, v))
    filter_ = ComplementaryFilter((1, 1), theta_on=0.2, theta_off=0.2, cutoff_hz=1.0)
    filter_.add_frame(ApsFrame(first, 0, 2_000))
    filter_.add_frame(ApsFrame(second, 10_000, 12_000))
    a, b = (float(filter_.read(t).log_intensity[0, 0]) for t in (11_000, 111_000))
    target = math.log(4 * v / 2)
    return -math.log((target - b) / (target - a)) / (2 * math.pi * 0.1)


def study(quick: bool) -> list[Found]:
    """Derive the kernel's numbers, and compare the filter with the formula."""
    found = [
        Found("_leaky.pyx per_ln_10", 1 / math.log(LOW),
              kernel_constant("_leaky.pyx", "per_ln_10"), 1e-7),
        Found("_leaky.pyx ln_255", math.log(END),
              kernel_constant("_leaky.pyx", "ln_255"), 1e-7),
        Found("_leaky.pyx per_top", 1 / math.log(END / HIGH),
              kernel_constant("_leaky.pyx", "per_top"), 1e-6)]
    values = (5.0, 100.0, 230.0) if quick else (
        1.5, 3.0, 5.0, 9.0, 50.0, 199.0, 230.0)
    return found + [
        Found(f"gain of the filter at v = {v:g}", gain(v), measured(v), 0.02)
        for v in values]


if __name__ == "__main__":
    sys.exit(main(study))
