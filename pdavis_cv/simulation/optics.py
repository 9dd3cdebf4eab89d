"""Optics: angle, extinction ratio and gain of each pixel's polarizer."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.sensor import Layout
from pdavis_cv.simulation import noise
from pdavis_cv.simulation.checks import FRACTION, Checked, instance, ruled, that, within

FloatArray = NDArray[np.float64]

_MOST_RATIO = 1e12      # far above any polarizer; a float still tells it from infinity
_HALF_TURN = within(0, math.pi)


@dataclass(frozen=True, kw_only=True)
class Optics(Checked):
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
    """

    layout: Layout = ruled(Layout.PDAVIS, instance(Layout))
    extinction_ratio: float = ruled(
        40.0, within(1, _MOST_RATIO), that(lambda ratio: ratio > 1, "be above 1"))
    extinction_ratio_sigma: float = ruled(0.0, within(0, _MOST_RATIO))
    angle_sigma: float = ruled(0.0, _HALF_TURN)
    angle_smooth: float = ruled(0.0, _HALF_TURN)
    gain_sigma: float = ruled(0.0, FRACTION, that(
        lambda gain: gain < 0.2, "be below 0.2 for gains to stay positive"))
    gain_smooth: float = ruled(0.0, FRACTION, that(lambda gain: gain < 1, "be below 1"))

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
            (H, W, 3): the response to S0, S1, S2.
        """
        index = noise.pixel_index(size, origin)
        rows = np.arange(size[0]) + origin[0]
        columns = np.arange(size[1]) + origin[1]
        v = 2 * (rows[:, None] + 0.5) / full_size[0] - 1  # -1..1 over the sensor
        u = 2 * (columns[None, :] + 0.5) / full_size[1] - 1
        cell = np.deg2rad(np.array(self.layout.angles_deg, np.float64))
        angle = cell[rows[:, None] % 2, columns[None, :] % 2]
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
        k = (ratio - 1) / (ratio + 1)
        analyser = gain[..., None] / 2 * np.stack(
            (np.ones(size), k * np.cos(2 * angle), k * np.sin(2 * angle)), axis=-1)
        return {"angle": angle, "extinction_ratio": ratio, "gain": gain,
                "analyser": analyser}
