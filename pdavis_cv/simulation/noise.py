"""Counter-based random numbers: a function of seed, purpose, pixel and counter.

SplitMix64 (Steele, Lea, Flood 2014) evaluated at a counter: the order of pixels,
chunks, threads and the region of interest do not change the noise of a pixel.
``_kernels/_double.pxd`` draws from the same streams.
"""
from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def _mix(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def pixel_index(
    size: tuple[int, int], origin: tuple[int, int] = (0, 0)
) -> NDArray[np.uint64]:
    """Return an index per pixel that is the same for every region of one sensor.

    The region has this size, and its first pixel, (row, column), is `origin`; uint64
    (H, W).
    """
    rows = np.arange(size[0], dtype=np.uint64) + np.uint64(origin[0])
    columns = np.arange(size[1], dtype=np.uint64) + np.uint64(origin[1])
    return rows[:, None] * np.uint64(65_536) + columns


def keys(seed: int, purpose: str, index: ArrayLike) -> NDArray[np.uint64]:
    """Return the key of each index's stream; a purpose has streams of its own."""
    base = np.array([seed % 2**64], np.uint64) + _GOLDEN
    named = _mix(base) ^ np.uint64(zlib.crc32(purpose.encode()))
    with np.errstate(over="ignore"):
        return _mix(_mix(named) + _GOLDEN * (np.asarray(index, np.uint64)
                                             + np.uint64(1)))


def uniform(
    seed: int, purpose: str, index: ArrayLike, counter: int = 0
) -> NDArray[np.float64]:
    """Draw one number in (0, 1) per index."""
    with np.errstate(over="ignore"):
        step = np.array([counter + 1], np.uint64) * _GOLDEN
        bits = _mix(keys(seed, purpose, index) + step)
    return ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53


def normal(
    seed: int, purpose: str, index: ArrayLike, counter: int = 0
) -> NDArray[np.float64]:
    """Draw one standard normal number per index."""
    from scipy.special import ndtri  # slow to load, seldom needed

    drawn: NDArray[np.float64] = ndtri(uniform(seed, purpose, index, counter))
    return drawn
