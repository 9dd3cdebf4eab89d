"""Live sources without a device: a replayed recording and a simulated camera."""
from __future__ import annotations

import functools
import math
from collections.abc import Callable

from pdavis_cv.live.address import taken
from pdavis_cv.live.replay import ReplaySource
from pdavis_cv.recording.base import Recording
from pdavis_cv.simulation import Camera, named_scene

__all__ = ["open_replay", "open_simulation", "simulated"]


def open_replay(
    where: str, target: str, values: dict[str, str],
    open_recording: Callable[[str], Recording],
) -> ReplaySource:
    """Open ``replay:FILE?speed=1&loop=0&seconds=inf``.

    Parameters
    ----------
    where : str
        The whole address.
    target : str
        Path of the file.
    values : dict of str to str
        What follows the question mark.
    open_recording : callable
        Opens a file.
    """
    if not target:
        raise ValueError("a file must follow the colon")
    options = taken(values, speed=1.0, loop=False, seconds=math.inf)
    recording = open_recording(target)
    try:
        return ReplaySource(recording, where, **options)
    except ValueError:
        recording.close()
        raise


def open_simulation(
    where: str, target: str, values: dict[str, str],
    open_recording: Callable[[str], Recording],
) -> ReplaySource:
    """Open ``simulate:SCENE?camera=nominal&size=48x48&rpm=200&seed=0&...``.

    One turn or cycle of the scene is simulated and sent repeatedly.  The light is
    continuous from its end to its beginning, but the pixels are reset.

    Parameters
    ----------
    where, target, values, open_recording
        As in `open_replay`; `target` names the scene.
    """
    options = taken(values, camera="nominal", size="48x48", rpm=200.0, hz=1.0, seed=0,
                    speed=1.0, loop=True, seconds=math.inf)
    recording = simulated(target, *(
        options.pop(name) for name in ("camera", "size", "rpm", "hz", "seed")))
    return ReplaySource(recording, where, **options)


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
    recording, _ = Camera.preset(
        camera, seed=seed, size=(int(height), int(width))).record(made, period_s)
    return recording
