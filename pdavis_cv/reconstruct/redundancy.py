"""AoP and DoLP from events alone: the four channels measure three numbers."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, positive, sensor_shape
from pdavis_cv.events import as_events
from pdavis_cv.reconstruct.base import Estimate, Needs, Reconstructor
from pdavis_cv.reconstruct.lamp import MEMORY_US, Lamplight, Wave
from pdavis_cv.reconstruct.stream_clock import (
    StreamClock,
    checked_bandwidth,
    checked_threshold,
)
from pdavis_cv.reconstruct.tracks import LOOKAHEAD_US, Tracks
from pdavis_cv.recording.base import ApsFrame

__all__ = ["EventRedundancy"]

STEP_US = 2_000
"""Interval at which the four channels are compared."""
SOLVE_EVERY = 10
"""Comparisons between two solutions."""
LEAST = 20
"""Comparisons before a first solution."""

WINDOW = 75.0
"""Comparisons that are remembered; a macropixel counts those with an event of its."""
MEMORY = 3000.0
"""Events of a pixel that its balance of ON and OFF remembers."""
RATIO_SIGMA = 0.06
"""Standard deviation of ln(theta_on / theta_off) over pixels, before its events."""
PULL = 1e-3
"""What a direction away from equal mean squares costs, as relative variance."""
VALID_QUALITY = 0.3


class EventRedundancy(Reconstructor):
    """Log intensity up to one offset per macropixel, from events alone.

    Whatever the light, I0 + I90 = I45 + I135.  With I_i = a_i exp(E_i), E_i the sum
    of a pixel's events, that holds at all times for one set of gains a only, if
    polarization changes: so AoP and DoLP follow without a frame.  Each pixel's
    thresholds are balanced so that its sum of events has no trend; between two events
    of a pixel the intensity is interpolated.  Frames are ignored.

    Parameters
    ----------
    shape : (int, int)
        (height, width); rows or columns beyond an even number are never valid.
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    response : array_like of shape (2, 2, 3) or (H, W, 3), optional
        Response of each pixel (of the cell) to S0, S1, S2; default: ideal polarizers,
        orthogonal ones on the diagonals.
    cutoff_hz : float
        Below it, common changes of a macropixel's four pixels fade.
    lookahead_us : int
        How long to wait for each pixel's next event; 0 = not at all.
    bandwidth : (float, float) or (float, float, float), optional
        As for `KalmanFilter`.

    Raises
    ------
    ValueError
        If a parameter is out of range; the message names it.

    Notes
    -----
    docs/theory/events.md.  Gains are the eigenvector of the smallest eigenvalue of the
    macropixel's moments, over the last moments in which it had events.  The quality
    of a pixel is the ratio of the two smallest eigenvalues: 0 where one set of gains
    explains all, 1 where nothing is known; it is valid below 0.3.  The variance is the
    smallest eigenvalue: what the best gains leave unexplained.
    """

    method = "events"
    needs = Needs(frames=False, lamp=True)
    causal_parameters = MappingProxyType({"lookahead_us": 0})

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        response: ArrayLike | None = None, cutoff_hz: float = 0.5,
        lookahead_us: int = LOOKAHEAD_US, bandwidth: Sequence[float] | None = None,
    ) -> None:
        self.shape = sensor_shape(shape)
        self._theta_on = checked_threshold("theta_on", theta_on, self.shape)
        self._theta_off = checked_threshold("theta_off", theta_off, self.shape)
        self._cutoff_hz = positive("cutoff_hz", cutoff_hz)
        if lookahead_us != int(lookahead_us) or lookahead_us < 0:
            raise ValueError(
                f"lookahead_us must be a whole number from 0, got {lookahead_us!r}")
        self.lookahead_us: int = int(lookahead_us)
        self._bandwidth = checked_bandwidth(bandwidth)
        self._response = None if response is None else np.array(response, np.float64)
        self._null = null_of(self._response, self.shape)
        self._lag = np.array([0.0, 0.0, *self._bandwidth])
        loss = -math.expm1(-2e-6 * math.pi * self._cutoff_hz * STEP_US)
        self._tuning = np.array([math.exp(-1 / WINDOW), RATIO_SIGMA, 1 / MEMORY, loss])
        self._prior = np.empty((*self.shape, 2))
        self._prior[..., 0], self._prior[..., 1] = self._theta_on, self._theta_off
        self._states = np.zeros((*self.shape, 9))
        self._states[..., 1:3] = self._prior
        self._states[..., 3] = -1
        self._reference = np.zeros(self.shape, np.int64)
        cells = (self.shape[0] // 2, self.shape[1] // 2)
        self._balance = np.zeros((*self.shape, 6))
        self._moments = np.zeros((*cells, 12))
        self._quality = np.ones((*cells, 2), np.float32)
        self._tracks = Tracks(self.shape, self.lookahead_us)
        self._clock = StreamClock(self.shape)
        self._lamp = Lamplight()
        self._next: int | None = None   # number of the next comparison
        self._unsolved = False
        self._shown = self._quality     # as of the last time read

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters that make an equal EventRedundancy."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "response": self._response, "cutoff_hz": self._cutoff_hz,
                "lookahead_us": self.lookahead_us, "bandwidth": self._bandwidth}

    @property
    def quality(self) -> NDArray[np.float32]:
        """Ratio of the two smallest eigenvalues, 1 = unknown; shape (H, W).

        As of the last time that was read.
        """
        return self._by_pixel(0)

    def _by_pixel(self, known: int) -> NDArray[np.float32]:
        out = np.ones(self.shape, np.float32)
        rows, columns, _ = self._shown.shape
        out[:2 * rows, :2 * columns] = (
            self._shown[..., known].repeat(2, 0).repeat(2, 1))
        return out

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events (see `Reconstructor.add_events`)."""
        events = as_events(events)
        taken = self._tracks.push(events, self._clock.last_us)
        if taken and self._next is None:
            self._next = int(events["t"][0]) // STEP_US + 1
        try:
            self._clock.took(events, taken)
        finally:
            self._compare(self._clock.last_us - self.lookahead_us - 1)

    def add_frame(self, frame: ApsFrame) -> None:
        """Check the frame and note its time."""
        self._clock.check_frame(frame)
        self._compare(self._clock.last_us - self.lookahead_us - 1)

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers (see `Reconstructor.add_wave`)."""
        self._lamp.add(wave)

    def _compare(self, until_us: int) -> None:
        """Make the comparisons, and solutions, up to until_us inclusive.

        Which they are is a matter of time alone: not of packets, nor of what other
        macropixels do.
        """
        tracks = self._tracks
        while self._next is not None and self._next * STEP_US <= until_us:
            k, before = self._next, tracks.committed
            tracks.commit(k * STEP_US)
            self._next = k + 1
            if tracks.committed != before:
                log, _ = self._log(k * STEP_US)
                _kernels.redundancy_sample(
                    log, self._null, self._prior, self._tuning, tracks.tracks,
                    self._states, self._balance, self._moments)
                self._unsolved = True
            else:
                # Nothing happens until the next event, or the next solution.
                waiting = tracks.waiting_us
                self._next = max(k + 1, until_us // STEP_US + 1 if waiting is None
                                 else -(-waiting // STEP_US))
                if self._unsolved:
                    self._next = min(self._next, -(-(k + 1) // SOLVE_EVERY)
                                     * SOLVE_EVERY)
            if k % SOLVE_EVERY == 0 and self._unsolved:
                _kernels.redundancy_solve(
                    PULL, LEAST, self._moments, self._states, self._quality)
                self._unsolved = False
        self._lamp.forget(until_us - MEMORY_US)

    def _log(
        self, t: int, out: NDArray[np.float32] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        tracks = self._tracks
        log = np.empty(self.shape, np.float32) if out is None else out
        variance = np.empty(self.shape, np.float32)
        tracks.chain_pending()
        _kernels.kalman_read(
            t, t + self.lookahead_us, tracks.store, tracks.link, tracks.first,
            self._lag, self._lamp.waves, self._lamp.start_us, tracks.tracks,
            self._reference, self._states, 0.0, log, variance,
            np.empty(self.shape, np.uint8))
        return log, variance

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity at t_us (see `Reconstructor.read`)."""
        t = int(t_us)
        self._clock.check_read(t + self.lookahead_us)
        log = output(out, self.shape, np.float32)
        due = self._next is not None and self._next * STEP_US <= t and (
            self._unsolved or self._tracks.waiting_us is not None)
        before = self._kept(whole=False) if due else None
        self._compare(t)
        self._log(t, log)
        self._shown = self._quality.copy()
        if before is not None:
            self._restore(before)
        return Estimate(log, self._by_pixel(1), self._by_pixel(0) < VALID_QUALITY)

    def _state(self) -> Mapping[str, Any]:
        return self._kept(whole=True)

    def _kept(self, whole: bool) -> Mapping[str, Any]:
        """Return the state; only what comparisons change unless whole."""
        return {"last_us": self._clock.last_us,
                "tracks": self._tracks.state() if whole else self._tracks.mark(),
                "state": self._states.copy(), "balance": self._balance.copy(),
                "moments": self._moments.copy(), "quality": self._quality.copy(),
                "next": self._next, "unsolved": self._unsolved,
                "lamp": self._lamp.state()}

    def _restore(self, state: Mapping[str, Any]) -> None:
        self._clock.last_us = state["last_us"]
        self._tracks.restore(state["tracks"])
        self._states[:] = state["state"]
        self._balance[:] = state["balance"]
        self._moments[:] = state["moments"]
        self._quality[:] = state["quality"]
        self._next, self._unsolved = state["next"], state["unsolved"]
        self._lamp.restore(state["lamp"])


