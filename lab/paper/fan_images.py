"""Figure 4a as pictures: the fan at two speeds, a line per method, truth above."""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analysis import axial_difference
from pdavis_cv.fusion import fuse
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.render import aop_bgr, fade
from pdavis_cv.simulation import FULL, Camera, Fan

from . import run as runs
from .network import all_weights
from .page import table
from .print_style import PAGE_IN, letters, look, new_figure
from .run import OFF_LOCK, SONY_FULL, Settings, Take, fuse_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_NETWORKS = ("firenet", "joint")
_LEFT_OUT = ("kalman offline", "Sony 75 fps")
"""Which look like another line."""
_RPMS = (200.0, 1000.0)
_SIDE, _QUICK_SIDE = 96, 48
_AT_S, _AFTER_S = 0.6, 0.1
"""When the picture is taken: frames have come, and there is a future to look at."""
_PLACES = 180
"""Along the circle."""
_SHARP = 3.0
"""Degrees from a sector's edge within which the profile is left out."""


@dataclass(frozen=True)
class View:
    """One method's image of the fan.

    Parameters
    ----------
    method : str
        ``"truth"``, or a method.
    rpm : float
    i0, aop, dolp : ndarray of float, shape (H, W)
        Light behind 0 degrees, DN per ms or what the method gives; radians; NaN where
        not valid.
    around_deg, along_deg, true_deg : ndarray of float, shape (N,)
        Places on a circle half way to the rim, AoP there, and the true one.
    sigma_deg, error_deg : ndarray of float, shape (H, W), or empty
        Uncertainty of AoP as the method states it, and the true error; NaN at sectors'
        edges and outside.
    """

    method: str
    rpm: float
    i0: NDArray[np.floating[Any]]
    aop: NDArray[np.floating[Any]]
    dolp: NDArray[np.floating[Any]]
    around_deg: NDArray[np.float64]
    along_deg: NDArray[np.float64]
    true_deg: NDArray[np.float64]
    sigma_deg: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    error_deg: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))


def fan_views(settings: Settings) -> Iterator[View]:
    """Record the fan and yield truth and methods, speed by speed."""
    side = _QUICK_SIDE if settings.quick else _SIDE
    preset, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    at_us = round(1e6 * _AT_S)
    for rpm in settings.rpms or _RPMS:
        takes: dict[str, tuple[Take, Fan, Camera]] = {}
        for name in ("truth", *_shown(settings)):
            method = runs.METHODS.get(name, runs.Method(parameters={"method": name}))
            maker = method.preset or preset
            if maker not in takes:
                takes[maker] = _record(maker, method, side, seed, rpm)
            take, fan, camera = takes[maker]
            circle = _Circle(fan, camera, take.truth, at_us)
            yield (_truth(rpm, fan, camera, circle, at_us) if name == "truth"
                   else _view(name, rpm, take, circle, at_us, fuse_parameters(
                       method, runs.Case(scene="fan", light=lambda s0: Fan(rpm=0),
                                         rpm=rpm, camera=preset))))


def count(settings: Settings) -> int:
    """Return how many images `fan_views` yields."""
    return len(settings.rpms or _RPMS) * (1 + len(_shown(settings)))


def _shown(settings: Settings) -> list[str]:
    return [name for name in (*runs.METHODS, *_NETWORKS) if name in settings.methods
            and "own times" not in name and name not in _LEFT_OUT]


def _record(preset: str, method: runs.Method, side: int, seed: int, rpm: float
            ) -> tuple[Take, Fan, Camera]:
    camera = Camera.preset(preset, seed=seed, size=(side, side), **method.changes)
    row, column = camera.origin
    fan = Fan(rpm=rpm * OFF_LOCK, radius=0.48 * side, hub=0.08 * side,
              s0=SONY_FULL if method.preset else FULL,
              centre=(column + (side - 1) / 2, row + (side - 1) / 2))
    recording, truth = camera.record(fan, _AT_S + _AFTER_S)
    return Take(recording, truth, 0, truth.stop_us), fan, camera


_NEAR = 0.06
"""Part of the circle's radius within which the true AoP must be one."""


