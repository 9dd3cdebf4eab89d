"""The supplement's dynamic range: of which angles, out of 180, AoP is right."""
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analysis import axial_difference
from pdavis_cv.fusion import fuse
from pdavis_cv.simulation import Camera, RotatingPolarizer

from . import run as runs
from .light import EVENT_DN, HIGH_UW_CM2, LOW_UW_CM2, SONY_DN
from .network import all_weights
from .page import table
from .print_style import PAGE_IN, letters, look, new_figure
from .run import OFF_LOCK, Case, Settings, fuse_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure


RPM = 60.0
"""The paper's."""
RIGHT_DEG = 10.0
"""An angle is right within this: the paper's bound for events to 1000 RPM."""
_NEARLY_FULL_DEG = 160.0
_IMAGES = 100  # of a turn, in which AoP goes round twice
_SONY_SIDE, _SIDE = 40, 24  # the paper's region has 40 x 40 pixels
_WINDOW_US = 20_000  # of the network: 25 of a cycle of 500 ms
# The Sony costs little: below the paper's range too, where its noise ends it.
_SONY_LOW_UW_CM2, _SONY_LEVELS = 0.0004, 33
_SONY_HIGH_UW_CM2 = 300.0  # the paper's
_SONY = "Sony 50 fps, own times"
_METHODS = (_SONY, "frames, own times", "events, redundancy", "kalman", "firenet")


@dataclass(frozen=True)
class Level:
    """One method in one irradiance, of the mean of the region.

    Parameters
    ----------
    camera, method : str
    irradiance_uw_cm2 : float
    span_deg : float
        Largest less smallest AoP: the paper's axis, blind to errors.
    right_deg : float
        180 times the part of the angles that are within `RIGHT_DEG` of the true one.
    error_deg : float
        Mean absolute error.
    """

    camera: str
    method: str
    irradiance_uw_cm2: float
    span_deg: float
    right_deg: float
    error_deg: float


def _cases(settings: Settings) -> list[tuple[str, str, float]]:
    """Return camera, method and irradiance of what is done."""
    shown = [name for name in _METHODS if name in settings.methods]
    every = np.geomspace(LOW_UW_CM2, HIGH_UW_CM2, 5 if settings.quick else 13)
    sony = np.geomspace(_SONY_LOW_UW_CM2, HIGH_UW_CM2, _SONY_LEVELS)
    cameras = settings.cameras or (
        ("nominal",) if settings.quick else ("nominal", "realistic"))
    return [("sony", _SONY, float(level)) for level in sony if _SONY in shown] + [
        (camera, name, float(level)) for camera in cameras for level in every
        for name in shown if name != _SONY]


def count(settings: Settings) -> int:
    """Return how many `levels` yields."""
    return len(_cases(settings))


def levels(settings: Settings) -> Iterator[Level]:
    """Record the turning polarizer in each irradiance and follow its angle."""
    made: tuple[Any, Any] = None, None
    for preset, name, irradiance in _cases(settings):
        if made[0] != (preset, irradiance):
            made = (preset, irradiance), _take(preset, irradiance, settings.seeds[0])
        yield level_of(made[1], preset, name, irradiance)


def _take(preset: str, irradiance: float, seed: int) -> runs.Take:
    sony = preset == "sony"
    side = _SONY_SIDE if sony else _SIDE
    camera = Camera.preset(preset, seed=seed, size=(side, side))
    scene = RotatingPolarizer(
        rpm=RPM * OFF_LOCK, s0=irradiance * (SONY_DN if sony else EVENT_DN))
    seconds = (runs.SETTLE_US + runs.TAIL_US + 60e6 / RPM) / 1e6
    recording, truth = camera.record(scene, seconds)
    return runs.Take(recording, truth, 0, truth.stop_us)


