"""Times of the images."""
from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["checked_grid"]


def checked_grid(
    fps: float | None, times_us: ArrayLike | None, start_us: int | None,
    stop_us: int | None,
) -> tuple[Fraction | None, NDArray[np.int64] | None]:
    """Return the rate or the times of the images."""
    for name, value in (("start_us", start_us), ("stop_us", stop_us)):
        if value is not None and not isinstance(value, (int, np.integer)):
            raise TypeError(
                f"{name} must be integer microseconds, got {type(value).__name__}")
    if times_us is not None:
        if any(value is not None for value in (fps, start_us, stop_us)):
            raise TypeError("times_us excludes fps, start_us and stop_us")
        raw = np.asarray(times_us)
        if raw.ndim != 1 or (raw.size and raw.dtype.kind not in "iu"):
            raise TypeError(
                "times_us must be one-dimensional integer microseconds, got "
                f"{raw.dtype} {raw.shape}")
        times = raw.astype(np.int64)
        if np.any(times[1:] <= times[:-1]):
            raise ValueError("times_us must increase")
        return None, times
    if fps is None:
        return None, None
    try:
        rate = Fraction(fps)
    except (TypeError, ValueError, OverflowError):
        rate = Fraction(0)
    if not 0 < rate <= 1_000_000:
        raise ValueError(f"fps must lie in (0, 1000000], got {fps!r}")
    return rate, None
