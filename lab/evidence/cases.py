"""The cases of the table: light, and what is unusual about camera or recording."""
from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.paper.light import EVENT_DN, LOW_UW_CM2, edges, halves
from lab.paper.run import OFF_LOCK, SETTLE_US
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.simulation import (
    FULL,
    Camera,
    Fan,
    FlatLight,
    MalusSweep,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
    Texture,
)

PRESETS = ("nominal", "typical", "davis346", "realistic")

Light = Callable[[int], Scene]
Loss = Callable[[NDArray[Any], Sequence[ApsFrame], int], NDArray[np.bool_]]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A recording to simulate, and what of it is scored.

    Parameters
    ----------
    light : callable
        (seed) -> Scene.
    changes : mapping of str to object
        What `Camera.preset` is told besides.
    seconds : float
        Length.
    start_us, step_us : int
        First image, and interval between images; no frame clock divides it.
    size, origin : (int, int)
        Region of the sensor; (height, width) and (row, column).
    least_dolp, margin : float
        Of `Scorer`.
    demosaic : str
        Of `fuse`: ``"superpixel"``, or ``"bilinear"`` for images of every pixel.
    mask : callable, optional
        (camera) -> super-pixels that are scored, bool (H / 2, W / 2).
    keep : callable, optional
        (events, frames, offset of the frames' stamps in us) -> events that are kept.
    usual : bool
        Whether it is scored unasked.
    """

    light: Light
    changes: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 2.2
    start_us: int = SETTLE_US
    step_us: int = 11_013
    size: tuple[int, int] = (12, 12)
    origin: tuple[int, int] | None = None
    least_dolp: float = 0.2
    margin: float = 0.0
    demosaic: str = "superpixel"
    mask: Callable[[Camera], NDArray[np.bool_]] | None = None
    keep: Loss | None = None
    usual: bool = True


def start_angle(seed: int) -> float:
    """Angle at time 0, radians: by steps of the golden angle of half a turn."""
    return math.radians(111.246 * seed % 180)


def polarizer(rpm: float, dolp: float = 1.0, s0: float = FULL) -> Light:
    """Return light behind a polarizer that turns, of this DoLP."""
    return lambda seed: RotatingPolarizer(
        rpm=rpm * OFF_LOCK, start_angle=start_angle(seed), dolp=dolp, s0=s0)


def plate(rpm: float, dolp: float = 1.0, s0: float = FULL) -> Light:
    """Return light behind a plate that turns, of at most this DoLP."""
    def light(seed: int) -> Scene:
        turning = RotatingPlate(
            rpm=rpm * OFF_LOCK, start_angle=start_angle(seed), s0=dolp * s0)
        return turning if dolp == 1 else turning + FlatLight(s0=(1 - dolp) * s0)

    return light


def texture(speed: float, s0: float = FULL) -> Light:
    """Return a texture that passes at this speed, pixels/s."""
    return lambda seed: Texture(
        velocity=(0.96 * speed, 0.28 * speed), seed=seed, s0=s0)


def _edges(speed: float) -> Light:
    return lambda seed: edges(speed)


def _sharp(speed: float) -> Light:
    return lambda seed: edges(speed, width=0.5)


def _still(s0: float) -> Light:
    return lambda seed: FlatLight(s0=s0, dolp=0.3, aop=start_angle(seed))


def _flickering(rpm: float) -> Light:
    return lambda seed: polarizer(rpm)(seed).flicker(60.0, 0.1)


def _turned(seed: int) -> Scene:
    return MalusSweep(step=math.radians(40), hold_us=750_000, move_us=150_000,
                      start_angle=start_angle(seed), dolp=0.8)


def _fan(half: str) -> Case:
    return Case(
        light=lambda seed: Fan(rpm=200 * OFF_LOCK, start_angle=start_angle(seed)),
        size=(8, 32), origin=(54, 156), margin=1.5, seconds=1.6,
        mask=lambda camera: halves(camera)[f"{half} half"])


def _between_exposures(every: int) -> Loss:
    """Return a loss of all events between exposures, in every nth interval."""
    def keep(
        events: NDArray[Any], frames: Sequence[ApsFrame], offset_us: int,
    ) -> NDArray[np.bool_]:
        kept = np.ones(len(events), np.bool_)
        for one, following in list(itertools.pairwise(frames))[::every]:
            first, last = np.searchsorted(events["t"], (
                int(np.max(one.exposure_end_us)) - offset_us,
                int(np.min(following.exposure_start_us)) - offset_us))
            kept[first:last] = False
        return kept

    return keep


_RPMS, _DOLPS = (20, 30, 60, 200, 500, 1000), (0.1, 0.3, 0.5, 0.8, 1)
_LIGHTS = {"polarizer": polarizer, "plate": plate}
_LONG = {"aps": {"exposure_us": 45_000, "readout_us": 4_000}}
_DIM, _BRIGHT = EVENT_DN * LOW_UW_CM2, EVENT_DN * 41.0

_MISSING = {
    "missing-60": Case(light=polarizer(60), keep=_between_exposures(1)),
    "missing-half-60": Case(light=polarizer(60), keep=_between_exposures(2)),
    "missing-long-60": Case(
        light=polarizer(60), keep=_between_exposures(1), changes=_LONG),
    "missing-texture-60": Case(
        light=texture(60), size=(16, 16), keep=_between_exposures(1)),
}

CASES: Mapping[str, Case] = {
    **{f"{name}-{rpm}-{dolp:g}": Case(
        light=light(rpm, dolp), least_dolp=0.2 * dolp)
       for (name, light), rpm, dolp in itertools.product(
           _LIGHTS.items(), _RPMS, _DOLPS)},
    # Images of every pixel are interpolated over the mosaic.
    **{f"{name}-{speed}{ending}": Case(
        light=light(speed), size=(16, 16), demosaic=demosaic)
       for (name, light), speed, (ending, demosaic) in itertools.product(
           (("texture", texture), ("edges", _edges), ("sharp", _sharp)), (60, 200, 600),
           (("", "superpixel"), ("-pixels", "bilinear")))},
    "fan-dark": _fan("dark"), "fan-bright": _fan("bright"),
    "saturated-60": Case(light=polarizer(60, s0=_BRIGHT)),
    "saturated-200": Case(light=polarizer(200, s0=_BRIGHT)),
    "dark-60": Case(light=plate(60, s0=_DIM)),
    "dark-texture-200": Case(light=texture(200, _DIM), size=(16, 16)),
    **{f"flicker-{rpm}": Case(light=_flickering(rpm)) for rpm in (60, 200)},
    # S0 in DN per ms: 10, 50 and 308 DN in a frame.
    **{f"still-{round(10 * s0)}": Case(light=_still(s0)) for s0 in (1.0, 5.0, FULL)},
    "still-after-turn": Case(light=_turned, seconds=1.6),
    **{f"black-{c}-{rpm}-{dolp:g}": Case(
        light=polarizer(rpm, dolp), changes={"aps": {"black_level_dn": float(c)}})
       for c, (rpm, dolp) in itertools.product(
           (0, 30, 80), ((60, 0.5), (200, 0.5), (200, 1)))},
    # Events are this much behind frames.
    **{f"clock-{str(ms).replace('-', 'minus-')}-{rpm}": Case(
        light=polarizer(rpm, 0.5),
        changes={"faults": {"frame_offset_us": -1000 * ms}})
       for ms, rpm in itertools.product((-5, 0, 5, 10, 15), (60, 200))},
    **{f"refractory-{ms:g}-{rpm}": Case(
        light=polarizer(rpm), changes={"dvs": {"refractory_us": 1e3 * ms}})
       for ms, rpm in itertools.product((0, 0.1, 1), (200, 1000))},
    **{f"drift-{rpm}": Case(light=polarizer(rpm), changes={
        "faults": {"drift_on": 0.15, "drift_off": -0.05}}) for rpm in (200, 1000)},
    **{f"lost-{rpm}": Case(light=polarizer(rpm), changes={"faults": {"lost": 0.1}})
       for rpm in (200, 1000)},
    "jitter-200": Case(light=polarizer(200), changes={"faults": {"jitter_us": 1e3}}),
    "hot-200": Case(light=polarizer(200), changes={
        "dvs": {"hot_fraction": 0.05, "hot_hz": 1000.0}}),
    "second-pole-1000": Case(light=polarizer(1000), changes={
        "dvs": {"second_pole_hz": 250.0}}),
    "slow-200": Case(light=polarizer(200), changes={
        "dvs": {"cutoff_hz": None, "cutoff_hz_per_dn_ms": 160 / FULL}}),
    **_MISSING,
    # The first and the fifth minute tell whether errors grow.
    **{f"seconds-{length:g}-{name}": Case(
        light=light, seconds=length, start_us=start, step_us=step, size=size,
        usual=length < 60)
       for (length, start, step), (name, light, size) in itertools.product(
           ((0.3, 60_000, 7_013), (1, 200_000, 11_013), (10, SETTLE_US, 51_013),
            (60, SETTLE_US, 251_013), (300, 240_000_000, 251_013)),
           (("20-1", polarizer(20), (12, 12)),
            ("200-0.5", polarizer(200, 0.5), (12, 12)),
            ("texture-200", texture(200), (16, 16))))},
}
"""Name -> what is simulated."""

REAL = {"left-out": None, "left-out-first-5": 5, "left-out-first-7": 7,
        "left-out-missing": None}
"""Cases of a real recording, every second frame of which is left out -> number of
frames after which pieces of it end; None: all of it."""

NAMED = (
    ("polarizer-200-0.5", "typical"), ("polarizer-1000-0.3", "typical"),
    ("polarizer-30-0.3", "typical"), ("polarizer-500-1", "typical"),
    *((f"polarizer-{rpm}-{dolp:g}", "davis346")
      for rpm in (60, 200, 500, 1000) for dolp in (0.3, 0.5, 1)),
    ("black-30-200-1", "nominal"), ("black-30-200-0.5", "typical"),
    ("saturated-60", "davis346"), ("saturated-200", "davis346"),
    ("refractory-1-1000", "nominal"), ("refractory-1-1000", "typical"),
    ("texture-200", "typical"), ("edges-60", "typical"), ("plate-200-0.5", "typical"),
    *((name, "typical") for name in _MISSING),
    *((name, "real") for name in REAL))
"""Cells on which an estimator is judged first."""

QUICK = (
    *NAMED, ("polarizer-200-1", "nominal"), ("plate-1000-1", "nominal"),
    ("polarizer-20-0.1", "typical"), ("plate-60-0.5", "realistic"),
    ("texture-600", "davis346"), ("edges-60-pixels", "typical"),
    ("sharp-60-pixels", "typical"), ("texture-200-pixels", "typical"),
    ("fan-dark", "typical"), ("fan-bright", "typical"), ("dark-60", "typical"),
    ("flicker-200", "typical"), ("still-50", "typical"),
    ("still-after-turn", "nominal"), ("black-80-60-0.5", "typical"),
    ("clock-10-200", "nominal"), ("clock-minus-5-60", "typical"),
    ("drift-200", "typical"), ("lost-200", "typical"), ("jitter-200", "nominal"),
    ("hot-200", "typical"), ("slow-200", "typical"), ("second-pole-1000", "nominal"),
    ("plate-500-0.3", "davis346"),
    ("seconds-0.3-200-0.5", "typical"), ("seconds-1-texture-200", "typical"))
"""Cells of ``--quick``."""
