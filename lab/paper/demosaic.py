"""Demosaicing: each method against four whole images, by scene, sensor and noise."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import Layout, Sensor, demosaic, stokes
from pdavis_cv.mosaic import DEMOSAIC_METHODS, HALF_SIZE

from .demosaic_scenes import MADE, four_angle_folder, make
from .page import table
from .print_style import PAGE_IN, new_figure
from .run import Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SENSORS = {"PDAVIS": Sensor.PDAVIS, "Sony": Sensor.SONY}
SNRS_DB = (np.inf, 40.0, 30.0)
"""Mean sample over the standard deviation of white noise; infinite: none."""
_BORDER = 6   # pixels: scores are of the inside, like the published ones


@dataclass(frozen=True)
class Score:
    """How far one method's image is from the truth."""

    scene: str
    sensor: str
    snr_db: float
    method: str
    s0_db: float
    """PSNR of S0; peak: the largest S0 of the scene."""
    dolp_db: float
    """PSNR of DoLP, clipped to 1; peak 1."""
    aop_deg: float
    """RMS error of AoP where the true DoLP exceeds .1."""


def scenes_of(settings: Settings) -> dict[str, NDArray[np.float32]]:
    """Return the scenes of the folders that were named, or else made ones."""
    if settings.scenes:
        return {name: quad for folder in settings.scenes
                for name, quad in four_angle_folder(Path(folder)).items()}
    shape = (64, 80) if settings.quick else (260, 346)
    return {name if len(settings.seeds) == 1 else f"{name} {seed}":
            make(name, shape, seed) for seed in settings.seeds for name in MADE}


def mosaic_of(
    quad: NDArray[np.float32], layout: Layout, extinction_ratio: float | None = None
) -> NDArray[np.float32]:
    """Return what a sensor sees of four whole images, behind its own polarizers."""
    if extinction_ratio is not None:
        contrast = np.float32((extinction_ratio - 1) / (extinction_ratio + 1))
        mean = quad.mean(0)
        quad = mean + contrast * (quad - mean)
    mosaic = np.empty(quad.shape[1:], np.float32)
    for plane, place in zip(quad, layout.places, strict=True):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = plane[row::2, column::2]
    return mosaic


def score(
    found: NDArray[np.float32], truth: NDArray[np.float32],
    extinction_ratio: float | None = None,
) -> tuple[float, float, float]:
    """Return PSNR of S0 and DoLP in dB, and the RMS error of AoP in degrees.

    Parameters
    ----------
    found : ndarray of float32, shape (4, H, W) or (4, H/2, W/2)
        Channels; images of half the size are compared with the mean of each cell.
    truth : ndarray of float32, shape (4, H, W)
        Channels behind ideal polarizers.
    extinction_ratio : float, optional
        Of the polarizers in front of what was found.
    """
    border = _BORDER
    height, width = found.shape[1:]
    if found.shape != truth.shape:
        border //= 2
        truth = truth.reshape(4, height, 2, width, 2).mean((2, 4))
    inside = np.s_[:, border:-border, border:-border]
    s0, s1, s2 = stokes(found[inside], extinction_ratio=extinction_ratio)
    true0, true1, true2 = stokes(truth[inside])
    dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-9)
    true = np.hypot(true1, true2) / np.maximum(true0, 1e-9)
    turn = (np.arctan2(s2, s1) - np.arctan2(true2, true1)) / 2
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2

    def psnr(error: NDArray[np.float32], peak: float) -> float:
        return float(10 * np.log10(peak**2 / max(float(np.mean(error**2)), 1e-20)))

    strong = true > 0.1
    return (psnr(s0 - true0, float(true0.max())),
            psnr(np.minimum(dolp, 1) - np.minimum(true, 1), 1.0),
            float(np.rad2deg(np.sqrt(np.mean(turn[strong]**2))))
            if strong.any() else float("nan"))


