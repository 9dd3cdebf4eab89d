"""Mosaics of colours, and images at known angles, against polanalyser on the same data.

Made scenes in front of a simulated IMX250MYR without noise: their four channels times
a tint of each colour that follows their regions.  Errors are of S0, DoLP and AoP of
each colour; times of a mosaic of 2448x2048 and 16 bits to S0, DoLP and AoP of each
colour, the median of pairs.  Then 6 images of 2448x2048 and 16 bits at known angles:
the difference of the results, and times to S0, DoLP and AoP.  Without polanalyser (pip
install polanalyser) our own errors are compared with those of bilinear interpolation.
"""
from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
from common import Found, main
from scipy import fft, ndimage

from lab.paper.demosaic import score
from lab.paper.demosaic_scenes import MADE, make
from pdavis_cv import AnalyserSteps, Layout, demosaic, polarization

LAYOUT = Layout.of("sony-rggb")
AXES = np.deg2rad([0, 45, 90, 135])
GAINS = (0.6, 1.0, 0.5)


def coloured(kind: str, shape: tuple[int, int], seed: int) -> np.ndarray:
    """Return the channels (3, 4, H, W) of a made scene in colour."""
    quad = make(kind, shape, seed)
    region = ndimage.median_filter(np.log(np.maximum(quad.sum(0), 0.02)), 9)
    tint = [gain * np.exp(0.4 * np.sin(2 * region + 2.1 * c))
            for c, gain in enumerate(GAINS)]
    return np.asarray(np.stack(tint)[:, None] * quad, np.float32)


def mosaic_of(channels: np.ndarray) -> np.ndarray:
    """Return what the sensor sees, 16 bits."""
    y, x = np.indices(channels.shape[2:])
    colour = np.array(["RGB".index(c) for c in LAYOUT.colours]).reshape(4, 4)
    angle = np.array(LAYOUT.angles_deg) // 45
    seen = channels[colour[y % 4, x % 4], angle[y % 2, x % 2], y, x]
    return np.asarray(np.rint(seen * 40_000), np.uint16)


def theirs(mosaic: np.ndarray) -> np.ndarray:
    """Return channels (3, 4, H, W) by polanalyser."""
    import polanalyser as pa

    found = pa.demosaicing(mosaic, pa.COLOR_PolarRGB)
    return np.moveaxis(np.stack(found), (3, 0), (0, 1))[::-1].astype(np.float32)


def their_images(mosaic: np.ndarray) -> None:
    """Make S0, DoLP and AoP of each colour as polanalyser's guide does."""
    import polanalyser as pa

    found = pa.calcStokes(pa.demosaicing(mosaic, pa.COLOR_PolarRGB), AXES)
    pa.cvtStokesToIntensity(found)
    pa.cvtStokesToDoLP(found)
    pa.cvtStokesToAoLP(found)


def our_images(method: str) -> Callable[[np.ndarray], None]:
    """Return what makes S0, DoLP and AoP of each colour, and of all together."""
    def made(mosaic: np.ndarray) -> None:
        image = polarization(mosaic, LAYOUT, method)
        for one in image.colours.values():
            _ = one.aop, one.dolp, one.s0

    return made


