"""Polarization per pixel from the events behind a turning analyser."""
from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import checked_threshold, positive, sensor_shape
from pdavis_cv._types import Events, Parameters, Records, State
from pdavis_cv.events import checked_time, timed_events
from pdavis_cv.reconstruct.base import Estimate, Needs, Reconstructor
from pdavis_cv.reconstruct.frames import log_samples
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.turning import PulseClock

__all__ = ["Polarization", "TurningRegression"]

_CELL = np.dtype([("t", "f8"), *((name, "f4") for name in (
    "c s s1 s2 on off sign rest a11 a12 a22 b1 b2 yy n l11 l12 l22 m1 m2 zz "
    "n1 g1 h1 y1 n0 g0 h0 y0 scale").split())])
"""As ``cell_t`` of the kernel."""

_FIRST_SPREAD, _OWN_SPREAD = 0.3, 0.06
"""Errors of ln threshold of a pixel before and after the mean of all pixels is known:
thresholds of sensors that were measured spread by .03 to .05."""
_COMMON = 0.03
"""Error of ln of the mean threshold where strongly polarized pixels told it."""
_STILL_PIXELS = 16
"""Least pixels that tell what all have in common."""
_LOOKS = 4, 64
"""Half turns after which thresholds are first estimated, and at most between two."""
_LATE = 0.5, 1.0
"""Part of the drift of q over the rows' mean age that is its error, centred and not."""


class Polarization(NamedTuple):
    """What a `TurningRegression` knows at one time.

    Parameters
    ----------
    quad : ndarray of float32, shape (4, H, W)
        I0, I45, I90, I135, relative unless frames tell S0.
    sigmas : ndarray of float32, shape (3, H, W)
        Errors of AoP (radians), DoLP, and of (S1, S2)/S0 across its direction.
    valid : ndarray of bool, shape (H, W)
    """

    quad: NDArray[np.float32]
    sigmas: NDArray[np.float32]
    valid: NDArray[np.bool_]


