"""AoP and DoLP from events alone, as four channels measure three Stokes parameters."""
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
    floats,
    output,
    positive,
    sensor_shape,
    whole_number,
)
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv.events import FAR, checked_time, timed_events
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.pixel.silences import table_of
from pdavis_cv.reconstruct.base import Estimate, Needs, Reconstructor
from pdavis_cv.reconstruct.lamp import MEMORY_US, Lamplight, Wave
from pdavis_cv.reconstruct.store import EventStore, as_bytes
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame

LOOKAHEAD_US = 50_000
"""Default look-ahead, us: how long to wait for each pixel's next event."""

REST_S = 1.0
"""Gap in which light is as likely still as moving, s, if no `model` tells it.  Without
frames, weak polarization that turns slowly needs at least this (measured on seeds 1001
and 1002 at 30 RPM and DoLP .3; longer ones change nothing) (lab.studies.constants)."""

STEP_US = 2_000
"""Interval at which the four channels are compared, us (lab.studies.constants)."""
SOLVE_EVERY = 10
"""Comparisons from one solution for gains to the next (lab.studies.constants)."""
LEAST = 20
"""Number of comparisons needed for the first solution (lab.studies.constants)."""

WINDOW = 75.0
"""Memory of the moments, in comparisons (decay by 1/e); each macropixel counts those in
which it had an event (lab.studies.constants)."""
MEMORY = 3000.0
"""Memory of a pixel's balance, events (decay by 1/e; lab.studies.constants)."""
RATIO_SIGMA = 0.1
"""Prior standard deviation of ln(theta_on / theta_off) from pixel to pixel, before the
events of the chip tell it: the geometric mean of 0.05 (3.5 % of each threshold, Brandli
et al. 2014) and 0.21 (15 %, the default of v2e, Hu et al. 2021)."""
LINE_ERROR = 2.2
"""Standard error of ln(theta_on / theta_off) that a line through the events of N
periods of the light gives, in units of 1 / (2 N)^2 (lab/studies/redundancy_far.py)."""
FAR_ERRORS = 2.6
"""A pixel whose ratio is farther from the prior than so many standard errors of its
line is an outlier: 98 % of lines err by less (lab/studies/redundancy_far.py)."""
PART_LEAST = 0.05
"""Bound of the fraction of ON, and of OFF, events; numerical."""
PULL = 1e-3
"""Ridge pulling gains to equal mean square, variance (lab.studies.constants)."""
VALID_QUALITY = 0.3
"""Ratio of the two smallest eigenvalues below which a pixel is valid.  It is far from
1, the ratio where the data do not determine the gains; chosen on `nominal`."""
SINGULAR = 1e-6
"""Largest minor of a macropixel's response below which it is singular; numerical."""

POLICY_DTYPE = np.dtype([
    (name, "<f8") for name in (
        "keep", "ratio_sigma", "forget", "loss", "pull", "least", "line_error",
        "far_errors", "part_least")])
"""Constants of the method: ``policy_t`` in the kernel."""

STATE_DTYPE = np.dtype([
    (name, "<f8") for name in (
        "base", "theta_off", "theta_on", "prior_off", "prior_on", "count_off",
        "count_on")])
"""State of a pixel: log intensity at the last comparison, up to an offset; its
thresholds, and those stated (natural-log units); its signed counts at that time."""

BALANCE_DTYPE = np.dtype([
    (name, "<f8") for name in (
        "weight", "mean_all", "mean_on", "var_all", "cov_on", "var_on", "null")])
"""Running regression of a pixel's ON events on all its events, and the pixel's
coefficient in the null vector of its macropixel (`null_of`)."""

MOMENTS_DTYPE = np.dtype([
    ("product", "<f8", (10,)), ("weight", "<f8"), ("since", "<f8"),
    ("ratio", "<f4"), ("smallest", "<f4")])
"""Second moments of a macropixel's weighted intensities, then the ratio of the two
smallest eigenvalues and the smallest one."""

_SOLVE_NS = 80
"""Time that a macropixel takes per solution, ns, if 2 of 5 had events (measured)."""

_READ_NS = 14.0
"""Time that a pixel takes in an image, ns (measured)."""