def slower(method: str, pairs: int, shape: tuple[int, int]) -> float:
    """Return the median of their time over ours, in turns."""
    mosaic = mosaic_of(coloured("waves", (64, 64), 1))
    mosaic = np.tile(mosaic, (shape[0] // 64, shape[1] // 64))
    ratios = []
    for _ in range(pairs):
        seconds = []
        for work in (their_images, our_images(method)):
            begun = time.perf_counter()
            work(mosaic)
            seconds.append(time.perf_counter() - begun)
        ratios.append(seconds[0] / seconds[1])
    return statistics.median(ratios)


def stepped(pairs: int, shape: tuple[int, int]) -> tuple[float, float]:
    """Return their time over ours, and the largest difference of S0, relative."""
    import polanalyser as pa

    angles = np.pi * np.arange(6) / 6
    images = np.random.default_rng(0).integers(0, 60_000, (6, *shape)).astype(np.uint16)
    ratios, steps = [], AnalyserSteps(tuple(angles))
    for _ in range(pairs):
        begun = time.perf_counter()
        stokes = pa.calcStokes(images, angles)
        s0 = pa.cvtStokesToIntensity(stokes)
        pa.cvtStokesToDoLP(stokes)
        pa.cvtStokesToAoLP(stokes)
        middle = time.perf_counter()
        image = steps.polarization(images)
        _ = image.aop, image.dolp, image.s0
        ratios.append((middle - begun) / (time.perf_counter() - middle))
    return statistics.median(ratios), float(np.abs(image.s0 / s0 - 1).max())


def ideal(plane: np.ndarray, kept: Callable[[Any, Any], Any]) -> float:
    """Return PSNR of S0 within the frequencies that samples alone carry, in dB."""
    waves = fft.dctn(plane, norm="ortho")
    y, x = (np.arange(n) / (2 * n) for n in plane.shape)
    off = (fft.idctn(waves * kept(y[:, None], x), norm="ortho") - plane)[6:-6, 6:-6]
    return float(10 * np.log10(plane[6:-6, 6:-6].max()**2 / np.mean(off**2)))


def ideals(shape: tuple[int, int]) -> tuple[float, float]:
    """Return `ideal` of a colour's samples, and of a monochrome mosaic's cells."""
    def square(step: int) -> Callable[[Any, Any], Any]:
        return lambda y, x: np.maximum(y, x) <= 0.5 / step

    kept = square(4), lambda y, x: y + x <= 0.25, square(4)
    planes = [coloured(kind, shape, 101).sum(1) for kind in MADE]
    colour = [ideal(*one) for three in planes for one in zip(three, kept, strict=True)]
    mono = [ideal(one, square(2)) for three in planes for one in three]
    return float(np.mean(colour)), float(np.mean(mono))


def errors(shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return S0 dB, DoLP dB and AoP degrees, the means of scenes and colours."""
    methods: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        name: lambda mosaic, name=name: demosaic(mosaic, LAYOUT, name) / 40_000
        for name in ("bilinear", "guided")}
    if find_spec("polanalyser"):
        methods["polanalyser"] = lambda mosaic: theirs(mosaic) / 40_000
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in methods}
    for kind in MADE:
        channels = coloured(kind, shape, 101)
        mosaic = mosaic_of(channels)
        for name, method in methods.items():
            rows[name] += [score(np.asarray(one, np.float32), truth) for one, truth in
                           zip(method(mosaic), channels, strict=True)]
    return {name: np.mean(found, 0) for name, found in rows.items()}


def study(quick: bool) -> list[Found]:
    """Compare errors, and times where polanalyser is installed."""
    found = errors((64, 80) if quick else (260, 346))
    for name, (s0, dolp, aop) in found.items():
        print(f"{name}: S0 {s0:.1f} dB, DoLP {dolp:.1f} dB, AoP {aop:.2f} degrees")
    colour, mono = ideals((64, 80) if quick else (260, 346))
    print(f"S0, ideal: of a colour's samples {colour:.1f} dB, monochrome {mono:.1f} dB")
    other = found.get("polanalyser", found["bilinear"])
    better = found["guided"] - other
    lines = [
        Found("guided: S0 better by, dB", better[0], 3.0, at_most=True),
        Found("guided: DoLP better by, dB", better[1], 4.0, at_most=True),
        Found("guided: AoP better by, degrees", -better[2], 3.0, at_most=True),
        Found("bilinear: AoP worse by, degrees", found["bilinear"][2] - other[2], 0.2,
              at_least=True)]
    if "polanalyser" in found and not quick:
        lines += [Found(f"{method}: times as fast as polanalyser",
                        slower(method, 15, (2048, 2432)), least, at_most=True)
                  for method, least in (("bilinear", 5.0), ("guided", 5.0))]
        ratio, off = stepped(15, (2048, 2448))
        lines += [Found("steps: times as fast as polanalyser", ratio, 4.0,
                        at_most=True),
                  Found("steps: relative difference of S0", off, 1e-5, at_least=True)]
    return lines


if __name__ == "__main__":
    sys.exit(main(study))
