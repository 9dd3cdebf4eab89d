"""The table of silences in pixel/silences.py, from simulated cameras.

    python lab/studies/silences.py          (five seconds)

36 cameras, seeds 1 to 36, of four presets and nine scenes.  A silence that is open when
an image is made is looked at again when its end is known: what had passed is regressed
on what was known, as in `learned_silences`, over all cameras together.
"""
from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from pdavis_cv import _kernels
from pdavis_cv.pixel.model import CONTEXTS, RATIOS, PixelModel
from pdavis_cv.pixel.sample import PixelSample
from pdavis_cv.simulation import Camera, RotatingPolarizer, Texture

SIZE = (12, 12)
SCENES = [("polarizer", rpm, dolp) for rpm, dolp in (
    (30, 1.0), (120, 0.6), (500, 1.0), (60, 0.3), (400, 0.4))] + [
    ("texture", speed, 1.0) for speed in (60, 300, 150, 200)]
PRESETS = ("nominal", "realistic", "hard", "davis346")
AHEAD_US = (0, 50_000)
RIDGE, MOST, EVENTS = 10.0, 4000, 1000.0


def scene(kind: str, speed: float, dolp: float, seed: int):
    """Return a scene of a kind, by RPM and DoLP or by pixels per second."""
    if kind == "polarizer":
        return RotatingPolarizer(rpm=1.013 * speed, dolp=dolp, start_angle=0.5 * seed)
    return Texture(velocity=(speed, 0.3 * speed), seed=seed)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table of each look-ahead; with --quick, of a third of the cameras."""
    quick = "--quick" in (sys.argv[1:] if argv is None else argv)
    size = 2 * CONTEXTS * RATIOS
    square, right = np.zeros((2, size, size)), np.zeros((2, size))
    model = PixelModel(theta=np.array([0.2, 0.2]), rest_s=0.25)
    cameras = [(preset, one) for preset in PRESETS for one in SCENES]
    cameras = cameras[::3 if quick else 1]
    for seed, (preset, one) in enumerate(cameras, 1):
        recording, _ = Camera.preset(preset, seed=seed, size=SIZE).record(
            scene(*one, seed), 2.2)
        sample = PixelSample(recording.info.sensor_size)
        for packet in recording.packets():
            if len(packet.events):
                sample.add_events(packet.events)
        data = sample.sampled().with_past(model.numbers)
        rng = np.random.default_rng(seed)
        pixels = np.flatnonzero(np.diff(data.start) >= 4).astype(np.int32)
        times = rng.integers(data.t[0], data.t[-1], 200)
        for i, ahead in enumerate(AHEAD_US):
            rows, target = np.zeros((MOST, size)), np.zeros(MOST)
            n = _kernels.learning_silences(
                data.events, data.start, rng.permutation(pixels), times, ahead,
                model.numbers, rows, target)
            if n < 50:
                continue
            x, weight = rows[:n], min(EVENTS, len(data.t)) / n
            if not ahead:
                x[:, size // 2:] = 0        # s = 1: no bow
            square[i] += weight * x.T @ x
            right[i] += weight * x.T @ target[:n]
    for i, ahead in enumerate(AHEAD_US):
        table = np.linalg.solve(square[i] + RIDGE * np.eye(size), right[i])
        print(f"    {ahead}: (")
        for row in table.reshape(-1, RATIOS):
            print("        " + ", ".join(f"{value:.3f}" for value in row) + ",")
        print("    ),")
    return 0


if __name__ == "__main__":
    sys.exit(main())
