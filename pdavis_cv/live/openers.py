"""Live sources without a device: a replayed recording and a simulated camera."""
from __future__ import annotations

import dataclasses
import functools
import math

from pdavis_cv.live.base import Address
from pdavis_cv.live.replay import ReplaySource
from pdavis_cv.recording.base import Recording
from pdavis_cv.simulation import DEFAULT_CAMERA, Camera, Fan, named_scene


def open_replay(
    address: Address, *, speed: float = 1.0, loop: bool = False,
    seconds: float = math.inf,
) -> ReplaySource:
    """Open ``replay:FILE``; parameters as in `ReplaySource`."""
    if not address.target:
        raise ValueError("a file must follow the colon")
    recording = address.open_recording(address.target)
    try:
        return ReplaySource(
            recording, address.text, speed=speed, loop=loop, seconds=seconds)
    except ValueError:
        recording.close()
        raise


def open_simulation(
    address: Address, *, camera: str = DEFAULT_CAMERA, size: str = "48x48",
    rpm: float = 200.0, hz: float = 1.0, seed: int = 0, speed: float = 1.0,
    loop: bool = True, seconds: float = math.inf,
) -> ReplaySource:
    """Open ``simulate:SCENE``.

    One turn or cycle of the scene is simulated and sent repeatedly.  The light is
    continuous from its end to its beginning, but the pixels are reset.
    """
    recording = simulated(address.target, camera, size, rpm, hz, seed)
    return ReplaySource(
        recording, address.text, speed=speed, loop=loop, seconds=seconds)


@functools.lru_cache(maxsize=1)
def simulated(
    scene: str, camera: str, size: str, rpm: float, hz: float, seed: int
) -> Recording:
    """Simulate one period of a scene into memory; the last result is cached."""
    width, cross, height = size.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise ValueError(f"size must be WIDTHxHEIGHT, got {size!r}")
    period_s = 1 / hz if scene == "tendon" else 60 / abs(rpm) if rpm else 1.0
    made = named_scene(scene, seconds=period_s, rpm=rpm, hz=hz, seed=seed,
                       camera=camera)
    if isinstance(made, Fan):  # all of the wheel, in light that frames can measure
        part = min(int(height), int(width)) / 260
        made = dataclasses.replace(
            made, radius=part * made.radius, hub=part * made.hub, bright=1.0)
    recording, _ = Camera.preset(
        camera, seed=seed, size=(int(height), int(width))).record(made, period_s)
    return recording
