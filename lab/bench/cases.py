"""What `python -m lab.bench` times, and the floors written in Python.

The floors never change with what they judge.
"""
from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.base import Reconstructor, Snapshot
from pdavis_cv.reconstruct.cf import ComplementaryFilter
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import Layout

from .floor import compiled_floor

SHAPE = (260, 346)
EVENTS, PACKET = 1_000_000, 10_000


@dataclass(frozen=True)
class Comparison:
    """A candidate and its floor on one input.

    Parameters
    ----------
    name : str
        Of the input.
    check : callable
        Raises AssertionError unless the candidate equals an independent evaluation.
    candidate, floor : callable
        Each does the work once and returns the seconds that it took.
    figure : callable
        Turns seconds into what is printed.
    unit : str
        Of what is printed.
    judged : bool
        Whether the case's goal applies.
    at : (str, float), optional
        Name of an axis and the input's position on it, for the picture.
    """

    name: str
    check: Callable[[], None]
    candidate: Callable[[], float]
    floor: Callable[[], float]
    figure: Callable[[float], float]
    unit: str
    judged: bool = True
    at: tuple[str, float] | None = None


@dataclass(frozen=True)
class Case:
    """Something to time; ``by_time`` cases must stay below their goal.

    Parameters
    ----------
    name, title : str
        For the command line and for the print-out.
    goal : float
        Of the ratio.
    comparisons : callable
        Yields a Comparison per input.
    by_time : bool
        Whether the ratio is of times (smaller is better) and not of speeds.
    """

    name: str
    title: str
    goal: float
    comparisons: Callable[[], Iterator[Comparison]]
    by_time: bool = False


CASES: dict[str, Case] = {}


def case(
    name: str, title: str, goal: float, *, by_time: bool = False
) -> Callable[[Callable[[], Iterator[Comparison]]],
              Callable[[], Iterator[Comparison]]]:
    """Enter the function that follows into `CASES`; parameters are those of `Case`."""
    def register(
        comparisons: Callable[[], Iterator[Comparison]]
    ) -> Callable[[], Iterator[Comparison]]:
        CASES[name] = Case(name, title, goal, comparisons, by_time)
        return comparisons
    return register


def _seconds(work: Callable[[], object]) -> float:
    start = perf_counter()
    work()
    return perf_counter() - start


def event_input(kind: str) -> NDArray[Any]:
    """Return a second of events: uniform over the sensor, or in one spot.

    Parameters
    ----------
    kind : {"uniform", "clustered"}
        Clustered: normal with a standard deviation of 30 pixels about the centre.
    """
    rng = np.random.default_rng(1)
    events = np.zeros(EVENTS, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(1_000, 1_001_000, EVENTS))
    for field, side in (("y", SHAPE[0]), ("x", SHAPE[1])):
        if kind == "clustered":
            where = np.rint(rng.normal(side / 2, 30, EVENTS)).clip(0, side - 1)
        else:
            where = rng.integers(0, side, EVENTS)
        events[field] = where
    events["p"] = rng.integers(0, 2, EVENTS)
    return events


def packets_of(events: NDArray[Any]) -> list[NDArray[Any]]:
    """Return events in packets."""
    return [events[i:i + PACKET] for i in range(0, EVENTS, PACKET)]


def fed(method: Reconstructor, fresh: Snapshot, packets: list[NDArray[Any]]) -> float:
    """Return the seconds in which a method, restored to `fresh`, takes packets."""
    method.restore(fresh)
    start = thread_time()
    for packet in packets:
        method.add_events(packet)
    return thread_time() - start


def summed(floor_sum: Callable[..., int], step: NDArray[np.float32],
           plane: NDArray[np.float32], packets: list[NDArray[Any]]) -> float:
    """Return the seconds in which the floor sums the steps of packets."""
    start = thread_time()
    for packet in packets:
        floor_sum(packet, step, plane)
    return thread_time() - start


