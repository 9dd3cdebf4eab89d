"""The position of a Fusion in its recording, to return to."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pdavis_cv._types import Parameters
from pdavis_cv.calibration.corrected import Clipping
from pdavis_cv.reconstruct.base import Snapshot, nbytes

BEFORE = -(2**62)
"""A time before all times of a recording, us."""


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
        Time up to which, inclusive, no data have to be fed again; None = all have.
    t_us : int or None
        Time of the last image.  None before the first image: then only `start_us` may
        be set.
    state : Snapshot or None
        State of the Reconstructor.  With ``causal`` and a method that takes no late
        frames, the state at the last frame's mid-exposure.
    frames : tuple of (int, int, float)
        Mid-exposure and arrival (us) and exposure (ms) of the last frames fed.
    reached_us : int
        Time of the last sample read, which may lie before `fed_us`.
    lamp : mapping of str to object, or None
        State of the `LampTracker`, fed with all events up to the last image.
    learning : mapping of str to object, or None
        State of the `OnlineLearning`, fed with everything up to `fed_us`.
    clipping : Clipping, optional
        Estimate of the DN at which pixels saturate, from the frames fed.
    state_us : int or None
        Time up to which, inclusive, `state` has been fed, if that is after `fed_us`.
    """

    index: int = 0
    start_us: int | None = None
    fed_us: int | None = None
    t_us: int | None = None
    state: Snapshot | None = None
    frames: tuple[tuple[int, int, float], ...] = ()
    reached_us: int = BEFORE
    lamp: Mapping[str, Any] | None = None
    learning: Parameters | None = None
    clipping: Clipping | None = None
    state_us: int | None = None

    @property
    def nbytes(self) -> int:
        """Size of all arrays, bytes."""
        return nbytes(self)
