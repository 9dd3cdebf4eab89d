"""The supplement's optics: extinction ratio by wavelength, and during alignment."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.calibration.align import alignment
from pdavis_cv.calibration.sweep import fit_sweep, read_sweep
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import CHANNELS
from pdavis_cv.simulation import PRESETS, Camera, FlatLight, Optics

from .page import table
from .print_style import PAGE_IN, letters, new_figure
from .run import Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Point", "ShiftedOptics", "bench_figure", "bench_page", "columns",
           "expected_ratio", "points"]

FloatArray = NDArray[np.float64]

# 40 at 500 nm and the range, in steps of 20 nm, are the paper's; how the ratio falls to
# 700 nm is an assumption, as the paper gives its curve in a picture only.
_NM = np.arange(500.0, 701.0, 20.0)
_ASSUMED = 40.0, 25.0
_SHIFTS = np.linspace(0.0, 0.5, 11)
_STEP_DEG = 10.0  # the paper's is 5
_SIDE, _SECONDS, _DARK_SECONDS = 16, 0.2, 1.0


@dataclass(frozen=True, kw_only=True)
class ShiftedOptics(Optics):
    """A filter array that lies beside the pixels: each sees parts of its neighbours'.

    Parameters
    ----------
    shift : float
        Along a row, 0..1 of a pixel.
    """

    shift: float = 0.0

    def maps(self, seed: int, size: tuple[int, int], origin: tuple[int, int],
             full_size: tuple[int, int]) -> dict[str, FloatArray]:
        """Return what `Optics.maps` does, the responses mixed by area."""
        height, width = size
        maps = super().maps(seed, (height, width + 1), origin, full_size)
        whole = maps["analyser"]
        mixed = (1 - self.shift) * whole[:, :-1] + self.shift * whole[:, 1:]
        return {**{name: plane[:, :-1] for name, plane in maps.items()},
                "analyser": mixed}


def expected_ratio(kappa: float, shift: float) -> float:
    """Return the extinction ratio of an array that is shifted along a row.

    Neighbours' filters stand at 45 degrees to each other, at right angles in the plane
    of doubled angles: the contrast of parts 1 - x and x is kappa ((1 - x)^2 +
    x^2)^(1/2).
    """
    contrast = kappa * math.hypot(1 - shift, shift)
    return (1 + contrast) / (1 - contrast)


@dataclass(frozen=True)
class Point:
    """A measured extinction ratio beside the true one.

    Parameters
    ----------
    what : {"wavelength", "shift"}
    at : float
        nm, or part of a pixel.
    channel : str
        Angle of the filter, or ``"0/90"`` of a pair.
    ratio, true : float
    """

    what: str
    at: float
    channel: str
    ratio: float
    true: float


def columns() -> tuple[str, ...]:
    """Names of the columns."""
    return tuple(field.name for field in dataclasses.fields(Point))


def points(settings: Settings) -> Iterator[Point]:
    """Measure the wavelength series and the alignment."""
    preset, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    some = slice(None, None, 5 if settings.quick else 1)
    for nm in _NM[some]:
        ratio = float(np.interp(nm, _NM[[0, -1]], _ASSUMED))
        yield from _by_sweep(_camera(preset, seed, dataclasses.replace(
            PRESETS[preset]["optics"], extinction_ratio=ratio)), float(nm))
    for shift in _SHIFTS[some]:
        base = PRESETS[preset]["optics"]
        yield from _by_alignment(_camera(preset, seed, ShiftedOptics(
            **dataclasses.asdict(base) | {"layout": base.layout},
            shift=float(shift))), float(shift))


def _camera(preset: str, seed: int, optics: Optics) -> Camera:
    return Camera.preset(
        preset, seed=seed, size=(_SIDE, _SIDE), optics=optics, dvs=None)


def _angles() -> FloatArray:
    return np.asarray(np.deg2rad(np.arange(0.0, 180.0, _STEP_DEG)), np.float64)


def _dark(camera: Camera) -> NDArray[np.float32]:
    recording, _ = camera.record(FlatLight(s0=0.0), _DARK_SECONDS)
    frames = [frame.dn for p in recording.packets() for frame in p.frames]
    return np.asarray(np.mean(frames, 0), np.float32)


def _by_sweep(camera: Camera, nm: float) -> Iterator[Point]:
    """Fit Malus's law, as the paper, after a dark frame is subtracted."""
    steps = [(float(angle), camera.record(FlatLight(dolp=1.0, aop=float(angle)),
                                          _SECONDS, run=run)[0])
             for run, angle in enumerate(_angles())]
    fit = fit_sweep(read_sweep(steps, dark=_dark(camera)))
    for angle, place in zip(CHANNELS, camera.layout.places, strict=True):
        part = np.s_[place // 2::2, place % 2::2]
        yield Point("wavelength", nm, f"{angle}",
                    float(np.median(fit.extinction_ratio[part])),
                    float(np.median(camera.maps["extinction_ratio"][part])))


def _by_alignment(camera: Camera, shift: float) -> Iterator[Point]:
    """Take the largest ratio of each pair over the polarizer's angles.

    They are the filters' own and those that the mixing turns the pairs' axes to.
    """
    dark = _dark(camera)
    turned = math.atan2(shift, 1 - shift) / 2
    angles = (np.deg2rad(CHANNELS) + np.array([[-turned], [0.0], [turned]])).reshape(-1)
    frames: list[ApsFrame] = []
    for run, angle in enumerate(angles):
        recording, _ = camera.record(
            FlatLight(dolp=1.0, aop=float(angle)), _SECONDS, run=run)
        frames += [frame for p in recording.packets() for frame in p.frames]
    ratios = np.array([row.ratio for row in alignment(
        frames, camera.layout, dark=dark)])
    ratio = camera.optics.extinction_ratio
    true = expected_ratio((ratio - 1) / (ratio + 1), shift)
    for pair, found in zip(("0/90", "45/135"), ratios.max(0), strict=True):
        yield Point("shift", shift, pair, float(found), true)


def bench_page(found: Sequence[Point]) -> list[str]:
    """Return the Markdown of both series."""
    lines = ["# optics", "",
             f"Simulated bench: a polarizer in steps of {_STEP_DEG:g} degrees, "
             f"{_SIDE} x {_SIDE} pixels, dark frames subtracted. Of the true ratio "
             "the paper's text states 40 at 500 nm; that it falls to 25 at 700 nm is "
             "assumed, as no published curve was found in numbers: the series tests "
             "the measurement, not the filters. An "
             "array that lies beside the pixels by a part of a pixel mixes "
             "neighbours: theory is (1 + c) / (1 - c), c = kappa ((1 - x)^2 + "
             "x^2)^(1/2).", ""]
    for what, title in (("wavelength", "nm"), ("shift", "shift, pixels")):
        mine = [point for point in found if point.what == what]
        names = list(dict.fromkeys(point.channel for point in mine))
        rows = []
        for at in dict.fromkeys(point.at for point in mine):
            here = {point.channel: point for point in mine if point.at == at}
            rows.append([f"{at:g}", *(f"{here[name].ratio:.1f} / {here[name].true:.1f}"
                                      for name in names)])
        lines += [f"## Extinction ratio, measured / true, by {title}", "",
                  *table((title, *names), rows)]
    worst = {what: max(abs(point.ratio / point.true - 1) for point in found
                       if point.what == what) for what in ("wavelength", "shift")}
    return [*lines, "## Beside the paper", "", *table(("quantity", "paper", "here"), [
        ("ER at 500 nm", "about 40", ", ".join(
            f"{point.ratio:.1f}" for point in found
            if (point.what, point.at) == ("wavelength", 500.0))),
        ("ER by wavelength", "measured, a picture",
         f"within {100 * worst['wavelength']:.1f} % of what was simulated"),
        ("ER while aligning", "watched until constant",
         f"within {100 * worst['shift']:.1f} % of theory")])]


def bench_figure(found: Sequence[Point]) -> Figure:
    """Draw measured extinction ratios as points over the true ones as lines."""
    drawing = new_figure(PAGE_IN, 2.9)
    panels = drawing.subplots(1, 2)
    letters(panels)
    for axes, what, label in zip(panels, ("wavelength", "shift"), (
            "wavelength (nm)", "array off by (pixels)"), strict=True):
        mine = [point for point in found if point.what == what]
        names = list(dict.fromkeys(point.channel for point in mine))
        for name, marker in zip(names, "osv^", strict=False):
            here = [point for point in mine if point.channel == name]
            axes.plot([point.at for point in here], [point.ratio for point in here],
                      marker, label=f"{name}°", markerfacecolor="none")
        _draw_truth(axes, what, mine)
        axes.set_xlabel(label)
        axes.set_ylabel("extinction ratio")
        axes.set_ylim(bottom=0)
        axes.legend(title="measured, filters at", title_fontsize=7)
    return drawing


def _draw_truth(axes: Any, what: str, mine: Sequence[Point]) -> None:
    if what == "wavelength":
        axes.plot(_NM[[0, -1]], _ASSUMED, color="black", label="truth (mean of pixels)")
        return
    kappa = (mine[0].true - 1) / (mine[0].true + 1)
    shifts = np.linspace(0, _SHIFTS[-1], 100)
    axes.plot(shifts, [expected_ratio(kappa, float(x)) for x in shifts],
              color="black", label="theory")
