"""Figure 4b: a tendon that is pulled: traces, spectrum, lock-in maps, truth behind."""
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.analysis import HarmonicFit, PhaseLaw
from pdavis_cv.fusion import fuse
from pdavis_cv.simulation import Camera, Tendon

from . import run as runs
from .network import all_weights
from .page import table
from .print_style import PAGE_IN, letters, look, new_figure
from .run import OFF_LOCK, Case, Settings, Take, fuse_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SPEEDS_HZ = (1.0, 5.0, 10.0)
"""The paper's."""
_QUICK_HZ = (1.0, 10.0)
_SIDE, _CYCLES_S = 32, 2  # seconds that count: whole cycles of every speed
_IMAGES_PER_CYCLE = 40
_SHOWN_CYCLES = 2.2
_HARMONICS = 4
_FRAMES = "frames, own times"
_NETWORKS = ("firenet", "joint")
_METHODS = (_FRAMES, "cf", "kalman", *_NETWORKS)
# Of the networks: 50 and 10 ms at 1 and 10 Hz, as in the paper.
_WINDOW_OF_CYCLE, _LONGEST_US = 0.1, 50_000


@dataclass(frozen=True)
class Pull:
    """What one method makes of one speed.

    Parameters
    ----------
    hz : float
    method : str
        ``"truth"``, or a method.
    t_us : ndarray of int64, shape (T,)
    dolp : ndarray of float64, shape (T,)
        Of the mean Stokes vector of all pixels.
    true : ndarray of float64, shape (T,)
        The same of the light.
    amplitude : ndarray of float64, shape (H, W)
        Of DoLP at the load's frequency, each super-pixel, by lock-in.
    """

    hz: float
    method: str
    t_us: NDArray[np.int64]
    dolp: NDArray[np.float64]
    true: NDArray[np.float64]
    amplitude: NDArray[np.float64]


def _speeds(settings: Settings) -> tuple[float, ...]:
    return _QUICK_HZ if settings.quick else SPEEDS_HZ


def _shown(settings: Settings) -> list[str]:
    return [name for name in _METHODS if name in settings.methods]


def count(settings: Settings) -> int:
    """Return how many `pulls` yields."""
    return len(_speeds(settings)) * (1 + len(_shown(settings)))


def pulls(settings: Settings) -> Iterator[Pull]:
    """Record the tendon at each speed and yield truth and methods."""
    preset, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    for nominal_hz in _speeds(settings):
        hz = nominal_hz * OFF_LOCK
        camera = Camera.preset(preset, seed=seed, size=(_SIDE, _SIDE))
        whole_us = _CYCLES_S / OFF_LOCK * 1e6
        recording, truth = camera.record(
            Tendon(hz=hz), (runs.SETTLE_US + whole_us + runs.TAIL_US) / 1e6)
        take = Take(recording, truth, 0, truth.stop_us)
        grid = (take.settled_us + np.arange(round(_IMAGES_PER_CYCLE * _CYCLES_S
                                                  * nominal_hz))
                * whole_us / (_IMAGES_PER_CYCLE * _CYCLES_S * nominal_hz)
                ).astype(np.int64)
        yield _followed("truth", hz, grid, _truth(truth, grid), truth)
        for name in _shown(settings):
            yield _followed(name, hz, *_images(name, hz, preset, take, grid), truth)


