"""Cases of the simulator; importing it registers them."""
from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.simulation import Camera, Fan, RotatingPlate, RotatingPolarizer, Scene

from .cases import CASES, EVENTS, PACKET, SHAPE, Case, Comparison, event_input
from .floor import compiled_floor

CLOSED_FORM: dict[str, tuple[Scene, tuple[int, int], float]] = {
    "polarizer, 64x64": (RotatingPolarizer(rpm=1013.0), (64, 64), 0.1),
    "polarizer, 12x12": (RotatingPolarizer(rpm=1013.0), (12, 12), 1.0),
    "plate, 64x64": (RotatingPlate(rpm=506.5, start_angle=0.1), (64, 64), 0.1),
}
FAN = (Fan(rpm=203.0, centre=(172.0, 180.0)), (24, 24), 0.1)


def _events(camera: Camera, scene: Scene, seconds: float) -> NDArray[Any]:
    return np.concatenate([
        packet.events for packet in camera.stream(scene, seconds).packets()])


def _check_polarizer() -> None:
    """Hold summed events of an ideal camera against the change of its log light."""
    scene, size, seconds = CLOSED_FORM["polarizer, 12x12"]
    camera = Camera.preset("ideal", size=size)
    events = _events(camera, scene, seconds)
    summed = np.zeros(size)
    np.add.at(summed, (events["y"], events["x"]),
              np.where(events["p"] == 1, 0.15, -0.15))
    first, last = (np.log(camera.maps["analyser"] @ scene.stokes(t, 0, 0))
                   for t in (0.0, seconds * 1e6))
    assert np.max(np.abs(last - first - summed)) < 0.1501


def _closed_form() -> Iterator[Comparison]:
    floor_sum = compiled_floor()
    step = np.array([-0.2, 0.2], np.float32)
    plane = np.zeros(SHAPE, np.float32)
    events = event_input("clustered")
    packets = [events[i:i + PACKET] for i in range(0, EVENTS, PACKET)]

    def floor() -> float:
        start = perf_counter()
        for packet in packets:
            floor_sum(packet, step, plane)
        return perf_counter() - start

    for name, (scene, size, seconds) in [*CLOSED_FORM.items(),
                                         ("fan, 24x24", FAN)]:
        camera = Camera.preset("ideal", size=size)

        def candidate(camera: Camera = camera, scene: Scene = scene,
                      seconds: float = seconds) -> float:
            start = perf_counter()
            made = sum(len(packet.events)
                       for packet in camera.stream(scene, seconds).packets())
            return (perf_counter() - start) * EVENTS / made

        yield Comparison(name, _check_polarizer, candidate, floor,
                         lambda s: EVENTS / s / 1e6, "Mev/s", name in CLOSED_FORM)


CASES["simulate"] = Case(
    "simulate", "simulate closed-form scenes, ideal, against floor_sum", 0.01,
    _closed_form)
