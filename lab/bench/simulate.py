"""Cases of the simulator; importing it registers them."""
from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.simulation import (
    Camera,
    Fan,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
    Texture,
    VideoScene,
    rotating_polarizer,
)

from .cases import (
    CASES,
    EVENTS,
    PACKET,
    SHAPE,
    Case,
    Comparison,
    event_input,
)
from .floor import compiled_floor

VIDEO_FPS, VIDEO_FRAMES = 1000.0, 40
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
    """Hold the sampled simulation against crossings in closed form."""
    # From an angle at which no level coincides with a peak, where only rounding says
    # whether it is reached.
    scene = RotatingPolarizer(rpm=1013.0, start_angle=0.3)
    exact, _ = rotating_polarizer(1013.0, 0.2, size=(4, 4), start_angle=0.3)
    want = np.concatenate([packet.events for packet in exact.packets()])
    got = _events(Camera.preset("ideal", size=(4, 4)), scene, 0.2)
    want, got = (e[np.lexsort((e["t"], e["x"], e["y"]))] for e in (want, got))
    np.testing.assert_array_equal(got[["x", "y", "p"]], want[["x", "y", "p"]])
    np.testing.assert_allclose(got["t"], want["t"], rtol=0, atol=1)


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


@cache
def texture_video() -> NDArray[np.float32]:
    """Return a moving texture as four planes in DN per ms, float32 (N, 4, H, W)."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    scene = Texture(velocity=(200.0, 60.0))
    quad = np.empty((VIDEO_FRAMES + 1, 4, *SHAPE), np.float32)
    for k, frame in enumerate(quad):
        s0, s1, s2 = scene.stokes(k * 1e6 / VIDEO_FPS, x, y)
        frame[:] = np.stack((s0 + s1, s0 + s2, s0 - s1, s0 - s2)) / 2
    return quad


def _check_video() -> None:
    """Hold summed events of an ideal camera against the video's own log ratio."""
    quad = texture_video()
    camera = Camera.preset("ideal", size=SHAPE, aps=None)
    events = _events(camera, VideoScene(quad, VIDEO_FPS), VIDEO_FRAMES / VIDEO_FPS)
    summed = np.zeros(SHAPE)
    np.add.at(summed, (events["y"], events["x"]),
              np.where(events["p"] == 1, 0.15, -0.15))
    s0 = quad.sum(1) / 2
    stokes = np.stack((s0, quad[:, 0] - quad[:, 2], quad[:, 1] - quad[:, 3]), -1)
    light = np.einsum("nhwc,hwc->nhw", stokes[[0, -1]], camera.maps["analyser"])
    assert np.max(np.abs(np.log(light[1] / light[0]) - summed)) < 0.1501


def _video_seconds(camera: Camera, quad: NDArray[np.float32]) -> float:
    """Time per frame, without the making of the camera and its first 10 ms."""
    stream = camera.stream(VideoScene(quad, VIDEO_FPS), VIDEO_FRAMES / VIDEO_FPS)
    pieces = stream.pieces()
    next(pieces)
    start = perf_counter()
    for _ in pieces:
        pass
    return (perf_counter() - start) / (VIDEO_FRAMES * 0.75)


def _video() -> Iterator[Comparison]:
    frame = np.random.default_rng(4).uniform(-1, 1, SHAPE)
    camera = Camera.preset("nominal", size=SHAPE, aps=None)
    moving = texture_video()
    still = np.repeat(moving[:1], len(moving), axis=0)

    def floor() -> float:
        start = perf_counter()
        for _ in range(30):
            np.exp(frame)
        return (perf_counter() - start) / 30

    for name, quad, judged in (("moving texture, noise", moving, True),
                               ("still texture, noise", still, False)):
        def candidate(quad: NDArray[np.float32] = quad) -> float:
            return _video_seconds(camera, quad)

        yield Comparison(name, _check_video, candidate, floor, lambda s: 1 / s,
                         "img/s", judged)


def _eventcv() -> Iterator[Comparison]:
    import eventcv  # type: ignore[import-not-found,unused-ignore]
    quad = texture_video()
    grey = quad.sum(1)
    grey /= grey.max()
    dvs = {"theta_on": 0.2, "theta_off": 0.2, "mismatch": 0.0, "mismatch_ln": 0.03,
           "refractory_us": 100.0, "cutoff_hz": 200.0, "leak_hz": 1.0,
           "shot_noise_hz": 10.0}
    camera = Camera.preset("nominal", size=SHAPE, aps=None, dvs=dvs)  # its defaults

    def floor() -> float:
        start = perf_counter()
        eventcv.simulate(grey, fps=VIDEO_FPS)
        return (perf_counter() - start) / VIDEO_FRAMES

    yield Comparison("moving texture, noise", _check_video,
                     lambda: _video_seconds(camera, quad), floor, lambda s: 1 / s,
                     "img/s")


for _name, _title, _goal, _comparisons in (
        ("simulate", "simulate closed-form scenes, ideal, against floor_sum", 0.01,
         _closed_form),
        ("simulate-video", "simulate a video, 346x260, against np.exp of one frame",
         0.1, _video),
        ("simulate-eventcv", "simulate a video, against EventCV's simulator", 3,
         _eventcv)):
    CASES[_name] = Case(_name, _title, _goal, _comparisons)
