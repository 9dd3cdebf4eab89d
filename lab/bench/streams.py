"""What `python -m lab.bench` times of streams: images in time, and by threads."""
from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import median
from time import perf_counter, process_time, thread_time
from typing import Any

import numpy as np

from pdavis_cv._workers import usable_cores
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import FusionOptions, fuse
from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.open import open_recording
from pdavis_cv.sensor import Layout

from .cases import SHAPE, Comparison, case
from .images import IMAGES, Repeatable, chain, check_same, endless, per_image, shown

SIZES = ((64, 64), (128, 128), SHAPE, (480, 640), (720, 1280))
"""Heights and widths of sensors."""

EVENTS_PER_PIXEL = 33e3 / (SHAPE[0] * SHAPE[1])
"""Per second: those of the slow scene that images are judged by."""

STATE_BYTES, MEMORY_PARTS = 100, 16
"""Bytes that an image reads of a pixel's state and writes, about; and how many images'
worth is copied: 144 MB, more than caches hold."""

STREAM_RATE = 1e6
"""Events per second of the stream whose images must not be late."""

BETWEEN_US = 2_400_000
"""Time of a stream, us, at which no estimate of its camera is in work (causal mode)."""

FULL_RATE, FULL_FPS = 10e6, 200.0
"""Events per second, the sensor's most, and images per second of a stream with which
causal images should keep up."""


def _fusion(
    method: str, rate: float, fps: float, shape: tuple[int, int] = SHAPE
) -> Fusion:
    """Return images of a stream, a second after its beginning."""
    fusion = Fusion(endless(rate, shape), FusionOptions(
        fps=fps, thresholds=(0.2, 0.2)), **IMAGES[method][0])
    while fusion.index < fps:
        fusion.advance()
    return fusion


def _milliseconds(seconds: float) -> float:
    return 1e3 * seconds


@case("image-pixels", "an image of kalman by pixels, CPU, against mosaic to AoP", 10,
      by_time=True)
def _by_pixels() -> Iterator[Comparison]:
    for shape in SIZES:
        make = partial(_fusion, "kalman", EVENTS_PER_PIXEL * shape[0] * shape[1], 1e3,
                       shape)
        fusion = make()

        yield Comparison(
            f"{shape[1]}x{shape[0]}", partial(check_same, make),
            partial(per_image, fusion), chain(shape), _milliseconds, "ms",
            judged=shape == SHAPE,
            at=("pixels", float(shape[0] * shape[1])))


@case("memory", "an image of kalman, CPU, against copying 100 bytes per pixel", 10,
      by_time=True)
def _memory() -> Iterator[Comparison]:
    # The source is larger than the caches: each copy reads a part that is not in them.
    source = np.ones((MEMORY_PARTS, STATE_BYTES * SHAPE[0] * SHAPE[1]), np.uint8)
    copy = np.empty_like(source[0])
    make = partial(_fusion, "kalman", 33e3, 1e3)
    fusion = make()

    def floor() -> float:
        start = thread_time()
        for part in source:
            np.copyto(copy, part)
        return (thread_time() - start) / len(source)

    yield Comparison("33 kev/s", partial(check_same, make),
                     partial(per_image, fusion), floor,
                     _milliseconds, "ms", judged=False)


@case("latency", "a causal image after a packet's last event, CPU, against the chain",
      20, by_time=True)
def _latency() -> Iterator[Comparison]:
    # An image every 10 ms, the span of a packet: each takes one packet, and shows it.
    make = partial(_fusion, "causal", STREAM_RATE, 100.0)
    fusion = make()

    def one() -> float:
        start = thread_time()
        shown(next(fusion))
        return thread_time() - start

    # Images of two periods of frames: most come without one, the slowest with one.
    for name, which in (("1 Mev/s, median", median), ("1 Mev/s, with a frame", max)):
        def candidate(which: Callable[[list[float]], float] = which) -> float:
            return which([one() for _ in range(8)])

        yield Comparison(name, partial(check_same, make), candidate, chain(SHAPE),
                         _milliseconds, "ms", judged=which is median)


