"""Scenes by name, for commands and addresses."""
from __future__ import annotations

import dataclasses
import math

from pdavis_cv._checks import positive, real_number
from pdavis_cv.simulation.camera import DEFAULT_CAMERA
from pdavis_cv.simulation.patterns import Fan, Tendon, Texture
from pdavis_cv.simulation.scenes import (
    FlatLight,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
)
from pdavis_cv.simulation.sweeps import IrradianceSweep, MalusSweep

SCENES = {
    "polarizer": "a turning polarizer",
    "qwp": "a turning quarter-wave plate behind a fixed polarizer",
    "plate": "a turning polarizer before a fixed quarter-wave plate",
    "fan": "six polarizers in a wheel, one half lit far brighter",
    "tendon": "a birefringent fibre sheet that is pulled in cycles",
    "malus": "a polarizer turned in steps of 5 degrees and held",
    "dr": "a turning polarizer under 40 nW/cm2 to 42 mW/cm2",
    "texture": "a moving texture with fields of AoP and DoLP",
    "flat": "constant unpolarized light",
    "dark": "no light",
}
"""Names of scenes, and what they show."""

_STEPS = 37                 # of MalusSweep: 0..180 degrees in steps of 5
_LEVELS = 13                # of IrradianceSweep


def named_scene(
    name: str, *, seconds: float, rpm: float = 200.0, hz: float = 1.0, seed: int = 0,
    start_angle: float = 0.0, light: float | None = None, background: float = 0.0,
    flicker_hz: float | None = None, camera: str = DEFAULT_CAMERA,
) -> Scene:
    """Return one of `SCENES`.

    Parameters
    ----------
    name : str
        One of `SCENES`.
    seconds : float
        Duration of all the steps of ``malus`` and of ``dr``.
    rpm : float
        Turns per minute; negative is clockwise.
    hz : float
        Cycles of the tendon per second.
    seed : int
        Seed of the texture.
    start_angle : float
        Angle at time 0, radians.
    light : float, optional
        S0 in DN per ms; default the scene's own.
    background : float
        S0 of a constant background in DN per ms, 30 % polarized at 30 degrees.
    flicker_hz : float, optional
        Mains frequency of the lamp.
    camera : str
        Preset of the camera, whose sensitivity scales ``dr``.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        If there is no such scene, `background` is negative, or the scene sets its own
        light.
    """
    if not isinstance(name, str) or name not in SCENES:
        raise ValueError(f"scene must be one of {', '.join(SCENES)}, got {name!r}")
    seconds = positive("seconds", seconds)
    hold_us = seconds * 1e6 / _STEPS
    scenes: dict[str, Scene] = {
        "polarizer": RotatingPolarizer(rpm=rpm, start_angle=start_angle),
        "qwp": RotatingPlate(rpm=rpm, start_angle=start_angle),
        "plate": PolarizerBeforePlate(rpm=rpm, start_angle=start_angle),
        "fan": Fan(rpm=rpm, start_angle=start_angle),
        "tendon": Tendon(hz=hz),
        "malus": MalusSweep(
            hold_us=hold_us, move_us=hold_us / 10, start_angle=start_angle),
        "dr": IrradianceSweep(
            rpm=rpm, hold_us=seconds * 1e6 / _LEVELS, start_angle=start_angle,
            dn_per_ms=0.68 if camera == "sony" else 27.0),
        "texture": Texture(seed=seed),
        "flat": FlatLight(),
        "dark": FlatLight(s0=0.0),
    }
    scene = scenes[name]
    if light is not None:
        if name in ("dr", "dark"):
            raise ValueError(f"{name} sets its own light: leave --light out")
        scene = dataclasses.replace(scene, s0=light)  # type: ignore[type-var]
    if not real_number(background) >= 0:
        raise ValueError(f"background must not be negative, got {background!r}")
    if background:
        scene = scene + FlatLight(s0=background, dolp=0.3, aop=math.radians(30))
    return scene if flicker_hz is None else scene.flicker(
        positive("flicker_hz", flicker_hz))
