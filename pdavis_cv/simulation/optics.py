"""Optics: angle, extinction ratio and gain of each pixel's polarizer."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.sensor import Layout
from pdavis_cv.simulation import noise
from pdavis_cv.simulation.checks import (
    fraction,
    instance,
    present,
    python_numbers,
    require,
    within,
)
from pdavis_cv.simulation.crosstalk import Kernel, Neighbours, check_kernel, kernel
from pdavis_cv.simulation.lens import Lens

__all__ = ["LENSES", "Optics"]

FloatArray = NDArray[np.float64]

_MOST_RATIO = 1e12      # far above any polarizer; a float still tells it from infinity


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Layout of the polarizers, and their spread and that of the sensitivity.

    A pixel behind an analyser at angle a sees
    ``gain / 2 (S0 + k (S1 cos 2a + S2 sin 2a))`` with k = (ER - 1)/(ER + 1): the
    extinction ratio ER is largest over smallest response to fully polarized light.

    Parameters
    ----------
    layout : Layout
        Nominal angles.
    extinction_ratio : float
        Mean extinction ratio, above 1, at most 1e12; PDAVIS 40, Sony 350 (Haessig,
        table S1).
    extinction_ratio_sigma : float
        Standard deviation over pixels, normal, kept above 1.5; at most 1e12.
    angle_sigma, angle_smooth : float
        Rms error of the angles in radians, at most pi: independent per pixel, and a
        field that varies smoothly over the sensor, as a misaligned filter array gives.
    gain_sigma, gain_smooth : float
        Relative spread of sensitivity: per pixel, and the fall towards the corners.
    lens : Lens, optional
        Lens in front of the polarizers; None: normal incidence.
    crosstalk : 3 rows of 3 floats, optional
        Kernel: fraction of a pixel's light that comes through each of the polarizers
        around it, and in the middle through its own; `crosstalk.kernel` makes one.
        None: no crosstalk.
    """

    layout: Layout = Layout.PDAVIS
    extinction_ratio: float = 40.0
    extinction_ratio_sigma: float = 0.0
    angle_sigma: float = 0.0
    angle_smooth: float = 0.0
    gain_sigma: float = 0.0
    gain_smooth: float = 0.0
    lens: Lens | None = None
    crosstalk: Kernel | None = None

    def __post_init__(self) -> None:
        python_numbers(self)
        instance(Layout, layout=self.layout)
        within(1, _MOST_RATIO, extinction_ratio=self.extinction_ratio)
        require("extinction_ratio", self.extinction_ratio, self.extinction_ratio > 1,
                "be above 1")
        within(0, _MOST_RATIO, extinction_ratio_sigma=self.extinction_ratio_sigma)
        within(0, math.pi, angle_sigma=self.angle_sigma, angle_smooth=self.angle_smooth)
        fraction(gain_sigma=self.gain_sigma, gain_smooth=self.gain_smooth)
        require("gain_smooth", self.gain_smooth, self.gain_smooth < 1, "be below 1")
        require("gain_sigma", self.gain_sigma, self.gain_sigma < 0.2,
                "be below 0.2 for gains to stay positive")
        instance(Lens, **present(lens=self.lens))
        if self.crosstalk is not None:
            check_kernel("crosstalk", self.crosstalk)

    def maps(
        self, seed: int, size: tuple[int, int], origin: tuple[int, int],
        full_size: tuple[int, int],
    ) -> dict[str, FloatArray]:
        """Return a specimen's maps: angle (radians), extinction_ratio, gain.

        Parameters
        ----------
        seed : int
            Seed of the specimen.
        size, origin, full_size : (int, int)
            Region of the sensor as (height, width) and (row, column), and the
            sensor's size.

        Returns
        -------
        dict of ndarray of float64, shape (H, W)
            ``angle``, ``extinction_ratio``, ``gain``, and ``analyser`` of shape
            (H, W, 3): the response to S0, S1, S2.  With lens and crosstalk these are
            the effective ones in uniform light; a lens adds ``circular``, the response
            to S3.
        """
        if self.crosstalk is not None:
            near = self.neighbours(seed, size, origin, full_size)
            return self._effective(near.uniform(), origin)
        angle, ratio, gain, x, y = self._pixels(seed, size, origin, full_size)
        if self.lens is not None:
            response = gain[..., None] * self.lens.seen(angle, ratio, x, y)
            return self._effective(response, origin)
        k = (ratio - 1) / (ratio + 1)
        analyser = gain[..., None] / 2 * np.stack(
            (np.ones(size), k * np.cos(2 * angle), k * np.sin(2 * angle)), axis=-1)
        return {"angle": angle, "extinction_ratio": ratio, "gain": gain,
                "analyser": analyser}

    def neighbours(
        self, seed: int, size: tuple[int, int], origin: tuple[int, int],
        full_size: tuple[int, int],
    ) -> Neighbours:
        """Return the crosstalk of the pixels of a region.

        Parameters
        ----------
        seed, size, origin, full_size
            As for `maps`.
        """
        if self.crosstalk is None:
            raise ValueError("crosstalk must not be None")
        first = max(origin[0] - 1, 0), max(origin[1] - 1, 0)
        last = tuple(min(o + n + 1, full) for o, n, full in zip(
            origin, size, full_size, strict=True))
        angle, ratio, gain, x, y = self._pixels(
            seed, (last[0] - first[0], last[1] - first[1]), first, full_size)
        lens = Lens() if self.lens is None else self.lens
        response = gain[..., None] * lens.seen(angle, ratio, x, y)
        padded = np.zeros((size[0] + 2, size[1] + 2, 4))
        row, column = first[0] - origin[0] + 1, first[1] - origin[1] + 1
        rows, columns = response.shape[:2]
        padded[row:row + rows, column:column + columns] = response
        return Neighbours(self.crosstalk, padded)

    def _effective(
        self, response: FloatArray, origin: tuple[int, int]
    ) -> dict[str, FloatArray]:
        """Convert responses (H, W, 4) to S0..S3 into the maps of `maps`."""
        s0, s1, s2, s3 = np.moveaxis(response, -1, 0)
        contrast = np.hypot(s1, s2) / s0
        nominal = self._nominal(response.shape[:2], origin)
        turn = np.arctan2(s2, s1) - 2 * nominal
        maps = {
            "angle": nominal + np.arctan2(np.sin(turn), np.cos(turn)) / 2,
            "extinction_ratio": (1 + contrast) / (1 - contrast), "gain": 2 * s0,
            "analyser": np.ascontiguousarray(response[..., :3])}
        return maps if self.lens is None else {**maps, "circular": s3.copy()}

    def _nominal(self, size: tuple[int, ...], origin: tuple[int, int]) -> FloatArray:
        rows, columns = np.arange(size[0]) + origin[0], np.arange(size[1]) + origin[1]
        cell = np.deg2rad(np.array(self.layout.angles_deg, np.float64))
        return np.asarray(cell[rows[:, None] % 2, columns[None, :] % 2])

    def _pixels(
        self, seed: int, size: tuple[int, int], origin: tuple[int, int],
        full_size: tuple[int, int],
    ) -> tuple[FloatArray, ...]:
        """Angle, extinction ratio, gain without lens and crosstalk; x, y of `Lens`."""
        index = noise.pixel_index(size, origin)
        rows = np.arange(size[0]) + origin[0]
        columns = np.arange(size[1]) + origin[1]
        v = 2 * (rows[:, None] + 0.5) / full_size[0] - 1  # -1..1 over the sensor
        u = 2 * (columns[None, :] + 0.5) / full_size[1] - 1
        angle = self._nominal(size, origin)
        angle = angle + self.angle_sigma * noise.normal(seed, "angle", index)
        if self.angle_smooth:
            c = noise.normal(seed, "angle field", np.arange(3))
            # rms 1 over the sensor whatever the direction
            field = (c[0] * u + c[1] * v + c[2] * u * v * math.sqrt(3)) * math.sqrt(3)
            angle = angle + self.angle_smooth * field / float(np.linalg.norm(c))
        ratio = self.extinction_ratio + self.extinction_ratio_sigma * noise.normal(
            seed, "extinction ratio", index)
        ratio = np.maximum(ratio, 1.5)
        gain = 1 + self.gain_sigma * noise.normal(seed, "gain", index)
        gain = np.maximum(gain, 0.05) * (1 - self.gain_smooth * (u**2 + v**2) / 2)
        corner = math.hypot(*full_size)
        return angle, ratio, gain, u * full_size[1] / corner, -v * full_size[0] / corner


LENSES: Mapping[str, Mapping[str, Any]] = MappingProxyType({
    name: MappingProxyType({
        "lens": Lens(f_number=f_number, chief_ray=math.radians(10),
                     half_ratio=math.radians(20), diattenuation=0.01,
                     retardance=math.radians(2)),
        "crosstalk": kernel(side, side / 5)})
    for name, f_number, side in (("f2.8", 2.8, 0.005), ("f8", 8.0, 0.00175))})
"""Lens and crosstalk by name, for `Camera.preset`.

The cone follows from the f-number.  The rest is assumed, since nothing is published of
this camera: a chief ray of 10 degrees at the corners (exit pupil 23 mm from a sensor of
8 mm diagonal), half the extinction ratio at 20 degrees, 1 % diattenuation and 2 degrees
retardance of the glass at the corners, and crosstalk inversely proportional to the
f-number, .5 % at f/2.8.
"""
