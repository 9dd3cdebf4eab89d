"""Detection of a lamp's flicker: what its statistics are with and without a lamp.

`LampTracker` fits a wave of 100 or 120 Hz to the times of events.  A lamp is reported
if the wave explains more than EVIDENCE times the variance that is left per equation, if
waves for each place of a macropixel explain less than APART of that beyond it, and if
its amplitude is above LEAST.  The study gathers these three for turning polarizers and
plates under steady light and under a lamp of 10 %, and asks that the thresholds lie
between: no false alarm, and most blocks of a lamp found.
"""
from __future__ import annotations

import sys
from collections.abc import Iterator
from unittest import mock

import numpy as np
from common import Found, main

from pdavis_cv import _kernels
from pdavis_cv.reconstruct import lamp
from pdavis_cv.simulation import Camera, RotatingPlate, RotatingPolarizer

THETA = (0.16, 0.18)
DEPTH = 0.1
"""Of the lamp's flicker."""
FIRST_BLOCK = 5
"""Of 100 ms: before, there are few events."""
NAMES = ("turns_per_us", "cosine", "sine", "common", "apart", "left", "number", "below")


def statistics(scene: object, seed: int, seconds: float) -> Iterator[np.ndarray]:
    """Yield (evidence, apart, amplitude) of every block and span of time."""
    camera = Camera.preset("nominal", seed=seed, size=(12, 12), aps=None)
    events = camera.record(scene, seconds)[0].events()
    fits: list[np.ndarray] = []
    fit = _kernels.lamp_wave

    def noted(sums: np.ndarray, start_us: int, out: np.ndarray) -> None:
        fit(sums, start_us, out)
        fits.append(np.array(out.tolist(), float).ravel())

    tracker = lamp.LampTracker((12, 12), *THETA)
    with mock.patch.object(lamp._kernels, "lamp_wave", noted):
        waves = list(tracker.push(events))
    assert len(waves) > FIRST_BLOCK
    for values in fits[FIRST_BLOCK:]:
        one = dict(zip(NAMES, values, strict=True))
        left = max(one["left"] / max(one["number"], 1.0), 1e-12)
        explained = max(one["common"], 1e-12)
        yield np.array([explained / left, max(one["apart"], one["below"]) / explained,
                        np.hypot(one["cosine"], one["sine"])])


def reported(values: np.ndarray, evidence: float) -> np.ndarray:
    """Tell which blocks are taken for a lamp, shape (n, 3)."""
    return ((values[:, 0] > evidence) & (values[:, 1] < lamp._APART)
            & (values[:, 2] > lamp._LEAST))


def study(quick: bool) -> list[Found]:
    """Compare blocks under a lamp with blocks under steady light."""
    rpms = (60.8, 506.5) if quick else (30.4, 60.8, 101.3, 202.6, 506.5, 1013.0)
    seeds, seconds = ((1,), 1.5) if quick else ((1, 2, 3), 2.5)
    steady, lit = [], []
    for rpm in rpms:
        for seed in seeds:
            for scene in (RotatingPolarizer(rpm=rpm), RotatingPlate(rpm=rpm / 2)):
                steady += list(statistics(scene, seed, seconds))
                for hz in (50.0, 60.0):
                    lit += list(statistics(scene.flicker(hz, DEPTH), seed, seconds))
    none, some = np.array(steady), np.array(lit)
    # The largest evidence of steady light that the other two conditions let through.
    let_through = none[(none[:, 1] < lamp._APART) & (none[:, 2] > lamp._LEAST)]
    worst = float(let_through[:, 0].max(initial=0.0))
    found = float(reported(some, lamp._EVIDENCE).mean())
    if not quick:
        for share in (0.05, 0.5, 0.95):
            print(f"quantile {share}: steady {np.quantile(none, share, axis=0)}, "
                  f"lamp {np.quantile(some, share, axis=0)}")
    return [Found("reconstruct.lamp _EVIDENCE, largest of steady light", worst,
                  lamp._EVIDENCE, at_least=True),
            Found("share of a lamp's fits that _EVIDENCE, _APART, _LEAST report",
                  found, 0.5, at_most=True)]


if __name__ == "__main__":
    sys.exit(main(study))
