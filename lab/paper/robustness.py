"""Robustness: every method on cameras and light that depart from what is assumed."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._workers import usable_cores
from pdavis_cv.simulation import (
    FULL,
    FlatLight,
    FunctionScene,
    MalusSweep,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
    Texture,
)

from .light import EVENT_DN, LOW_UW_CM2, fan_cases
from .run import METHODS, OFF_LOCK, Case, Method, Row, Settings, Takes, run


CAUSAL: dict[str, Method] = {
    "frames": METHODS["frames"],
    "cf causal": Method(parameters={"method": "cf", "causal": True}),
    "events, redundancy causal": Method(parameters={
        "method": "events", "offsets": "redundancy", "causal": True}),
    "kalman causal": METHODS["kalman causal"],
}
"""What may be compared live: frames are held from the end of their readout."""

RECORDED: dict[str, Method] = {
    "frames from mid-exposure": Method(parameters={"method": "frames", "hold": "mid"}),
    "cf": METHODS["cf"],
    "events, redundancy": METHODS["events, redundancy"],
    "kalman": Method(parameters={"method": "kalman"}),
    "kalman offline": Method(parameters={"method": "kalman", "mode": "offline"}),
}
"""What may be compared on a recording; nothing is set that is not the default."""

ALL = CAUSAL | RECORDED
SEEDS, QUICK_SEEDS = (1, 2, 3, 4, 5), (1,)
STEPS_US = 5077, 10_151  # between images, and with --quick

_MS = 1000
# Of a pixel in the middle of the polarizer's swing, DN per ms.
_MEAN_LIGHT = FULL / 2

DEPARTURES: Mapping[str, Mapping[str, Any]] = {
    "unchanged": {},
    **{f"frame stamps {ms:+d} ms": {"faults": {"frame_offset_us": ms * _MS}}
       for ms in (-10, -5, -3, 3, 5, 10)},
    "refractory period 1 ms": {"dvs": {"refractory_us": 1.0 * _MS}},
    "refractory period 3 ms": {"dvs": {"refractory_us": 3.0 * _MS}},
    "10 % of events lost": {"faults": {"lost": 0.1}},
    "drift of thresholds, ON +15 %, OFF -5 %": {
        "faults": {"drift_on": 0.15, "drift_off": -0.05}},
    "jitter 1 ms": {"faults": {"jitter_us": 1.0 * _MS}},
    "5 % hot pixels, 1 kHz": {"dvs": {"hot_fraction": 0.05, "hot_hz": 1000.0}},
    "second pole, 250 Hz": {"dvs": {"second_pole_hz": 250.0}},
    "bandwidth 80 Hz, in proportion to light": {
        "dvs": {"cutoff_hz": None, "cutoff_hz_per_dn_ms": 80.0 / _MEAN_LIGHT}},
}
"""Name -> what `Camera.preset` is told besides; of a polarizer that turns."""

# Before the first 20 ms exposure ends at the usual 20 frames per second, everything is
# unknown; 1 s settles (`SETTLE_US`), .44 s are scored.
_SECONDS = 1.5
_SPEEDS_RPM = (30.0, 200.0, 1000.0)
_SPEEDS_PX_S = (60.0, 200.0, 600.0)
_STATIC_LIGHT = (1.0, 5.0, FULL)  # S0, DN per ms: 10, 50 and 300 DN in a frame
_SIZE, _QUICK_SIZE = (16, 16), (12, 12)
# Between specimens, degrees: golden angle of the half turn, so that no angle repeats.
_START_STEP_DEG = 111.2

Light = Callable[[float], Scene]


def robustness_cases(settings: Settings) -> list[Case]:
    """Return the recordings of the table, all conditions of one specimen together."""
    cases = []
    for seed, start in settings.specimens:
        turned = (start + _START_STEP_DEG * seed) % 180
        common: dict[str, Any] = {
            "seed": seed, "start_deg": turned,
            "size": _QUICK_SIZE if settings.quick else _SIZE,
            "seconds": settings.seconds or _SECONDS}
        for camera in settings.cameras or ("nominal", "davis346"):
            own = {"camera": camera, **common}
            if camera == "nominal" or settings.cameras:
                cases += _departures(settings, DEPARTURES, own)
                cases += _scenes(settings, own)
            else:
                cases += _departures(settings, {"unchanged": {}}, own)
    return cases


def _departures(
    settings: Settings, changes: Mapping[str, Mapping[str, Any]], own: dict[str, Any],
) -> list[Case]:
    start = math.radians(own["start_deg"])

    def light(rpm: float) -> Light:
        return lambda s0: RotatingPolarizer(
            rpm=rpm * OFF_LOCK, start_angle=start, s0=s0)

    return [Case(scene=name, rpm=rpm, light=light(rpm), changes=change, **own)
            for name, change in changes.items() for rpm in settings.rpms or _SPEEDS_RPM]


def _scenes(settings: Settings, own: dict[str, Any]) -> list[Case]:
    """Return light that rests, has structure, is dim, or saturates frames."""
    start, seed = math.radians(own["start_deg"]), own["seed"]
    dim, bright = EVENT_DN * LOW_UW_CM2, EVENT_DN * 41.0
    slow = {"rpm": 60.0, **own}

    def plate(s0: float) -> Scene:
        return RotatingPlate(rpm=60.0 * OFF_LOCK, start_angle=start, s0=s0)

    def polarizer(s0: float) -> Scene:
        return RotatingPolarizer(rpm=60.0 * OFF_LOCK, start_angle=start, s0=s0)

    def turn(s0: float) -> Scene:
        return MalusSweep(step=math.radians(40), hold_us=750_000, move_us=150_000,
                          start_angle=start, s0=s0, dolp=0.8)

    def texture(speed: float) -> Light:
        return lambda s0: Texture(
            velocity=(speed * 0.96, speed * 0.28), s0=s0, seed=seed)

    def stripes(speed: float) -> Light:
        return lambda s0: edges(speed, s0)

    structured = {"rpm": 0.0, "demosaic": "bilinear", **own}
    still = {"rpm": 0.0, **own}
    fans = fan_cases(dataclasses.replace(
        settings, cameras=(own["camera"],), seeds=(seed,), rpms=(200.0,),
        starts_deg=(own["start_deg"],), seconds=own["seconds"]))
    return [
        *(Case(scene=f"at rest, DoLP 0.3, {round(20 * s0 / 2)} DN in a frame",
               light=lambda s0: FlatLight(s0=s0, dolp=0.3, aop=start),
               event_dn_per_ms=s0, **still) for s0 in _STATIC_LIGHT),
        # Turned once, .6 s before the end.
        Case(scene="at rest after a turn of 40 degrees", light=turn,
             **{**still, "seconds": 1.5}),
        *(Case(scene=f"texture, {speed:g} pixels/s", light=texture(speed), **structured)
          for speed in _SPEEDS_PX_S),
        *(Case(scene=f"edges, {speed:g} pixels/s", light=stripes(speed), **structured)
          for speed in _SPEEDS_PX_S),
        Case(scene="rotating plate, 40 nW/cm2", light=plate, event_dn_per_ms=dim,
             **slow),
        Case(scene="polarizer, 41 uW/cm2, frames saturated", light=polarizer,
             event_dn_per_ms=bright, **slow),
        *fans]


def edges(speed: float, s0: float = FULL) -> Scene:
    """Stripes, 4 to 1 in intensity, of their own angle and degree, that pass."""
    period, steepness, direction = 24.0, 4.0, math.radians(20)

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

    # An edge, period / (pi steepness) = 2 pixels wide, takes 16 samples to pass.
    return FunctionScene(light, sampling_us=2e6 / speed / 16)  # type: ignore[arg-type]


def robustness_rows(settings: Settings) -> Iterator[list[Row]]:
    """Yield the rows of each case, in order; cases run on all cores, in processes."""
    count = len(robustness_cases(settings))
    workers = min(usable_cores(), count)
    if workers < 2:
        yield from map(case_rows, [settings] * count, range(count))
        return
    # "spawn": a fork of a process that has threads may never go on.
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        yield from pool.map(case_rows, [settings] * count, range(count))


def case_rows(settings: Settings, index: int) -> list[Row]:
    """Return the rows of a case, made here: its light, a function, does not travel."""
    case = robustness_cases(settings)[index]
    return list(run(case, settings, Takes(case), ALL))
