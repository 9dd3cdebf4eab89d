"""The supplement's optics: extinction ratio by wavelength, and during alignment."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.calibration.sweep import fit_sweep, read_sweep
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import CHANNELS, Layout
from pdavis_cv.simulation import FULL, PRESETS, Camera, FlatLight, Optics

from .page import table
from .print_style import PAGE_IN, letters, new_figure
from .run import SONY_FULL, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FloatArray = NDArray[np.float64]

PUBLISHED: Mapping[str, tuple[tuple[float, float, str], ...]] = {
    "PDAVIS": ((500.0, 40.0, "the paper"),
               (700.0, 95.0, "[Gruev 2011], an array with wires as high and wide")),
    "sony": ((430.0, 425.0, "Sony's flyer, quoted"), (500.0, 350.0, "the paper"),
             (525.0, 300.0, "Sony's flyer, quoted")),
}
"""Wavelength in nm, extinction ratio, source: all that was found in numbers."""
# The paper's range, in steps of 20 nm, and the Sony's published one.
_NM: Mapping[str, NDArray[np.float64]] = {
    "PDAVIS": np.arange(500.0, 701.0, 20.0), "sony": np.linspace(430.0, 525.0, 11)}
_SHIFTS = np.linspace(0.0, 0.5, 11)
_STEP_DEG = 10.0  # the paper's is 5
_SIDE, _SECONDS, _DARK_SECONDS = 16, 0.2, 1.0
_SONY_SECONDS = 2.0  # the paper's 100 frames: the least light is a 400th of the most


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
    camera : {"PDAVIS", "sony"}
    at : float
        nm, or part of a pixel.
    channel : str
        Angle of the filter, or ``"0/90"`` of a pair.
    ratio, true : float
    """

    what: str
    camera: str
    at: float
    channel: str
    ratio: float
    true: float


def published_ratio(camera: str, nm: float) -> float:
    """Return the published extinction ratio, between two wavelengths on a log line."""
    known = PUBLISHED[camera]
    return float(np.exp(np.interp(nm, [one[0] for one in known],
                                  np.log([one[1] for one in known]))))


def points(settings: Settings) -> Iterator[Point]:
    """Measure the wavelength series and the alignment."""
    preset, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    some = slice(None, None, 5 if settings.quick else 1)
    for camera, name in (("PDAVIS", preset), ("sony", "sony")):
        for nm in _NM[camera][some]:
            yield from _by_sweep(camera, _camera(name, seed, dataclasses.replace(
                PRESETS[name]["optics"],
                extinction_ratio=published_ratio(camera, float(nm)))), float(nm))
    for shift in _SHIFTS[some]:
        base = PRESETS[preset]["optics"]
        yield from _by_alignment(_camera(preset, seed, ShiftedOptics(
            **dataclasses.asdict(base) | {"layout": base.layout},
            shift=float(shift))), float(shift))


def _camera(preset: str, seed: int, optics: Optics) -> Camera:
    return Camera.preset(
        preset, seed=seed, size=(_SIDE, _SIDE), optics=optics, dvs=None)


def _dark(camera: Camera) -> NDArray[np.float32]:
    recording, _ = camera.record(FlatLight(s0=0.0), _DARK_SECONDS)
    frames = [frame.dn for p in recording.packets() for frame in p.frames]
    return np.asarray(np.mean(frames, 0), np.float32)


