"""Figures 2 and 3: what turns in front of the camera, at 30 to 1000 RPM."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

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

from .bound import Limits, limits
from .intervals import events_by_phase, pixel_intervals
from .run import METHODS, OFF_LOCK, Case, Row, Settings, Takes, fuse_parameters, run

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
    limits: list[Limits] = field(default_factory=list)
    """Of the event camera and of the Sony cameras that are shown, by speed."""

    def limits_of(self, method: str) -> list[Limits]:
        """Return the limits of the camera that a method looks through."""
        wanted = METHODS[method] if method in METHODS else METHODS["frames"]
        return [each for each in self.limits if each.camera == (
            method.split(",")[0] if wanted.preset else "event camera")]

    @property
    def specimens(self) -> int:
        """How many there are."""
        return len({(row.seed, row.start_deg) for row in self.rows})


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
        result.limits = [each for case in first for each in _limits(case, settings)]
        flat = Case(scene="constant light", rpm=0.0, camera=made[0].camera,
                    seed=made[0].seed, light=lambda s0: FlatLight(s0=s0), seconds=2.0)
        still = Takes(flat)(METHODS["frames"])
        height, width = still.recording.info.sensor_size
        noise, per_pixel_s = still.recording.events(), height * width * 2.0
        result.outside_hz = len(noise) / per_pixel_s
        result.denoised_hz = len(
            EventDenoiser((height, width)).filter(noise)) / per_pixel_s
    return result


def _limits(case: Case, settings: Settings) -> Iterator[Limits]:
    yield limits("event camera", case.specimen(METHODS["frames"]), case.rpm,
                 case.light(case.event_dn_per_ms), case.turn_us)
    for name in ("Sony 50 fps", "Sony 75 fps"):
        if any(each.startswith(name) for each in settings.methods):
            yield limits(name, case.specimen(METHODS[name]), case.rpm,
                         case.light(case.sony_dn_per_ms), case.turn_us)


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
