"""The complementary filter: frames below the cutoff, events above it."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import checked_threshold, output, positive, sensor_shape
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv.events import timed_events
from pdavis_cv.reconstruct.base import Estimate, Reconstructor
from pdavis_cv.reconstruct.frames import log_exposure, log_samples
from pdavis_cv.reconstruct.stream_clock import StreamClock, steps
from pdavis_cv.recording.base import ApsFrame

RULES = ("transfer", "authors", "printed")
"""Readings of the paper's filter (see `ComplementaryFilter`)."""

CELL_DTYPE = np.dtype(
    [("t", "<f8"), ("value", "<f8"), ("rate", "<f4"), ("unused", "<f4")])
"""A leaky integrator: time of its last update, us; value then; decay rate, 1/us."""

GAIN_FLOOR = 0.1
"""Lambda of the adaptive gain (Haessig et al., supplement)."""

CUTOFF_HZ = 1.6
"""Crossover frequency f3dB in Hz (Haessig et al., supplement)."""

_ADAPTIVE_BITS = 8
"""Bits of the scale on which the paper states the adaptive gain's limits."""

_READ_NS = 0.8
"""Time that reading a pixel takes, ns (measured)."""


class ComplementaryFilter(Reconstructor):
    """High-passed sum of events plus the last frame's value, low-passed.

    Between updates the log intensity L of a pixel relaxes with time constant
    1 / (2 pi cutoff_hz) to L_F, its value in the last frame; an event adds
    ``theta_on`` or subtracts ``theta_off``.  L and L_F start at the first frame;
    before it, events are summed from 0 and nothing is valid.  A pixel is valid
    while its last sample is.  A frame acts from its mid-exposure on, each column of
    a rolling shutter from its own.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    cutoff_hz : float
        Crossover frequency f3dB.
    adaptive_gain : bool
        Relax more slowly, by down to a factor of 0.1, towards samples near either end
        of the range and towards samples that are not valid.
    rule : str
        One of ``RULES``.  ``"transfer"``: the paper's transfer function, as above.
        ``"authors"``: as the authors' program (DavisComplementaryFilter of jAER): a
        frame, with its own gain, weighs the time since the last update, and L is read
        as it was at the last update; all columns act at mid-exposure.  ``"printed"``:
        the printed equation: L, in ln of 10-bit DN, decays towards 0 at events, is
        pulled to a sample only when the frame comes, and is read likewise.

    Raises
    ------
    ValueError
        If a threshold, the cutoff or the shape is not positive, or a map of
        thresholds has another shape.

    Notes
    -----
    Haessig et al., supplement "Complementary Filter", after Scheerlinck et al., ACCV
    2018.  Memory is 29 bytes per pixel.  Results do not depend on how the stream is
    cut into packets.
    """

    method = "cf"

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        cutoff_hz: float = CUTOFF_HZ, adaptive_gain: bool = True,
        rule: str = "transfer",
    ) -> None:
        if rule not in RULES:
            raise ValueError(f"rule must be one of {RULES}, got {rule!r}")
        self.shape = sensor_shape(shape)
        self._set_thresholds(theta_on, theta_off)
        self._cutoff_hz = positive("cutoff_hz", cutoff_hz)
        self._adaptive_gain = bool(adaptive_gain)
        self._rule = rule
        self._rate = 1e-6 * math.tau * self._cutoff_hz
        self._floor = GAIN_FLOOR if self._adaptive_gain else 1.0
        self._clock = StreamClock(self.shape)
        self._started = False
        self._cells = np.zeros(self.shape, CELL_DTYPE)
        self._cells["rate"] = self._rate
        self._held = np.zeros(self.shape, np.float32)
        self._exposure = np.zeros(self.shape[1], np.float32)
        self._valid = np.zeros(self.shape, np.bool_)

    def _set_thresholds(self, theta_on: ArrayLike, theta_off: ArrayLike) -> None:
        self._theta_on = checked_threshold("theta_on", theta_on, self.shape)
        self._theta_off = checked_threshold("theta_off", theta_off, self.shape)
        self._steps = steps(self._theta_on, self._theta_off, self.shape)

    def retune(self, **learned: Any) -> None:
        """Continue with other thresholds for later events (see `Reconstructor`)."""
        if learned.keys() - {"theta_on", "theta_off"}:
            raise TypeError("retune takes theta_on and theta_off, got "
                            f"{', '.join(sorted(learned))}")
        self._set_thresholds(learned.get("theta_on", self._theta_on),
                             learned.get("theta_off", self._theta_off))

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal ComplementaryFilter."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "cutoff_hz": self._cutoff_hz, "adaptive_gain": self._adaptive_gain,
                "rule": self._rule}

    def add_events(self, events: Events) -> None:
        """Integrate events (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        clock = self._clock
        clock.took(events, _kernels.leak_events(
            events, self._steps, clock.last_us, self._cells))

    def add_frame(self, frame: ApsFrame) -> None:
        """Relax towards the frame's samples from its mid-exposure on."""
        mid = self._clock.check_frame(frame)
        exposure = log_exposure(frame)
        unit = np.zeros_like(exposure) if self._rule == "printed" else exposure
        sample, valid = log_samples(frame, unit)
        # ln of the converter's full scale over 256: DN to the 8-bit scale.
        log_scale = math.log(2) * (frame.full_scale_dn.bit_length() - _ADAPTIVE_BITS)
        if not self._started:
            self._cells["value"] = sample if self._rule == "printed" else 0
            self._held[:] = sample
            self._started = True
        usable, log_8bit = valid.view(np.uint8), unit - np.float32(log_scale)
        if self._rule == "printed":
            _kernels.cf_frame_printed(
                sample, usable, mid, self._rate, self._floor, -log_scale, self._cells)
        elif self._rule == "authors":
            _kernels.cf_frame_authors(
                sample, usable, log_8bit, mid, self._rate, self._floor, self._held,
                self._cells)
        else:
            age = (mid - frame.column_mid_us).astype(np.float32)
            _kernels.cf_frame(
                sample, usable, log_8bit, age, mid, self._rate, self._floor,
                self._held, self._cells)
        self._exposure, self._valid = exposure, valid

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity at t_us (see `Reconstructor.read`)."""
        t = self._clock.check_read(t_us)
        log = output(out, self.shape, np.float32)
        if self._rule == "authors":
            np.add(self._cells["value"], self._held, out=log, casting="same_kind")
        elif self._rule == "printed":
            np.subtract(self._cells["value"], self._exposure, out=log,
                        casting="same_kind")
        else:
            self.workers.rows(len(log), lambda first, last: _kernels.leak_read(
                self._cells[first:last], self._held[first:last], t, log[first:last]),
                row_ns=_READ_NS * self.shape[1])
        return Estimate(log, None, self._valid.copy())

    def _state(self) -> State:
        return {"last_us": self._clock.last_us, "started": self._started,
                "cells": self._cells.copy(), "held": self._held.copy(),
                "exposure": self._exposure.copy(), "valid": self._valid.copy()}

    def _restore(self, state: State) -> None:
        self._clock.last_us = state["last_us"]
        self._started = state["started"]
        self._cells, self._held = state["cells"].copy(), state["held"].copy()
        self._exposure, self._valid = state["exposure"].copy(), state["valid"].copy()
