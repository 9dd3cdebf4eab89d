"""Experiments of the paper as cases: what is recorded, and how methods score on it."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analysis.intervals import pixel_intervals
from pdavis_cv.analysis.score import KnownLight, Score, Scorer
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import fuse
from pdavis_cv.recording.base import Recording
from pdavis_cv.simulation import FULL, PRESETS, Camera, Scene

__all__ = [
    "METHODS",
    "SONY_FULL",
    "Case",
    "Method",
    "Row",
    "Settings",
    "events_of",
    "fuse_parameters",
    "nominal_thresholds",
    "record",
    "run",
    "score",
]

# Held until the first frames and a slow high-pass have settled.
SETTLE_US = 1_000_000
# The last images of a recording have less future than others.
TAIL_US = 60_000
# A Sony camera is given light that fills its 12 bits as FULL fills 10.
SONY_FULL = 4 * FULL


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way to get polarization images.

    Parameters
    ----------
    parameters : mapping of str to object
        Of `fuse`.
    own_times : bool
        Score at the frames' own mid-exposures rather than on a grid.
    preset : str, optional
        Camera of frames that stands in for the event camera.
    changes : mapping of str to object
        Of `Camera.preset`.
    """

    parameters: Mapping[str, Any]
    own_times: bool = False
    preset: str | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)


_SONY_75 = {"aps": {"fps": 75.0, "exposure_us": 13_300}}

METHODS: dict[str, Method] = {
    "Sony 50 fps": Method(parameters={"method": "frames"}, preset="sony"),
    "Sony 75 fps": Method(
        parameters={"method": "frames"}, preset="sony", changes=_SONY_75),
    "Sony 50 fps, own times": Method(
        parameters={"method": "frames", "hold": "mid"}, own_times=True, preset="sony"),
    "frames": Method(parameters={"method": "frames"}),
    "frames, own times": Method(
        parameters={"method": "frames", "hold": "mid"}, own_times=True),
    "events": Method(parameters={"method": "events"}),
    "events, redundancy": Method(
        parameters={"method": "events", "offsets": "redundancy"}),
    "cf": Method(parameters={"method": "cf"}),
    "kalman causal": Method(parameters={"method": "kalman", "causal": True}),
    "kalman": Method(parameters={"method": "kalman", "thresholds": "in-situ"}),
}
"""What is compared; a new way to fuse is a new line here."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One recording to be made, of one scene by one specimen.

    Parameters
    ----------
    scene : str
        Name of the scene.
    light : callable
        (S0 in DN per ms) -> Scene.
    rpm : float
        Nominal turns per minute.
    camera : str
        Preset of the event camera.
    seed : int
        Which specimen.
    start_deg : float
        Angle of what turns, at time 0.
    seconds : float
        Length.
    event_dn_per_ms, sony_dn_per_ms : float
        S0 on the two cameras.
    irradiance_uw_cm2 : float
        Where the light is given as such, else NaN.
    size, origin : (int, int)
        Region of the sensors that is simulated; (row, column).
    regions : callable
        Camera -> {name: mask of super-pixels, or None for all}.
    margin : float
        Of `Scorer`.
    """

    scene: str
    light: Callable[[float], Scene]
    rpm: float
    camera: str = "nominal"
    seed: int = 1
    start_deg: float = 0.0
    seconds: float = 3.0
    event_dn_per_ms: float = FULL
    sony_dn_per_ms: float = SONY_FULL
    irradiance_uw_cm2: float = math.nan
    size: tuple[int, int] = (12, 12)
    origin: tuple[int, int] | None = None
    regions: Callable[[Camera], Mapping[str, NDArray[np.bool_] | None]] = (
        lambda camera: {"all": None})
    margin: float = 0.0

    def specimen(self, method: Method) -> Camera:
        """Return the camera that a method looks through."""
        if method.preset is None:
            return Camera.preset(
                self.camera, seed=self.seed, size=self.size, origin=self.origin)
        return Camera.preset(
            method.preset, seed=self.seed, size=self.size, origin=self.origin,
            **method.changes)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table: one method on one region of one recording.

    Angles are in degrees; the first two errors are those of single super-pixels,
    ``_roi`` those of the region's mean; see `pdavis_cv.analysis.Score`.
    """

    scene: str
    region: str
    camera: str
    seed: int
    start_deg: float
    rpm: float
    irradiance_uw_cm2: float
    method: str
    aop_error_deg: float
    dolp_error: float
    aop_error_roi_deg: float
    dolp_error_roi: float
    aop_range_deg: float
    aop_coverage: float
    dolp_coverage: float
    valid: float
    events_per_pixel_s: float
    median_interval_us: float

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(item.name for item in dataclasses.fields(cls))

    def values(self) -> tuple[Any, ...]:
        """Return the cells."""
        return dataclasses.astuple(self)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line sets for every experiment.

    Parameters
    ----------
    cameras, seeds, starts_deg, rpms
        What cases are made of; None leaves it to the experiment.
    methods : tuple of str
        Names in `METHODS`.
    seconds : float or None
        Length of a recording.
    step_us : int
        Interval of the images that are scored.
    quick : bool
        Fewer cases, for a first look.
    """

    cameras: tuple[str, ...] | None = None
    seeds: tuple[int, ...] = (1,)
    starts_deg: tuple[float, ...] = (17.0,)
    rpms: tuple[float, ...] | None = None
    methods: tuple[str, ...] = tuple(METHODS)
    seconds: float | None = None
    step_us: int = 1000
    quick: bool = False

    @property
    def specimens(self) -> list[tuple[int, float]]:
        """Seeds and start angles together."""
        return [(seed, start) for seed in self.seeds for start in self.starts_deg]


