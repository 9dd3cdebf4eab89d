"""`LastingDegree`: how many frames it remembers, and how sure a degree has to be.

A polarizer turns before specimens that no score uses, some of which lose events: the
degree lasts.  Unpolarized texture moves before others: any degree is apparent.  The
memory is to be as good as half and twice of it. A polarizer must gain, texture must not
suffer, and neither must a degree that swings, fast or slowly, far or little; how sure a
degree must be was chosen on a real recording, by `pdavis score`.
"""
from __future__ import annotations

import sys
from unittest import mock

import numpy as np
from common import Found, main

from lab.scoring import Scorer
from pdavis_cv import fuse
from pdavis_cv.reconstruct.kalman import lasting_degree
from pdavis_cv.simulation import FULL, Camera, FunctionScene, RotatingPolarizer, Texture

SIZE, SECONDS = (12, 12), 1.5
SPEEDS_RPM = 30.4, 202.6
SWINGS = tuple((swing, hz) for swing in (0.02, 0.1, 0.3) for hz in (0.3, 2.0))
MEMORIES, MULTIPLES = (5, 10, 20), (5.0, 10.0, 20.0)


def recorded(seed: int, rpm: float):
    """Return recordings and their truth: a polarizer, the same with lost events."""
    scene = RotatingPolarizer(rpm=rpm, start_angle=0.5 * seed)
    return [Camera.preset("nominal", seed=seed, size=SIZE, **faults).record(
        scene, SECONDS) for faults in ({}, {"faults": {"lost": 0.1}})]


def swinging(seed: int, swing: float, hz: float):
    """Return a recording and its truth: an angle that turns, a degree that swings."""
    def light(t, x, y):
        total = np.full(np.broadcast(t, x, y).shape, FULL)
        degree = 0.6 + swing * np.sin(2e-6 * np.pi * hz * t)
        twice = 2 * (2e-6 * np.pi * SPEEDS_RPM[1] / 60 * t + 0.5 * seed)
        return total, total * degree * np.cos(twice), total * degree * np.sin(twice)

    return Camera.preset("nominal", seed=seed, size=SIZE).record(
        FunctionScene(light, sampling_us=1000), SECONDS)


def degree_error(recordings) -> float:
    """Return the mean DoLP error of live and of buffered images."""
    errors = []
    for recording, truth in recordings:
        for options in ({"causal": True}, {}):
            scorer = Scorer(truth, (SIZE[0] // 2, SIZE[1] // 2))
            for image in fuse(
                    recording, method="kalman", demosaic="superpixel",
                    times_us=np.arange(1_000_000, 1_440_000, 10_151),
                    nominal_thresholds=(0.16, 0.18), **options):
                scorer.add(image)
            errors.append(scorer.score.dolp_error)
    return float(np.mean(errors))


def texture_error(recording, truth) -> float:
    """Return the root mean squared error of log intensity behind each polarizer."""
    squares = []
    y, x = np.indices(SIZE)
    for image in fuse(recording, method="kalman", causal=True,
                      times_us=np.arange(1_000_000, 1_440_000, 10_151),
                      nominal_thresholds=(0.16, 0.18)):
        # Unpolarized: every channel is half of S0.
        light = truth.s0(image.t_us, x, y) / 2
        squares.append(np.mean(np.log(image.quad / light)**2))
    return float(np.sqrt(np.mean(squares)))


def unweighed(degree, light, variance, valid, workers) -> None:
    """Replace `LastingDegree.weigh`: each image's own degree stays."""


def study(quick: bool) -> list[Found]:
    """Print errors by memory and by multiple; the code's are held to be good ones."""
    seeds = (21,) if quick else (21, 22, 23, 24)
    turning = [one for seed in seeds for rpm in SPEEDS_RPM[:1 if quick else 2]
               for one in recorded(seed, rpm)]
    moving = [Camera.preset("nominal", seed=seed, size=SIZE).record(
        Texture(velocity=(120.0, 35.0), seed=seed, dolp=0.0,
                dolp_spread=0.0), SECONDS)
        for seed in seeds]
    memories = {}
    for frames in MEMORIES:
        with mock.patch.object(lasting_degree, "FRAMES", frames):
            memories[frames] = degree_error(turning)
        print(f"memory of {frames} frames: DoLP error {memories[frames]:.4f}")
    with mock.patch.object(lasting_degree.LastingDegree, "weigh", unweighed):
        without = degree_error(turning)
        still = [texture_error(*one) for one in moving]
    print(f"without: DoLP error {without:.4f}, texture {np.mean(still):.4f}")
    swings = []
    for swing, hz in SWINGS[1::2] if quick else SWINGS:
        recordings = [swinging(seed, swing, hz) for seed in seeds[:2]]
        with mock.patch.object(lasting_degree.LastingDegree, "weigh", unweighed):
            plain = degree_error(recordings)
        swings.append(degree_error(recordings) / plain)
        print(f"swing of {swing:g} at {hz:g} Hz: DoLP error {plain:.4f} without, x "
              f"{swings[-1]:.3f}")
    gains, losses = {}, {}
    for multiple in (lasting_degree.SURE,) if quick else MULTIPLES:
        with mock.patch.object(lasting_degree, "SURE", multiple):
            gains[multiple] = degree_error(turning) / without
            losses[multiple] = max(
                texture_error(*one) / before
                for one, before in zip(moving, still, strict=True))
        print(f"{multiple:g} sigma: DoLP error x {gains[multiple]:.3f}, unpolarized "
              f"texture x {losses[multiple]:.4f} at most")
    sure = lasting_degree.SURE
    return [
        Found("DoLP error with the code's FRAMES over the least of three",
              memories[lasting_degree.FRAMES] / min(memories.values()), 1.1,
              at_least=True),
        Found("DoLP error with the code's SURE over that without", gains[sure], 0.85,
              at_least=True),
        Found("DoLP error of degrees that swing over that without", max(swings), 1.02,
              at_least=True),
        Found("error of unpolarized texture over that without", losses[sure], 1.002,
              at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
