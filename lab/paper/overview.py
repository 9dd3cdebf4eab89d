"""Figure 1: layout, a pixel's answer to a step, AoP events, networks."""
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import AopEvents, Layout
from pdavis_cv.analysis import axial_difference
from pdavis_cv.fusion import fuse
from pdavis_cv.simulation import FULL, PRESETS, Camera, FunctionScene, Texture

from .network import all_weights
from .page import table
from .print_style import PAGE_IN, letters, new_figure
from .run import OFF_LOCK, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# ---- a pixel's answer to a step --------------------------------------------------

_STEP_US, _BACK_US, _END_S = 20_000, 60_000, 0.1
_RATIO = 4.0  # of light: eight ON events
_RISE_US = 20.0  # of the light: far below the photoreceptor's time constant


@dataclass(frozen=True)
class Step:
    """A pixel and light that is four times brighter for 40 ms.

    Parameters
    ----------
    t_us, light, receptor : ndarray of float64, shape (T,)
        Times, ln of the light and output of the photoreceptor, both from 0.
    on_us, off_us : ndarray of int64
        Times of the events.
    theta_on, theta_off, cutoff_hz : float
        Of the pixel.
    """

    t_us: NDArray[np.float64]
    light: NDArray[np.float64]
    receptor: NDArray[np.float64]
    on_us: NDArray[np.int64]
    off_us: NDArray[np.int64]
    theta_on: float
    theta_off: float
    cutoff_hz: float


def step_response(preset: str = "nominal") -> Step:
    """Simulate the events of a pixel without noise, mismatch and leak."""
    dvs = PRESETS[preset]["dvs"]
    if dvs.cutoff_hz is None:  # of presets that follow the light: that in full light
        raise ValueError(f"preset must have a constant bandwidth, got {preset!r}")
    camera = Camera.preset(preset, size=(2, 2), optics=PRESETS["ideal"]["optics"], dvs={
        "mismatch": 0.0, "mismatch_ln": 0.0, "leak_hz": 0.0, "leak_hz_per_dn_ms": 0.0,
        "shot_noise_hz": 0.0, "burst_chance": 0.0})

    def log_light(t: NDArray[np.float64]) -> NDArray[np.float64]:
        rise = np.tanh((t - _STEP_US) / _RISE_US) - np.tanh((t - _BACK_US) / _RISE_US)
        return np.asarray(math.log(_RATIO) / 2 * rise, np.float64)

    def light(t: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
              ) -> tuple[NDArray[np.float64], ...]:
        s0 = FULL / _RATIO * np.exp(log_light(t)) + 0 * x * y
        return s0, 0 * s0, 0 * s0

    recording, _ = camera.record(
        FunctionScene(light, sampling_us=5.0, uniform=True), _END_S)  # type: ignore[arg-type]
    events = recording.events()
    mine = events[(events["x"] == 0) & (events["y"] == 0)]
    t = np.arange(0, 1e6 * _END_S, 50.0)
    return Step(t, log_light(t), receptor_output(t, dvs.cutoff_hz),
                mine["t"][mine["p"] == 1], mine["t"][mine["p"] == 0],
                dvs.theta_on, dvs.theta_off, dvs.cutoff_hz)


def receptor_output(t_us: NDArray[np.float64], cutoff_hz: float) -> NDArray[np.float64]:
    """Return the first-order answer to the step up and the step down."""
    rate = 2e-6 * math.pi * cutoff_hz
    up, down = (1 - np.exp(-rate * np.maximum(t_us - at, 0))
                for at in (_STEP_US, _BACK_US))
    return np.asarray(math.log(_RATIO) * (up - down), np.float64)


def first_event_us(step: Step) -> float:
    """Return how long after the step theory has the first event."""
    return -1e6 * math.log(1 - step.theta_on / math.log(_RATIO)) / (
        2 * math.pi * step.cutoff_hz)


# ---- AoP events ------------------------------------------------------------------

