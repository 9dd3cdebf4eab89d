"""Which spread of threshold ratios `kalman` should hand on to `EventRedundancy`.

Checks two choices of `Saturated` (pdavis_cv/reconstruct/kalman/saturation.py), on
specimens that no table reports: where frames saturate (bright half of the fan), the
spread that is learned is better than the prior; where they are dim (a plate in 40
nW/cm2), the prior is.

    python lab/studies/kalman_ratio_spread.py [--quick]
"""
from __future__ import annotations

import sys
from typing import Any
from unittest import mock

import numpy as np
from common import Found, main

from lab.evidence.cases import CASES
from lab.paper.run import Take, score
from pdavis_cv.reconstruct.kalman import saturation
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA
from pdavis_cv.simulation import PRESETS, Camera

SEEDS, QUICK_SEEDS = tuple(range(1011, 1019)), (1011, 1012)


def errors(name: str, seeds: tuple[int, ...], **options: Any):
    """Return the medians of AoP (degrees) and DoLP errors of buffered images."""
    case, dvs, found = CASES[name], PRESETS["nominal"]["dvs"], []
    for seed in seeds:
        camera = Camera.preset(
            "nominal", seed=seed, size=case.size, origin=case.origin)
        recording, truth = camera.record(case.light(seed), case.seconds)
        scored = score(
            Take(recording, truth, 0, truth.stop_us), step_us=case.step_us,
            regions={name: case.mask and case.mask(camera)}, margin=case.margin,
            method="kalman", nominal_thresholds=(dvs.theta_on, dvs.theta_off),
            **options)[name]
        found.append((np.rad2deg(scored.aop_error), scored.dolp_error))
    return np.median(found, 0)


def study(quick: bool) -> list[Found]:
    """Print errors by spread; return those of the code's over those of the other."""
    seeds = QUICK_SEEDS if quick else SEEDS
    fan = [errors("fan-bright", seeds, **options)
           for options in ({}, {"ratio_sigma": RATIO_SIGMA})]
    # Without a lower bound dim pixels have the learned spread, too.
    with mock.patch.object(saturation, "RATIO_SIGMA", 0.0):
        learned = errors("dark-60", seeds)
    plate = [errors("dark-60", seeds), learned]
    for name, (code, other) in (
            ("fan's bright half: learned, prior", fan),
            ("plate: prior, learned", plate)):
        print(f"{name}: AoP {code[0]:.3f}, {other[0]:.3f} degrees, DoLP {code[1]:.4f}, "
              f"{other[1]:.4f}")
    return [Found("DoLP error, saturated: the code's over the prior's",
                  float(fan[0][1] / fan[1][1]), 1.0, at_least=True),
            Found("AoP error, dim: the code's over that of the learned spread",
                  float(plate[0][0] / plate[1][0]), 1.0, at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
