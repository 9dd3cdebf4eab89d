"""Where a Fusion is, to return to."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pdavis_cv.calibration.corrected import Clipping
from pdavis_cv.reconstruct.base import Snapshot, nbytes

__all__ = ["BEFORE", "FusionSnapshot"]

BEFORE = -(2**62)
"""A time before all others, us."""


@dataclass(frozen=True, eq=False)
class FusionSnapshot:
    """State of a `Fusion` between two images; picklable.

    Parameters
    ----------
    index : int
        Number of the next image.
    start_us : int or None
        Time of the first image.
    fed_us : int or None
        Time up to which, inclusive, nothing is fed again; None = everything is.
    t_us : int or None
        Time of the last image; None before the first, where nothing else is set.
    state : Snapshot or None
        Of the Reconstructor; with ``causal``, and a method that takes no late frames,
        as of the last frame's mid-exposure.
    frames : tuple of (int, int)
        Mid-exposure and arrival of the latest frames fed.
    reached_us : int
        Time of the last sample read, which may lie before `fed_us`.
    lamp : mapping of str to object, or None
        State of the `LampTracker`, which has seen all events up to the last image.
    learning : mapping of str to object, or None
        State of an `OnlineLearning`, which has seen everything up to `fed_us`.
    clipping : Clipping, optional
        What the frames fed tell of the DN at which pixels are full.
    state_us : int or None
        Time up to which, inclusive, `state` has been fed, where that is after `fed_us`.
    """

    index: int = 0
    start_us: int | None = None
    fed_us: int | None = None
    t_us: int | None = None
    state: Snapshot | None = None
    frames: tuple[tuple[int, int], ...] = ()
    reached_us: int = BEFORE
    lamp: Mapping[str, Any] | None = None
    learning: Mapping[str, Any] | None = None
    clipping: Clipping | None = None
    state_us: int | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in it."""
        return nbytes(self)
