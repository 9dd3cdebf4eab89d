"""The ``events`` method: high-passed sum of events, or the channels' redundancy."""
from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import (
    checked_threshold,
    output,
    positive,
    sensor_shape,
    whole_number,
)
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv.events import timed_events
from pdavis_cv.reconstruct.aop_events import MOST_RADIUS
from pdavis_cv.reconstruct.base import Estimate, Needs, Reconstructor
from pdavis_cv.reconstruct.cf import CELL_DTYPE
from pdavis_cv.reconstruct.redundancy import EventRedundancy
from pdavis_cv.reconstruct.stream_clock import StreamClock, steps
from pdavis_cv.recording.base import ApsFrame


class EventHighPass(Reconstructor):
    """Log intensity relative to its recent mean, from events alone.

    Each event decays the value dL of its pixel with time constant
    1 / (2 pi cutoff_hz) and adds ``theta_on`` or subtracts ``theta_off``.  Frames are
    ignored.  As in the paper, 1 + dL is taken as the intensity divided by its recent
    mean, so the angle of polarization is correct only while the means of the four
    channels are equal, as behind a rotating polarizer; with unequal means (a wave
    plate, partly polarized light) it is biased.  The degree of polarization is not
    measured.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    cutoff_hz : float
        Corner frequency f3dB.
    radius : int
        Radius of a spatial mean in macropixels: a pixel shows the mean over the pixels
        of the same polarizer within it.  0: its own value.
    hold : bool
        Show each pixel's value after its last event, which is the paper's equation;
        otherwise the value decayed to the time of the image, so that static parts
        fade.

    Raises
    ------
    ValueError
        If a threshold, the cutoff or the shape is not positive, the radius negative,
        or a map of thresholds has another shape.

    Notes
    -----
    Haessig et al., supplement "Reconstructing AoP from PDAVIS events only".  The mean
    is computed at each read.  A pixel is valid once any pixel in its mean has had an
    event.

    The high pass has a phase lead: AoP is ahead of the truth, in the sense of its
    rotation, by ``atan(cutoff_hz / f) / 2`` if decayed to the time of the image.  f is
    the frequency of the intensity, twice that of the rotation of the light: 45 degrees
    far below the cutoff, 13 at 30 RPM, 7 at 60 RPM.  With ``hold`` it is 9 and 4.
    """

    method = "events"
    # As `from_events` takes them.
    trials = MappingProxyType({"events, redundancy": {"offsets": "redundancy"}})
    needs = Needs(frames=False)

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        cutoff_hz: float = 0.5, radius: int = 1, hold: bool = True,
    ) -> None:
        self.shape = sensor_shape(shape)
        self._theta_on = checked_threshold("theta_on", theta_on, self.shape)
        self._theta_off = checked_threshold("theta_off", theta_off, self.shape)
        self._cutoff_hz = positive("cutoff_hz", cutoff_hz)
        self._radius = whole_number("radius", radius, 0, MOST_RADIUS)
        self._hold = bool(hold)
        self.margin = 2 * self._radius
        self._steps = steps(self._theta_on, self._theta_off, self.shape)
        self._clock = StreamClock(self.shape)
        self._cells = np.zeros(self.shape, CELL_DTYPE)
        self._cells["t"] = -np.inf  # no event yet
        self._cells["rate"] = 1e-6 * math.tau * self._cutoff_hz
        self._base = np.zeros(self.shape, np.float32)
        self._neighbours = _neighbours(self._radius)
        ones = np.ones(self.shape, np.float32)
        self._count = np.empty(self.shape, np.float32)   # pixels in each pixel's mean
        _kernels.mean_around(ones, ones, self._neighbours, self._count)
        # Each pixel's value after its last event, and whether it had one; scratch space
        # of `read`; cache of `_around`: its input and its result.
        self._held = np.zeros(self.shape, np.float32)
        self._seen = np.zeros(self.shape, np.bool_)
        self._decayed = np.empty(self.shape, np.float32)
        self._mean_cache: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal EventHighPass."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "cutoff_hz": self._cutoff_hz, "radius": self._radius,
                "hold": self._hold}

    def add_events(self, events: Events) -> None:
        """Integrate events (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        clock = self._clock
        taken = _kernels.leak_events(events, self._steps, clock.last_us, self._cells)
        _kernels.leak_shown(
            events[:taken], self._cells, self._held, self._seen.view(np.uint8))
        clock.took(events, taken)

    def add_frame(self, frame: ApsFrame) -> None:
        """Check the frame and record its time."""
        self._clock.check_frame(frame)

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the high-passed log intensity at t_us (see `Reconstructor.read`)."""
        t = self._clock.check_read(t_us)
        log = output(out, self.shape, np.float32)
        own = self._held
        if not self._hold:
            own = self._decayed
            _kernels.leak_read(self._cells, self._base, t, own)
        if self._radius:
            _kernels.mean_around(own, self._count, self._neighbours, log)
            seen = self._around()
        else:
            log[:], seen = own, self._seen.copy()
        return Estimate(log, None, seen)

    def _around(self) -> NDArray[np.bool_]:
        """Return where any pixel of the mean has had an event, bool (H, W)."""
        seen = self._seen
        if self._mean_cache is None or not np.array_equal(self._mean_cache[0], seen):
            around = seen.copy()
            for dy, dx in self._neighbours.tolist():
                to, of = zip(_shifted(dy, seen.shape[0]), _shifted(dx, seen.shape[1]),
                             strict=True)
                around[to] |= seen[of]
            self._mean_cache = seen.copy(), around
        return self._mean_cache[1].copy()

    def intensity(self, log_intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return 1 + dL, for a macropixel's relative intensities."""
        return log_intensity + np.float32(1)

    def _state(self) -> State:
        return {"last_us": self._clock.last_us, "cells": self._cells.copy()}

    def _restore(self, state: State) -> None:
        self._clock.last_us = state["last_us"]
        self._cells = state["cells"].copy()
        self._held[:] = self._cells["value"]
        self._seen[:] = self._cells["t"] > -np.inf


def _neighbours(radius: int) -> NDArray[np.intp]:
    """Return offsets, rows and columns, of the macropixels within a radius, (n, 2)."""
    reach = range(-radius, radius + 1)
    return np.array([(2 * dy, 2 * dx) for dy in reach for dx in reach
                     if 0 < dy * dy + dx * dx <= radius * radius],
                    np.intp).reshape(-1, 2)


def _shifted(by: int, side: int) -> tuple[slice, slice]:
    """Return the slices of all i, and of i + by, that both lie in 0..side - 1."""
    lo, hi = min(max(-by, 0), side), max(side - max(by, 0), 0)
    return slice(lo, max(hi, lo)), slice(lo + by, max(hi, lo) + by)


_KINDS: dict[str, Any] = {"mean": EventHighPass, "redundancy": EventRedundancy}
_ONLY = {"mean": ("radius", "hold"),
         "redundancy": ("lookahead_us", "bandwidth", "ratio_sigma")}


def from_events(
    shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
    offsets: str = "mean", cutoff_hz: float = 0.5, radius: int | None = None,
    hold: bool | None = None, lookahead_us: int | None = None,
    bandwidth: tuple[float, float] | None = None, ratio_sigma: float | None = None,
    response: ArrayLike | None = None,
) -> Reconstructor:
    """Make an EventHighPass, or an EventRedundancy.

    Parameters
    ----------
    shape, theta_on, theta_off, cutoff_hz
        As for both classes.
    offsets : {"mean", "redundancy"}
        "mean": the channels' means are taken to be equal, as in the paper;
        "redundancy": they follow from I0 + I90 = I45 + I135, and DoLP with them.
    radius, hold
        As for `EventHighPass`, with its defaults.
    lookahead_us, bandwidth, ratio_sigma
        As for `EventRedundancy`, with its defaults.
    response
        As for `EventRedundancy`.

    Raises
    ------
    TypeError
        If a parameter of the other class is given.
    ValueError
        If ``offsets`` is another word, or a parameter out of range.
    """
    if offsets not in _KINDS:
        raise ValueError(f"offsets must be 'mean' or 'redundancy', got {offsets!r}")
    given: dict[str, Any] = {
        "radius": radius, "hold": hold, "lookahead_us": lookahead_us,
        "bandwidth": bandwidth,
        "ratio_sigma": ratio_sigma}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in _ONLY[offsets]:
            raise TypeError(f"{name} has no meaning with offsets={offsets!r}")
    if offsets == "redundancy":
        given["response"] = response
    made: Reconstructor = _KINDS[offsets](
        shape, theta_on=theta_on, theta_off=theta_off, cutoff_hz=cutoff_hz, **given)
    return made
