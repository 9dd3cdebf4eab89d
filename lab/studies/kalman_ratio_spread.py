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

from lab.paper.robustness import RECORDED, STEPS_US, robustness_cases
from lab.paper.run import (
    Case,
    Settings,
    Takes,
    fuse_parameters,
    score,
)
from pdavis_cv.reconstruct.kalman import saturation
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA

SEEDS, QUICK_SEEDS = tuple(range(11, 19)), (11, 12)


def case_of(seed: int, scene: str) -> Case:
    """Return the case of a scene in the robustness table, of another specimen."""
    cases = robustness_cases(Settings(
        seeds=(seed,), starts_deg=(), cameras=("nominal",)))
    return next(case for case in cases if case.scene.startswith(scene))


def errors(scene: str, region: str, seeds: tuple[int, ...], **options: Any):
    """Return the medians of AoP (degrees) and DoLP errors of buffered images."""
    method, found = RECORDED["kalman"], []
    for seed in seeds:
        case = case_of(seed, scene)
        scored = score(
            Takes(case)(method), regions=case.regions(case.specimen(method)),
            step_us=STEPS_US[1], margin=case.margin, demosaic=case.demosaic,
            **fuse_parameters(method, case), **options)[region]
        found.append((np.rad2deg(scored.aop_error), scored.dolp_error))
    return np.median(found, 0)


def study(quick: bool) -> list[Found]:
    """Print errors by spread; return those of the code's over those of the other."""
    seeds = QUICK_SEEDS if quick else SEEDS
    fan = [errors("fan", "bright half", seeds, **options)
           for options in ({}, {"ratio_sigma": RATIO_SIGMA})]
    # Without a lower bound dim pixels have the learned spread, too.
    with mock.patch.object(saturation, "RATIO_SIGMA", 0.0):
        learned = errors("rotating plate", "all", seeds)
    plate = [errors("rotating plate", "all", seeds), learned]
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