def demosaic_cases(settings: Settings) -> Iterator[Score]:
    """Score every method on every scene, sensor and noise."""
    for name, truth in scenes_of(settings).items():
        for sensor_name, sensor in SENSORS.items():
            ratio, layout = sensor.extinction_ratio, sensor.layout
            assert layout is not None
            clean = mosaic_of(truth, layout, ratio)
            for snr_db in SNRS_DB:
                rng = np.random.default_rng(7)
                noise = rng.standard_normal(clean.shape).astype(np.float32)
                sigma = clean.mean() * np.float32(10 ** (-snr_db / 20))
                for method in DEMOSAIC_METHODS:
                    found = demosaic(clean + sigma * noise, layout, method)
                    yield Score(name, sensor_name, snr_db, method,
                                *score(found, truth, ratio))


def _mean(rows: Sequence[Score], **where: object) -> list[str]:
    rows = [row for row in rows
            if all(getattr(row, key) == value for key, value in where.items())]
    return [f"{np.nanmean([getattr(row, key) for row in rows]):.2f}"
            for key in ("s0_db", "dolp_db", "aop_deg")]


def demosaic_page(rows: Sequence[Score]) -> list[str]:
    """Return the page as lines of Markdown."""
    scenes = list(dict.fromkeys(row.scene for row in rows))
    whole = [name for name in DEMOSAIC_METHODS if name not in HALF_SIZE]
    lines = ["# Demosaicing", "",
             "PSNR of S0 (peak: the scene's largest) and of DoLP (peak 1) in dB, RMS "
             "error of AoP in degrees where DoLP exceeds .1; the two methods with one "
             "pixel per cell against the mean over the cell. Noise is white; its level "
             "is the mean sample over its standard deviation.", ""]
    for sensor in SENSORS:
        lines += [f"## {sensor}, mean of {len(scenes)} scenes", ""]
        lines += table(
            ["method", *(f"{'no noise' if np.isinf(snr) else f'{snr:.0f} dB'}: S0 / "
                         "DoLP / AoP" for snr in SNRS_DB)],
            ([method, *(" / ".join(_mean(rows, sensor=sensor, snr_db=snr,
                                         method=method)) for snr in SNRS_DB)]
             for method in DEMOSAIC_METHODS))
    lines += ["## By scene, Sony, no noise", ""]
    lines += table(
        ["scene", *(f"{method}: S0 / DoLP / AoP" for method in whole)],
        ([scene, *(" / ".join(_mean(rows, scene=scene, sensor="Sony", snr_db=np.inf,
                                    method=method)) for method in whole)]
         for scene in scenes))
    return lines


def demosaic_figure(settings: Settings) -> Figure:
    """Draw crops of S0, DoLP and AoP of the first scene: truth and two methods."""
    name, truth = next(iter(scenes_of(settings).items()))
    layout = Layout.SONY
    mosaic = mosaic_of(truth, layout)
    height, width = mosaic.shape
    side = min(64, height - 12, width - 12)
    top, left = (height - side) // 2, (width - side) // 2
    crop = np.s_[:, top:top + side, left:left + side]
    shown = {"truth": truth[crop]} | {
        method: demosaic(mosaic, layout, method)[crop]
        for method in ("bilinear", "guided")}
    figure = new_figure(PAGE_IN, PAGE_IN)
    grid = figure.subplots(3, 3)
    white = float(truth[crop].sum(0).max()) / 2
    for row, (label, quad) in zip(grid, shown.items(), strict=True):
        s0, s1, s2 = stokes(np.ascontiguousarray(quad))
        aop = np.rad2deg(np.arctan2(s2, s1) / 2) % 180
        dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-9)
        for axes, picture, title, colours, most in (
                (row[0], s0, "S0", "gray", white), (row[1], dolp, "DoLP", "magma", 0.8),
                (row[2], aop, "AoP", "hsv", 180)):
            axes.imshow(picture, cmap=colours, vmin=0, vmax=most,
                        interpolation="nearest")
            axes.set_title(f"{label}: {title}")
            axes.set_axis_off()
    figure.suptitle(f"{name}, {side}x{side} pixels, Sony's layout, no noise")
    return figure
