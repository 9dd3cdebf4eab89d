"""Third differences of stamps that jitter by more than the gaps between them.

Checks `_TOLD_JITTER` of pdavis_cv/selfcal/jitter.py, and that the formula there, with
`_SHUFFLED` and `_POWER`, tells the jitter to 10 % up to it.  Light rises and falls in
turn by events at equal gaps, whose stamps get normal errors and are then sorted.  No
camera has a part in it.

    python lab/studies/stamp_jitter.py [--quick]
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found, main

from pdavis_cv.selfcal import jitter as used

JITTER = np.arange(0.05, 1.0, 0.05)     # in gaps
SWING = 22      # events from one turn to the next: a polarizer and nominal thresholds
WITHIN = 0.1


def third_difference(jitter, n):
    """Return the typical third difference of runs, and the jitter, in their mean gap.

    Runs are those of one sign whose mean gap is in the octave around the true gap.
    """
    t = np.arange(n) + np.random.default_rng(1).normal(0, jitter, n)
    order = np.argsort(t)
    t, p = t[order], (order // SWING) % 2
    gap = (t[3:] - t[:-3]) / 3
    kept = (gap > 0.5**0.5) & (gap < 2**0.5)
    for i in range(1, 4):
        kept &= p[i:len(p) - 3 + i] == p[:-3]
    third = np.abs(t[3:] - 3 * t[2:-1] + 3 * t[1:-2] - t[:-3])
    typical = np.median(gap[kept])
    return np.median(third[kept]) / typical, jitter / typical


def study(quick=False):
    """Return the jitter at the limit, and the formula's largest error up to it."""
    ratio, true = np.array([third_difference(one, 20_000 if quick else 1_000_000)
                            for one in JITTER]).T
    told = used._jitter_of(ratio)
    for one, third, by_formula in zip(true, ratio, told, strict=True):
        print(f"jitter {one:.2f} gaps: third difference {third:.3f}, "
              f"by the formula {by_formula:.3f}")
    worst = float(np.abs(told / true - 1)[ratio <= used._TOLD].max())
    return [Found("_TOLD_JITTER of selfcal/jitter.py",
                  float(np.interp(used._TOLD, ratio, true)), used._TOLD_JITTER, 0.08),
            Found("error of _jitter_of in selfcal/jitter.py", worst, WITHIN,
                  at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
