"""Light that is bright, dim, both, or not steady: fan, irradiance, flicker, edges."""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.simulation import (
    FULL,
    Camera,
    Fan,
    FlatLight,
    FunctionScene,
    RotatingPlate,
    RotatingPolarizer as Polarizer,
    Scene,
)

from .page import mean, pivot, table
from .run import METHODS, OFF_LOCK, Case, Row, Settings

Light = Callable[[float], Scene]

# ---- edges that pass -------------------------------------------------------------


def edges(speed: float, s0: float = FULL, width: float = 2.0) -> Scene:
    """Stripes, 4 to 1 in intensity, of their own angle and degree, that pass.

    Parameters
    ----------
    speed : float
        Pixels per second.
    s0 : float
        S0 of the bright ones, DN per ms.
    width : float
        Of an edge, pixels.
    """
    period, direction = 24.0, math.radians(20)
    steepness = 8.0 / width

    def light(
        t: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], ...]:
        along = x * math.cos(direction) + y * math.sin(direction) - speed * 1e-6 * t
        part = 0.5 + 0.5 * np.tanh(
            steepness * np.sin(2 * np.pi / period * along))
        total = s0 * (0.25 + 0.75 * part)
        polarized = total * (0.3 + 0.5 * part)
        twice = 2 * np.deg2rad(20 + 50 * part)
        return total, polarized * np.cos(twice), polarized * np.sin(twice)

    # It takes 16 samples to pass.
    return FunctionScene(
        light, sampling_us=width * 1e6 / speed / 16)  # type: ignore[arg-type]


# ---- figure 4a: the fan, half of it lit 2000 times more --------------------------

# A strip above the axis, across the edge of the bright half: a whole sensor would
# take minutes per second.  Height, width; row, column.
_STRIP, _PLACE = (12, 32), (54, 156)
_FROM_EDGE = 3.0
FAN_RPMS = (200.0, 1000.0)
_SEEN_DEG = 15.0  # half the step between sectors, which are told apart within it


