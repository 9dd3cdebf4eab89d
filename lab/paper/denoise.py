"""What `EventDenoiser` leaves of noise, and keeps of the events that light makes."""
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.denoise import EventDenoiser
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer, Scene

from .page import table
from .print_style import PAGE_IN, letters, new_figure
from .rotation import RPMS
from .run import OFF_LOCK, SETTLE_US, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SIZE = (48, 48)
HOT_FRACTION, HOT_HZ = 0.01, 100.0
_DARK = FlatLight(s0=0.01)


@dataclass(frozen=True)
class Denoised:
    """One speed and specimen.

    Parameters
    ----------
    camera : str
    seed : int
    start_deg, rpm : float
    noise_hz, left_hz : float
        Events per pixel and second in the dark, before and after.
    true_hz : float
        Events per pixel and second that the light makes.
    kept : float
        Share of these that is kept, among the noise.
    """

    camera: str
    seed: int
    start_deg: float
    rpm: float
    noise_hz: float
    left_hz: float
    true_hz: float
    kept: float


@dataclass(frozen=True)
class Example:
    """Events of an interval, and what the denoiser makes of them.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
    true, kept : ndarray of bool, shape (N,)
        Whether light made an event; whether it is kept.
    rpm : float
    """

    events: NDArray[Any]
    true: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    rpm: float


def denoise_cases(settings: Settings) -> Iterator[Denoised]:
    """Yield what is measured, specimen by specimen.

    Noise and light are recorded apart, so that it is known of each event which of the
    two made it, and put together in the order of time.
    """
    rpms = settings.rpms or ((RPMS[0], RPMS[-1]) if settings.quick else RPMS)
    seconds = settings.seconds or (3.0 if settings.quick else 5.0)
    for camera in settings.cameras or ("nominal",):
        for seed, start in settings.specimens:
            noise = _events(camera, seed, _DARK, seconds,
                            hot_fraction=HOT_FRACTION, hot_hz=HOT_HZ)
            left = EventDenoiser(SIZE).filter(noise)
            for rpm in rpms:
                light = RotatingPolarizer(
                    rpm=rpm * OFF_LOCK, start_angle=math.radians(start))
                true = _events(camera, seed, light, seconds, shot_noise_hz=0, leak_hz=0)
                yield Denoised(
                    camera, seed, start, rpm, _rate(noise, seconds),
                    _rate(left, seconds), _rate(true, seconds), _kept(true, noise))


def _events(camera: str, seed: int, scene: Scene, seconds: float, **pixel: float
            ) -> NDArray[Any]:
    made = Camera.preset(camera, seed=seed, size=SIZE, aps=None, bus=None, dvs=pixel)
    return made.record(scene, seconds)[0].events()


def _rate(events: NDArray[Any], seconds: float) -> float:
    """Return events per pixel and second, once hot pixels are known."""
    settled = np.count_nonzero(events["t"] >= SETTLE_US)
    return settled / (seconds - SETTLE_US / 1e6) / (SIZE[0] * SIZE[1])


def _kept(true: NDArray[Any], noise: NDArray[Any]) -> float:
    events, made = _together(true, noise)
    counts = made & (events["t"] >= SETTLE_US)
    return float(EventDenoiser(SIZE).keep(events)[counts].mean())