def null_of(
    response: NDArray[np.float64] | None, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return by pixel what a macropixel's intensities sum to 0 with, for all light.

    Parameters
    ----------
    response : ndarray of float64, shape (2, 2, 3) or (H, W, 3), or None
        See `EventRedundancy`.
    shape : (int, int)
        (height, width).

    Returns
    -------
    ndarray of float32, shape (H, W)
        The largest of a macropixel is 1; 0 where there is no whole macropixel.

    Raises
    ------
    ValueError
        If the response has another shape, or does not tell the channels apart.
    """
    rows, columns = shape[0] // 2, shape[1] // 2
    null = np.zeros(shape, np.float32)
    if response is None:
        null[:2 * rows, :2 * columns] = np.tile([[1, -1], [-1, 1]], (rows, columns))
        return null
    if response.shape not in ((2, 2, 3), (*shape, 3)):
        raise ValueError(
            f"response must have shape (2, 2, 3) or {(*shape, 3)}, got "
            f"{response.shape}")
    cells = response[:response.shape[0] // 2 * 2, :response.shape[1] // 2 * 2]
    part = [cells[i // 2::2, i % 2::2] for i in range(4)]
    with np.errstate(invalid="ignore", divide="ignore"):
        minors = [
            sign * np.linalg.det(np.stack([part[j] for j in range(4) if j != i], -1))
            for i, sign in enumerate((1, -1, 1, -1))]
        largest = np.max(np.abs(minors), axis=0)
        if not np.all(largest > 1e-6):
            raise ValueError("response must tell the four channels apart, but it does "
                             "not in some macropixel")
        for i, minor in enumerate(minors):
            null[i // 2:2 * rows:2, i % 2:2 * columns:2] = minor / largest
    return null
