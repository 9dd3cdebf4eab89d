"""The three constants of guided demosaicing: tuned on some scenes, scored on others.

Tuned on made scenes of seeds 1 and 2, with 0 and 1 % noise; scored on seeds 101 and
102 and, where PDAVIS_TEST_DATA names a folder with a raw mosaic of a Sony IMX250MZR
(fruits_IMX250MZR.png), on its four channels binned 2x2 and 3x3, which lie at one place
and are the truth that is mosaiced again.
"""
from __future__ import annotations

import itertools
import os
import sys
from pathlib import Path

import numpy as np
from common import Found, main

from pdavis_cv import Layout, demosaic, mosaic
from pdavis_cv.tools.reproduce.demosaic import mosaic_of, score
from pdavis_cv.tools.reproduce.demosaic_scenes import MADE, make

LAYOUT = Layout.SONY
GRID = {"_FLOOR": (3e-4, 1e-3, 3e-3), "_ACROSS": (0.0, 0.1, 0.3),
        "_ADDITIVE": (0.3, 1.0, 3.0)}
NOISE = (0.0, 0.01)
"""Standard deviations over the mean sample."""


def sony(path: Path, factor: int) -> np.ndarray:
    """Return four channels (4, H, W) of a raw mosaic, binned; 1 = full scale."""
    import cv2

    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255
    height, width = (side // (2 * factor) * 2 for side in raw.shape)
    quad = demosaic(raw, LAYOUT)[:, :height * factor, :width * factor]
    return quad.reshape(4, height, factor, width, factor).mean((2, 4))


def made(seeds: tuple[int, ...], shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return made scenes by name."""
    return {f"{kind} {seed}": make(kind, shape, seed)
            for seed in seeds for kind in MADE}


def scores(truths: dict[str, np.ndarray], method: str, sigma: float) -> np.ndarray:
    """Return S0 dB, DoLP dB and AoP degrees of each scene, shape (scenes, 3)."""
    rows = []
    for truth in truths.values():
        clean = mosaic_of(truth, LAYOUT)
        noise = np.random.default_rng(7).standard_normal(clean.shape)
        noisy = clean + (sigma * clean.mean() * noise).astype(np.float32)
        rows.append(score(demosaic(noisy, LAYOUT, method), truth))
    return np.array(rows)


def gains(truths: dict[str, np.ndarray]) -> np.ndarray:
    """Return what guided is better by than bilinear, shape (noises x scenes, 3)."""
    return np.concatenate([scores(truths, "guided", sigma)
                           - scores(truths, "bilinear", sigma) for sigma in NOISE])


def merit(truths: dict[str, np.ndarray], values: tuple[float, ...]) -> float:
    """Return the mean gain of S0 and DoLP in dB with these constants."""
    kept = {name: getattr(mosaic, name) for name in GRID}
    try:
        for name, value in zip(GRID, values, strict=True):
            setattr(mosaic, name, value)
        return float(gains(truths)[:, :2].mean())
    finally:
        for name, value in kept.items():
            setattr(mosaic, name, value)


def study(quick: bool) -> list[Found]:
    """Search the grid, then score the constants as they stand."""
    shape = (64, 80) if quick else (260, 346)
    train = made((1,) if quick else (1, 2), shape)
    code = tuple(getattr(mosaic, name) for name in GRID)
    grid = [values for values in itertools.product(*GRID.values())
            if not quick or sum(a != b for a, b in zip(values, code, strict=True)) < 2]
    merits = {values: merit(train, values) for values in grid}
    if not quick:
        for values, each in merits.items():
            print(*(f"{name} {value:g}" for name, value in zip(
                GRID, values, strict=True)), f"{each:.2f} dB")
    held = made((101, 102), shape)
    folder = Path(os.environ.get("PDAVIS_TEST_DATA", ""))
    if not quick and (folder / "fruits_IMX250MZR.png").is_file():
        held |= {f"fruits 1/{k}": sony(folder / "fruits_IMX250MZR.png", k)
                 for k in (2, 3)}
    found = gains(held)
    if not quick:
        for name, row in zip(list(held) * len(NOISE), found, strict=True):
            print(f"{name}: S0 {row[0]:+.2f} dB, DoLP {row[1]:+.2f} dB, "
                  f"AoP {row[2]:+.2f} degrees")
    s0, dolp, aop = found.mean(0)
    return [
        Found("S0 and DoLP, dB that another set of constants would gain",
              max(merits.values()) - merits[code], 0.3, at_least=True),
        Found("held scenes: S0 better by, dB", s0, 2.5, at_most=True),
        Found("held scenes: DoLP better by, dB", dolp, 4.0, at_most=True),
        Found("held scenes: AoP better by, degrees", -aop, 1.0, at_most=True),
        Found("held scenes: the worst one's DoLP better by, dB", found[:, 1].min(),
              0.5, at_most=True),
    ]


if __name__ == "__main__":
    sys.exit(main(study))
