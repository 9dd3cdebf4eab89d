"""Bench cases of what works on events alone."""
from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.aop_events import AopEvents
from pdavis_cv.sensor import Layout

from .cases import EVENTS, PACKET, SHAPE, Comparison, case, event_input
from .floor import compiled_floor

_THETA = 0.2


@case("aop-events", "AoP of each event, its macropixel and four neighbours", 0.012)
def _aop_events() -> Iterator[Comparison]:
    floor_sum = compiled_floor()
    step = np.array([-_THETA, _THETA], np.float32)
    plane = np.zeros(SHAPE, np.float32)
    for kind in ("uniform", "clustered"):
        events = event_input(kind)
        packets = [events[i:i + PACKET] for i in range(0, EVENTS, PACKET)]

        def candidate(packets: list[NDArray[Any]] = packets) -> float:
            stream = AopEvents(
                SHAPE, theta_on=_THETA, theta_off=_THETA, layout=Layout.PDAVIS)
            start = perf_counter()
            for packet in packets:
                stream.add(packet)
            return perf_counter() - start

        def floor(packets: list[NDArray[Any]] = packets) -> float:
            start = perf_counter()
            for packet in packets:
                floor_sum(packet, step, plane)
            return perf_counter() - start

        def check(events: NDArray[Any] = events) -> None:
            stream = AopEvents(
                SHAPE, theta_on=_THETA, theta_off=_THETA, layout=Layout.PDAVIS)
            got = stream.add(events)
            doubled = np.deg2rad(2 * np.array(Layout.PDAVIS.angles_deg))
            for i in range(EVENTS // 50, EVENTS, EVENTS // 50):
                past, e = events[:i + 1], events[i]
                rows, columns = (
                    past[name].astype(int) // 2 - int(e[name]) // 2 for name in "yx")
                near = past[rows**2 + columns**2 <= 1]
                weight = np.where(near["p"], 1, -1) * np.exp(
                    1e-6 * np.pi * (near["t"] - e["t"]))
                s = np.sum(weight * np.exp(
                    1j * doubled[near["y"] % 2, near["x"] % 2]))
                if abs(s) > 0.1:
                    turn = 2 * got["aop"][i] - np.angle(s) + np.pi
                    assert abs(turn % (2 * np.pi) - np.pi) < 1e-3

        yield Comparison(kind, check, candidate, floor,
                         lambda s: EVENTS / s / 1e6, "Mev/s")
