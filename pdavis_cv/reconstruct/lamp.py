"""Flicker of a mains lamp: a ripple common to all pixels, estimated from events."""
from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import sensor_shape
from pdavis_cv._types import Events, Records, State
from pdavis_cv.recording.base import ApsFrame

BLOCK_US = 100_000
"""Length of a block, us.  Each block has one wave, fitted to the blocks before it."""

MEMORY_US = 30_000_000
"""How long waves are kept, us: longer than any kernel looks back."""

_BLOCKS = 10
"""Number of blocks that a wave is fitted to: mains keep a frequency for a second."""
_PIXELS = 4096
"""Most pixels that are used, spread over the sensor; this bounds the computing time."""
# Time constants (us) of the local-linearity weight: three events of a pixel count the
# less, the longer they take.  The shortest is tried first; a fit is accepted without
# trying the next if explained / residual variance exceeds _ENOUGH.  Chosen on `nominal`
# (docs/theory/lamp.md).
_EVEN_US, _ENOUGH = np.array([1000.0, 4000.0, 15000.0]), 4000.0
# Detection: explained / residual variance above _EVIDENCE; variance that separate waves
# of the four places of a macropixel explain in addition, below _APART of the common
# wave's; amplitude above _LEAST, ln units.  Steady light passes none of these tests:
# lab/studies/lamp_detection.py.
_EVIDENCE, _APART, _LEAST = 200.0, 0.5, 0.02

_LEAST_EXPOSURE_MS = 1e-3
"""Lower bound of an exposure as a divisor, ms; numerical."""
WAVE_DTYPE = np.dtype([
    ("start_us", "<i8"), ("turns_per_us", "<f8"), ("cosine", "<f8"), ("sine", "<f8"),
    ("of_light", "<f8")])
"""Ripple of a lamp in one block (see `Wave`); its frequency is in turns per us."""

_LONG_AGO = -(2**62)
"""A time in us before all stamps; differences to it fit into 64 bits."""
_STAMP = 2 * _LONG_AGO
_SUMS = 7
"""Length of the normal equations of (cosine, sine): three elements of the matrix, two
of the right side, sum of squares, count (`normal_t` of _lamp.pyx)."""
_FIT = 8
"""Length of the result of `_kernels.lamp_wave`, whose docstring gives the order."""


class Wave(NamedTuple):
    """Ripple of the log intensity of all pixels in one block of `BLOCK_US`.

    Parameters
    ----------
    start_us : int
        Start of the block, a multiple of `BLOCK_US`.
    hz : float
        Frequency; 0 = a steady lamp.
    cosine, sine : float
        Amplitudes in natural-log units, phase 0 at start_us.
    of_light : bool
        True: the amplitudes are those of the light; False: those behind the pixels'
        low-pass.
    """

    start_us: int
    hz: float = 0.0
    cosine: float = 0.0
    sine: float = 0.0
    of_light: bool = False