class EventRedundancy(Reconstructor):
    """Log intensity from events alone, up to one offset per macropixel.

    For any light I0 + I90 = I45 + I135.  With I_i = a_i exp(E_i), where E_i is the sum
    of a pixel's events, this determines the gains a up to one factor if polarization
    changes, so AoP and DoLP follow without a frame.  Each pixel's thresholds are
    balanced so that its sum of events has no trend; between two events of a pixel the
    intensity is interpolated.  Frames are ignored.

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
        Corner of a high-pass filter on the common changes of a macropixel's pixels.
    lookahead_us : int
        How long to wait for each pixel's next event, us; 0 = not at all.
    bandwidth : (float, float), optional
        (hz, hz_per_intensity) of the photoreceptors: corner frequency, Hz, and its
        increase per DN/ms; default: no lag is taken out.
    ratio_sigma : float
        Prior standard deviation of ln(theta_on / theta_off) from pixel to pixel; `fuse`
        learns it from the events if it is not given.
    model : PixelModel, optional
        Tells how light goes on after an event, and the dead time; default: as in other
        cameras.

    Raises
    ------
    ValueError
        If a parameter is out of range; the message names it.

    Notes
    -----
    docs/theory/events.md derives the method.  The gains are the eigenvector of the
    smallest eigenvalue of the macropixel's moments, over its last comparisons with
    events.  The quality of a pixel is the ratio of the two smallest eigenvalues: 0
    where one set of gains explains all data, 1 where the data determine none; a pixel
    is valid below 0.3.  The variance is the smallest eigenvalue, the residual variance
    of the best gains.
    """

    method = "events"
    reads_valid = False     # whether pixels that are not valid are left out when read
    needs = Needs(frames=False, lamp=True, learned=frozenset({"ratio_sigma"}))
    causal_parameters = MappingProxyType({"lookahead_us": 0})

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        response: ArrayLike | None = None, cutoff_hz: float = 0.5,
        lookahead_us: int = LOOKAHEAD_US, bandwidth: Sequence[float] | None = None,
        ratio_sigma: float = RATIO_SIGMA, model: PixelModel | None = None,
    ) -> None:
        self.shape = sensor_shape(shape)
        self._theta_on = checked_threshold("theta_on", theta_on, self.shape)
        self._theta_off = checked_threshold("theta_off", theta_off, self.shape)
        self._cutoff_hz = positive("cutoff_hz", cutoff_hz)
        self.lookahead_us: int = whole_number("lookahead_us", lookahead_us, 0, FAR)
        self._bandwidth = _checked_bandwidth(bandwidth)
        self._response = None if response is None else floats("response", response)
        self._model = model
        self._tune()
        loss = -math.expm1(-1e-6 * math.tau * self._cutoff_hz * STEP_US)
        self._policy = np.array([(
            math.exp(-1 / WINDOW), positive("ratio_sigma", ratio_sigma), 1 / MEMORY,
            loss, PULL, LEAST, LINE_ERROR, FAR_ERRORS, PART_LEAST)], POLICY_DTYPE)
        self._states = np.zeros(self.shape, STATE_DTYPE)
        for part, theta in (("on", self._theta_on), ("off", self._theta_off)):
            self._states[f"theta_{part}"] = self._states[f"prior_{part}"] = theta
        cells = (self.shape[0] // 2, self.shape[1] // 2)
        self._balance = np.zeros(self.shape, BALANCE_DTYPE)
        self._balance["null"] = null_of(self._response, self.shape)
        self._moments = np.zeros(cells, MOMENTS_DTYPE)
        self._moments["ratio"] = self._moments["smallest"] = 1
        self._store = EventStore(self.shape)
        self._clock = StreamClock(self.shape)
        self._lamp = Lamplight()
        self._next: int | None = None   # number of the next comparison
        self._unsolved = False
        self._fed = 0                   # calls that changed the state so far
        self._ahead: tuple[EventRedundancy, int] | None = None
        self._answered: EventRedundancy | None = None   # the last read, if a copy did
        self._solved: NDArray[np.float32] | None = None

    def _tune(self) -> None:
        model = self._model
        if model is None:
            end, bow = table_of(self.lookahead_us)
            model = PixelModel(theta=np.ones(2), end=end, bow=bow, rest_s=REST_S)
        # Counts are those of unit thresholds: pixels have their own.
        self._numbers = model.replace(
            theta=np.ones(2), by_class=np.zeros_like(model.by_class), black=0.0,
            bandwidth=self._bandwidth).numbers

    def retune(self, **learned: Any) -> None:
        """Continue with other thresholds, bandwidth or spread (see `Reconstructor`).

        Past sums of events stay as they are; the gains follow within their memory.
        """
        unknown = learned.keys() - {
            "theta_on", "theta_off", "bandwidth", "ratio_sigma", "model"}
        if unknown:
            raise TypeError(
                "retune takes theta_on, theta_off, bandwidth, ratio_sigma and model, "
                f"got {', '.join(sorted(unknown))}")
        self._model = learned.get("model", self._model)
        if "ratio_sigma" in learned:
            self._policy["ratio_sigma"] = positive(
                "ratio_sigma", learned["ratio_sigma"])
        if "bandwidth" in learned:
            self._bandwidth = _checked_bandwidth(learned["bandwidth"])
        if not {"theta_on", "theta_off"}.isdisjoint(learned):
            self._take_thresholds(learned.get("theta_on", self._theta_on),
                                  learned.get("theta_off", self._theta_off))
        self._tune()
        self._fed += 1      # what is cached from the state is no longer right

    def _take_thresholds(self, on: ArrayLike, off: ArrayLike) -> None:
        self._theta_on = checked_threshold("theta_on", on, self.shape)
        self._theta_off = checked_threshold("theta_off", off, self.shape)
        for part, theta in (("on", self._theta_on), ("off", self._theta_off)):
            # What the balance has told of the ratio stays.
            self._states[f"theta_{part}"] *= theta / self._states[f"prior_{part}"]
            self._states[f"prior_{part}"] = theta

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal EventRedundancy."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "response": self._response, "cutoff_hz": self._cutoff_hz,
                "lookahead_us": self.lookahead_us, "bandwidth": self._bandwidth,
                "ratio_sigma": float(self._policy["ratio_sigma"][0]),
                "model": self._model}

    @property
    def quality(self) -> NDArray[np.float32]:
        """Ratio of the two smallest eigenvalues at the last read; shape (H, W).

        It is 1 where the data do not determine the gains.
        """
        ratio: NDArray[np.float32] = (self._answered or self)._solution[0]
        return ratio.copy()

    @property
    def _solution(self) -> NDArray[np.float32]:
        """Each pixel's ratio of the two smallest eigenvalues, and the smallest."""
        if self._solved is None:
            self._solved = np.ones((2, *self.shape), np.float32)
            rows, columns = (side // 2 * 2 for side in self.shape)
            for one, name in zip(self._solved, ("ratio", "smallest"), strict=True):
                for i, j in np.ndindex(2, 2):
                    one[i:rows:2, j:columns:2] = self._moments[name]
        return self._solved

    def add_events(self, events: Events) -> None:
        """Take events (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        self._fed += 1
        taken = self._store.push(events, self._clock.last_us, self._numbers)
        if taken and self._next is None:
            self._next = int(events["t"][0]) // STEP_US + 1
        try:
            self._clock.took(events, taken)
        finally:
            self._compare(self._clock.last_us - self.lookahead_us - 1)

    def add_frame(self, frame: ApsFrame) -> None:
        """Check the frame and advance to its time; its image is not used."""
        self._fed += 1
        self._clock.check_frame(frame)
        self._compare(self._clock.last_us - self.lookahead_us - 1)

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers (see `Reconstructor.add_wave`)."""
        self._fed += 1
        self._lamp.add(wave)

    def settle(self, t_us: int) -> None:
        """Make the comparisons that are due (see `Reconstructor.settle`)."""
        self._clock.last_us = max(self._clock.last_us, t_us)
        if self._due(t_us - self.lookahead_us):
            self._fed += 1
            self._compare(t_us - self.lookahead_us)

    def _due(self, t: int) -> bool:
        return self._next is not None and self._next * STEP_US <= t and (
            self._unsolved or self._store.waiting_us is not None)

    def _compare(self, until_us: int) -> None:
        """Make the comparisons and solutions up to until_us, inclusive.

        They fall on fixed times, so results depend neither on how the stream is cut
        into packets nor on the activity of other macropixels.
        """
        store = self._store
        while self._next is not None and self._next * STEP_US <= until_us:
            k, before = self._next, store.committed
            t = k * STEP_US
            store.commit(t)
            self._next = k + 1
            if store.committed != before:
                _kernels.redundancy_sample(
                    t, t + self.lookahead_us,
                    (store.events, store.pixels, before, store.committed),
                    (self._numbers, self._lamp.waves), self._policy,
                    (self._states, self._balance, self._moments))
                self._unsolved = True
            else:
                # Skip to the next event or the next solution, whichever is first.
                waiting = store.waiting_us
                self._next = max(k + 1, until_us // STEP_US + 1 if waiting is None
                                 else -(-waiting // STEP_US))
                if self._unsolved:
                    self._next = min(self._next, -(-(k + 1) // SOLVE_EVERY)
                                     * SOLVE_EVERY)
            if k % SOLVE_EVERY == 0 and self._unsolved:
                self.workers.rows(  # of macropixels, which have two rows of pixels
                    len(self._moments), lambda first, last: _kernels.redundancy_solve(
                        self._policy, self._moments[first:last],
                        self._states[2 * first:2 * last]),
                    row_ns=_SOLVE_NS * self._moments.shape[1])
                self._unsolved = False
                self._solved = None
        self._lamp.forget(until_us - MEMORY_US)

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity at t_us (see `Reconstructor.read`)."""
        t = checked_time("t_us", t_us)
        self._clock.check_read(t + self.lookahead_us)
        log = output(out, self.shape, np.float32)
        self._answered = self._compared(t) if self._due(t) else None
        return (self._answered or self)._estimate(t, log)

    def _compared(self, t: int) -> EventRedundancy:
        """Return a copy that has made the comparisons up to t, inclusive.

        This is needed where less than the look-ahead has been fed after t, as at the
        end of a recording.  A read must not change the state, so a copy does the work.
        """
        one, fed = self._ahead or (EventRedundancy(self.shape, **self.parameters), -1)
        if fed != self._fed or (one._next or 0) > t // STEP_US + 1:
            one.workers = self.workers
            one.assign(self)
        one._compare(t)
        self._ahead = one, self._fed
        return one

    def _estimate(self, t: int, log: NDArray[np.float32]) -> Estimate:
        recent = self._store.events, self._store.pixels
        model = self._numbers, self._lamp.waves
        ratio, smallest = self._solution
        valid = ratio < VALID_QUALITY
        wanted = valid if self.reads_valid else np.ones_like(valid)
        self.workers.rows(len(log), lambda first, last: _kernels.redundancy_read(
            t, t + self.lookahead_us, recent, model, self._states, (first, last),
            wanted.view(np.uint8), log), row_ns=_READ_NS * log.shape[1])
        return Estimate(log, smallest.copy(), valid)

    def assign(self, other: Reconstructor) -> None:
        """Copy the state of an equal object (see `Reconstructor.assign`)."""
        if not isinstance(other, EventRedundancy) or other.shape != self.shape:
            raise ValueError(f"other must be an equal EventRedundancy, got {other!r}")
        self._bandwidth, self._model = other._bandwidth, other._model
        self._theta_on, self._theta_off = other._theta_on, other._theta_off
        self._policy["ratio_sigma"] = other._policy["ratio_sigma"]
        self._tune()
        self._restore(other._state())

    def _state(self) -> State:
        arrays = (as_bytes(one).copy()
                  for one in (self._states, self._balance, self._moments))
        return {"store": self._store.state(), "rest": (
            self._clock.last_us, *arrays, self._next, self._unsolved,
            self._lamp.state())}

    def _restore(self, state: State) -> None:
        self._store.restore(state["store"])
        (self._clock.last_us, *arrays, self._next, self._unsolved, lamp) = state["rest"]
        for one, other in zip(
                (self._states, self._balance, self._moments), arrays, strict=True):
            as_bytes(one)[:] = other
        self._solved = None
        self._lamp.restore(lamp)
        self._fed += 1


def _checked_bandwidth(value: Sequence[float] | None) -> tuple[float, float]:
    """Return (hz, hz_per_intensity), checked; zeros for None."""
    if value is None:
        return 0.0, 0.0
    if isinstance(value, str) or len(value) != 2:
        raise ValueError(f"bandwidth must be (hz, hz_per_intensity), got {value!r}")
    hz, slope = (float(part) for part in value)
    if not all(np.isfinite(x) and x >= 0 for x in (hz, slope)):
        raise ValueError(
            f"bandwidth must hold finite numbers that are not negative, got {value!r}")
    return hz, slope


def null_of(
    response: NDArray[np.float64] | None, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return weights with which a macropixel's intensities sum to 0 for any light.

    The response is that of `EventRedundancy`; one that does not tell the channels apart
    is a ValueError.  The weights are float32 (H, W): the largest of each macropixel is
    1; 0 outside whole macropixels.
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
        if not np.all(largest > SINGULAR):
            raise ValueError("response must tell the four channels apart, but it does "
                             "not in some macropixel")
        for i, minor in enumerate(minors):
            null[i // 2:2 * rows:2, i % 2:2 * columns:2] = minor / largest
    return null
