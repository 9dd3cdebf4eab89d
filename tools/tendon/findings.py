"""What `pdavis tendon` measures and its report shows."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import analysis, render

from .periodic import PeriodicLight


@dataclass(frozen=True, eq=False)
class Loop:
    """The loop of a region's DoLP over the load, and what it encloses.

    `x` and `y` are load and DoLP over a cycle, float64 (M,), `lag_deg` is by how much
    DoLP is behind the load, `area` that per cycle, positive for a clockwise loop.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    lag_deg: float
    lag_se_deg: float
    area: float
    area_se: float


@dataclass(eq=False)
class Findings:
    """All measurements, which the report shows.

    `origin_us` is the time of 0 s, and of phase 0; `fused` and `frames` are traces of
    the fused images, and of the frames alone (None without frames), `light` is
    amplitude and phase by the frames.  `waves` are those of each region with an
    amplitude: ``dolp``, ``aop``, ``s0``, and with optics ``retardance``,
    ``birefringence``; None for others. `loops` has one per region, or none at all.
    """

    origin_us: int
    facts: dict[str, Any]
    fused: analysis.Traces
    frames: analysis.Traces | None
    light: PeriodicLight
    waves: list[dict[str, analysis.Wave] | None] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    clock: analysis.Clock | None = None
    load: analysis.LoadTrace | None = None
    loops: list[Loop | None] = field(default_factory=list)
    still: render.Picture | None = None
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def load_hz(self) -> float:
        """Frequency of the load."""
        return self.light.fit.law.hz

    def seconds(self, t_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds since the recording's start."""
        return np.asarray((t_us - self.origin_us) / 1e6)