class Lamplight:
    """The waves of the recent blocks of `BLOCK_US`, in the form that kernels take.

    `waves` has one per block, in order; it is empty if the lamp is steady.
    """

    def __init__(self) -> None:
        self._all = self.waves = np.empty(0, WAVE_DTYPE)

    def add(self, wave: Wave) -> None:
        """Append the wave of the next block; any other block begins a new series."""
        row = np.array([(wave.start_us, 1e-6 * wave.hz, wave.cosine, wave.sine,
                         float(wave.of_light))], WAVE_DTYPE)
        all_ = self._all
        if len(all_) and wave.start_us != int(all_["start_us"][-1]) + BLOCK_US:
            all_ = all_[:0]
        self._show(np.concatenate([all_, row]))

    def forget(self, before_us: int) -> None:
        """Drop the blocks that end at or before a time, us."""
        if not len(self._all):
            return
        n = min((before_us - int(self._all["start_us"][0])) // BLOCK_US, len(self._all))
        if n > 0:
            self._show(self._all[n:].copy())

    def _show(self, waves: Records) -> None:
        self._all = waves
        self.waves = waves if waves["turns_per_us"].any() else waves[:0]

    def state(self) -> NDArray[Any]:
        """Return all waves; the array is never changed in place."""
        return self._all

    def restore(self, state: NDArray[Any]) -> None:
        """Take over what `state` returned."""
        self._show(state)


class LampTracker:
    """Estimates the flicker of a mains lamp (100 or 120 Hz) from events.

    One wave is fitted for the whole sensor.  Flicker below a threshold triggers no
    events in constant light, but where the light changes it shifts the events in time:
    the middle one of three events of a pixel then deviates from the straight line
    between the others. A least-squares fit to these deviations over the last second
    gives the wave; its frequency may be 0.6 Hz off the nominal one.  A wave that
    differs between the four polarizers is not attributed to the lamp.  Of a lamp whose
    light is not sinusoidal the first harmonic is found.

    Events show the lamp behind the photoreceptors' low-pass.  The low-pass is divided
    out where the bandwidth, (hz, hz_per_intensity) as for `EventRedundancy`, is known,
    and taken to be equal in all pixels otherwise.  The shape is (height, width) of the
    sensor; of the thresholds, natural-log units, the means are used.
    """

    def __init__(
        self, shape: Sequence[int], theta_on: ArrayLike, theta_off: ArrayLike,
        bandwidth: Sequence[float] | None = None,
    ) -> None:
        self._shape = height, width = sensor_shape(shape)
        self._shift = 0
        while height * width >> 2 * self._shift > _PIXELS:
            self._shift += 1
        step = 2 << self._shift
        self._stamps = np.full(
            (2 * -(-height // step), 2 * -(-width // step), 2), _STAMP, np.int64)
        # Before the first frame, all pixels are taken to be as slow as in the dark.
        self._corners = np.empty(self._stamps.shape[:2], np.float32)
        self.retune(theta_on, theta_off, bandwidth)
        self._now = np.zeros((len(_EVEN_US), 4, 4, _SUMS))
        self._sums: tuple[NDArray[np.float64], ...] = ()
        self._block: int | None = None
        self._seen_us = _LONG_AGO

    def push(self, events: Events) -> Iterator[Wave]:
        """Take events in order of time; yield the waves of the blocks that they begin.

        Events up to the time that `advance` was given are ignored.
        """
        i = 0
        if len(events) and events["t"][0] <= self._seen_us:
            i = bisect_right(events["t"], self._seen_us)
        while i < len(events):
            yield from self._enter(int(events["t"][i]) // BLOCK_US)
            assert self._block is not None
            i += _kernels.lamp_push(
                events[i:], (self._block + 1) * BLOCK_US,
                (*self._shape, self._shift), (self._on, self._off), _EVEN_US,
                self._corners, self._stamps, self._now)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take the pixels' brightness, and so their bandwidth, from a frame."""
        if not self._slope:
            return
        cells = 1 << self._shift
        rows, columns = (
            np.flatnonzero(np.arange(side) // 2 % cells == 0) for side in self._shape)
        bright = frame.dn[np.ix_(rows, columns)] / max(
            frame.exposure_ms, _LEAST_EXPOSURE_MS)
        self._corners[:len(rows), :len(columns)] = self._hz + self._slope * bright

    def retune(
        self, theta_on: ArrayLike, theta_off: ArrayLike,
        bandwidth: Sequence[float] | None = None,
    ) -> None:
        """Continue with other parameters; the next frame gives the brightness."""
        self._on, self._off = (float(np.mean(np.asarray(theta)))
                               for theta in (theta_on, theta_off))
        self._hz, self._slope = bandwidth or (0.0, 0.0)
        self._corners[:] = self._hz

    def advance(self, t_us: int) -> Iterator[Wave]:
        """Advance to t_us, up to which all events have been pushed; yield the waves."""
        self._seen_us = max(self._seen_us, t_us)
        if self._block is not None:
            yield from self._enter(t_us // BLOCK_US)

    def _enter(self, block: int) -> Iterator[Wave]:
        if self._block is None or (block - self._block) * BLOCK_US > MEMORY_US:
            self._block, self._sums = block, ()
            self._now[:] = 0
            yield Wave(block * BLOCK_US)
        while self._block < block:
            self._sums = (*self._sums, self._now.copy())[-_BLOCKS:]
            self._now[:] = 0
            self._block += 1
            yield self._wave(self._block * BLOCK_US)

    def _wave(self, start_us: int) -> Wave:
        sums = np.array(self._sums)
        out = np.empty(_FIT)
        for span in range(len(_EVEN_US)):
            _kernels.lamp_wave(np.ascontiguousarray(sums[:, span]), start_us, out)
            turns, cosine, sine, common, apart, left, n, below = out
            if common > _ENOUGH * left / max(n, 1.0):
                break
        lamp = (common > _EVIDENCE * left / max(n, 1.0)
                and max(apart, below) < _APART * common
                and cosine**2 + sine**2 > _LEAST**2)
        of_light = self._hz > 0 or self._slope > 0
        return (Wave(start_us, 1e6 * turns, cosine, sine, of_light) if lamp
                else Wave(start_us))

    def state(self) -> State:
        """Return copies of everything that feeding changes."""
        return {"stamps": self._stamps.copy(), "now": self._now.copy(),
                "corners": self._corners.copy(),
                "sums": self._sums, "block": self._block, "seen_us": self._seen_us}

    def restore(self, state: State) -> None:
        """Return to what `state` returned, which is copied."""
        self._stamps[:], self._now[:] = state["stamps"], state["now"]
        self._corners[:] = state["corners"]
        self._sums, self._block = state["sums"], state["block"]
        self._seen_us = state["seen_us"]