def _by_sweep(name: str, camera: Camera, nm: float) -> Iterator[Point]:
    """Fit Malus's law, as the paper, after a dark frame is subtracted.

    Not of the Sony: its samples stop at 0, so that the mean of dark ones is too high.
    """
    s0, seconds, dark = (FULL, _SECONDS, _dark(camera)) if name == "PDAVIS" else (
        SONY_FULL, _SONY_SECONDS, None)
    steps = [(float(angle), camera.record(
        FlatLight(s0=s0, dolp=1.0, aop=float(angle)), seconds, run=run)[0])
        for run, angle in enumerate(np.deg2rad(np.arange(0.0, 180.0, _STEP_DEG)))]
    fit = fit_sweep(read_sweep(steps, dark=dark))
    for angle, place in zip(CHANNELS, camera.layout.places, strict=True):
        part = np.s_[place // 2::2, place % 2::2]
        yield Point("wavelength", name, nm, f"{angle}",
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
    ratios = np.array([_pair_ratios(frame.dn - dark, camera.layout)
                       for frame in frames])
    ratio = camera.optics.extinction_ratio
    true = expected_ratio((ratio - 1) / (ratio + 1), shift)
    for pair, found in zip(("0/90", "45/135"), ratios.max(0), strict=True):
        yield Point("shift", "PDAVIS", shift, pair, float(found), true)


def _pair_ratios(dn: NDArray[np.float32], layout: Layout) -> list[float]:
    """Return the brighter over the darker sum of the 0/90 and of the 45/135 pixels."""
    sums = [float(dn[place // 2::2, place % 2::2].sum(dtype=np.float64))
            for place in layout.places]
    return [max(pair) / max(min(pair), 1e-9) for pair in (sums[::2], sums[1::2])]


_TITLES = (("wavelength", "PDAVIS", "nm, PDAVIS"), ("wavelength", "sony", "nm, Sony"),
           ("shift", "PDAVIS", "shift, pixels"))


def bench_page(found: Sequence[Point]) -> list[str]:
    """Return the Markdown of the series."""
    sources = {camera: "; ".join(f"{ratio:g} at {nm:g} nm ({source})"
                                 for nm, ratio, source in known)
               for camera, known in PUBLISHED.items()}
    lines = ["# optics", "",
             f"Simulated bench: a polarizer in steps of {_STEP_DEG:g} degrees, "
             f"{_SIDE} x {_SIDE} pixels, dark frames subtracted (not of the Sony, "
             "which cuts them off at 0). True ratios are published ones, on a line of "
             f"their logarithm between. PDAVIS: {sources['PDAVIS']}. Sony: "
             f"{sources['sony']}. The paper's own curve is a picture. An "
             "array that lies beside the pixels by a part of a pixel mixes "
             "neighbours: theory is (1 + c) / (1 - c), c = kappa ((1 - x)^2 + "
             "x^2)^(1/2).", ""]
    worst = {}
    for what, camera, title in _TITLES:
        mine = [point for point in found
                if (point.what, point.camera) == (what, camera)]
        names = list(dict.fromkeys(point.channel for point in mine))
        rows = []
        for at in dict.fromkeys(point.at for point in mine):
            here = {point.channel: point for point in mine if point.at == at}
            rows.append([f"{at:g}", *(f"{here[name].ratio:.1f} / {here[name].true:.1f}"
                                      for name in names)])
        lines += [f"## Extinction ratio, measured / true, by {title}", "",
                  *table((title, *names), rows)]
        worst[title] = 100 * max(abs(point.ratio / point.true - 1) for point in mine)
    at_500 = [point.ratio for point in found
              if (point.what, point.camera, point.at) == ("wavelength", "PDAVIS", 500)]
    head = ("quantity", "paper", "here", "")
    return [*lines, "## Beside the paper", "", *table(head, [
        ("ER at 500 nm", "about 40", ", ".join(f"{ratio:.1f}" for ratio in at_500),
         "agrees" if max(abs(ratio / 40 - 1) for ratio in at_500) < 0.05 else
         "differs"),
        *((f"ER by wavelength, {name}", stated,
           f"within {worst[title]:.1f} % of the true one", _agrees(worst[title]))
          for name, title, stated in (
              ("PDAVIS", "nm, PDAVIS", "measured, a picture"),
              ("Sony", "nm, Sony", "350 at 500 nm"))),
        ("ER while aligning", "watched until constant",
         f"within {worst['shift, pixels']:.1f} % of theory",
         _agrees(worst["shift, pixels"]))])]


def _agrees(percent: float) -> str:
    return "agrees with what was simulated" if percent < 5 else "differs"


_MARKS = (("o", "#0072B2"), ("s", "#E69F00"), ("v", "#009E73"), ("^", "#D55E00"))


def bench_figure(found: Sequence[Point]) -> Figure:
    """Draw measured extinction ratios as points over the true ones as lines."""
    drawing = new_figure(PAGE_IN, 2.9)
    panels = drawing.subplots(1, len(_TITLES))
    letters(panels)
    for axes, (what, camera, title) in zip(panels, _TITLES, strict=True):
        mine = [point for point in found
                if (point.what, point.camera) == (what, camera)]
        _draw_truth(axes, what, camera, mine)
        names = list(dict.fromkeys(point.channel for point in mine))
        for name, (marker, colour) in zip(names, _MARKS, strict=False):
            here = [point for point in mine if point.channel == name]
            axes.plot([point.at for point in here], [point.ratio for point in here],
                      marker, label=f"measured, {name}°", markerfacecolor="none",
                      color=colour)
        axes.set_xlabel("wavelength (nm)" if what == "wavelength" else
                        "array off by (pixels)")
        axes.set_ylabel("extinction ratio")
        rises = (what, camera) == ("wavelength", "PDAVIS")
        axes.set_ylim(0, (1.5 if rises else 1.05) * axes.get_ylim()[1])
        axes.set_title(title.split(", ")[1] if what == "wavelength" else "alignment")
        axes.legend(loc="upper left" if rises else "lower left" if camera == "sony"
                    else "upper right")
    return drawing


def _draw_truth(axes: Any, what: str, camera: str, mine: Sequence[Point]) -> None:
    if what == "wavelength":
        known = PUBLISHED[camera]
        nm = np.linspace(known[0][0], known[-1][0], 100)
        axes.plot(nm, [published_ratio(camera, float(one)) for one in nm],
                  color="black", label="truth, mean of pixels")
        axes.plot([one[0] for one in known], [one[1] for one in known], "D",
                  color="black", markersize=5, label="published")
        return
    kappa = (mine[0].true - 1) / (mine[0].true + 1)
    shifts = np.linspace(0, _SHIFTS[-1], 100)
    axes.plot(shifts, [expected_ratio(kappa, float(x)) for x in shifts],
              color="black", label="theory")