def level_of(take: runs.Take, preset: str, name: str, irradiance: float) -> Level:
    """Follow a region's AoP for a turn."""
    method = runs.METHODS.get(name, runs.Method(parameters={"method": name}))
    case = Case(scene="polarizer", light=lambda s0: RotatingPolarizer(rpm=0), rpm=RPM,
                camera=preset)
    options = fuse_parameters(method, case)
    if name == "firenet":
        options |= {"weights": all_weights(())[name], "window_us": _WINDOW_US}
    stop = take.settled_us + 60e6 / (RPM * OFF_LOCK)
    when: dict[str, Any] = (
        {"start_us": take.settled_us, "stop_us": round(stop)} if method.own_times else
        {"times_us": np.linspace(take.settled_us, stop, _IMAGES, endpoint=False
                                 ).astype(np.int64)})
    times, stokes = [], []
    for image in fuse(take.recording, demosaic="superpixel", **when, **options):
        times.append(image.t_us)
        # As the paper: of frames all samples count, too dim and saturated ones as well,
        # since choosing them by their noise would bias the mean.
        counted = np.ones_like(image.valid) if method.own_times else image.valid
        stokes.append([plane[counted].mean(dtype=np.float64) if counted.any()
                       else math.nan for plane in (image.s1, image.s2)])
    s1, s2 = np.array(stokes, np.float64).T
    return _measured(preset, name, irradiance, np.arctan2(s2, s1) / 2 % np.pi,
                     take.truth.aop(np.array(times), 0, 0))


def _measured(preset: str, name: str, irradiance: float,
              found: NDArray[np.float64], true: NDArray[np.float64]) -> Level:
    seen = np.isfinite(found)
    off = np.abs(np.rad2deg(axial_difference(found, true)))
    span = np.ptp(np.rad2deg(found[seen])) if seen.any() else 0.0
    return Level(preset, name, irradiance, float(span),
                 180 * float((off < RIGHT_DEG).mean()),
                 float(off[seen].mean()) if seen.any() else math.nan)


def decibels(lines: Sequence[Level]) -> tuple[float, float, float]:
    """Return the ends (uW/cm2) and 20 log10 of the widest range that is nearly right.

    Levels next to each other whose ``right_deg`` exceeds 160; beyond the last of them,
    to where a straight line over the log of irradiance falls below.
    """
    ordered = sorted(lines, key=lambda line: line.irradiance_uw_cm2)
    log = np.log([line.irradiance_uw_cm2 for line in ordered])
    right = np.array([line.right_deg for line in ordered])
    good = np.flatnonzero(right > _NEARLY_FULL_DEG)
    if not len(good):
        return math.nan, math.nan, -math.inf
    groups = np.split(good, np.flatnonzero(np.diff(good) > 1) + 1)
    widest = max(groups, key=len)
    ends = [_crossing(log, right, int(widest[0]), -1),
            _crossing(log, right, int(widest[-1]), 1)]
    low, high = np.exp(ends)
    return float(low), float(high), 20 * math.log10(high / low)


def _crossing(log: NDArray[np.float64], right: NDArray[np.float64], at: int, step: int
              ) -> float:
    beyond = at + step
    if not 0 <= beyond < len(log):
        return float(log[at])
    part = (right[at] - _NEARLY_FULL_DEG) / (right[at] - right[beyond])
    return float(log[at] + part * (log[beyond] - log[at]))


def span_page(lines: Sequence[Level]) -> list[str]:
    """Return the Markdown: angles that are right, by irradiance; the range in dB."""
    page = ["# range", "",
            f"A polarizer at {RPM:g} RPM, AoP of the mean of a region ({_SIDE} x "
            f"{_SIDE} pixels, Sony {_SONY_SIDE} x {_SONY_SIDE}), a full turn. *Right*: "
            f"180 times the part of the angles within {RIGHT_DEG:g} degrees of truth. "
            "Frames at their own times. *Span* is the paper's axis: largest less "
            "smallest angle, which noise fills as well as light does.", ""]
    summary = []
    for camera, name in dict.fromkeys((line.camera, line.method) for line in lines):
        mine = [line for line in lines if (line.camera, line.method) == (camera, name)]
        low, high, range_db = decibels(mine)
        summary.append((f"{name}, `{camera}`", _stated(name),
                        _told(low, high, range_db), _because(name)))
        page += [f"## {name}, `{camera}`", "", *table(
            ("uW/cm2", *(f"{line.irradiance_uw_cm2:.3g}" for line in mine)), [
                ("right", *(f"{line.right_deg:.0f}" for line in mine)),
                ("span", *(f"{line.span_deg:.0f}" for line in mine)),
                ("error", *(f"{line.error_deg:.1f}" for line in mine))])]
    return [*page, "## Beside the paper", "", *table(
        ("range in which 160 of 180 degrees are right", "paper", "here", ""), summary)]