def _truth(truth: Any, t_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return S0, S1, S2 in the middles of super-pixels, shape (T, 3, H, W)."""
    y, x = (2 * place + 0.5 for place in np.mgrid[:_SIDE // 2, :_SIDE // 2])
    return np.array([truth.stokes(int(t), x, y) for t in t_us])


def _images(name: str, hz: float, preset: str, take: Take, grid: NDArray[np.int64]
            ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    method = runs.METHODS.get(name, runs.Method(parameters={"method": name}))
    options = fuse_parameters(method, Case(
        scene="tendon", light=lambda s0: Tendon(hz=hz), rpm=math.nan, camera=preset))
    if name in _NETWORKS:
        options |= {"weights": all_weights(())[name], "window_us": round(
            min(_LONGEST_US, 1e6 * _WINDOW_OF_CYCLE / hz))}
    when: dict[str, Any] = {"times_us": grid}
    if method.own_times:
        when = {"start_us": int(grid[0]), "stop_us": int(2 * grid[-1] - grid[-2])}
    made = [(image.t_us, [np.where(image.valid, plane, np.nan) for plane in (
        image.s0, image.s1, image.s2)]) for image in fuse(
            take.recording, demosaic="superpixel", **when, **options)]
    return (np.array([t for t, _ in made], np.int64),
            np.array([planes for _, planes in made], np.float64))


def _followed(name: str, hz: float, t_us: NDArray[np.int64],
              stokes: NDArray[np.float64], truth: Any) -> Pull:
    lock = HarmonicFit(
        (_SIDE // 2, _SIDE // 2), PhaseLaw.steady(hz, int(t_us[0])), harmonics=1,
        degree=0, span_us=(int(t_us[0]), int(t_us[-1])), signals=1)
    for t, (s0, s1, s2) in zip(t_us, stokes, strict=True):
        lock.add(int(t), (np.hypot(s1, s2) / s0)[None])
    return Pull(hz, name, t_us, _dolp_of_mean(stokes),
                _dolp_of_mean(_truth(truth, t_us)),
                lock.result().wave().amplitude[0])


def _dolp_of_mean(stokes: NDArray[np.float64]) -> NDArray[np.float64]:
    s0, s1, s2 = np.nanmean(stokes, (2, 3)).T
    return np.asarray(np.hypot(s1, s2) / s0, np.float64)


def amplitude_at(pull: Pull, values: NDArray[np.float64], hz: float) -> float:
    """Return the amplitude of a cosine at a frequency, by least squares."""
    phase = 2e-6 * np.pi * hz * (pull.t_us - pull.t_us[0])
    basis = np.stack((np.ones_like(phase), np.cos(phase), np.sin(phase)), 1)
    _, a, b = np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.hypot(a, b))


# ---- what is written and drawn ---------------------------------------------------


COLUMNS = ("hz", "method", "t_us", "dolp", "true_dolp")


def pull_rows(made: Sequence[Pull]) -> Iterator[tuple[Any, ...]]:
    """Yield the traces."""
    for pull in made:
        for t, found, true in zip(pull.t_us, pull.dolp, pull.true, strict=True):
            yield pull.hz, pull.method, int(t), found, true


def tendon_page(made: Sequence[Pull]) -> list[str]:
    """Return the Markdown: amplitudes and errors by speed."""
    speeds = list(dict.fromkeys(pull.hz for pull in made))
    rows = []
    for name in dict.fromkeys(pull.method for pull in made):
        mine = {pull.hz: pull for pull in made if pull.method == name}
        rows.append([name, *(_told(mine[hz], made) for hz in speeds)])
    return ["# tendon", "",
            f"A birefringent fibre sheet pulled at 1 to 10 Hz (times {OFF_LOCK}), "
            f"strain 2 to 3 %, {_SIDE} x {_SIDE} pixels, two seconds from 1 s on. DoLP "
            "of the mean Stokes vector: amplitude at the load's frequency / its true "
            "one / mean absolute error of the trace, straight between images. Frames: "
            "20 per second, at their own times.", "",
            *table(("method", *(f"{hz / OFF_LOCK:g} Hz" for hz in speeds)), rows),
            "## Beside the paper", "", *table(("quantity", "paper", "here", ""), [
                ("1 Hz", "frames and network similar", _line(made, min(speeds)),
                 _follows(made, min(speeds))),
                ("10 Hz", "frames at 20 per second severely aliased; the network "
                 "reconstructs it", _line(made, max(speeds)),
                 _follows(made, max(speeds)))])]


_FOLLOWS = 0.7
"""Part of the true amplitude, in phase with it, from which a trace follows the load."""


def _follows(made: Sequence[Pull], hz: float) -> str:
    """Say which methods follow the load at a speed: the swing of truth in a trace."""
    truth, = (one for one in made if (one.method, one.hz) == ("truth", hz))
    swing = truth.dolp - truth.dolp.mean()
    parts = {}
    for pull in made:
        if pull.hz == hz and pull.method != "truth":
            between = np.interp(truth.t_us, pull.t_us, pull.dolp)
            parts[pull.method] = float(between @ swing / (swing @ swing))
    told = [name for name, part in parts.items() if part > _FOLLOWS]
    lost = [f"{name} ({part:.2f} of the swing)" for name, part in parts.items()
            if part <= _FOLLOWS]
    aliased = hz > 2 * OFF_LOCK     # of two speeds of the paper the fast one
    agree = [(_FRAMES in told) != aliased] * (_FRAMES in parts) + [
        any(name in told for name in _NETWORKS)] * any(
            name in parts for name in _NETWORKS)
    verdict = "-" if not agree else "agrees" if all(agree) else "differs"
    return "; ".join([verdict, f"follow: {', '.join(told) or 'none'}",
                      *([f"do not: {', '.join(lost)}"] if lost else [])])


def _told(pull: Pull, made: Sequence[Pull]) -> str:
    return (f"{amplitude_at(pull, pull.dolp, pull.hz):.3f} / "
            f"{amplitude_at(pull, pull.true, pull.hz):.3f} / "
            f"{error(pull, made):.3f}")


def error(pull: Pull, made: Sequence[Pull]) -> float:
    """Return the mean absolute error of a trace, straight between its images."""
    truth, = (one for one in made if (one.method, one.hz) == ("truth", pull.hz))
    between = np.interp(truth.t_us, pull.t_us, pull.dolp)
    return float(np.abs(between - truth.dolp).mean())


def _line(made: Sequence[Pull], hz: float) -> str:
    return "; ".join(
        f"{pull.method}: error {error(pull, made):.3f}, "
        f"{len(pull.t_us) / (_CYCLES_S / OFF_LOCK) / pull.hz:.3g} images per cycle"
        for pull in made if pull.hz == hz and pull.method != "truth")


def tendon_figure(made: Sequence[Pull]) -> Figure:
    """Draw traces and spectra by speed, and lock-in maps of the fastest."""
    speeds = list(dict.fromkeys(pull.hz for pull in made))
    drawing = new_figure(PAGE_IN, 1.75 * len(speeds) + 2.0)
    upper, lower = drawing.subfigures(
        2, 1, squeeze=False, height_ratios=(1.75 * len(speeds), 1.6))[:, 0]
    grid = upper.subplots(len(speeds), 2, squeeze=False,
                          gridspec_kw={"width_ratios": (2, 1)})
    for (traces, spectra), hz in zip(grid, speeds, strict=True):
        for pull in (pull for pull in made if pull.hz == hz):
            _draw_trace(traces, pull)
            _draw_spectrum(spectra, pull)
        traces.set_ylabel(f"DoLP, {hz / OFF_LOCK:g} Hz")
        spectra.set_ylabel("amplitude of DoLP")
        spectra.set(yscale="log", ylim=(1e-4, 0.5), xlim=(0, _HARMONICS + 0.5))
    grid[-1, 0].set_xlabel("time (cycles)")
    grid[-1, 1].set_xlabel("frequency (of the load's)")
    letters(grid.reshape(-1))
    upper.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center",
                 ncols=6)
    last = [pull for pull in made if pull.hz == speeds[-1]]
    maps = lower.subplots(1, len(last), squeeze=False)[0]
    top = float(np.nanquantile(last[0].amplitude, 0.98))
    lower.text(0.01, 0.98, "abcdefgh"[2 * len(speeds)], fontweight="bold", va="top")
    for axes, pull in zip(maps, last, strict=True):
        shown = axes.imshow(pull.amplitude, cmap="viridis", vmin=0, vmax=1.5 * top)
        axes.set_title(pull.method.replace(", ", ",\n"))
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
    lower.colorbar(shown, ax=list(maps), location="bottom", fraction=0.1, aspect=50,
                   label=f"amplitude of DoLP at {speeds[-1] / OFF_LOCK:g} Hz")
    return drawing


def _draw_trace(axes: Any, pull: Pull) -> None:
    cycles = (pull.t_us - pull.t_us[0]) * 1e-6 * pull.hz
    some = cycles <= _SHOWN_CYCLES
    style = {**look(pull.method), "markersize": 2.5}
    if pull.method == "truth":
        style |= {"color": "0.6", "linewidth": 2.5}
    elif pull.method != _FRAMES:
        style |= {"marker": "", "linewidth": 0.9}
    axes.plot(cycles[some], pull.dolp[some], label=pull.method, **style)


def _draw_spectrum(axes: Any, pull: Pull) -> None:
    """Draw the amplitudes of the record, which holds whole cycles."""
    step = float(np.diff(pull.t_us).mean()) * 1e-6
    values = pull.dolp - pull.dolp.mean()
    hz = np.fft.rfftfreq(len(values), step)[1:]
    amplitude = 2 * np.abs(np.fft.rfft(values))[1:] / len(values)
    style = {**look(pull.method), "marker": "", "linewidth": 0.9}
    if pull.method == "truth":
        style |= {"color": "0.6", "linewidth": 2.5}
    shown = hz < (_HARMONICS + 0.5) * pull.hz
    axes.plot(hz[shown] / pull.hz, amplitude[shown], **style)