class _Circle:
    """Places of the image on a circle half way to the rim, and the AoP there."""

    def __init__(self, fan: Fan, camera: Camera, truth: Any, at_us: int) -> None:
        angle = np.arange(_PLACES) * 2 * np.pi / _PLACES
        radius = (fan.radius + fan.hub) / 2
        row, column = camera.origin
        self._x = fan.centre[0] - column + radius * np.cos(angle)
        self._y = fan.centre[1] - row - radius * np.sin(angle)
        self.around_deg = np.rad2deg(angle)
        true = truth.aop(at_us, self._x, self._y)
        spread = [np.abs(axial_difference(true, truth.aop(
            at_us, self._x + radius * dx, self._y + radius * dy)))
            for dx in (-_NEAR, _NEAR) for dy in (-_NEAR, _NEAR)]
        edge = np.max(spread, 0) > math.radians(_SHARP)
        self.true_deg = np.where(edge, np.nan, np.rad2deg(true) % 180)

    def along_deg(self, aop: NDArray[np.floating[Any]], scale: float
                  ) -> NDArray[np.float64]:
        """Return the AoP of the nearest pixels, degrees."""
        y, x = (np.clip(np.rint((place + 0.5) / scale - 0.5).astype(np.int64), 0,
                        side - 1)
                for place, side in zip((self._y, self._x), aop.shape, strict=True))
        return np.asarray(np.rad2deg(aop[y, x]) % 180, np.float64)


def _truth(rpm: float, fan: Fan, camera: Camera, circle: _Circle, at_us: int) -> View:
    y, x = np.mgrid[:camera.size[0], :camera.size[1]]
    s0, s1, s2 = fan.stokes(at_us, x + camera.origin[1], y + camera.origin[0])
    return View("truth", rpm, (s0 + s1) / 2, np.arctan2(s2, s1) / 2 % np.pi,
                np.hypot(s1, s2) / s0, circle.around_deg, circle.true_deg,
                circle.true_deg)


def _view(name: str, rpm: float, take: Take, circle: _Circle, at_us: int,
          parameters: Mapping[str, Any]) -> View:
    options = dict(parameters)
    if name in _NETWORKS:
        # windows of a 25th of a sector's passage, 1 ms or more
        options |= {"weights": all_weights(())[name],
                    "window_us": max(1000, round(60e6 / rpm / 6 / 25))}
    image = next(iter(fuse(take.recording, times_us=[at_us], demosaic="superpixel",
                           **options)))
    aop = np.where(image.valid, image.aop, np.nan)
    i0, dolp = (np.where(image.valid, plane, np.nan)
                for plane in (image.quad[0], image.dolp))
    if name in runs.METHODS and not runs.METHODS[name].gives_dolp:
        dolp = np.full_like(dolp, np.nan)
    return View(name, rpm, i0, aop, dolp, circle.around_deg,
                circle.along_deg(aop, 2.0), circle.true_deg,
                *_uncertainty(image, take.truth, at_us))


_SURE_DOLP = 0.97
"""Of the light: less of it means that sectors mix."""


def _uncertainty(image: PolarFrame, truth: Any, at_us: int
                 ) -> tuple[NDArray[np.float64], ...]:
    """Return stated sigma and error of AoP, degrees, nothing where none is stated."""
    if image.sigma_aop is None:
        return ()
    y, x = (2 * place + 0.5 for place in np.indices(image.shape))
    about = np.linspace(-1, 1, 5)       # an edge is a pixel wide
    sure = image.valid & np.all([truth.dolp(at_us, x + dx, y + dy) > _SURE_DOLP
                                 for dx in about for dy in about], axis=0)
    off = np.abs(axial_difference(
        image.aop.astype(np.float64), truth.aop(at_us, x, y)))
    return tuple(np.where(sure, np.rad2deg(plane), np.nan)
                 for plane in (image.sigma_aop, off))


# ---- what is written and drawn ---------------------------------------------------


PROFILE_COLUMNS = ("rpm", "method", "around_deg", "aop_deg", "true_aop_deg")


def profile_rows(views: Sequence[View]) -> Iterator[tuple[Any, ...]]:
    """Yield AoP along the circle of every method and speed."""
    for view in views:
        for place, found, true in zip(
                view.around_deg, view.along_deg, view.true_deg, strict=True):
            yield view.rpm, view.method, place, found, true


def fan_images_page(views: Sequence[View]) -> list[str]:
    """Return the Markdown: the error along the circle, by half and speed."""
    speeds = list(dict.fromkeys(view.rpm for view in views))
    lines = ["# fan", "", "A wheel of six polarizers, 30 degrees apart, its left half "
             "lit 2000 times more; median error of AoP in degrees / part valid, of "
             "single super-pixels on a circle half way to the rim, away from the "
             "sectors' edges: right (dark) half; left (bright) half. One image of each "
             f"method, {_AT_S:g} s after the beginning.", ""]
    rows = []
    for name in dict.fromkeys(view.method for view in views):
        mine = {view.rpm: view for view in views if view.method == name}
        if name != "truth":
            rows.append([name, *("; ".join(
                _half(mine[rpm], bright) for bright in (False, True))
                for rpm in speeds)])
    return [*lines, *table(("method", *(f"{rpm:g} RPM" for rpm in speeds)), rows),
            *_beside(views)]