class TurningRegression(Reconstructor):
    """Regress each pixel's events on the angle of a turning analyser.

    Behind it the light is S0/2 (1 + q1 cos 2a + q2 sin 2a), with q = (S1, S2)/S0.  From
    one event of a pixel to the next its log changes by a threshold: an equation that is
    linear in q and needs no level.  They are solved by weighted least squares, older
    ones with less weight.  Pixels need no neighbours, and no layout.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    segments : array_like of shape (M, 3), or PulseClock
        Twice the angle of the analyser; see `TurningAnalyser.segments`.
    half_turns : float
        Window in half turns.  Rows fade with half of it as their time constant, which
        is as noisy and as old as a window with edges.
    centred : bool
        Use as much after the time of an image as before it.
    learn : bool
        Estimate each pixel's thresholds: their ratio, and from strongly polarized light
        their size, which the shape of the curve tells.
    threshold_sigma : float
        Relative error of the stated thresholds that all pixels have in common.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    method = "turning"
    needs = Needs(frames=True)
    causal_parameters = MappingProxyType({"centred": False})

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        segments: ArrayLike | PulseClock, half_turns: float = 1.0, centred: bool = True,
        learn: bool = True, threshold_sigma: float = 0.5,
    ) -> None:
        self.shape = sensor_shape(shape)
        on = checked_threshold("theta_on", theta_on, self.shape)
        off = checked_threshold("theta_off", theta_off, self.shape)
        self._half_turns = positive("half_turns", half_turns)
        self._sigma = positive("threshold_sigma", threshold_sigma)
        self._centred, self._learn = bool(centred), bool(learn)
        self._given = segments if isinstance(segments, PulseClock) else np.array(
            segments, np.float64).reshape(-1, 3)
        rate = float(np.median(np.abs(self.segments[:, 2])))
        if not rate > 0:
            raise ValueError("segments must hold rates that are not 0")
        self._half_us = 2 * math.pi / rate
        self._tau = self._half_us * self._half_turns / 2
        self.lookahead_us = round(self._tau) if self._centred else 0
        self._clock = StreamClock(self.shape)
        self._cells = _aligned(self.shape)
        self._cells["t"] = -np.inf
        self._cells["on"], self._cells["off"] = np.exp(on / 2), np.exp(off / 2)
        self._cells["scale"] = _OWN_SPREAD
        self._theta = on, off
        self._mean = math.exp(np.log(on).mean()), math.exp(np.log(off).mean())
        self._common, self._counts = self._sigma, [0, 0]
        self._start: int | None = None
        self._looks = 0
        self._dc = np.zeros(self.shape, np.float32)
        self._has_dc = False

    @property
    def segments(self) -> NDArray[np.float64]:
        """Twice the angle of the analyser, as far as it is known."""
        return self._given.segments() if isinstance(
            self._given, PulseClock) else self._given

    @property
    def half_us(self) -> float:
        """Median time of half a turn, us."""
        return self._half_us

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal TurningRegression."""
        return {"theta_on": self._theta[0], "theta_off": self._theta[1],
                "segments": self._given, "half_turns": self._half_turns,
                "centred": self._centred, "learn": self._learn,
                "threshold_sigma": self._sigma}

    @property
    def thresholds(self) -> NDArray[np.float32]:
        """Thresholds of each pixel, ON and OFF, as they are known; (2, H, W)."""
        halves = np.stack([self._cells["on"], self._cells["off"]])
        return np.asarray(2 * np.log(halves), np.float32)

    @property
    def common_sigma(self) -> float:
        """Relative error that all thresholds have in common."""
        return self._common

    # ---- feeding -------------------------------------------------------------

    def add_events(self, events: Events) -> None:
        """Add rows to the pixels' sums (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        if self._start is None and len(events):
            self._start = int(events["t"][0])
        while self._learn and len(events) and events["t"][-1] >= self._look_us:
            first = int(np.searchsorted(events["t"], self._look_us))
            self._take(events[:first])
            events = events[first:]
            self._look()
        self._take(events)

    def _take(self, events: Events) -> None:
        if not len(events):
            return
        taken = _kernels.turning_events(
            events, self._clock.last_us, self._cells, self.segments, self._tau,
            1 / self._half_turns)
        risen = int(np.count_nonzero(events["p"][:taken]))
        self._counts[0] += risen
        self._counts[1] += taken - risen
        self._clock.took(events, taken)

    @property
    def _look_us(self) -> float:
        """Time of the next estimate of the thresholds."""
        first, most = _LOOKS
        last: int = min(self._looks, int(math.log2(most / first)))
        half_turns = float(first * 2**last + most * (self._looks - last))
        return (self._start or 0) + half_turns * self._half_us

    def _look(self) -> None:
        """Estimate all thresholds from what the pixels have seen."""
        self._looks += 1
        told = np.zeros(self.shape, np.uint8)
        known = self._common <= _COMMON or self._sigma < _FIRST_SPREAD
        _kernels.turning_learn(
            self._cells, *self._mean, _OWN_SPREAD if known else _FIRST_SPREAD, told)
        on, off = np.log(self.thresholds)
        size, ratio = math.log(self._mean[0] * self._mean[1]) / 2, None
        if np.count_nonzero(told) >= _STILL_PIXELS:
            ratio = float(np.median((on - off)[told > 0]))
        elif min(self._counts) > 0:     # a pixel that ends where it began has as many
            ratio = math.log(self._counts[1] / self._counts[0])
        if np.count_nonzero(told == 2) >= _STILL_PIXELS:
            size = float(np.median((on + off)[told == 2])) / 2
            self._common = min(self._common, _COMMON)
        if ratio is not None:
            self._mean = math.exp(size + ratio / 2), math.exp(size - ratio / 2)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take the level of S0 from a frame."""
        mid = self._clock.check_frame(frame)
        log, valid = log_samples(frame)
        segment = self.segments[max(int(np.searchsorted(
            self.segments[:, 0], mid, "right")) - 1, 0)]
        angle = segment[1] + segment[2] * (mid - segment[0])
        seen = float(np.sinc(
            segment[2] * (frame.exposure_end_us - frame.exposure_start_us) / math.tau))
        now = self._read(mid)
        s0 = now.quad[0] + now.quad[2]
        q1 = (now.quad[0] - now.quad[2]) / s0
        q2 = (now.quad[1] - now.quad[3]) / s0
        light = 1 + seen * (q1 * math.cos(angle) + q2 * math.sin(angle))
        level = log + math.log(2) - np.log(np.maximum(light, 0.02))
        rest = np.log(s0) - self._dc
        np.copyto(self._dc, (level - rest).astype(np.float32), where=valid)
        self._has_dc = True

    # ---- reading -------------------------------------------------------------

    def polarization(self, t_us: int) -> Polarization:
        """Return the polarization at t_us; the state stays as it is.

        Parameters
        ----------
        t_us : int
            Not before the last time fed, less ``lookahead_us``.
        """
        t = checked_time("t_us", t_us) + (self.lookahead_us or 0)
        if t < self._clock.last_us:
            raise ValueError(
                "t_us must not lie before the last time seen less the look-ahead, "
                f"{self._clock.last_us - (self.lookahead_us or 0)}, got {t_us}")
        return self._read(t)

    def _read(self, t: int) -> Polarization:
        quad, sigmas = (np.empty((n, *self.shape), np.float32) for n in (4, 3))
        valid = np.empty(self.shape, np.bool_)
        _kernels.turning_read(
            self._cells, t, self._tau, self._half_us, self._common,
            _LATE[not self._centred], self._dc, quad, sigmas,
            valid.view(np.uint8))
        return Polarization(quad, sigmas, valid)

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return ln S0 at t_us (see `Reconstructor.read`)."""
        now = self.polarization(t_us)
        log = np.log(now.quad[0] + now.quad[2])
        if out is not None:
            out[:] = log
            log = out
        return Estimate(log, None, now.valid)

    def _state(self) -> State:
        return {"last_us": self._clock.last_us, "cells": self._cells.copy(),
                "mean": self._mean, "common": self._common,
                "counts": tuple(self._counts), "start": self._start,
                "looks": self._looks, "dc": self._dc.copy()}

    def _restore(self, state: State) -> None:
        self._clock.last_us = state["last_us"]
        self._cells[:] = state["cells"]
        self._mean, self._common = state["mean"], state["common"]
        self._counts, self._start = list(state["counts"]), state["start"]
        self._looks, self._dc = state["looks"], state["dc"].copy()


def _aligned(shape: tuple[int, int]) -> Records:
    """Return cells of zeros, each in two cache lines."""
    size = math.prod(shape) * _CELL.itemsize
    memory = np.zeros(size + 63, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first:first + size].view(_CELL).reshape(shape)