def halves(camera: Camera) -> Mapping[str, NDArray[np.bool_]]:
    """Return the super-pixels in the dim and in the bright half of the fan."""
    height, width = (side // 2 for side in camera.size)
    x = np.arange(width) * 2 + 0.5 + camera.origin[1] - Fan(rpm=0).centre[0]
    across = np.broadcast_to(x, (height, width))
    return {"dark half": across > _FROM_EDGE, "bright half": across < -_FROM_EDGE}


def fan_cases(settings: Settings) -> list[Case]:
    """Return the recordings of the fan."""
    def light(rpm: float, start: float) -> Light:
        return lambda s0: Fan(rpm=rpm * OFF_LOCK, start_angle=start, s0=s0)

    return [
        Case(scene="fan", rpm=rpm, camera=camera, seed=seed, start_deg=start,
             light=light(rpm, math.radians(start)), origin=_PLACE,
             size=(4, _STRIP[1]) if settings.quick else _STRIP,
             regions=halves, margin=1.5,
             seconds=settings.seconds or (1.5 if settings.quick else 2.5))
        for camera in settings.cameras or ("nominal",)
        for seed, start in settings.specimens for rpm in settings.rpms or FAN_RPMS]


def fan_page(rows: Sequence[Row], settings: Settings) -> list[str]:
    """Return the Markdown of figure 4a."""
    lines = ["# fig4a", "", "A wheel of six polarizers, 30 degrees apart; its left "
             "half is lit 2000 times more than the other and saturates every frame. A "
             "strip across the edge of the light, 70 pixels from the axis, "
             f"{_STRIP[1]} pixels wide; super-pixels within 1.5 pixels of a "
             "sector's edge are left out. AoP error in degrees / part of them valid, "
             "from 1 s on.", ""]
    for camera in _event_cameras(rows):
        for region in ("dark half", "bright half"):
            mine = [row for row in rows if row.region == region
                    and (row.camera == camera or "Sony" in row.method)]
            lines += [f"## {region}, `{camera}` camera, by turns per minute", "",
                      *pivot(mine, "rpm", ("aop_error_deg", "valid"), average=False),
                      "Part of the AoP errors within one sigma (honest: 0.68).", "",
                      *pivot(mine, "rpm", ("aop_coverage",), average=False)]
    slow = [row for row in rows if row.rpm == min(r.rpm for r in rows)]
    here = {name: [mean([row for row in slow if (row.method, row.region) == (
        name, half)], "aop_error_deg") for half in ("dark half", "bright half")]
        for name in METHODS if any(r.method == name for r in slow)}
    blind = [name for name, errors in here.items()
             if METHODS[name].preset is None and "frames" not in name
             and not all(error < _SEEN_DEG for error in errors)]
    sony = all(not errors[1] < _SEEN_DEG for name, errors in here.items()
               if METHODS[name].preset is not None)
    head = ("quantity", "paper", "here", "")
    lines += ["## Beside the paper", "", *table(head, [
        (f"AoP in both halves at {slow[0].rpm:g} RPM",
         "PDAVIS measures it in both, the Sony not in the bright one",
         "; ".join(f"{name}: {_error(slow, name, 'dark half')} in the dark half, "
                   f"{_error(slow, name, 'bright half')} in the bright one"
                   for name in here),
         "differs" if not sony else "agrees" if not blind else
         f"agrees, but for {', '.join(blind)}: held to frames, saturated there")])]
    return lines


def _error(rows: Sequence[Row], method: str, region: str) -> str:
    mine = [row for row in rows if (row.method, row.region) == (method, region)]
    return f"{mean(mine, 'aop_error_deg'):.1f}"


# ---- the supplement's dynamic range ----------------------------------------------

LOW_UW_CM2, HIGH_UW_CM2 = 0.04, 42_000.0
LEVELS = 13
# DN per ms that 1 microwatt per cm2 gives; see `IrradianceSweep`.
EVENT_DN, SONY_DN = 27.0, 0.68
_RANGE_RPM = 60.0


def dynamic_range_cases(settings: Settings) -> list[Case]:
    """Return the recordings of the irradiance sweep, one per level."""
    def polarizer(rpm: float, start: float) -> Light:
        return lambda s0: Polarizer(rpm=rpm * OFF_LOCK, start_angle=start, s0=s0)

    def plate(rpm: float, start: float) -> Light:
        return lambda s0: RotatingPlate(rpm=rpm * OFF_LOCK, start_angle=start, s0=s0)

    levels = np.geomspace(LOW_UW_CM2, HIGH_UW_CM2, 5 if settings.quick else LEVELS)
    return [
        Case(scene=name, rpm=rpm, camera=camera, seed=seed, start_deg=start,
             light=light(rpm, math.radians(start)), irradiance_uw_cm2=float(level),
             event_dn_per_ms=EVENT_DN * level, sony_dn_per_ms=SONY_DN * level,
             seconds=settings.seconds or (2.5 if settings.quick else 3.5))
        for camera in settings.cameras or (
            ("nominal",) if settings.quick else ("nominal", "realistic"))
        for name, light in (("polarizer", polarizer), ("rotating plate", plate))
        for seed, start in settings.specimens
        for rpm in settings.rpms or (_RANGE_RPM,) for level in levels]


def dynamic_range_page(rows: Sequence[Row], settings: Settings) -> list[str]:
    """Return the Markdown of the irradiance sweep."""
    lines = ["# dr", "", "A polarizer, and a quarter-wave plate behind a polarizer, "
             f"turning at {rows[0].rpm:g} RPM; a recording of its own for each "
             "irradiance. `realistic` pixels are as fast as the light is bright. "
             f"PDAVIS: {EVENT_DN:g} DN/ms per uW/cm2, frames saturate from 1.4 uW/cm2 "
             f"on; Sony: {SONY_DN:g} DN/ms per uW/cm2. Columns: irradiance in uW/cm2. "
             "Range is largest less smallest AoP of the region's mean: it is blind to "
             "noise; see `python -m lab.paper range`.", ""]
    for camera in _event_cameras(rows):
        for scene in ("polarizer", "rotating plate"):
            mine = [row for row in rows if row.scene == scene
                    and (row.camera == camera or "Sony" in row.method)]
            across = {"across": "irradiance_uw_cm2", "label": "{:.3g}".format}
            lines += [f"## {scene}, `{camera}` camera", "",
                      "AoP error in degrees, super-pixels / region's mean.", "",
                      *pivot(mine, columns=("aop_error_deg", "aop_error_roi_deg"),
                             **across),  # type: ignore[arg-type]
                      "Range of AoP in degrees / part of the super-pixels valid.", "",
                      *pivot(mine, columns=("aop_range_deg", "valid"), average=False,
                             **across),  # type: ignore[arg-type]
                      "Part of the errors within one sigma (honest: 0.68): AoP / "
                      "DoLP.", "",
                      *pivot(mine, columns=("aop_coverage", "dolp_coverage"),
                             average=False, **across)]  # type: ignore[arg-type]
    return lines


# ---- a lamp on the mains, a background -------------------------------------------

FLICKER_RPMS = (60.0, 200.0, 1000.0)
_MAINS_HZ, _DEPTH = 60.0, 0.1
_SCENES = ("polarizer", "polarizer over a background")
_FLICKERS = ", 120 Hz flicker"


def flicker_cases(settings: Settings) -> list[Case]:
    """Return the recordings with and without flicker, twice."""
    def light(name: str, rpm: float, start: float) -> Light:
        def made(s0: float) -> Scene:
            part = s0 if "background" not in name else 0.7 * s0
            scene: Scene = Polarizer(rpm=rpm * OFF_LOCK, start_angle=start, s0=part)
            if "background" in name:
                scene = scene + FlatLight(s0=0.3 * s0, dolp=0.3, aop=math.radians(30))
            return scene.flicker(_MAINS_HZ, _DEPTH) if _FLICKERS in name else scene
        return made

    names = [scene + after for scene in (_SCENES[:1] if settings.quick else _SCENES)
             for after in ("", _FLICKERS)]
    return [
        Case(scene=name, rpm=rpm, camera=camera, seed=seed, start_deg=start,
             light=light(name, rpm, math.radians(start)),
             seconds=settings.seconds or (2.0 if settings.quick else 3.0))
        for camera in settings.cameras or ("nominal",)
        for name in names for seed, start in settings.specimens
        for rpm in settings.rpms or FLICKER_RPMS]


def flicker_page(rows: Sequence[Row], settings: Settings) -> list[str]:
    """Return the Markdown of the flicker."""
    lines = ["# flicker", "", "A rotating polarizer, alone and with 30 % of the light "
             "from a fixed background of DoLP 0.3, under a lamp of 1 + 0.1 cos(2 pi "
             "120 Hz t). Super-pixels: AoP in degrees / DoLP, by turns per minute.", ""]
    for camera in _event_cameras(rows):
        for scene in (name for name in _SCENES if any(r.scene == name for r in rows)):
            steady, lit = ([row for row in rows if row.scene == scene + after
                            and (row.camera == camera or "Sony" in row.method)]
                           for after in ("", _FLICKERS))
            columns = ("aop_error_deg", "dolp_error")
            speeds = sorted({row.rpm for row in steady})
            ratios = [[name, *(" / ".join(
                _times(_at(lit, name, rpm, c), _at(steady, name, rpm, c))
                for c in columns) for rpm in speeds)]
                for name in METHODS if any(row.method == name for row in steady)]
            lines += [f"## {scene}, `{camera}` camera", "", "Steady lamp.", "",
                      *pivot(steady, "rpm", columns), "Flickering lamp.", "",
                      *pivot(lit, "rpm", columns),
                      "Error with flicker over error without.", "",
                      *table(("method", *(f"{rpm:g}" for rpm in speeds)), ratios)]
    return lines


def _times(error: float, without: float) -> str:
    return "-" if math.isnan(error / without) else f"{error / without:.2f}"


def _at(rows: Sequence[Row], method: str, rpm: float, column: str) -> float:
    return mean([row for row in rows if (row.method, row.rpm) == (method, rpm)], column)


def _event_cameras(rows: Sequence[Row]) -> list[str]:
    return sorted({row.camera for row in rows if "Sony" not in row.method})