_SEEN = 15.0
"""Degrees: half a sector's step; within it the sectors are told apart."""


def _beside(views: Sequence[View]) -> list[str]:
    """Set the paper's words on the halves beside what is seen."""
    slow = min(view.rpm for view in views)
    here = {view.method: [_middle_of(view, bright)[0] for bright in (False, True)]
            for view in views if view.rpm == slow and view.method != "truth"}

    def told(names: Sequence[str]) -> str:
        return "; ".join(f"{name} " + " and ".join(
            "none" if math.isnan(error) else f"{error:.1f}" for error in here[name])
            for name in names)

    sony = [name for name in here if name.startswith("Sony")]
    fused = [name for name in here
             if not name.startswith("Sony") and name != "frames"]
    blind = [name for name in fused
             if not all(error < _SEEN for error in here[name])]
    rows = []
    if sony:
        rows.append((
            f"Sony at {slow:g} RPM, dark and bright half, degrees",
            "motion blur; saturated in the bright half, no AoP", told(sony),
            "agrees" if all(not here[name][1] < _SEEN for name in sony) else
            "differs"))
    if fused:
        rows.append((
            f"methods that use events at {slow:g} RPM, the same",
            "AoP in both lighting conditions, sharp", told(fused),
            "agrees" if not blind else f"agrees, but for {', '.join(blind)}: held to "
            "frames, which are saturated there"))
    return ["## Beside the paper", "", *table(("quantity", "paper", "here", ""), rows)]


def _half(view: View, bright: bool) -> str:
    """Return median error / part valid of a half of the circle, as text."""
    middle, valid = _middle_of(view, bright)
    return f"{'-' if math.isnan(middle) else f'{middle:.1f}'} / {valid:.2f}"


def _middle_of(view: View, bright: bool) -> tuple[float, float]:
    """Return median error (NaN if nothing is valid) and part valid of a half."""
    left = np.cos(np.deg2rad(view.around_deg)) < 0
    counted = (left == bright) & np.isfinite(view.true_deg)
    off = np.abs(np.rad2deg(axial_difference(
        np.deg2rad(view.along_deg), np.deg2rad(view.true_deg))))[counted]
    valid = np.isfinite(off)
    return float(np.median(off[valid])) if valid.any() else math.nan, valid.mean()


def views_figure(views: Sequence[View]) -> Figure:
    """Draw I0, AoP faded by DoLP, and DoLP: a line per method.

    I0 is logarithmic, each picture to its own range: where frames saturate, events
    tell how light changes but not how bright it is.
    """
    from matplotlib import colormaps

    ramps = {name: colormaps[name].with_extremes(bad="0.38")
             for name in ("gray", "viridis")}
    speeds = list(dict.fromkeys(view.rpm for view in views))
    names = list(dict.fromkeys(view.method for view in views))
    drawing = new_figure(PAGE_IN, min(9.6, 1.0 + 1.08 * len(names)))
    places = drawing.add_gridspec(len(names) + 1, 3 * len(speeds),
                                  height_ratios=(*[1] * len(names), 0.12))
    grid = np.array([[drawing.add_subplot(places[y, x])
                      for x in range(3 * len(speeds))] for y in range(len(names))])
    by_name = {(view.method, view.rpm): view for view in views}
    for line, name in zip(grid, names, strict=True):
        for k, rpm in enumerate(speeds):
            view = by_name[name, rpm]
            three = line[3 * k:3 * k + 3]
            log = np.log10(np.maximum(view.i0, 1e-6))
            low, high = np.nanquantile(log, (0.01, 0.99))
            three[0].imshow(log, cmap=ramps["gray"], vmin=low, vmax=high)
            three[1].imshow(_faded(view))
            shown = three[2].imshow(view.dolp, cmap=ramps["viridis"], vmin=0, vmax=1)
            if name == names[0]:
                for n, title in enumerate(("I0, log", "AoP", "DoLP")):
                    three[n].set_title(f"{title}\n{rpm:g} RPM")
                    three[n].annotate("abcdef"[3 * k + n], (0, 1), (0, 14), va="bottom",
                                      xycoords="axes fraction", fontweight="bold",
                                      textcoords="offset points")
        for axes in line:
            axes.set_xticks([])
            axes.set_yticks([])
            axes.grid(visible=False)
        line[0].set_ylabel(name.replace(", ", ",\n"), rotation=0, ha="right",
                           va="center")
    width = 3 * len(speeds) // 3
    _keys(drawing, [drawing.add_subplot(places[-1, n * width:(n + 1) * width])
                    for n in range(3)], shown)
    return drawing


