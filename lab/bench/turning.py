"""A camera behind a turning analyser, the case `turning`."""
from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion.iteration import fuse
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.open import open_recording
from pdavis_cv.turning import TurningAnalyser

from .cases import Comparison, case
from .event_files import write_evt3

__all__: list[str] = []

SIZE, RATE, FPS = (480, 640), 5_000_000, 50
ANALYSER, THETA = TurningAnalyser(rpm=600), 0.25
KINDS, STEP_US = 512, 50
"""Pixels that are simulated; each stands at many places."""


def _second() -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return events of a second, and the AoP of pixels, NaN where no event is.

    Some pixels, anywhere on the sensor, see polarized light, the others none.
    """
    rng = np.random.default_rng(6)
    aop, dolp = rng.uniform(0, np.pi, KINDS), rng.uniform(0.3, 0.5, KINDS)
    _, twice, per_us = ANALYSER.segments()[0]
    t = np.arange(0, 1_000_000, STEP_US)
    light = np.log(1 + dolp * np.cos(twice + per_us * t[:, None] - 2 * aop)) / THETA
    level, change = light[0] + rng.uniform(-0.5, 0.5, KINDS), np.zeros(light.shape)
    for now, steps in zip(light, change, strict=True):
        np.trunc(now - level, out=steps)
        level += steps
    when, kind = np.nonzero(change)
    copies = RATE // len(when)
    place = rng.permutation(SIZE[0] * SIZE[1])[:copies * KINDS].reshape(copies, KINDS)
    events = np.empty((len(when), copies), EVENT_DTYPE)
    events["t"], events["p"] = t[when, None], change[when, kind][:, None] > 0
    events["y"], events["x"] = np.divmod(place.T[kind], SIZE[1])
    truth = np.full(SIZE, np.nan)
    truth.flat[place] = aop
    return events.ravel(), truth


def _images(path: Path) -> Iterator[PolarFrame]:
    with open_recording(path) as recording:
        yield from fuse(recording, fps=FPS, causal=True, analyser=ANALYSER,
                        thresholds=(THETA, THETA))


@case("turning", "a second behind a turning analyser, CPU time, against reading it", 8,
      by_time=True)
def _turning() -> Iterator[Comparison]:
    events, aop = _second()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.raw"
        write_evt3(path, events, SIZE)

        def check() -> None:
            *_, last = _images(path)
            error = np.angle(np.exp(2j * (last.aop - aop)))[last.valid] / 2
            assert np.array_equal(last.valid, np.isfinite(aop))
            assert np.rad2deg(np.median(np.abs(error))) < 2

        def candidate() -> float:
            start = process_time()
            assert sum(1 for _ in _images(path)) == FPS
            return process_time() - start

        def floor() -> float:
            start = process_time()
            with open_recording(path) as recording:
                for _ in recording.packets():
                    pass
            return process_time() - start

        yield Comparison(f"{len(events) / 1e6:.1f} Mev, {FPS} images",
                         check, candidate, floor, float, "s")
