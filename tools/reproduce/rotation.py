"""Figures 2 and 3: what turns in front of the camera, at 30 to 1000 RPM."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analysis.intervals import events_by_phase, pixel_intervals
from pdavis_cv.fusion import fuse
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.denoise import EventDenoiser
from pdavis_cv.simulation import (
    FlatLight,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
)

from .bound import Bound, frame_bound, optics_bound
from .page import mean, pivot, table
from .run import (
    METHODS,
    NETWORKS,
    OFF_LOCK,
    Case,
    Row,
    Settings,
    Takes,
    fuse_parameters,
    run,
)

__all__ = ["INTERVALS_US", "RPMS", "SCENES", "Comparison", "Rotation",
           "Spectrum", "Trace", "cases", "compare", "mean_traces", "page"]

RPMS = (30.0, 60.0, 100.0, 200.0, 500.0, 1000.0)
# A fixed plate along 0 or 45 degrees would leave two channels without a change.
_PLATE_AXIS = math.radians(15)
INTERVALS_US = 10 ** np.linspace(1, 7, 61)

Light = Callable[[float], Scene]


def _polarizer(rpm: float, start: float) -> Light:
    return lambda s0: RotatingPolarizer(rpm=rpm, start_angle=start, s0=s0)


def _plate(rpm: float, start: float) -> Light:
    return lambda s0: RotatingPlate(rpm=rpm, start_angle=start, s0=s0)


def _before_plate(rpm: float, start: float) -> Light:
    return lambda s0: PolarizerBeforePlate(
        rpm=rpm, start_angle=start, axis=_PLATE_AXIS, s0=s0)


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """One thing that turns.

    Parameters
    ----------
    name, title : str
        In tables and file names, and in full.
    light : callable
        (rpm, start angle in radians) -> (S0 in DN per ms -> Scene).
    cycles : int
        Of the polarization per turn.
    """

    name: str
    title: str
    light: Callable[[float, float], Light]
    cycles: int


SCENES = {
    "fig2": (Rotation(name="polarizer", title="rotating polarizer",
                      light=_polarizer, cycles=2),),
    "fig3": (
        Rotation(name="rotating plate", light=_plate, cycles=4,
                 title="rotating quarter-wave plate behind a fixed polarizer"),
        Rotation(name="rotating polarizer", light=_before_plate, cycles=4,
                 title="rotating polarizer before a fixed quarter-wave plate")),
}


@dataclass(frozen=True)
class Trace:
    """AoP (radians) and DoLP of a region's mean over time, shape (T,) each."""

    rpm: float
    method: str
    t_us: NDArray[np.int64]
    aop: NDArray[np.float64]
    dolp: NDArray[np.float64]


@dataclass(frozen=True)
class Spectrum:
    """Events of one speed.

    Parameters
    ----------
    rpm : float
    intervals : ndarray of int64
        Counts in `INTERVALS_US`.
    below_1ms : float
        Part of the intervals.
    by_phase : ndarray of int64, shape (2, bins)
        OFF and ON events of the I0 pixels over a turn.
    per_turn : (float, float)
        OFF and ON events per such pixel and turn.
    raster : (ndarray, ndarray)
        Time in turns and polarity of one pixel's events, over a turn.
    """

    rpm: float
    intervals: NDArray[np.int64]
    below_1ms: float
    by_phase: NDArray[np.int64]
    per_turn: tuple[float, float]
    raster: tuple[NDArray[np.float64], NDArray[np.uint8]]


@dataclass
class Comparison:
    """Everything that one scene gave."""

    rotation: Rotation
    rows: list[Row] = field(default_factory=list)
    traces: list[Trace] = field(default_factory=list)
    spectra: list[Spectrum] = field(default_factory=list)
    outside_hz: float = math.nan
    denoised_hz: float = math.nan
    bounds: list[tuple[float, Bound, Bound]] = field(default_factory=list)
    """Turns per minute; least errors of a camera that is not calibrated; of a frame."""


def cases(
    rotation: Rotation, settings: Settings, default_rpms: Sequence[float] = RPMS
) -> list[Case]:
    """Return the recordings that a scene needs."""
    rpms = settings.rpms or ((30.0, 200.0, 1000.0) if settings.quick else default_rpms)
    return [
        Case(scene=rotation.name, rpm=rpm, camera=camera, seed=seed, start_deg=start,
             light=rotation.light(rpm * OFF_LOCK, math.radians(start)),
             seconds=settings.seconds or (2.0 if settings.quick else 3.0))
        for camera in settings.cameras or ("nominal",)
        for seed, start in settings.specimens for rpm in rpms]


