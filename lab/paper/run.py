"""Experiments of the paper as cases: what is recorded, and how methods score on it."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.scoring import Score, Scorer
from pdavis_cv.fusion import fuse
from pdavis_cv.recording.base import Recording
from pdavis_cv.simulation import FULL, PRESETS, Camera, Scene
from pdavis_cv.tools._images import warn_of_nothing

from .intervals import pixel_intervals

# Held until the first frames and a slow high-pass have settled.
SETTLE_US = 1_000_000
# The last images of a recording have less future than others.
TAIL_US = 60_000
# Speeds locked to the frame clock would flatter or ruin a method.
OFF_LOCK = 1.013
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
    gives_dolp : bool
        Whether its DoLP means anything.
    """

    parameters: Mapping[str, Any]
    own_times: bool = False
    preset: str | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    gives_dolp: bool = True


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
    "events": Method(parameters={"method": "events"}, gives_dolp=False),
    "events, redundancy": Method(
        parameters={"method": "events", "offsets": "redundancy"}),
    "cf": Method(parameters={"method": "cf"}),
    "kalman causal": Method(parameters={"method": "kalman", "causal": True}),
    "kalman": Method(parameters={"method": "kalman"}),
    "kalman offline": Method(parameters={
        "method": "kalman", "mode": "offline"}),
}
"""What is compared; a new way to fuse is a new line here."""

NETWORKS = ("firenet", "joint")
"""Networks on events alone; figures 2 and 3 score them at the ends of windows."""

SHOWN = (*METHODS, *NETWORKS)
"""What tables and pictures show, in order."""


@dataclass(frozen=True)
class Take:
    """A recording and what is known about it.

    Parameters
    ----------
    recording : Recording
    truth : object
        The light in front of the camera.
    start_us, stop_us : int
        Beginning and end.
    """

    recording: Recording
    truth: Any
    start_us: int
    stop_us: int

    @property
    def settled_us(self) -> int:
        """First time that counts."""
        return self.start_us + SETTLE_US

    @property
    def last_us(self) -> int:
        """End of what counts, exclusive."""
        return self.stop_us - TAIL_US


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
    changes : mapping of str to object
        Of `Camera.preset`, for the event camera.
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
    demosaic : str
        Of `fuse`.
    existing : Take, optional
        Stands in for what the event camera would record.
    true_rpm : float, optional
        Turns per minute; default ``rpm`` times `OFF_LOCK`.
    options : mapping of str to object
        Of `fuse`, for the event camera; without ``nominal_thresholds`` those of the
        preset are taken.
    """

    scene: str
    light: Callable[[float], Scene]
    rpm: float
    camera: str = "nominal"
    changes: Mapping[str, Any] = field(default_factory=dict)
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
    demosaic: str = "superpixel"
    existing: Take | None = None
    true_rpm: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def turn_us(self) -> float:
        """Time of a turn."""
        rpm = self.rpm * OFF_LOCK if self.true_rpm is None else self.true_rpm
        return 60e6 / abs(rpm)

    def specimen(self, method: Method) -> Camera:
        """Return the camera that a method looks through."""
        if method.preset is None:
            return Camera.preset(
                self.camera, seed=self.seed, size=self.size, origin=self.origin,
                **self.changes)
        return Camera.preset(
            method.preset, seed=self.seed, size=self.size, origin=self.origin,
            **method.changes)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table: one method on one region of one recording.

    Angles are in degrees; the first two errors are those of single super-pixels,
    ``_roi`` those of the region's mean, ``dolp_roi`` that mean's DoLP itself; see
    `lab.scoring.Score`.
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
    dolp_roi: float
    aop_range_deg: float
    aop_coverage: float
    dolp_coverage: float
    valid: float
    events_per_pixel_s: float
    median_interval_us: float


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line sets for every experiment.

    Parameters
    ----------
    cameras, rpms
        What cases are made of; None leaves it to the experiment.
    seeds : tuple of int
        Which specimens.
    starts_deg : tuple of float
        Angles at time 0, each with every specimen; empty = each specimen its own.
    methods : tuple of str
        Names in `METHODS`, or of the figure's own.
    weights : tuple of str
        Files of weights instead of the package's.
    scenes : tuple of str
        Those that are made, of figures that leave a choice; empty = all.
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
    weights: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    seconds: float | None = None
    step_us: int = 1013
    quick: bool = False

    @property
    def specimens(self) -> list[tuple[int, float]]:
        """Seeds and start angles together."""
        return [(seed, start) for seed in self.seeds
                # of their own: ten in a row cover half a turn
                for start in self.starts_deg or ((17.0 + 18.0 * (seed - 1)) % 180,)]

    @property
    def told_specimens(self) -> str:
        """Seeds and start angles in words, and what bands are if there are several."""
        starts = dict.fromkeys(f"{start:g}" for _, start in self.specimens)
        return (f"specimens {', '.join(map(str, self.seeds))}, start angles "
                f"{', '.join(starts)} degrees{', one each' * (not self.starts_deg)}"
                + (": lines are medians, bands 5 to 95 %"
                   if len(self.specimens) > 1 else ""))


class Takes:
    """The recordings of a case, each made when it is first asked for."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._made: dict[Any, Take] = {}

    def __call__(self, method: Method) -> Take:
        """Return what a method's camera records."""
        case = self._case
        if method.preset is None and case.existing is not None:
            return case.existing
        key = method.preset, repr(method.changes)
        if key not in self._made:
            s0 = case.event_dn_per_ms if method.preset is None else (
                case.sony_dn_per_ms)
            recording, truth = case.specimen(method).record(
                case.light(s0), case.seconds)
            self._made[key] = Take(recording, truth, 0, truth.stop_us)
        return self._made[key]


