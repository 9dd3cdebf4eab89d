"""Methods on cameras on which no constant was chosen: for lab/docs/reproduced.md.

Finds no constant.  A polarizer of DoLP 0.8 turns before specimens of `drawn` and
`davis346`, whose thresholds, bandwidth, noise, refractory period and clocks differ from
what methods assume; `nominal` is beside them.  Errors count from 1 s on.

    python lab/studies/held_cameras.py [--quick]
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found, main

from pdavis_cv import fuse
from pdavis_cv.analysis import Scorer
from pdavis_cv.simulation import Camera, RotatingPolarizer

SPECIMENS = {"nominal": (1, 2), "drawn": (1, 2, 3), "davis346": (1, 2, 3)}
SPEEDS_RPM, SIZE, SECONDS = (60, 1000), (12, 12), 2.5
METHODS = {
    "cf": {"method": "cf"},
    "kalman causal": {"method": "kalman", "causal": True},
    "kalman": {"method": "kalman"},
    "kalman offline": {"method": "kalman", "mode": "offline"},
    "events, redundancy": {"method": "events", "offsets": "redundancy"}}


def scored(preset: str, seed: int, rpm: float, methods) -> dict[str, tuple]:
    """Return by method: AoP error (degrees), DoLP error, and their coverage."""
    camera = Camera.preset(preset, seed=seed, size=SIZE)
    told = ((camera.dvs.theta_on, camera.dvs.theta_off) if preset == "nominal"
            else (0.2, 0.2))
    scene = RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * seed, dolp=0.8)
    recording, truth = camera.record(scene, SECONDS)
    times = np.arange(1_000_000, int(1e6 * SECONDS) - 100_000, 7_013)
    found = {}
    for name in methods:
        scorer = Scorer(truth, (SIZE[0] // 2, SIZE[1] // 2))
        for image in fuse(recording, times_us=times, demosaic="superpixel",
                          nominal_thresholds=told, **METHODS[name]):
            scorer.add(image)
        score = scorer.score
        found[name] = (np.rad2deg(score.aop_error), score.dolp_error,
                       score.aop_coverage, score.dolp_coverage)
    return found


def study(quick: bool) -> list[Found]:
    """Print the table; kalman is held to less than half of the error of cf."""
    methods = ("cf", "kalman") if quick else tuple(METHODS)
    found = []
    for preset, seeds in SPECIMENS.items():
        cells = {rpm: [scored(preset, seed, rpm, methods)
                       for seed in (seeds[:1] if quick else seeds)]
                 for rpm in (SPEEDS_RPM[:1] if quick else SPEEDS_RPM)}
        means = {(name, rpm): np.mean([one[name] for one in cell], axis=0)
                 for rpm, cell in cells.items() for name in methods}
        for name in methods:
            print(f"{preset}, {name}:", *(
                "{:.2f} / {:.3f} [{:.2f} {:.2f}]".format(*means[name, rpm])
                for rpm in cells))
        found.append(Found(
            f"{preset}: kalman's AoP error over cf's, {SPEEDS_RPM[0]} RPM",
            float(means["kalman", SPEEDS_RPM[0]][0] / means["cf", SPEEDS_RPM[0]][0]),
            0.5, at_least=True))
    return found


if __name__ == "__main__":
    sys.exit(main(study))
