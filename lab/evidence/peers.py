"""Two estimates that anyone can make from frames alone, without this library.

The frame that was read out last, held; and a straight line of ln intensity from one
mid-exposure to the next.  NumPy only: they are what methods must be better than.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import ApsFrame

FloatArray = NDArray[np.float64]

_EXTINCTION_RATIO = 40


class Image(NamedTuple):
    """What a `Scorer` asks of an image; no sigmas are stated."""

    t_us: int
    s0: FloatArray
    s1: FloatArray
    s2: FloatArray
    aop: FloatArray
    dolp: FloatArray
    valid: NDArray[np.bool_]
    sigma_aop: None = None
    sigma_dolp: None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width)."""
        return self.aop.shape


class Stack(NamedTuple):
    """Frames as arrays: ln DN per ms (N, H, W), and two times of each, us (N,)."""

    ln: FloatArray
    mid_us: FloatArray
    available_us: FloatArray

    @classmethod
    def of(cls, frames: Sequence[ApsFrame]) -> Stack:
        """Stack frames."""
        return cls(
            np.array([np.log(np.maximum(one.dn, 1) / (one.exposure_ms or 1))
                      for one in frames], np.float64),
            np.array([one.mid_us for one in frames], np.float64),
            np.array([one.available_us for one in frames], np.float64))


def held(stack: Stack, t_us: float) -> FloatArray:
    """Return ln intensity of the last frame read out by a time, NaN before the first.

    >>> stack = Stack(np.array([[[1.0]], [[2.0]]]), np.r_[0.0, 50], np.r_[20.0, 70])
    >>> float(held(stack, 69)), float(held(stack, 70)), float(held(stack, 19))
    (1.0, 2.0, nan)
    """
    i = int(np.searchsorted(stack.available_us, t_us, "right")) - 1
    return stack.ln[i] if i >= 0 else np.full(stack.ln.shape[1:], np.nan)


def line(stack: Stack, t_us: float) -> FloatArray:
    """Return ln intensity on the line between the frames around a time.

    Before the first and after the last mid-exposure that frame is held.

    >>> stack = Stack(np.array([[[1.0]], [[2.0]]]), np.r_[0.0, 50], np.r_[20.0, 70])
    >>> float(line(stack, 10)), float(line(stack, 60))
    (1.2, 2.0)
    """
    last = len(stack.mid_us) - 1
    i = int(np.clip(np.searchsorted(stack.mid_us, t_us, "right"), 1, max(last, 1)))
    if last == 0:
        return stack.ln[0]
    start, stop = stack.mid_us[i - 1:i + 1]
    part = np.clip((t_us - start) / (stop - start), 0, 1)
    return np.asarray((1 - part) * stack.ln[i - 1] + part * stack.ln[i])


PEERS = {"held frame": (held, "causal"), "line": (line, "buffered")}
"""Name -> (function, what it knows of what follows)."""


def polarization(
    ln: FloatArray, angles_deg: Sequence[float], t_us: int,
    demosaic: str = "superpixel",
) -> Image:
    """Return the polarization of 2x2 cells, or of every pixel.

    Parameters
    ----------
    ln : ndarray of float64, shape (H, W)
        Log intensity of the pixels.
    angles_deg : sequence of float
        Polarizers of a cell, by row: 0, 45, 90 and 135 in some order.
    t_us : int
        Time of the image.
    demosaic : {"superpixel", "bilinear"}
        A pixel per cell, or the mean of the nearest pixels of each angle.
    """
    light = np.exp(ln)
    at = {round(angle) % 180: (
        light[k // 2::2, k % 2::2] if demosaic == "superpixel"
        else _interpolated(light, k // 2, k % 2)) for k, angle in enumerate(angles_deg)}
    purity = (_EXTINCTION_RATIO - 1) / (_EXTINCTION_RATIO + 1)
    s0 = (at[0] + at[45] + at[90] + at[135]) / 2
    s1, s2 = (at[0] - at[90]) / purity, (at[45] - at[135]) / purity
    return Image(t_us, s0, s1, s2, np.arctan2(s2, s1) / 2, np.hypot(s1, s2) / s0,
                 np.isfinite(s0))


def _interpolated(light: FloatArray, row: int, column: int) -> FloatArray:
    """Return the bilinear interpolation of every second pixel to all."""
    sums = np.zeros((2, light.shape[0] + 2, light.shape[1] + 2))
    for dy, dx in np.ndindex(3, 3):
        weight = (2 - abs(dy - 1)) * (2 - abs(dx - 1))
        part = sums[:, dy:dy + light.shape[0], dx:dx + light.shape[1]]
        part[0, row::2, column::2] += weight * light[row::2, column::2]
        part[1, row::2, column::2] += weight
    return np.asarray(sums[0, 1:-1, 1:-1] / sums[1, 1:-1, 1:-1])
