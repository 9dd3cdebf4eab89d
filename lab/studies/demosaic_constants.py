"""The constants of guided demosaicing: tuned on some scenes, scored on others.

Tuned on made scenes of seeds 1 and 2, with 0 and 1 % noise; scored on seeds 101 and
102 and, where PDAVIS_TEST_DATA names a folder with raw mosaics of a Sony IMX250MZR
(fruits_IMX250MZR.png, camera_IMX250MZR.png), on their four channels binned 2x2 and 3x3,
which lie at one place and are the truth that is mosaiced again.
"""
from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from common import Found, main

from lab.paper.demosaic import mosaic_of, score
from lab.paper.demosaic_scenes import MADE, make
from pdavis_cv import Layout, demosaic, mosaic

LAYOUT = Layout.SONY
GRID = {"floor": (3e-4, 1e-3, 3e-3), "across": (0.1, 0.3, 1.0),
        "gain": (0.0, 1.0, 2.0, 3.0, 4.0), "most": (1.0, 2.0, 3.0),
        "additive": (0.3, 1.0, 3.0), "noise": (0.0, 1.75, 3.5, 7.0)}
"""Of the constants, the values tried: one by one, the others as they stand."""
RAWS = ("fruits_IMX250MZR.png", "camera_IMX250MZR.png")
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


def merit(truths: dict[str, np.ndarray], name: str, value: float) -> float:
    """Return the mean gain of S0 and DoLP in dB with this value of a constant."""
    constants, kept = mosaic._GUIDED, mosaic._GUIDED.copy()
    try:
        constants[name] = value
        return float(gains(truths)[:, :2].mean())
    finally:
        constants[:] = kept


def study(quick: bool) -> list[Found]:
    """Try each constant's values, then score the constants as they stand."""
    shape = (64, 80) if quick else (260, 346)
    train = made((1,) if quick else (1, 2), shape)
    now = float(gains(train)[:, :2].mean())
    merits = {(name, value): merit(train, name, value)
              for name, values in GRID.items() for value in values}
    held = made((101, 102), shape)
    folder = Path(os.environ.get("PDAVIS_TEST_DATA", ""))
    if not quick:
        for (name, value), each in merits.items():
            print(f"{name} {value:g}: {each:.2f} dB")
        held |= {f"{raw.split('_')[0]} 1/{k}": sony(folder / raw, k)
                 for raw in RAWS for k in (2, 3) if (folder / raw).is_file()}
    found = gains(held)
    if not quick:
        names = [f"{name}, noise {sigma:g}" for sigma in NOISE for name in held]
        for name, row in zip(names, found, strict=True):
            print(f"{name}: S0 {row[0]:+.2f} dB, DoLP {row[1]:+.2f} dB, "
                  f"AoP {row[2]:+.2f} degrees")
    s0, dolp, aop = found.mean(0)
    return [
        Found("S0 and DoLP, dB that another value of one constant would gain",
              max(merits.values()) - now, 0.3, at_least=True),
        Found("held scenes: S0 better by, dB", s0, 2.5, at_most=True),
        Found("held scenes: DoLP better by, dB", dolp, 4.0, at_most=True),
        Found("held scenes: AoP better by, degrees", -aop, 1.0, at_most=True),
        Found("held scenes: the worst one's DoLP better by, dB", found[:, 1].min(),
              0.3, at_most=True),
    ]


if __name__ == "__main__":
    sys.exit(main(study))
