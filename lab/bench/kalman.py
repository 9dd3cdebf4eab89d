"""What `python -m lab.bench` times of the Kalman method."""
from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.fusion.learning import learned_pixels
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.recording.memory import recording_from_arrays
from pdavis_cv.sensor import Layout

from .cases import EVENTS, SHAPE, Comparison, case, event_input, fed, packets_of, summed
from .floor import compiled_floor

THETA = 0.2
KINDS = ("uniform", "clustered")


def _floor(events: NDArray[Any]) -> partial[float]:
    return partial(summed, compiled_floor(), np.array([-THETA, THETA], np.float32),
                   np.zeros(SHAPE, np.float32), packets_of(events))


def _add_events(mode: str) -> Iterator[Comparison]:
    method = KalmanFilter(SHAPE, theta_on=THETA, theta_off=THETA, mode=mode)
    # The four pixels of a macropixel see the same light: no degree of polarization that
    # lasts moves the images.
    sample = np.random.default_rng(2).uniform(
        50, 900, (SHAPE[0] // 2, SHAPE[1] // 2)).repeat(2, 0).repeat(2, 1)
    method.add_frame(ApsFrame(sample, -90_000, -80_000))
    none = event_input("uniform")[:1].copy()
    none["t"] = 0
    method.add_events(none)
    fresh = method.snapshot()
    for kind in KINDS:
        events = event_input(kind)

        def check(events: NDArray[Any] = events) -> None:
            fed(method, fresh, packets_of(events))
            stop = 2_000_000
            pixel = events["y"].astype(np.intp) * SHAPE[1] + events["x"]
            pixel = np.append(pixel, none["y"].astype(np.intp) * SHAPE[1] + none["x"])
            sign = np.append(events["p"], none["p"])
            total = np.bincount(
                pixel, np.where(sign, THETA, -THETA), SHAPE[0] * SHAPE[1])
            log = method.read(stop).log_intensity - np.log(sample / 10)
            # What is read beyond the last event is less than a threshold.
            assert np.abs(log - total.reshape(SHAPE)).max() < THETA

        yield Comparison(kind, check, partial(fed, method, fresh, packets_of(events)),
                         _floor(events), lambda s: EVENTS / s / 1e6, "Mev/s")


@case("kalman-causal", "kalman.add_events, causal, against floor_sum", 0.15)
def _causal() -> Iterator[Comparison]:
    return _add_events("causal")


@case("kalman", "kalman.add_events, buffered, against floor_sum", 0.15)
def _buffered() -> Iterator[Comparison]:
    return _add_events("buffered")


@case("learning", "the camera at 20 frames/s, against floor_sum", 150, by_time=True)
def _learning() -> Iterator[Comparison]:
    rng = np.random.default_rng(2)
    frames = [ApsFrame(rng.uniform(50, 900, SHAPE), start, start + 20_000,
                       available_us=start + 32_000)
              for start in range(2_000, 960_000, 50_000)]
    for kind in KINDS:
        events = event_input(kind)
        recording = recording_from_arrays(
            events, frames, sensor_size=SHAPE, layout=Layout.PDAVIS)
        work = partial(learned_pixels, recording)

        def candidate(work: partial[Any] = work) -> float:
            start = process_time()
            work()
            return process_time() - start

        def check(work: partial[Any] = work) -> None:
            found = work()
            assert np.all(np.isfinite(found.model.theta) & (found.model.theta > 0))
            assert np.all(np.linalg.eigvalsh(found.model.theta_cov) > 0)

        yield Comparison(kind, check, candidate, _floor(events),
                         lambda s: 1e3 * s, "ms")