_CLOUD_RPM, _CLOUD_SIDE, _CLOUD_S = 120.0, 32, 2.6
_SHOWN_US = 250_000  # a half turn at 120 RPM: AoP goes round once
_SPAN = 11.0, 6.5  # half sides of the rectangle, pixels


@dataclass(frozen=True)
class AopCloud:
    """AoP events of a rectangular polarizer that turns on a darker ground.

    Parameters
    ----------
    events : ndarray of AOP_EVENT_DTYPE, shape (N,)
        Of the last half turn.
    inside : ndarray of bool, shape (N,)
        Whether the polarizer was before the pixel all that time.
    true_aop : ndarray of float64, shape (N,)
        Radians, of the polarizer at the events' times.
    rpm : float
    """

    events: NDArray[Any]
    inside: NDArray[np.bool_]
    true_aop: NDArray[np.float64]
    rpm: float

    @property
    def error_deg(self) -> float:
        """Median error of the events inside."""
        off = axial_difference(self.events["aop"].astype(np.float64), self.true_aop)
        return float(np.degrees(np.median(np.abs(off[self.inside]))))


def aop_cloud(settings: Settings) -> AopCloud:
    """Record the turning rectangle and return its AoP events."""
    preset, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    camera = Camera.preset(preset, seed=seed, size=(_CLOUD_SIDE, _CLOUD_SIDE))
    rate = 2 * math.pi * _CLOUD_RPM * OFF_LOCK / 60e6
    middle = [origin + (_CLOUD_SIDE - 1) / 2 for origin in camera.origin]

    def light(t: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
              ) -> tuple[NDArray[np.float64], ...]:
        angle = rate * t
        right, up = x - middle[1], middle[0] - y
        along = np.cos(angle) * right + np.sin(angle) * up
        across = np.cos(angle) * up - np.sin(angle) * right
        part = _edge(along, _SPAN[0]) * _edge(across, _SPAN[1])
        s0 = FULL * (0.4 + 0.6 * part)
        return s0, FULL * part * np.cos(2 * angle), FULL * part * np.sin(2 * angle)

    recording, _ = camera.record(
        FunctionScene(light, sampling_us=500.0), _CLOUD_S)  # type: ignore[arg-type]
    dvs = PRESETS[preset]["dvs"]
    layout = camera.layout
    found = AopEvents(camera.size, theta_on=dvs.theta_on, theta_off=dvs.theta_off,
                      layout=layout, correct_phase=True).add(recording.events())
    shown = found[found["t"] >= 1e6 * _CLOUD_S - _SHOWN_US]
    centre = (_CLOUD_SIDE - 1) / 2
    inside = np.hypot(shown["x"] - centre, shown["y"] - centre) < _SPAN[1] - 3
    return AopCloud(shown, inside, rate * shown["t"] % np.pi, _CLOUD_RPM * OFF_LOCK)