def compare(rotation: Rotation, settings: Settings, made: Sequence[Case],
            tick: Callable[[], object]) -> Comparison:
    """Record, score and look closer at the lowest and the highest speed.

    Parameters
    ----------
    rotation : Rotation
    settings : Settings
    made : sequence of Case
        Of `cases`.
    tick : callable
        Called after each case.
    """
    result = Comparison(rotation)
    first = [case for case in made if (case.camera, case.seed, case.start_deg) == (
        made[0].camera, made[0].seed, made[0].start_deg)]
    ends = {min(case.rpm for case in first), max(case.rpm for case in first)}
    for case in made:
        takes = Takes(case)
        result.rows += run(case, settings, takes)
        if case in first and case.rpm in ends:
            result.traces += _traces(case, rotation, settings, takes)
            result.spectra.append(_spectrum(case, takes))
        tick()
    if made[0].existing is None:
        result.bounds = [_bounds(case) for case in first]
        flat = Case(scene="constant light", rpm=0.0, camera=made[0].camera,
                    seed=made[0].seed, light=lambda s0: FlatLight(s0=s0), seconds=2.0)
        still = Takes(flat)(METHODS["frames"])
        height, width = still.recording.info.sensor_size
        noise, per_pixel_s = still.recording.events(), height * width * 2.0
        result.outside_hz = len(noise) / per_pixel_s
        result.denoised_hz = len(
            EventDenoiser((height, width)).filter(noise)) / per_pixel_s
    return result


def _bounds(case: Case) -> tuple[float, Bound, Bound]:
    camera, scene = case.specimen(METHODS["frames"]), case.light(case.event_dn_per_ms)
    return (case.rpm, optics_bound(camera.optics, scene, case.turn_us),
            frame_bound(camera, scene, case.turn_us))


def _traces(
    case: Case, rotation: Rotation, settings: Settings, takes: Takes
) -> list[Trace]:
    traces: list[Trace] = []
    for name, method in METHODS.items():
        if name not in settings.methods or method.own_times:
            continue
        take = takes(method)
        start = take.settled_us
        stop = min(start + 2.2 * case.turn_us / rotation.cycles, take.last_us)
        times = np.unique(np.linspace(start, stop, 441).astype(np.int64))
        aop, dolp = mean_traces(
            fuse(take.recording, times_us=times, demosaic="superpixel",
                 **fuse_parameters(method, case)))
        traces.append(Trace(case.rpm, name, times, aop, dolp if method.gives_dolp else
                            np.full(len(dolp), np.nan)))
        if traces[0].method != "truth":
            traces.insert(0, Trace(case.rpm, "truth", times,
                                   take.truth.aop(times, 0, 0),
                                   take.truth.dolp(times, 0, 0)))
    return traces