def nominal_thresholds(camera: str) -> tuple[float, float]:
    """Return the thresholds that the maker of a preset would state."""
    dvs = PRESETS[camera]["dvs"]
    return float(dvs.theta_on), float(dvs.theta_off)


def events_of(recording: Recording) -> NDArray[Any]:
    """Return all events of a recording, in the order of time."""
    parts = [packet.events for packet in recording.packets() if len(packet.events)]
    return np.concatenate(parts) if parts else np.empty(0, EVENT_DTYPE)


def record(case: Case, method: Method) -> tuple[Recording, KnownLight, int]:
    """Make a case's recording as a method's camera sees it.

    Returns
    -------
    recording : Recording
    truth : KnownLight
    stop_us : int
        End of the recording.
    """
    light = (case.event_dn_per_ms if method.preset is None else case.sony_dn_per_ms)
    recording, truth = case.specimen(method).record(case.light(light), case.seconds)
    return recording, truth, truth.stop_us


def score(
    recording: Recording, truth: KnownLight, stop_us: int, *,
    regions: Mapping[str, NDArray[np.bool_] | None] | None = None,
    step_us: int = 1000, settle_us: int = SETTLE_US, own_times: bool = False,
    margin: float = 0.0, **parameters: Any,
) -> dict[str, Score]:
    """Score a method on super-pixels of a recording, once it has settled.

    Parameters
    ----------
    recording, truth
        As a `Camera` returns them.
    stop_us : int
        End of the recording.
    regions : mapping of str to ndarray of bool, optional
        Masks of super-pixels, None for all of them.
    step_us, settle_us : int
        Interval and first time that counts.
    own_times : bool
        Score at the frames' mid-exposures instead.
    margin : float
        Of `Scorer`.
    **parameters
        Of `fuse`.

    Returns
    -------
    dict of str to Score
    """
    when: dict[str, Any] = (
        {"start_us": settle_us, "stop_us": stop_us - TAIL_US} if own_times else
        {"times_us": np.arange(settle_us, stop_us - TAIL_US, step_us)})
    x, y = parameters.get("roi", (0, 0))[:2]
    scorers: dict[str, Scorer] = {}
    for image in fuse(recording, demosaic="superpixel", **when, **parameters):
        scorers = scorers or {
            name: Scorer(truth, image.shape, mask=mask, margin=margin, origin=(x, y))
            for name, mask in (regions or {"all": None}).items()}
        for scorer in scorers.values():
            scorer.add(image)
    return {name: scorer.score for name, scorer in scorers.items()}


def run(case: Case, settings: Settings) -> Iterator[Row]:
    """Make a case's recordings and yield a row per method and region."""
    made: dict[Any, tuple[Recording, KnownLight, int]] = {}
    counted: dict[str, tuple[float, float]] = {}
    for name in (name for name in METHODS if name in settings.methods):
        method = METHODS[name]
        of_events = method.preset is None
        key = method.preset, repr(method.changes)
        if key not in made:
            made[key] = record(case, method)
        recording, truth, stop_us = made[key]
        regions = case.regions(case.specimen(method))
        if of_events and not counted:
            counted = _event_statistics(recording, regions, stop_us)
        found = score(
            recording, truth, stop_us, regions=regions, step_us=settings.step_us,
            own_times=method.own_times, margin=case.margin,
            **fuse_parameters(method, case.camera))
        for region, s in found.items():
            rate, interval = (
                counted[region] if of_events else (math.nan, math.nan))
            yield Row(
                scene=case.scene, region=region, camera=method.preset or case.camera,
                seed=case.seed, start_deg=case.start_deg, rpm=case.rpm,
                irradiance_uw_cm2=case.irradiance_uw_cm2, method=name,
                aop_error_deg=math.degrees(s.aop_error), dolp_error=s.dolp_error,
                aop_error_roi_deg=math.degrees(s.roi_aop_error),
                dolp_error_roi=s.roi_dolp_error,
                aop_range_deg=math.degrees(s.roi_aop_range),
                aop_coverage=s.aop_coverage, dolp_coverage=s.dolp_coverage,
                valid=s.valid, events_per_pixel_s=rate, median_interval_us=interval)


def fuse_parameters(method: Method, camera: str) -> dict[str, Any]:
    """Return what `fuse` is told: nothing that is tuned to a recording.

    Parameters
    ----------
    method : Method
    camera : str
        Preset of the event camera, whose nominal thresholds are given.
    """
    parameters = dict(method.parameters)
    if method.preset is None and parameters["method"] != "frames":
        parameters["nominal_thresholds"] = nominal_thresholds(camera)
    return parameters


def _event_statistics(
    recording: Recording, regions: Mapping[str, NDArray[np.bool_] | None], stop_us: int
) -> dict[str, tuple[float, float]]:
    """Return events per pixel and second, and the median interval, per region."""
    events = events_of(recording)
    height, width = recording.info.sensor_size
    result = {}
    for name, mask in regions.items():
        inside, pixels = events, height * width
        if mask is not None:
            inside, pixels = events[mask[events["y"] // 2, events["x"] // 2]], (
                4 * int(mask.sum()))
        gaps = pixel_intervals(inside, width)
        result[name] = (len(inside) / pixels / stop_us * 1e6,
                        float(np.median(gaps)) if len(gaps) else math.nan)
    return result