def _faded(view: View) -> NDArray[np.uint8]:
    """Return AoP as RGB, black where the light is not polarized, grey if not valid."""
    valid = np.isfinite(view.aop)
    picture = aop_bgr(np.nan_to_num(view.aop), valid)
    if np.isfinite(view.dolp).any():
        fade(picture, np.nan_to_num(view.dolp), valid)
    return picture[..., ::-1]


def _keys(drawing: Figure, places: Sequence[Any], shown: Any) -> None:
    """Draw what the colours mean."""
    angle, dolp, none = places
    hues = aop_bgr(np.linspace(0, np.pi, 181)[None])[..., ::-1]
    angle.imshow(hues, aspect="auto", extent=(0, 180, 0, 1))
    angle.set(xticks=(0, 45, 90, 135, 180), yticks=(), xlabel="AoP (degrees)")
    angle.grid(visible=False)
    drawing.colorbar(shown, cax=dolp, orientation="horizontal", label="DoLP")
    none.set_axis_off()
    none.text(0, 1, "AoP is black where DoLP is 0.\nGrey: not valid, or no DoLP.",
              va="top")


def uncertainty_figure(views: Sequence[View]) -> Figure | None:
    """Draw the uncertainty of AoP that methods state beside its error.

    None if there is no such method.
    """
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm

    stated = [view for view in views if view.sigma_deg.size]
    if not stated:
        return None
    speeds = list(dict.fromkeys(view.rpm for view in stated))
    names = list(dict.fromkeys(view.method for view in stated))
    drawing = new_figure(PAGE_IN, 0.9 + 1.55 * len(names))
    grid = drawing.subplots(len(names), 2 * len(speeds), squeeze=False)
    letters(grid[0])
    ramp = colormaps["cividis"].with_extremes(bad="0.8")
    for view in stated:
        y, k = names.index(view.method), 2 * speeds.index(view.rpm)
        part = np.nanmean(view.error_deg < view.sigma_deg, where=np.isfinite(
            view.error_deg))
        for axes, plane, title in (
                (grid[y, k], view.sigma_deg, f"sigma, {view.rpm:g} RPM"),
                (grid[y, k + 1], view.error_deg, "error")):
            shown = axes.imshow(np.maximum(plane, 0.1), cmap=ramp,
                                norm=LogNorm(0.1, 30))
            axes.set(xticks=(), yticks=())
            axes.grid(visible=False)
            if y == 0:
                axes.set_title(title)
        grid[y, k + 1].set_xlabel(f"{100 * part:.0f} % within sigma")
    for axes, name in zip(grid[:, 0], names, strict=True):
        axes.set_ylabel(name.replace(", ", ",\n"), rotation=0, ha="right", va="center")
    drawing.colorbar(shown, ax=grid, location="bottom", fraction=0.05, aspect=50,
                     format="{x:g}", label="AoP (degrees); honest: 68 % within sigma")
    return drawing


def profiles_figure(views: Sequence[View]) -> Figure:
    """Draw the error of AoP along the circle: a line of panels per method."""
    speeds = list(dict.fromkeys(view.rpm for view in views))
    names = [name for name in dict.fromkeys(view.method for view in views)
             if name != "truth"]
    drawing = new_figure(PAGE_IN, 0.7 + 0.8 * len(names))
    grid = drawing.subplots(len(names), len(speeds), sharex=True, sharey=True,
                            squeeze=False)
    for view in views:
        if view.method == "truth":
            continue
        axes = grid[names.index(view.method), speeds.index(view.rpm)]
        off = np.rad2deg(axial_difference(
            np.deg2rad(view.along_deg), np.deg2rad(view.true_deg)))
        axes.axvspan(90, 270, color="0.92", linewidth=0)
        axes.plot(view.around_deg, off, linestyle="none", marker=".", markersize=2,
                  color=look(view.method).get("color", "black"))
        axes.set_ylim(-95, 95)
        axes.set_yticks((-90, 0, 90))
        if view.method == names[0]:
            axes.set_title(f"{view.rpm:g} RPM")
        if view.method == names[-1]:
            axes.set_xticks((0, 90, 180, 270, 360))
            axes.set_xlabel("place on the circle (degrees); grey: the bright half")
    letters(grid[0])
    for axes, name in zip(grid[:, 0], names, strict=True):
        axes.set_ylabel(name.replace(", ", ",\n"), rotation=0, ha="right", va="center")
    drawing.suptitle("error of AoP along a circle half way to the rim (degrees)")
    return drawing
