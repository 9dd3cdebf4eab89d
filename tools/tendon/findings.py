"""What `pdavis tendon` measures and its report shows."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import PolarFrame, analysis, aop, dolp, render

__all__ = ["Findings", "MeanStokes"]


class MeanStokes:
    """Mean Stokes planes of images, over valid pixels."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._sum, self._count = np.zeros((3, *shape)), np.zeros(shape, np.int64)

    def add(self, image: PolarFrame) -> None:
        """Add an image."""
        for total, plane in zip(
                self._sum, (image.s0, image.s1, image.s2), strict=True):
            np.add(total, plane, out=total, where=image.valid)
        self._count += image.valid

    def maps(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_]]:
        """Return AoP (radians) and DoLP of the means, and where they are valid."""
        s0, s1, s2 = self._sum.astype(np.float32)
        return aop(s1, s2), dolp(s0, s1, s2), self._count > 0


@dataclass(eq=False)
class Findings:
    """All measurements, which the report shows.

    Parameters
    ----------
    origin_us : int
        Time of 0 s.
    fused, frames : Traces
        Traces of the fused images, and of the frames alone (None without frames).
    tones : list of Tone
        DoLP's dominant periodic component, one per region.
    load_hz : float
        Frequency of the load.
    frame_hz : float
        Frames per second of the recording.
    """

    origin_us: int
    facts: dict[str, Any]
    fused: analysis.Traces
    frames: analysis.Traces | None
    tones: list[analysis.Tone]
    load_hz: float
    frame_hz: float
    cycles: list[analysis.Cycle] = field(default_factory=list)
    drifts: list[analysis.Drift] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    maps: analysis.LockInMaps | None = None
    mean: MeanStokes | None = None
    clock: analysis.Clock | None = None
    load: analysis.LoadTrace | None = None
    loops: list[analysis.Loop] = field(default_factory=list)
    still: render.Picture | None = None
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)

    def seconds(self, t_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds since the recording's start."""
        return np.asarray((t_us - self.origin_us) / 1e6)