def _together(true: NDArray[Any], noise: NDArray[Any]
              ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return both in the order of time, and which of them light made."""
    both = np.concatenate([true, noise])
    order = np.argsort(both["t"], kind="stable")
    return both[order], order < len(true)


_SHOWN_RPM, _SHOWN_US = 60.0, 20_000


def example(settings: Settings) -> Example:
    """Return the events of 20 ms: light within a disc, noise everywhere."""
    camera, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    seconds = (SETTLE_US + _SHOWN_US) / 1e6
    light = RotatingPolarizer(rpm=_SHOWN_RPM * OFF_LOCK)
    y, x = np.mgrid[:SIZE[0], :SIZE[1]]
    disc = np.hypot(y - (SIZE[0] - 1) / 2, x - (SIZE[1] - 1) / 2) < 0.36 * SIZE[0]
    true = _events(camera, seed, light, seconds, shot_noise_hz=0, leak_hz=0)
    events, made = _together(
        true[disc[true["y"], true["x"]]],
        _events(camera, seed, _DARK, seconds, hot_fraction=HOT_FRACTION,
                hot_hz=HOT_HZ))
    kept = EventDenoiser(SIZE).keep(events)
    shown = events["t"] >= SETTLE_US
    return Example(events[shown], made[shown], kept[shown], _SHOWN_RPM)


def denoise_figure(rows: Sequence[Denoised], shown: Example) -> Figure:
    """Draw an interval's events before and after, and rates by speed."""
    drawing = new_figure(PAGE_IN, 2.6)
    before, after, rates = drawing.subplots(
        1, 3, gridspec_kw={"width_ratios": (1, 1, 1.3)})
    letters((before, after, rates))
    for axes, part, title in (
            (before, np.ones(len(shown.events), np.bool_),
             f"{_SHOWN_US // 1000} ms, {shown.rpm:g} RPM"),
            (after, shown.kept, "denoised")):
        for made, colour, marker, label in (
                (True, "#0072B2", "o", "of light"), (False, "#D55E00", "x", "noise")):
            mine = shown.events[part & (shown.true == made)]
            axes.plot(mine["x"], mine["y"], marker, color=colour, markersize=2,
                      linestyle="none", markeredgewidth=0.6, label=label)
        axes.set(xlim=(-1, SIZE[1]), ylim=(SIZE[0], -1), aspect="equal",
                 xlabel="column", ylabel="row")
        axes.set_title(title)
    drawing.legend(*before.get_legend_handles_labels(), loc="outside lower center",
                   ncols=2)
    speeds = sorted({row.rpm for row in rows})
    for name, colour, line, label in (
            ("true_hz", "#0072B2", "o-", "of light"),
            ("noise_hz", "#D55E00", "x--", "noise"),
            ("left_hz", "#D55E00", "x:", "noise that is left")):
        values = np.array([[getattr(row, name) for row in rows if row.rpm == rpm]
                           for rpm in speeds])
        rates.loglog(speeds, values.mean(1), line, color=colour, label=label)
        if values.shape[1] > 1:
            rates.fill_between(speeds, values.min(1), values.max(1), color=colour,
                               alpha=0.15, linewidth=0)
    rates.set_xticks(speeds, [f"{rpm:g}" for rpm in speeds])
    rates.xaxis.set_minor_formatter("")
    rates.yaxis.set_major_formatter("{x:g}")
    rates.set(xlabel="turns per minute", ylabel="events per pixel and second",
              ylim=(None, 1e5))
    rates.legend(loc="upper left")
    return drawing


def denoise_page(rows: Sequence[Denoised]) -> list[str]:
    """Return the Markdown of the results."""
    lines = [
        "# denoise", "",
        "`EventDenoiser` with its own parameters: a chip of "
        f"{SIZE[1]}x{SIZE[0]} pixels, {100 * HOT_FRACTION:g} % of them hot with "
        f"{HOT_HZ:g} Hz. Noise is that in the dark, true events are those of a turning "
        "polarizer on the same specimen, the noise among them; after the first second.",
        ""]
    for camera in sorted({row.camera for row in rows}):
        mine = [row for row in rows if row.camera == camera]
        lines += [f"## `{camera}` camera", "", *table(
            ("RPM", "noise, Hz per pixel", "left, Hz per pixel",
             "true events, Hz per pixel", "of these kept, %"),
            [_line(rpm, [row for row in mine if row.rpm == rpm])
             for rpm in sorted({row.rpm for row in mine})])]
    left = max(row.left_hz for row in rows)
    kept = 100 * min(row.kept for row in rows)
    head = ("quantity", "paper", "here", "")
    return [*lines, "## Beside the paper", "", *table(head, [
        ("events where there is no light that changes, after denoising",
         "< 1 Hz per pixel", f"{left:.3f} Hz; {kept:.1f} % of true events kept",
         "agrees" if left < 1 else "differs")])]


def _line(rpm: float, rows: Sequence[Denoised]) -> tuple[str, ...]:
    noise, left, true, kept = (
        float(np.mean([getattr(row, name) for row in rows]))
        for name in ("noise_hz", "left_hz", "true_hz", "kept"))
    return (f"{rpm:g}", f"{noise:.2f}", f"{left:.3f}", f"{true:.1f}",
            f"{100 * kept:.2f}")
