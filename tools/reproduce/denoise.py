"""What `EventDenoiser` leaves of noise, and keeps of the events that light makes."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.denoise import EventDenoiser
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer, Scene

from .page import table
from .rotation import RPMS
from .run import OFF_LOCK, SETTLE_US, Settings

__all__ = ["Denoised", "columns", "denoise_cases", "denoise_page"]

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


def columns() -> tuple[str, ...]:
    """Return the names of the columns."""
    return tuple(field.name for field in dataclasses.fields(Denoised))


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
    both = np.concatenate([true, noise])
    order = np.argsort(both["t"], kind="stable")
    counts = (order < len(true)) & (both["t"][order] >= SETTLE_US)
    return float(EventDenoiser(SIZE).keep(both[order])[counts].mean())


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
    return lines


def _line(rpm: float, rows: Sequence[Denoised]) -> tuple[str, ...]:
    noise, left, true, kept = (
        float(np.mean([getattr(row, name) for row in rows]))
        for name in ("noise_hz", "left_hz", "true_hz", "kept"))
    return (f"{rpm:g}", f"{noise:.2f}", f"{left:.3f}", f"{true:.1f}",
            f"{100 * kept:.2f}")