def _edge(place: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    return np.asarray((1 + np.tanh((half - np.abs(place)) / 0.7)) / 2, np.float64)


# ---- networks --------------------------------------------------------------------

_NETWORKS = ("firenet", "joint")
_TEXTURE = {"velocity": (120.0, 50.0), "shortest": 12.0, "seed": 9101}
_WINDOW_US, _AT_US = 10_000, 900_000


@dataclass(frozen=True)
class NetworkView:
    """What a network makes of a moving texture, or the truth.

    Parameters
    ----------
    name : str
    s0, aop, dolp : ndarray of float, shape (H, W)
        S0 in DN per ms up to a gain, radians, 1.
    aop_error_deg, dolp_error : float
        Mean absolute errors, AoP where the true DoLP exceeds 0.3; NaN of the truth.
    """

    name: str
    s0: NDArray[np.floating[Any]]
    aop: NDArray[np.floating[Any]]
    dolp: NDArray[np.floating[Any]]
    aop_error_deg: float = math.nan
    dolp_error: float = math.nan


def network_views(settings: Settings) -> tuple[
        NDArray[np.float64], NDArray[np.float64], list[NetworkView]]:
    """Record a texture; return its last frame, its events, truth and networks.

    Returns
    -------
    frame : ndarray of float64, shape (H, W)
        DN.
    counts : ndarray of float64, shape (H, W)
        ON less OFF events of the window before.
    views : list of NetworkView
    """
    side = 40 if settings.quick else 64
    camera = Camera.preset((settings.cameras or ("nominal",))[0],
                           seed=settings.seeds[0], size=(side, side))
    recording, truth = camera.record(
        Texture(**_TEXTURE), (_AT_US + 1000) / 1e6)  # type: ignore[arg-type]
    frame = np.asarray([f.dn for p in recording.packets(None, _AT_US)
                        for f in p.frames][-1], np.float64)
    events = recording.events(_AT_US - _WINDOW_US, _AT_US)
    counts = np.zeros(camera.size)
    np.add.at(counts, (events["y"], events["x"]), 2.0 * events["p"] - 1)
    y, x = (2 * place + 0.5 for place in np.mgrid[:side // 2, :side // 2])
    s0, s1, s2 = truth.stokes(_AT_US, x, y)
    views = [NetworkView("truth", s0, np.arctan2(s2, s1) / 2 % np.pi,
                         np.hypot(s1, s2) / s0)]
    for name in (name for name in _NETWORKS if name in settings.methods):
        image = next(iter(fuse(
            recording, method=name, times_us=[_AT_US], demosaic="superpixel",
            window_us=_WINDOW_US, weights=all_weights(())[name])))
        off = np.abs(axial_difference(
            image.aop.astype(np.float64), views[0].aop))[views[0].dolp > 0.3]
        views.append(NetworkView(
            name, image.s0, image.aop, image.dolp, float(np.degrees(off.mean())),
            float(np.abs(image.dolp - views[0].dolp).mean())))
    return frame, counts, views


# ---- what is written and drawn ---------------------------------------------------


def cloud_rows(cloud: AopCloud) -> Iterator[tuple[Any, ...]]:
    """Yield the AoP events with their truth."""
    for event, inside, true in zip(
            cloud.events, cloud.inside, cloud.true_aop, strict=True):
        yield (int(event["t"]), int(event["x"]), int(event["y"]),
               float(np.rad2deg(event["aop"])), float(np.rad2deg(true)), int(inside))


CLOUD_COLUMNS = ("t_us", "x", "y", "aop_deg", "true_aop_deg", "inside")


def overview_page(step: Step, cloud: AopCloud, views: Sequence[NetworkView]
                  ) -> list[str]:
    """Return the Markdown of figure 1."""
    up = step.on_us[step.on_us > _STEP_US]
    first = float(up[0] - _STEP_US)
    return [
        "# fig1", "",
        "Simulated: layout as the code has it; a pixel without noise; AoP events of a "
        f"rectangular polarizer that turns at {cloud.rpm:.4g} RPM, the high pass's "
        "turn taken out (`correct_phase`); networks on events alone of a moving "
        f"texture, windows of {_WINDOW_US // 1000} ms.", "",
        *table(("quantity", "paper", "here", ""), [
            ("ON events of a step to four times the light", "-",
             f"{len(up)}; ln 4 / {step.theta_on:g} = "
             f"{math.log(_RATIO) / step.theta_on:.1f}", "agrees with theory"),
            ("first event after the step", "sub-millisecond",
             f"{first:.0f} us; theory {first_event_us(step):.0f} us at "
             f"{step.cutoff_hz:g} Hz", "agrees"),
            ("AoP events", "a stream of low latency",
             f"{len(cloud.events)} in {_SHOWN_US / 1000:g} ms; median error inside the "
             f"polarizer {cloud.error_deg:.1f} degrees", "agrees"),
            *((f"{view.name}: AoP / DoLP error", "pictures only",
               f"{view.aop_error_deg:.1f} degrees / {view.dolp_error:.2f}",
               "weights are ours: trained on simulation")
              for view in views if view.name != "truth")]),
    ]


def overview_figure(step: Step, cloud: AopCloud) -> Figure:
    """Draw layout, the step, the cloud of AoP events, and AoP over time."""
    from matplotlib.colors import hsv_to_rgb

    drawing = new_figure(PAGE_IN, 4.9)
    grid = drawing.add_gridspec(2, 3, width_ratios=(1, 1.25, 1.25))
    places = [drawing.add_subplot(grid[0, 0]), drawing.add_subplot(grid[0, 1:])]
    cloud_axes = drawing.add_subplot(grid[1, :2], projection="3d")
    angle_axes = drawing.add_subplot(grid[1, 2])
    _draw_layout(places[0], np.array(Layout.PDAVIS.angles_deg, np.float64))
    _draw_step(places[1], step)
    hue = np.stack([cloud.events["aop"] / np.pi % 1, np.ones(len(cloud.events)),
                    np.full(len(cloud.events), 0.9)], -1)
    colours = hsv_to_rgb(hue)
    _draw_cloud(cloud_axes, cloud, colours)
    _draw_angles(angle_axes, cloud, colours)
    letters([*places, cloud_axes, angle_axes])
    return drawing


def _draw_layout(axes: Any, layout_deg: NDArray[np.float64]) -> None:
    """Draw 4 x 4 pixels with the axes of what their polarizers pass."""
    from matplotlib.colors import hsv_to_rgb
    from matplotlib.patches import Rectangle

    for y in range(4):
        for x in range(4):
            angle = float(layout_deg[y % 2, x % 2])
            axes.add_patch(Rectangle((x, y), 1, 1, edgecolor="white", linewidth=1.5,
                                     facecolor=hsv_to_rgb((angle / 180, 0.35, 0.95))))
            dx, dy = np.cos(np.deg2rad(angle)), -np.sin(np.deg2rad(angle))
            for shift in np.linspace(-0.24, 0.24, 5):
                at_x, at_y = x + 0.5 - shift * dy, y + 0.36 + shift * dx
                axes.plot([at_x - 0.2 * dx, at_x + 0.2 * dx],
                          [at_y - 0.2 * dy, at_y + 0.2 * dy], color="0.2",
                          linewidth=0.7)
            axes.text(x + 0.5, y + 0.96, f"{angle:g}°", ha="center", va="bottom")
    axes.add_patch(Rectangle((0, 0), 2, 2, fill=False, edgecolor="black"))
    axes.set(xlim=(-0.05, 4.05), ylim=(4.05, -0.05), aspect="equal",
             xticks=[0.5, 1.5, 2.5, 3.5], yticks=[0.5, 1.5, 2.5, 3.5],
             xticklabels=range(4), yticklabels=range(4), xlabel="column",
             ylabel="row")
    axes.grid(visible=False)
    axes.set_title("lines: axes passed")


def _draw_step(axes: Any, step: Step) -> None:
    ms = step.t_us / 1000
    axes.plot(ms, step.light, color="0.6", linewidth=2.5, label="ln light")
    axes.plot(ms, step.receptor, color="black", linestyle="--", label="photoreceptor")
    for times, marker, colour, label in (
            (step.on_us, "^", "#009E73", "ON"), (step.off_us, "v", "#D55E00", "OFF")):
        axes.plot(times / 1000, np.interp(times, step.t_us, step.receptor), marker,
                  color=colour, label=label, markersize=3.5)
    axes.set_xlim(15, 75)
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("ln units")
    axes.legend(loc="lower center", handlelength=1.4)


def _draw_cloud(axes: Any, cloud: AopCloud, colours: NDArray[np.float64]) -> None:
    events = cloud.events
    some = np.random.default_rng(0).permutation(len(events))[:6000]
    ms = (events["t"] - events["t"][0]) / 1000
    axes.scatter(ms[some], events["x"][some], -events["y"][some].astype(float),
                 c=colours[some], s=1.0, linewidths=0, depthshade=False,
                 rasterized=True)
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("column", labelpad=-8)
    axes.set_zlabel("row", labelpad=-6)
    axes.set_yticks([0, 15, 30])
    axes.set_zticks([-30, -15, 0], ["30", "15", "0"])
    axes.tick_params(pad=-2)
    axes.set_box_aspect((2.2, 1, 1), zoom=1.4)
    axes.view_init(18, -62)


def _draw_angles(axes: Any, cloud: AopCloud, colours: NDArray[np.float64]) -> None:
    inside = cloud.inside
    ms = (cloud.events["t"] - cloud.events["t"][0]) / 1000
    true = np.rad2deg(cloud.true_aop)
    order = np.argsort(ms)
    line = np.where(np.abs(np.diff(true[order], prepend=true[order][0])) > 90, np.nan,
                    true[order])
    axes.plot(ms[order], line, color="black", linewidth=0.8, label="truth", zorder=3)
    axes.scatter(ms[inside], np.rad2deg(cloud.events["aop"][inside]), s=2.0,
                 c=colours[inside], linewidths=0, rasterized=True,
                 label="AoP events")
    axes.set(xlabel="time (ms)", ylabel="AoP (degrees)", ylim=(-5, 185),
             yticks=(0, 45, 90, 135, 180))
    axes.legend(loc="upper right", handlelength=1.0)


def views_figure(frame: NDArray[np.float64], counts: NDArray[np.float64],
                 views: Sequence[NetworkView]) -> Figure:
    """Draw a frame, events, and S0, AoP and DoLP of truth and networks."""
    from pdavis_cv.render import aop_bgr

    drawing = new_figure(PAGE_IN, 4.0)
    grid = drawing.subplots(1 + len(_NETWORKS), 5)
    grid[0, 0].imshow(frame, cmap="gray")
    grid[0, 0].set_title("frame")
    most = float(np.abs(counts).max()) or 1.0
    shown = grid[1, 0].imshow(counts, cmap="PuOr", vmin=-most, vmax=most)
    grid[1, 0].set_title(f"events of {_WINDOW_US // 1000} ms")
    grid[2, 0].set_axis_off()
    drawing.colorbar(shown, cax=grid[2, 0].inset_axes((0, 0.8, 1, 0.1)),
                     orientation="horizontal", label="ON less OFF")
    for line in grid[len(views):, 1:4].reshape(-1):
        line.set_axis_off()
    for line, view in zip(grid[:, 1:], views, strict=False):
        log = np.log10(np.maximum(view.s0, 1e-6))
        line[0].imshow(log - np.median(log), cmap="gray", vmin=-0.5, vmax=0.5)
        line[1].imshow(aop_bgr(view.aop)[..., ::-1])
        dolp = line[2].imshow(view.dolp, cmap="viridis", vmin=0, vmax=1)
        line[3].set_axis_off()
        line[0].set_ylabel(view.name)
    for axes, title in zip(grid[0, 1:4], ("log S0", "AoP", "DoLP"), strict=True):
        axes.set_title(title)
    letters([grid[0, 0], *grid[0, 1:4]])
    drawing.colorbar(dolp, cax=grid[0, 4].inset_axes((0, 0, 0.1, 1)), label="DoLP")
    _hues(grid[1, 4])
    grid[2, 4].set_axis_off()
    for axes in grid[:, :4].reshape(-1):
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
    return drawing


def _hues(axes: Any) -> None:
    """Draw the key of AoP."""
    from pdavis_cv.render import aop_bgr

    y, x = np.mgrid[1:-1:81j, -1:1:81j]
    radius = np.hypot(x, y)
    picture = aop_bgr(np.arctan2(y, x) % np.pi)[..., ::-1].copy()
    picture[(radius > 1) | (radius < 0.55)] = 255
    axes.set_axis_on()
    axes.imshow(picture)
    axes.set_xlabel("AoP: direction")
    axes.set(xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_visible(False)