def _told(low: float, high: float, range_db: float) -> str:
    if math.isnan(low):
        return "nowhere"
    return f"{_power(low)} to {_power(high)}: {range_db:.1f} dB"


def _power(uw_cm2: float) -> str:
    if uw_cm2 < 1:
        return f"{1000 * uw_cm2:.3g} nW/cm2"
    return f"{uw_cm2:.3g} uW/cm2" if uw_cm2 < 1000 else f"{uw_cm2 / 1000:.3g} mW/cm2"


def _stated(name: str) -> str:
    if name == _SONY:
        return "40 nW/cm2 to 300 uW/cm2: 77.5 dB"
    return "network: 40 nW/cm2 to 42 mW/cm2, 120 dB" if name == "firenet" else "-"


def _because(name: str) -> str:
    if name == _SONY:
        return ("lower end: from its noise; upper end differs because samples that "
                "begin to be clipped, from 300 uW/cm2 on (so is its sensitivity "
                f"chosen), still point within {RIGHT_DEG:g} degrees, and the paper "
                "counts to there")
    if name.startswith("frames"):
        return "20 ms: samples are clipped from 1.4 uW/cm2 on"
    return "ends are those of what was simulated"


# Where the paper has the angle: camera, ends in uW/cm2, place of the bar, colour, dB.
_STATED = (("Sony", LOW_UW_CM2, _SONY_HIGH_UW_CM2, 0.02, "#777777", 77.5),
           ("PDAVIS, network", LOW_UW_CM2, HIGH_UW_CM2, 0.07, "#B15928", 120.0))


def span_figure(lines: Sequence[Level]) -> Figure:
    """Draw angles that are right, the paper's span, and the error, by irradiance."""
    panels = (("right_deg", "angles right (of 180 degrees)"),
              ("span_deg", "span of AoP (degrees)"),
              ("error_deg", "AoP error, region (degrees)"))
    cameras = [name for name in dict.fromkeys(line.camera for line in lines)
               if name != "sony"] or ["sony"]
    drawing = new_figure(PAGE_IN, 0.9 + 2.2 * len(cameras))
    grid = drawing.subplots(len(cameras), len(panels), squeeze=False)
    letters(grid.reshape(-1))
    for row, camera in zip(grid, cameras, strict=True):
        shown = [line for line in lines if line.camera in (camera, "sony")]
        for axes, (column, label) in zip(row, panels, strict=True):
            if column != "error_deg":
                axes.axhline(180, color="0.78", linewidth=3, label="truth", zorder=0)
                axes.set(ylim=(-8, 192), yticks=(0, 45, 90, 135, 180))
            for place, name in enumerate(dict.fromkeys(
                    line.method for line in shown)):
                _draw_levels(axes, name, column, place,
                             [line for line in shown if line.method == name])
            axes.set_xscale("log")
            axes.set_xlabel("irradiance (µW/cm²)")
            axes.set_ylabel(label)
            if column == "error_deg":
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter("{x:g}")
            if column == "right_deg":
                for name, low, high, at, colour, range_db in _STATED:
                    axes.axvspan(low, high, ymin=at - 0.02, ymax=at + 0.02,
                                 color=colour, linewidth=0,
                                 label=f"paper, {name}: {range_db:g} dB")
        row[1].set_title(f"{camera} camera" if len(cameras) > 1 else "")
    drawing.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center",
                   ncols=4)
    return drawing


def _draw_levels(axes: Any, name: str, column: str, place: int,
                 mine: Sequence[Level]) -> None:
    """Draw a method with hollow marks on every other level, so that all are seen."""
    step = 4 if name == _SONY else 1
    axes.plot([line.irradiance_uw_cm2 for line in mine],
              [getattr(line, column) for line in mine], label=name,
              markevery=(place % step, step), markerfacecolor="none",
              **{**look(name), "markersize": 3.5 + 0.8 * place})