@case("first-image", "learning and the first image, CPU, against the chain", 4000,
      by_time=True)
def _first_image() -> Iterator[Comparison]:
    files = {"simulated fan": example_recording("fan")}
    if folder := os.environ.get("PDAVIS_TEST_DATA"):
        files["davis346"] = Path(folder, "davis346.aedat4")
    for name, path in files.items():
        def first(path: Path = path) -> Any:
            with open_recording(path) as recording:
                return shown(next(Fusion(recording, layout=Layout.PDAVIS)))

        def candidate(first: Callable[[], Any] = first) -> float:
            start = process_time()
            first()
            return process_time() - start

        def check(first: Callable[[], Any] = first) -> None:
            np.testing.assert_array_equal(first().aop, first().aop)

        yield Comparison(name, check, candidate, chain(SHAPE), _milliseconds, "ms",
                         judged=name == "davis346")


@contextlib.contextmanager
def _every_core() -> Iterator[None]:
    """Let this thread, and those that it starts, run on all cores."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@case("threads", "images of kalman with two threads, wall time, against one", 1.5)
def _threads() -> Iterator[Comparison]:
    def made(method: str, rate: float, threads: int) -> Iterator[PolarFrame]:
        """Return images of a recording, between two estimates of the camera."""
        images = fuse(Repeatable(rate), FusionOptions(
            fps=1e3, start_us=BETWEEN_US, thresholds=(0.2, 0.2), threads=threads),
            **IMAGES[method][0])
        next(images)
        return images

    def same(one: Callable[[], Iterator[PolarFrame]],
             two: Callable[[], Iterator[PolarFrame]]) -> None:
        for mine, other in zip(*(islice(make(), 3) for make in (one, two)),
                               strict=True):
            np.testing.assert_array_equal(shown(mine).aop, other.aop)

    def images(those: Iterator[PolarFrame], n: int) -> float:
        start = perf_counter()
        for _ in range(n):
            shown(next(those))
        return (perf_counter() - start) / n

    with _every_core():     # also while these are measured
        cores = usable_cores()
        for method, rate in (("kalman", 33e3), ("causal", 33e3), ("offline", 33e3),
                             ("kalman", 1e6)):
            one, two = (partial(made, method, rate, threads) for threads in (1, 2))
            yield Comparison(
                f"{method}, {rate / 1e6:g} Mev/s", partial(same, one, two),
                partial(images, two(), 40), partial(images, one(), 40), _milliseconds,
                "ms", judged=cores > 1 and rate == 33e3)
    # On the one core of the benchmark, as where others keep all other cores busy.
    one, two = (partial(made, "kalman", 33e3, threads) for threads in (1, 2))
    yield Comparison(
        "kalman, 0.033 Mev/s, one core", partial(same, one, two),
        partial(images, two(), 40), partial(images, one(), 40), _milliseconds, "ms",
        judged=False)


@case("full-rate", "a second of causal images of 10 Mev/s at 200/s, wall time", 1,
      by_time=True)
def _full_rate() -> Iterator[Comparison]:
    def made(threads: int) -> Iterator[PolarFrame]:
        """Return images of a recording, after what the beginning allocates."""
        images = fuse(Repeatable(FULL_RATE), FusionOptions(
            fps=FULL_FPS, thresholds=(0.2, 0.2), threads=threads),
            **IMAGES["causal"][0])
        for _ in range(40):
            next(images)
        return images

    def same() -> None:
        for mine, other in zip(*(islice(made(n), 3) for n in (1, 2)), strict=True):
            np.testing.assert_array_equal(shown(mine).aop, other.aop)

    def second(those: Iterator[PolarFrame]) -> float:
        start = perf_counter()
        for _ in range(40):     # five periods of frames
            shown(next(those))
        return (perf_counter() - start) * FULL_FPS / 40

    with _every_core():
        for threads in (1, 2):
            yield Comparison(
                f"{threads} thread{'s'[:threads - 1]}", same,
                partial(second, made(threads)), lambda: 1.0, float, "s",
                judged=threads == 2 and usable_cores() > 1)
