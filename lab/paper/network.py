"""Networks on events alone beside the other methods: what turns, moves and dims."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lab.scoring import Scorer
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import fuse
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.checkpoint import firenet_weights
from pdavis_cv.reconstruct.firenet import PLACES, FireNet, Joint
from pdavis_cv.reconstruct.weights import Weights
from pdavis_cv.recording.base import Recording
from pdavis_cv.sensor import CHANNELS, PDAVIS_EXTINCTION_RATIO, Sensor
from pdavis_cv.simulation import (
    Camera,
    Fan,
    RotatingPlate,
    RotatingPolarizer,
    Tendon,
    Texture,
    Truth,
)
from pdavis_cv.simulation.scenes import Scene

from . import run as runs
from .light import EVENT_DN, HIGH_UW_CM2, LOW_UW_CM2, halves
from .page import table
from .print_style import PAGE_IN, letters, look, new_figure
from .response import response_table
from .rotation import RPMS
from .run import OFF_LOCK, TAIL_US, Case, Settings, Take

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_TABLE = "firenet, table"
METHODS: dict[str, Mapping[str, Any]] = {
    "joint": {"method": "joint"},
    "firenet": {"method": "firenet"},
    "firenet, minimum": {"method": "firenet", "scaling": "minimum"},
    _TABLE: {"method": "firenet", "scaling": "table"},
    **{name: runs.METHODS[name].parameters
       for name in ("events", "events, redundancy", "cf", "kalman")},
}
"""What is compared."""

SCENES = ("polarizer", "rotating plate", "fan", "tendon", "irradiance", "texture")
"""What is recorded."""

# Training draws its textures from another generator; these seeds are of no clip.
TEXTURE_SEEDS = (9101, 9102, 9103, 9104, 9105, 9106)
WINDOWS_PER_PERIOD = 24.618  # windows are to end at all phases
SETTLING = 64  # windows: the longer of the memories of ``joint``
_IMAGES = 200  # scored of a recording, at the most
_LEAST_DOLP = 0.3
SIDE, _ROI = 40, 12
_RANGE_RPM = 60.0


def window_us(period_us: float) -> int:
    """Return the window for light of a period: about a 25th, 1 ms or more."""
    return int(np.clip(period_us / WINDOWS_PER_PERIOD, 1_000, 1_000_000))


@dataclass(frozen=True, kw_only=True)
class NetworkCase:
    """A recording, and the period of what its pixels see.

    Parameters
    ----------
    case : Case
    setting : str
        What tells it from others of its scene.
    period_us : float
        Of the light at a pixel; of textures, the time in which they move 16 pixels.
    calibrated : bool
        Whether the paper's calibrations apply: light that turns, with no picture.
    """

    case: Case
    setting: str
    period_us: float
    calibrated: bool = False


@dataclass(frozen=True, kw_only=True)
class NetworkRow:
    """A line of the table; see `network_page` for what the errors are."""

    scene: str
    setting: str
    region: str
    camera: str
    seed: int
    window_us: int
    method: str
    images: int
    aop_error_deg: float
    dolp_error: float
    s0_error: float
    aop_error_roi_deg: float
    dolp_error_roi: float
    aop_range_deg: float


def network_cases(settings: Settings) -> list[NetworkCase]:
    """Return what is recorded."""
    made = (*_turning(settings), *_fans(settings), *_tendons(settings),
            *_range(settings), *_textures(settings))
    return [each for each in made
            if each.case.scene.split(",")[0] in settings.scenes or not settings.scenes]


def _case(scene: str, light: Callable[[float], Scene], period_us: float,
          settings: Settings, seed: int = 0, **more: Any) -> Case:
    settled = max(runs.SETTLE_US, SETTLING * window_us(period_us))
    scored = max(0.4e6, period_us) if settings.quick else max(5e5, 6 * period_us)
    return Case(scene=scene, light=light, seed=seed or settings.seeds[0], **{
        "rpm": math.nan, "size": (SIDE, SIDE),
        "seconds": settings.seconds or (settled + scored + TAIL_US) / 1e6, **more})


def _turning(settings: Settings) -> Iterator[NetworkCase]:
    def polarizer(rpm: float, start: float) -> Callable[[float], Scene]:
        return lambda s0: RotatingPolarizer(
            rpm=rpm * OFF_LOCK, start_angle=start, s0=s0)

    def plate(rpm: float, start: float) -> Callable[[float], Scene]:
        return lambda s0: RotatingPlate(rpm=rpm * OFF_LOCK, start_angle=start, s0=s0)

    rpms = settings.rpms or ((200.0,) if settings.quick else RPMS)
    for scene, light, cycles in (("polarizer", polarizer, 2),
                                 ("rotating plate", plate, 4)):
        for seed, start in settings.specimens:
            for rpm in rpms:
                period = 60e6 / (rpm * OFF_LOCK) / cycles
                yield NetworkCase(
                    case=_case(scene, light(rpm, math.radians(start)), period,
                               settings, seed, rpm=rpm, start_deg=start,
                               regions=middle_of),
                    setting=f"{rpm:g} RPM", period_us=period, calibrated=True)


def _middle(size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask of the super-pixels in the middle 12x12 pixels, as in the paper."""
    y, x = (np.abs(np.arange(side // 2) - (side // 2 - 1) / 2) < _ROI / 4
            for side in size)
    return np.asarray(np.logical_and.outer(y, x))


def middle_of(camera: Camera) -> Mapping[str, NDArray[np.bool_]]:
    """Return the region ``"middle"``: 12 x 12 pixels around a camera's middle."""
    return {"middle": _middle(camera.size)}


def _fans(settings: Settings) -> Iterator[NetworkCase]:
    def light(rpm: float) -> Callable[[float], Scene]:
        return lambda s0: Fan(rpm=rpm * OFF_LOCK, s0=s0)

    for rpm in (200.0,) if settings.quick else (200.0, 1000.0):
        sector = 60e6 / (rpm * OFF_LOCK) / 6
        size = (8, 32) if settings.quick else (24, 32)
        yield NetworkCase(
            case=_case("fan", light(rpm), sector, settings, rpm=rpm, size=size,
                       origin=(54, 156), regions=halves, margin=1.5),
            setting=f"{rpm:g} RPM", period_us=sector)


def _tendons(settings: Settings) -> Iterator[NetworkCase]:
    def light(hz: float) -> Callable[[float], Scene]:
        return lambda s0: Tendon(hz=hz, s0=s0)

    for hz in (10.0,) if settings.quick else (1.0, 10.0):
        yield NetworkCase(
            case=_case("tendon", light(hz), 1e6 / hz, settings,
                       size=(16, 16) if settings.quick else (SIDE, SIDE)),
            setting=f"{hz:g} Hz", period_us=1e6 / hz)


def _range(settings: Settings) -> Iterator[NetworkCase]:
    def light(s0: float) -> Scene:
        return RotatingPolarizer(rpm=_RANGE_RPM * OFF_LOCK, s0=s0)

    levels = np.geomspace(LOW_UW_CM2, HIGH_UW_CM2, 2 if settings.quick else 5)
    for camera in ("nominal",) if settings.quick else ("nominal", "realistic"):
        for level in levels:
            period = 30e6 / (_RANGE_RPM * OFF_LOCK)
            # The range of AoP is that of the images: they must be many.
            seconds = settings.seconds or (2.5 if settings.quick else 9.0)
            yield NetworkCase(
                case=_case(f"irradiance, {camera}", light, period, settings,
                           rpm=_RANGE_RPM, camera=camera, regions=middle_of,
                           irradiance_uw_cm2=float(level),
                           event_dn_per_ms=EVENT_DN * level, seconds=seconds),
                setting=f"{level:.3g} uW/cm2", period_us=period)


def _textures(settings: Settings) -> Iterator[NetworkCase]:
    for seed in TEXTURE_SEEDS[:1 if settings.quick else None]:
        random = np.random.default_rng(seed)
        speed = math.exp(random.uniform(math.log(60), math.log(600)))
        angle = random.uniform(0, 2 * math.pi)
        fields = {
            "velocity": (speed * math.cos(angle), speed * math.sin(angle)),
            "contrast": random.uniform(0.3, 0.8), "aop": random.uniform(0, math.pi),
            "aop_spread": random.uniform(0.3, 1.0),
            "shortest": random.uniform(8, 16), "seed": seed}

        def light(s0: float, fields: dict[str, Any] = fields) -> Scene:
            return Texture(s0=s0, **fields)

        period = WINDOWS_PER_PERIOD * 1e6 / speed  # a window is a pixel of its way
        yield NetworkCase(
            case=_case("texture", light, period, settings,
                       size=(16, 16) if settings.quick else (SIDE, SIDE)),
            setting=f"seed {seed}", period_us=period)


# ---- measuring -------------------------------------------------------------------


def all_weights(paths: Sequence[str]) -> dict[str, Weights]:
    """Return both networks' weights: some from files, else the package's own.

    Parameters
    ----------
    paths : sequence of str
        npz files, or checkpoints of the published FireNet.

    Returns
    -------
    dict of str to Weights
        By network.
    """
    read = [Weights.load(path) if Path(path).suffix == ".npz" else
            firenet_weights(path) for path in paths]
    weights = {name: Weights.shipped(name) for name in ("joint", "firenet")}
    return weights | {given.network: given for given in read}


def measure(made: NetworkCase, settings: Settings,
            weights: Mapping[str, Weights]) -> Iterator[NetworkRow]:
    """Make a recording and score each method on it at the ends of windows.

    Parameters
    ----------
    made : NetworkCase
    settings : Settings
        ``methods`` names those of `METHODS` that count; without any of them, all.
    weights : mapping of str to Weights
        By network.
    """
    case, window = made.case, window_us(made.period_us)
    names = [name for name in METHODS if name in settings.methods]
    camera = case.specimen(runs.METHODS["frames"])
    light = case.light(case.event_dn_per_ms)
    recording, truth = camera.record(light, case.seconds)
    take = Take(recording, truth, 0, truth.stop_us)
    times = window_ends(take, window)
    regions = case.regions(camera)
    for name in names:
        if "scaling" in METHODS[name] and not made.calibrated:
            continue
        parameters = parameters_of(name, case, window, weights)
        if name == _TABLE:
            parameters["table"] = _curves(
                *camera.record(light, case.seconds, run=1), times, parameters)
        yield from _scored(made, window, name, take, times, regions, parameters)


def window_ends(take: Take, window: int) -> NDArray[np.int64]:
    """Return ends of windows: an image in between would show the one before."""
    first = max(take.settled_us, take.start_us + SETTLING * window)
    ends = np.arange(-(-first // window), -(-take.last_us // window)) * window
    chosen = np.random.default_rng(0).permutation(len(ends))[:_IMAGES]
    return ends[np.sort(chosen)]


def parameters_of(name: str, case: Case, window: int,
                  weights: Mapping[str, Weights]) -> dict[str, Any]:
    """Return what `fuse` is told of a method in `METHODS`; the window is in us."""
    method = runs.Method(parameters=METHODS[name])
    parameters = runs.fuse_parameters(method, case)
    if parameters["method"] in ("joint", "firenet"):
        parameters["window_us"] = window
        parameters["weights"] = weights[parameters["method"]]
    return parameters


def _curves(recording: Recording, truth: Truth, times: NDArray[np.int64],
            parameters: Mapping[str, Any]) -> NDArray[np.float32]:
    """Return the table that takes the mean of the middle to the light there."""
    info = recording.info
    assert info.layout is not None
    where = _middle(info.sensor_size)
    given = np.array([image.quad[:, where].mean(1) for image in fuse(
        recording, times_us=times, demosaic="superpixel",
        **{**parameters, "scaling": None})]).T
    s0, s1, s2 = truth.stokes(times)
    ratio = PDAVIS_EXTINCTION_RATIO  # images make up for it again
    k = (ratio - 1) / (ratio + 1)
    light = np.array([s0 + k * s1, s0 + k * s2, s0 - k * s1, s0 - k * s2]) / 2
    order = [CHANNELS.index(info.layout.angles_deg[row][column])
             for row, column in PLACES]
    return response_table(given[order], light[order] / s0.mean())


def _scored(
    made: NetworkCase, window: int, name: str, take: Take, times: NDArray[np.int64],
    regions: Mapping[str, NDArray[np.bool_] | None], parameters: Mapping[str, Any],
) -> Iterator[NetworkRow]:
    case = made.case
    scorers: dict[str, tuple[Scorer, _Light]] = {}
    for image in fuse(take.recording, times_us=times, demosaic="superpixel",
                      **parameters):
        scorers = scorers or {
            region: (Scorer(take.truth, image.shape, mask=mask, margin=case.margin,
                            least_dolp=_LEAST_DOLP), _Light(take, image.shape, mask))
            for region, mask in regions.items()}
        for scorer, s0 in scorers.values():
            scorer.add(image)
            s0.add(image)
    phase_only = name == "events"  # its DoLP and S0 mean nothing
    for region, (scorer, s0) in scorers.items():
        s = scorer.score
        yield NetworkRow(
            scene=case.scene, setting=made.setting, region=region, camera=case.camera,
            seed=case.seed, window_us=window, method=name, images=s.images,
            aop_error_deg=math.degrees(s.aop_error),
            dolp_error=math.nan if phase_only else s.dolp_error,
            s0_error=math.nan if phase_only else s0.error,
            aop_error_roi_deg=math.degrees(s.roi_aop_error),
            dolp_error_roi=math.nan if phase_only else s.roi_dolp_error,
            aop_range_deg=math.degrees(s.roi_aop_range))


class _Light:
    """Errors of ln S0, up to one gain per recording."""

    def __init__(self, take: Take, shape: tuple[int, int],
                 mask: NDArray[np.bool_] | None) -> None:
        self._truth: Any = take.truth
        self._mask = np.ones(shape, np.bool_) if mask is None else mask
        y, x = np.nonzero(self._mask)
        self._x, self._y = 2 * x + 0.5, 2 * y + 0.5
        self._off: list[NDArray[np.float64]] = []

    def add(self, image: PolarFrame) -> None:
        """Compare one image."""
        true = self._truth.s0(image.t_us, self._x, self._y)
        self._off.append(np.log(
            np.maximum(image.s0[self._mask], 1e-6, dtype=np.float64) / true))

    @property
    def error(self) -> float:
        """Mean absolute error of ln S0."""
        off = np.concatenate(self._off)
        return float(np.abs(off - np.median(off)).mean())


def network_steps(
    weights: Mapping[str, Weights], size: tuple[int, int] = Sensor.PDAVIS.size
) -> dict[str, Callable[[], float]]:
    """Return functions that make a network's next image and return the time it took.

    Events of a window go in, log intensity comes out; the time is that of the
    processor, in which what else runs does not count.

    Parameters
    ----------
    weights : mapping of str to Weights
    size : (int, int)
        Of the sensor.

    Returns
    -------
    dict of str to callable
        Of seconds, by network.
    """
    window, n = 10_000, size[0] * size[1] // 4
    random = np.random.default_rng(0)
    events = np.zeros(n, EVENT_DTYPE)
    events["t"] = np.sort(random.integers(0, window, n))
    events["y"] = random.integers(0, size[0], n)
    events["x"] = random.integers(0, size[1], n)
    events["p"] = random.integers(0, 2, n)

    def step_of(made: type[Joint] | type[FireNet]) -> Callable[[], float]:
        method = made(size, theta_on=0.2, theta_off=0.2, window_us=window,
                      weights=weights[made.method])
        now = events.copy()

        def step() -> float:
            start = process_time()
            method.add_events(now)
            now["t"] += window
            method.read(int(now["t"][0]) // window * window)
            return process_time() - start

        step()  # builds the model
        return step

    return {made.method: step_of(made) for made in (Joint, FireNet)}


def step_costs(steps: Mapping[str, Callable[[], float]], rounds: int
               ) -> dict[str, float]:
    """Time one image of each network in turn.

    Parameters
    ----------
    steps : mapping of str to callable
        Of `network_steps`.
    rounds : int
        Images of each.

    Returns
    -------
    dict of str to float
        Shortest time of each, in milliseconds.
    """
    took = [[step() for step in steps.values()] for _ in range(rounds)]
    return {name: 1e3 * min(times)
            for name, times in zip(steps, zip(*took, strict=True), strict=True)}


# ---- words -----------------------------------------------------------------------

_COLUMNS = ("aop_error_deg", "dolp_error", "s0_error")
_ROI_COLUMNS = ("aop_error_roi_deg", "dolp_error_roi", "aop_range_deg")
_FORMATS = {"aop_error_deg": "{:.1f}", "dolp_error": "{:.3f}", "s0_error": "{:.3f}",
            "aop_error_roi_deg": "{:.1f}", "dolp_error_roi": "{:.3f}",
            "aop_range_deg": "{:.0f}"}


def network_page(rows: Sequence[NetworkRow], weights: Mapping[str, Weights],
                 costs: Mapping[str, float], seeds: Sequence[int]) -> list[str]:
    """Return the Markdown: a table per scene and region, and the costs.

    Parameters
    ----------
    rows : sequence of NetworkRow
    weights : mapping of str to Weights
        Those that were used.
    costs : mapping of str to float
        Of `step_costs`.
    seeds : sequence of int
        Of the specimens.
    """
    lines = [
        "# network", "",
        *(f"{name}: weights {w.digest}, {w.parameters} numbers, "
          f"{w.about.get('pixel_steps', 'unknown')} pixel-steps of training."
          for name, w in weights.items()), "",
        "Mean absolute errors of super-pixels: AoP in degrees where the true DoLP "
        f"exceeds {_LEAST_DOLP}, DoLP, natural log of S0 up to one gain per recording. "
        "In the second table of a scene, of the mean of the middle 12x12 pixels: AoP, "
        "DoLP, range of AoP in degrees. Truth is the light in front of the camera. "
        f"Specimens {', '.join(map(str, seeds))}; textures of seeds "
        f"{', '.join(map(str, TEXTURE_SEEDS))} from a generator that training does not "
        f"use. Windows are 1/{WINDOWS_PER_PERIOD} of the period of the light at a "
        "pixel, or what a texture needs for one pixel, 1 ms at the least; every method "
        f"is scored at ends of windows, after {SETTLING} of them and 1 s. `firenet, "
        "table` is calibrated on another recording of the same specimen.", ""]
    for scene in dict.fromkeys(row.scene for row in rows):
        here = [row for row in rows if row.scene == scene]
        for region in dict.fromkeys(row.region for row in here):
            mine = [row for row in here if row.region == region]
            lines += [f"## {scene}" + ("" if region == "all" else f", {region}"), ""]
            lines += _table(mine, _COLUMNS)
            if any(math.isfinite(row.aop_error_roi_deg) for row in mine):
                lines += _table(mine, _ROI_COLUMNS)
    if costs:
        lines += ["## Cost", "", *table(
            ("network", "CPU time per 346x260 image, ms"),
            [(name, f"{ms:.0f}") for name, ms in costs.items()]),
            f"joint / firenet: {costs['joint'] / costs['firenet']:.2f}", ""]
    return lines


def _table(rows: Sequence[NetworkRow], columns: Sequence[str]) -> list[str]:
    settings = list(dict.fromkeys(row.setting for row in rows))
    windows = {row.setting: row.window_us for row in rows}
    body = []
    for name in METHODS:
        mine = [row for row in rows if row.method == name]
        if not mine:
            continue
        cells = [_cell([row for row in mine if row.setting == setting], columns)
                 for setting in settings]
        body.append([name, *cells, _cell(mine, columns)])
    head = ["method", *(f"{setting}, {windows[setting] / 1000:.3g} ms"
                        for setting in settings), "mean"]
    return table(head, body)


def _cell(rows: Sequence[NetworkRow], columns: Sequence[str]) -> str:
    parts = []
    for column in columns:
        values = np.array([getattr(row, column) for row in rows], np.float64)
        values = values[np.isfinite(values)]
        parts.append(_FORMATS[column].format(values.mean()) if len(values) else "-")
    return " / ".join(parts)


def network_figure(rows: Sequence[NetworkRow]) -> Figure:
    """Draw the errors of super-pixels: a line per scene, a mark per method.

    Marks are medians of speeds, textures and so on, lines reach from the least of them
    to the largest.
    """
    places = list(dict.fromkeys((row.scene, row.region) for row in rows))
    names = [name for name in METHODS if any(row.method == name for row in rows)]
    drawing = new_figure(PAGE_IN, 1.2 + 0.42 * len(places))
    panels = drawing.subplots(1, 2, sharey=True)
    letters(panels)
    for axes, (column, label) in zip(panels, (
            ("aop_error_deg", "AoP error (degrees)"), ("dolp_error", "DoLP error")),
            strict=True):
        for n, name in enumerate(names):
            style = look(name) | {"linestyle": "none"}
            for y, (scene, region) in enumerate(places):
                values = [getattr(row, column) for row in rows if (
                    row.scene, row.region, row.method) == (scene, region, name)]
                if not np.isfinite(values).any():
                    continue
                at = y + 0.09 * (n - (len(names) - 1) / 2)
                axes.plot(np.nanmedian(values), at, **style,
                          label=name if name not in axes.get_legend_handles_labels()[1]
                          else None)
                axes.plot((np.nanmin(values), np.nanmax(values)), (at, at),
                          color=style["color"], linewidth=0.7)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlabel(label)
    panels[0].set_yticks(range(len(places)), [
        scene if region in ("all", "middle") else f"{scene},\n{region}"
        for scene, region in places])
    panels[0].invert_yaxis()
    drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center",
                   ncols=4)
    return drawing
