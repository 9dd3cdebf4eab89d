"""Bench case of demosaicing: guided against bilinear, through to AoP and DoLP."""
from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.mosaic import demosaic
from pdavis_cv.sensor import Layout, Sensor
from pdavis_cv.stokes_vector import aop, dolp, stokes

from .cases import Comparison, case, mosaic_input

AOP, DOLP = 0.7, 0.6


class _Chain:
    """Mosaic to Stokes parameters, AoP and DoLP, in memory of its own."""

    def __init__(self, shape: tuple[int, int], layout: Layout) -> None:
        self.layout = layout
        self.quad = np.empty((4, *shape), np.float32)
        self.stokes = np.empty((3, *shape), np.float32)
        self.aop, self.dolp = np.empty((2, *shape), np.float32)

    def seconds(self, mosaic: NDArray[Any], method: str) -> float:
        """Fill the images by a method; return the time it took."""
        start = perf_counter()
        demosaic(mosaic, self.layout, method, self.quad)
        s0, s1, s2 = stokes(self.quad, out=self.stokes)
        aop(s1, s2, out=self.aop)
        dolp(s0, s1, s2, out=self.dolp)
        return perf_counter() - start


def _check(chain: _Chain) -> None:
    shape = chain.aop.shape
    even = mosaic_input(shape, chain.layout, AOP, DOLP).astype(np.float32)
    for method in ("guided", "bilinear"):
        chain.seconds(even, method)
        np.testing.assert_allclose(chain.aop, AOP, rtol=0, atol=1e-5)
        np.testing.assert_allclose(chain.dolp, DOLP, rtol=0, atol=1e-5)


@case("guided", "guided, Stokes, AoP, DoLP against the same with bilinear", 8,
      by_time=True)
def _guided() -> Iterator[Comparison]:
    for sensor in (Sensor.PDAVIS, Sensor.SONY):
        (height, width), layout = sensor.size, sensor.layout
        assert layout is not None
        ramp = np.add.outer(0.3 * np.arange(height), 0.5 * np.arange(width))
        mosaic = mosaic_input(
            sensor.size, layout, AOP, DOLP, 20 + 60 * ramp / ramp.max())
        mosaic = (mosaic + np.random.default_rng(3).normal(0, 2, sensor.size)).astype(
            np.uint8)
        chain = _Chain(sensor.size, layout)
        yield Comparison(
            f"{width}x{height}", partial(_check, chain),
            partial(chain.seconds, mosaic, "guided"),
            partial(chain.seconds, mosaic, "bilinear"), lambda s: 1e3 * s, "ms")