def score(
    take: Take, *, regions: Mapping[str, NDArray[np.bool_] | None] | None = None,
    step_us: int = 1013, times_us: NDArray[np.int64] | None = None,
    own_times: bool = False, margin: float = 0.0, demosaic: str = "superpixel",
    **parameters: Any,
) -> dict[str, Score]:
    """Score a method on a recording, once it has settled.

    Parameters
    ----------
    take : Take
    regions : mapping of str to ndarray of bool, optional
        Masks of the images' pixels, None for all of them.
    step_us : int
        Interval of the images.
    times_us : ndarray of int64, shape (T,), optional
        Times of the images instead.
    own_times : bool
        Score at the frames' mid-exposures instead.
    margin : float
        Of `Scorer`.
    demosaic : str
        Of `fuse`; ``"superpixel"`` makes images half as wide and high.
    **parameters
        Of `fuse`.

    Returns
    -------
    dict of str to Score
    """
    when: dict[str, Any] = (
        {"start_us": take.settled_us, "stop_us": take.last_us} if own_times else
        {"times_us": np.arange(take.settled_us, take.last_us, step_us)
         if times_us is None else times_us})
    scorers: dict[str, Scorer] = {}
    for image in fuse(take.recording, demosaic=demosaic, **when, **parameters):
        scorers = scorers or {
            name: Scorer(take.truth, image.shape, mask=mask, margin=margin,
                         scale=2 if demosaic == "superpixel" else 1)
            for name, mask in (regions or {"all": None}).items()}
        for scorer in scorers.values():
            scorer.add(image)
    return {name: scorer.score for name, scorer in scorers.items()}


def run(
    case: Case, settings: Settings, takes: Takes,
    methods: Mapping[str, Method] = METHODS,
) -> Iterator[Row]:
    """Make a case's recordings and yield a row per method and region."""
    counted: dict[str, tuple[float, float]] = {}
    for name in (name for name in methods if name in settings.methods):
        method = methods[name]
        of_events = method.preset is None
        take = takes(method)
        regions: Mapping[str, NDArray[np.bool_] | None] = {"all": None}
        if case.existing is None:
            regions = case.regions(case.specimen(method))
        if of_events and not counted:
            counted = _event_statistics(take, regions)
        found = score(
            take, regions=regions, step_us=settings.step_us,
            own_times=method.own_times, margin=case.margin, demosaic=case.demosaic,
            **(parameters := fuse_parameters(method, case)))
        if of_events and case.existing is not None and not found["all"].valid:
            warn_of_nothing(take.recording, name, parameters.get("calibration"))
        for region, s in found.items():
            if not method.gives_dolp:
                s = dataclasses.replace(
                    s, dolp_error=math.nan, roi_dolp_error=math.nan,
                    roi_dolp=math.nan, dolp_coverage=math.nan)
            rate, interval = (
                counted[region] if of_events else (math.nan, math.nan))
            yield row_of(case, name, s, region=region,
                         camera=method.preset or case.camera,
                         events_per_pixel_s=rate, median_interval_us=interval)


def row_of(
    case: Case, method: str, s: Score, *, region: str, camera: str,
    events_per_pixel_s: float = math.nan, median_interval_us: float = math.nan,
) -> Row:
    """Return the row of a method's score on a region of a case's recording."""
    return Row(
        scene=case.scene, region=region, camera=camera, seed=case.seed,
        start_deg=case.start_deg, rpm=case.rpm,
        irradiance_uw_cm2=case.irradiance_uw_cm2, method=method,
        aop_error_deg=math.degrees(s.aop_error), dolp_error=s.dolp_error,
        aop_error_roi_deg=math.degrees(s.roi_aop_error),
        dolp_error_roi=s.roi_dolp_error, dolp_roi=s.roi_dolp,
        aop_range_deg=math.degrees(s.roi_aop_range), aop_coverage=s.aop_coverage,
        dolp_coverage=s.dolp_coverage, valid=s.valid,
        events_per_pixel_s=events_per_pixel_s, median_interval_us=median_interval_us)


def fuse_parameters(method: Method, case: Case) -> dict[str, Any]:
    """Return what `fuse` is told: nothing that was chosen for the recording.

    Of a simulated camera the thresholds that its maker would state are known.
    """
    parameters = dict(method.parameters)
    if method.preset is None and parameters["method"] != "frames":
        if case.existing is None:
            dvs = PRESETS[case.camera]["dvs"]
            parameters["nominal_thresholds"] = dvs.theta_on, dvs.theta_off
        parameters.update(case.options)
    return parameters


def _event_statistics(
    take: Take, regions: Mapping[str, NDArray[np.bool_] | None]
) -> dict[str, tuple[float, float]]:
    """Return events per pixel and second, and the median interval, per region."""
    events = take.recording.events()
    height, width = take.recording.info.sensor_size
    result = {}
    for name, mask in regions.items():
        inside, pixels = events, height * width
        if mask is not None:
            inside, pixels = events[mask[events["y"] // 2, events["x"] // 2]], (
                4 * int(mask.sum()))
        gaps = pixel_intervals(inside, width)
        seconds = (take.stop_us - take.start_us) / 1e6
        result[name] = (len(inside) / pixels / seconds,
                        float(np.median(gaps)) if len(gaps) else math.nan)
    return result