def mean_traces(
    images: Iterable[PolarFrame], where: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return AoP (radians) and DoLP of images' mean Stokes vectors, shape (T,) each.

    Parameters
    ----------
    images : iterable of PolarFrame
    where : ndarray of bool, shape (H, W), optional
        What counts; default everything.
    """
    part = Ellipsis if where is None else where
    s0, s1, s2 = np.array([
        [plane[part].mean(dtype=np.float64) for plane in (image.s0, image.s1, image.s2)]
        for image in images]).T
    return np.arctan2(s2, s1) / 2 % np.pi, np.hypot(s1, s2) / s0


def _spectrum(case: Case, takes: Takes) -> Spectrum:
    take = takes(METHODS["frames"])
    recording = take.recording
    events, (height, width) = recording.events(), recording.info.sensor_size
    gaps = pixel_intervals(events, width)
    layout = recording.info.layout
    assert layout is not None
    angles = np.asarray(layout.angles_deg)
    zero = events[angles[events["y"] % 2, events["x"] % 2] == 0]
    zero["t"] -= take.start_us
    turn_us = case.turn_us
    phases = events_by_phase(zero, turn_us)
    turns = (take.stop_us - take.start_us) / turn_us
    off, on = (float(count) / (height * width / 4) / turns for count in phases.sum(1))
    row, column = np.argwhere(angles == 0)[0] + (height // 4 * 2, width // 4 * 2)
    one = zero[(zero["y"] == row) & (zero["x"] == column) & (zero["t"] < turn_us)]
    return Spectrum(
        case.rpm, np.histogram(gaps, INTERVALS_US)[0],
        float((gaps < 1000).mean()) if len(gaps) else math.nan, phases, (off, on),
        (one["t"] / turn_us, one["p"].copy()))


# ---- words -----------------------------------------------------------------------

_USE_EVENTS = ("events", "cf", "firenet", "joint", "kalman")


def page(figure: str, results: Sequence[Comparison], settings: Settings,
         head: Sequence[str] | None = None) -> list[str]:
    """Return the Markdown of a figure: tables, and the paper's words beside ours."""
    cameras = sorted({row.camera for r in results for row in r.rows if "Sony" not in
                      row.method})
    lines = list(head) if head is not None else [
             f"# {figure}", "",
             f"Cameras: {', '.join(cameras)}; {settings.told_specimens}. Mean "
             "absolute errors, AoP in degrees where the true DoLP exceeds 0.2, by "
             f"turns per minute (times {OFF_LOCK}: none is locked to the frame clock), "
             "from 1 s on. Thresholds are those that the maker would state.", ""]
    for result in results:
        for camera in cameras:
            rows = [row for row in result.rows
                    if row.camera == camera or "Sony" in row.method]
            lines += [f"## {result.rotation.title}, `{camera}` camera", "",
                      "Super-pixels: AoP / DoLP.", "",
                      *pivot(rows, "rpm", ("aop_error_deg", "dolp_error")),
                      "Mean of the region: AoP / DoLP.", "",
                      *pivot(rows, "rpm", ("aop_error_roi_deg", "dolp_error_roi")),
                      "Part of the errors within one sigma (honest: 0.68): AoP / "
                      "DoLP.", "",
                      *pivot(rows, "rpm", ("aop_coverage", "dolp_coverage"))]
        lines += [*_bounds_table(result), *_events_table(result)]
    stated = _stated2(results[0]) if figure == "fig2" else _stated3(results)
    lines += ["## Beside the paper", "",
              *table(("quantity", "paper", "here"), stated),
              "Frames are held from the end of their readout, and `own times` at "
              "their mid-exposure: held ones are wrong because they are late, those "
              "because they are blurred. `kalman causal` knows a frame when its "
              "readout ends; other methods use it from its mid-exposure on. Sony "
              "cameras are simulated: 12 bits, extinction ratio 350, 20 ms exposure "
              "(13.3 ms at 75 fps), the same part of the converter's range. The paper "
              "gives its errors in pictures and states limits, which the pictures "
              "here have as arrows.", ""]
    if any(row.method in NETWORKS for result in results for row in result.rows):
        lines += ["`firenet` and `joint` are the networks that come with the package: "
                  "the paper's and one over four channels, trained on simulated "
                  "textures, polarizers, retarders and wheels (docs/networks.md), not "
                  "on these recordings and not anew for them, without the paper's "
                  "calibration per speed. They see events only, of 40 x 40 pixels, of "
                  "which the middle 12 x 12 count, and are scored at the ends of their "
                  "windows, 1/25 of a period, once their memory has settled.", ""]
    return lines


def _bounds_table(result: Comparison) -> list[str]:
    """Return the least errors of super-pixels, AoP in degrees / DoLP, by speed."""
    if not result.bounds:
        return []
    speeds, optics, frames = zip(*result.bounds, strict=True)
    return ["Least errors of super-pixels that the physics allows: AoP / DoLP "
            "(docs/theory/limits.md).", "",
            *table(("", *(f"{rpm:g}" for rpm in speeds)), [
                (name, *(f"{each.aop_deg:.2f} / {each.dolp:.3f}" for each in bounds))
                for name, bounds in (
                    ("any method, camera not calibrated", optics),
                    ("one frame's noise, all of the camera known", frames))])]


def _events_table(result: Comparison) -> list[str]:
    rows = [row for row in result.rows if row.method == "kalman"] or [
        row for row in result.rows if np.isfinite(row.events_per_pixel_s)]
    speeds = sorted({row.rpm for row in rows})
    per = [[row for row in rows if row.rpm == rpm] for rpm in speeds]
    return ["Events.", "", *table(
        ("", *(f"{rpm:g}" for rpm in speeds)),
        [("events per pixel and second",
          *(f"{mean(each, 'events_per_pixel_s'):.1f}" for each in per)),
         ("median interval, ms",
          *(f"{mean(each, 'median_interval_us') / 1000:.2f}" for each in per))])]


def _over(result: Comparison, column: str, methods: Sequence[str],
          rpms: Callable[[float], bool] = lambda rpm: True) -> str:
    """Return the worst speed's mean of each method, as text."""
    parts = []
    for name in methods:
        mine = [row for row in result.rows if row.method == name and rpms(row.rpm)]
        by_speed = [mean([row for row in mine if row.rpm == rpm], column)
                    for rpm in {row.rpm for row in mine}]
        if np.isfinite(by_speed).any():
            digits = 1 if column.endswith("_deg") else 3
            parts.append(f"{name} {max(by_speed):.{digits}f}")
    return "; ".join(parts) or "-"


def _exponent(result: Comparison) -> str:
    """Return d ln(rate less noise) / d ln(rpm)."""
    rows = [row for row in result.rows if np.isfinite(row.events_per_pixel_s)]
    speeds = sorted({row.rpm for row in rows})
    rates = [mean([row for row in rows if row.rpm == rpm], "events_per_pixel_s")
             - np.nan_to_num(result.outside_hz) for rpm in speeds]
    if len(speeds) < 2 or min(rates) <= 0:
        return "-"
    return f"rate ~ RPM^{np.polyfit(np.log(speeds), np.log(rates), 1)[0]:.3f}"


def _stated2(result: Comparison) -> list[tuple[str, str, str]]:
    at, slow = "aop_error_roi_deg", (lambda rpm: rpm <= 60)
    low = min(row.rpm for row in result.rows)
    return [
        ("AoP error to 60 RPM, both cameras, region's mean", "< 5 degrees", _over(
            result, at, ("Sony 50 fps", "Sony 50 fps, own times", "frames",
                         "frames, own times", *_USE_EVENTS), slow)),
        ("AoP error to 1000 RPM with events, region's mean", "< 10 degrees",
         _over(result, at, _USE_EVENTS)),
        ("frames above 100 RPM", "alias and blur", _over(
            result, at, ("Sony 50 fps", "Sony 75 fps", "frames"),
            lambda rpm: rpm > 100) + " degrees at worst"),
        ("DoLP of a polarizer at low speed", "nearly 1", _over(
            result, "dolp_error_roi",
            ("Sony 50 fps", "frames", "cf", "firenet", "joint", "kalman"),
            lambda rpm: rpm == low) + " from 1"),
        ("DoLP to 1000 RPM", "events keep it beyond the frames' Nyquist limit", _over(
            result, "dolp_error_roi", ("Sony 50 fps", "frames", *_USE_EVENTS))
         + " from 1"),
        ("event rate", "grows with RPM", _exponent(result)),
        ("event rate outside the polarizer", "< 1 Hz per pixel after denoising",
         "-" if np.isnan(result.outside_hz) else
         f"{result.denoised_hz:.3f} Hz under constant light, before denoising "
         f"{result.outside_hz:.2f}"),
    ]


def _growth(result: Comparison, methods: Sequence[str]) -> str:
    parts = []
    for name in methods:
        mine = [row for row in result.rows if row.method == name]
        speeds = sorted({row.rpm for row in mine})
        if len(speeds) > 1 and np.isfinite(mean(mine, "dolp_error_roi")):
            by_speed = [mean([row for row in mine if row.rpm == rpm], "dolp_error_roi")
                        for rpm in speeds]
            parts.append(f"{name} {100 * (max(by_speed) - by_speed[0]):+.1f}")
    return "; ".join(parts) or "-"


def _stated3(results: Sequence[Comparison]) -> list[tuple[str, str, str]]:
    lines = []
    for result in results:
        name = result.rotation.name
        lines += [
            (f"growth of the DoLP error from the lowest speed, worst speed, {name}",
             "< 8 points for the network, > 50 for Sony frames",
             _growth(result, ("Sony 50 fps", "Sony 75 fps", "frames", *_USE_EVENTS))
             + " points"),
            (f"event rate, {name}", "directly proportional to RPM", _exponent(result)),
            *_structure(result)]
    return lines


def _structure(result: Comparison) -> list[tuple[str, str, str]]:
    name = result.rotation.name
    ends = sorted(result.spectra, key=lambda spectrum: spectrum.rpm)
    if len(ends) < 2:
        return []
    slow, fast = ends[0], ends[-1]
    alike = np.corrcoef(slow.by_phase.reshape(-1), fast.by_phase.reshape(-1))[0, 1]
    return [
        (f"interval between a pixel's events at {fast.rpm:g} RPM, {name}",
         "down to less than 1 ms",
         f"{100 * fast.below_1ms:.0f} % below 1 ms ({100 * slow.below_1ms:.1f} % at "
         f"{slow.rpm:g} RPM)"),
        (f"ON and OFF events per I0 pixel and turn, {name}",
         "similar structure at 30 and 1000 RPM",
         f"ON {slow.per_turn[1]:.0f} and {fast.per_turn[1]:.0f}, OFF "
         f"{slow.per_turn[0]:.0f} and {fast.per_turn[0]:.0f}; correlation over the "
         f"turn {alike:.2f}")]