@case("cf", "cf.add_events, adaptive gain, against floor_sum", 0.25)
def _cf() -> Iterator[Comparison]:
    floor_sum, theta = compiled_floor(), 0.2
    step = np.array([-theta, theta], np.float32)
    dn = np.random.default_rng(2).uniform(1, 1023, SHAPE)
    frame = ApsFrame(dn, 0, 2_000)
    cf = ComplementaryFilter(SHAPE, theta_on=theta, theta_off=theta)
    cf.add_frame(frame)
    fresh, stop = cf.snapshot(), 1_001_000
    plane = np.zeros(SHAPE, np.float32)
    for kind in ("uniform", "clustered"):
        events = event_input(kind)
        packets = packets_of(events)

        def check(events: NDArray[Any] = events) -> None:
            # One weight per event: the sum of p exp(-m (t_stop - t) / tau).
            gain = _adaptive_gain(frame.dn)[events["y"], events["x"]]
            rate = gain * 2e-6 * np.pi * 1.6
            weight = np.where(events["p"], theta, -theta)
            weight = weight * np.exp(-rate * (stop - events["t"]))
            pixel = events["y"].astype(np.intp) * SHAPE[1] + events["x"]
            total = np.bincount(pixel, weight, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
            fed(cf, fresh, packets_of(events))
            np.testing.assert_allclose(
                cf.read(stop).log_intensity, np.log(frame.dn / 2.0) + total,
                rtol=0, atol=1e-5)
            plane.fill(0)
            floor_sum(events, step, plane)
            want = np.zeros_like(plane)
            np.add.at(want, (events["y"], events["x"]), step[events["p"]])
            np.testing.assert_array_equal(plane, want)

        yield Comparison(kind, check, partial(fed, cf, fresh, packets),
                         partial(summed, floor_sum, step, plane, packets),
                         lambda s: EVENTS / s / 1e6, "Mev/s")


def _adaptive_gain(dn: NDArray[Any]) -> NDArray[np.float64]:
    v = np.clip(dn.astype(float) / 4, 1, 255.75)
    low, high = np.log(v) / np.log(10), np.log(255 / v) / np.log(255 / 200)
    return np.asarray(0.1 + 0.9 * np.clip(np.minimum(low, high), 0, 1))


class FloorCv2:
    """Mosaic to doubled AoP and DoLP with OpenCV alone, in memory of its own.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the mosaic, both even.
    layout : Layout
        Polarizer layout.
    """

    def __init__(self, shape: tuple[int, int], layout: Layout) -> None:
        import cv2
        self.cv2, self.places = cv2, layout.places
        height, width = shape
        self.planes = np.empty((4, height // 2, width // 2), np.float32)
        self.quad, self.sums = np.empty((2, 4, *shape), np.float32)
        self.length, self.angle, self.dolp = np.empty((3, *shape), np.float32)

    def __call__(self, mosaic: NDArray[Any]) -> None:
        """Fill ``angle`` (2 AoP, radians) and ``dolp``."""
        cv2, quad, sums = self.cv2, self.quad, self.sums
        size = mosaic.shape[::-1]
        for plane, full, place in zip(self.planes, quad, self.places, strict=True):
            np.copyto(plane, mosaic[place // 2::2, place % 2::2])
            cv2.resize(plane, size, dst=full, interpolation=cv2.INTER_LINEAR)
        cv2.add(quad[0], quad[2], dst=sums[0])
        cv2.add(quad[1], quad[3], dst=sums[1])
        cv2.add(sums[0], sums[1], dst=sums[0])
        cv2.subtract(quad[0], quad[2], dst=sums[2])
        cv2.subtract(quad[1], quad[3], dst=sums[3])
        cv2.cartToPolar(sums[2], sums[3], magnitude=self.length, angle=self.angle)
        cv2.divide(self.length, sums[0], dst=self.dolp, scale=2)


def mosaic_input(
    shape: tuple[int, int], layout: Layout, aop: float, dolp: float,
    brightness: NDArray[Any] | float = 300.0,
) -> NDArray[np.float64]:
    """Return what a sensor of ideal polarizers sees of evenly polarized light."""
    tile = (shape[0] // 2, shape[1] // 2)
    angle = np.deg2rad(np.tile(np.array(layout.angles_deg), tile))
    return np.asarray(brightness * (1 + dolp * np.cos(2 * (angle - aop))))


@case("polarization", "mosaic to AoP and DoLP, full size, against floor_cv2", 2)
def _polarization() -> Iterator[Comparison]:
    import cv2

    from pdavis_cv.polarimetry import polarization
    layout, (height, width) = Layout.PDAVIS, SHAPE
    ramp = 200 + np.add.outer(0.3 * np.arange(height), 0.5 * np.arange(width))
    noise = np.random.default_rng(3).normal(0, 5, SHAPE)
    floor_cv2 = FloorCv2(SHAPE, layout)
    for dtype in (np.uint8, np.uint16, np.float32):
        scale = 0.25 if dtype is np.uint8 else 1.0
        mosaic = (scale * (mosaic_input(SHAPE, layout, 0.7, 0.6, ramp) + noise)).astype(
            dtype)

        def candidate(mosaic: NDArray[Any] = mosaic) -> float:
            return _seconds(lambda: polarization(mosaic, layout).aop)

        def floor(mosaic: NDArray[Any] = mosaic) -> float:
            threads = cv2.getNumThreads()
            cv2.setNumThreads(1)
            try:
                return _seconds(lambda: floor_cv2(mosaic))
            finally:
                cv2.setNumThreads(threads)

        def check() -> None:
            for brightness in (300.0, ramp):
                even = mosaic_input(SHAPE, layout, 0.7, 0.6, brightness)
                image = polarization(even.astype(np.float32), layout)
                np.testing.assert_allclose(image.aop, 0.7, rtol=0, atol=1e-5)
                np.testing.assert_allclose(image.dolp, 0.6, rtol=0, atol=1e-5)
            floor_cv2(mosaic_input(SHAPE, layout, 0.7, 0.6))
            np.testing.assert_allclose(floor_cv2.angle, 1.4, rtol=0, atol=1e-3)
            np.testing.assert_allclose(floor_cv2.dolp, 0.6, rtol=0, atol=1e-5)

        yield Comparison(np.dtype(dtype).name, check, candidate, floor,
                         lambda s: 1e3 * s, "ms")


def _import_seconds(statement: str) -> float:
    code = ("from time import perf_counter as clock; start = clock(); "
            f"{statement}; print(clock() - start)")
    done = subprocess.run([sys.executable, "-c", code], check=True, text=True,
                          capture_output=True)
    return float(done.stdout)


def _check_import() -> None:
    code = "import sys, pdavis_cv; sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@case("import", "import, against import numpy", 1.3, by_time=True)
def _import() -> Iterator[Comparison]:
    floor = partial(_import_seconds, "import numpy")
    for statement, judged in (("import pdavis_cv", True),
                              ("from pdavis_cv import fuse", False)):
        yield Comparison(
            statement.removeprefix("from pdavis_cv "), _check_import,
            partial(_import_seconds, statement), floor, lambda s: 1e3 * s, "ms", judged)
