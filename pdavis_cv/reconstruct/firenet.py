"""The ``firenet`` and ``joint`` methods: recurrent networks on events alone."""
from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import checked_threshold, output, sensor_shape
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv.errors import WindowWarning
from pdavis_cv.events import timed_events
from pdavis_cv.reconstruct.base import WHOLE_SENSOR, Estimate, Needs, Reconstructor
from pdavis_cv.reconstruct.onnx import model_shapes
from pdavis_cv.reconstruct.runner import Runner, chosen_backend, make_runner
from pdavis_cv.reconstruct.stream_clock import StreamClock, steps
from pdavis_cv.reconstruct.weights import BINS, MEMORY, Weights
from pdavis_cv.recording.base import ApsFrame

SCALINGS = ("minimum", "normalise", "table")
"""The paper's calibrations of a network's output, in `FireNet`'s ``scaling``."""

IDLE = 64
"""Number of windows without an event after which a network is not run until one."""

# Row and column in the cell, by plane, in the order of `voxel_planes`.
PLACES = ((1, 0), (1, 1), (0, 1), (0, 0))

_SHORTEST_US, _LONGEST_US = 1_000, 1_000_000
_SMALLEST = 1e-3  # lower bound of the intensity, so that its logarithm is finite

# Of the test for windows that are too long.
_WINDOWS = 32           # windows per test
_LEAST_EVENTS = 8       # of a pixel that takes part in the test
_PER_WINDOW = 0.25      # reversals at a period of eight windows
_MOST_EVENTS = 200_000  # kept per test; with more, the test is left out

Array = NDArray[np.float32]


@dataclass(frozen=True)
class _State:
    """State of a network after a window; its arrays are never written to."""

    h1: Array      # hidden states
    h2: Array
    memory: Array  # (4, 2, h, w), leaky integrals of the events
    light: Array   # (4, h, w), intensity by place in the cell
    low: Array     # (4, h, w), smallest and largest intensity so far
    high: Array
    quiet: int     # number of windows since the last one with an event


class _Recurrent(Reconstructor):
    """Base of both methods: windows, states, reading."""

    margin = WHOLE_SENSOR  # convolutions spread the states from pixel to pixel
    _network: str

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        window_us: int = 10_000, weights: str | Path | Weights | None = None,
        backend: str = "auto", scaling: str | None = None,
        table: ArrayLike | None = None,
    ) -> None:
        self.shape = sensor_shape(shape)
        self._theta_on = checked_threshold("theta_on", theta_on, self.shape)
        self._theta_off = checked_threshold("theta_off", theta_off, self.shape)
        if window_us != int(window_us) or not (
                _SHORTEST_US <= window_us <= _LONGEST_US):
            raise ValueError(
                f"window_us must be a whole number in {_SHORTEST_US}..{_LONGEST_US}, "
                f"got {window_us!r}")
        self._window_us = int(window_us)
        self._weights = _weights(weights, self._network)
        self._backend = chosen_backend(backend)
        if scaling not in (None, *SCALINGS):
            raise ValueError(
                f"scaling must be None or one of {', '.join(SCALINGS)}, got "
                f"{scaling!r}")
        self._scaling, self._table = scaling, _checked_table(table, scaling)
        height, width = self.shape
        self._planes = (height + 1) // 2, (width + 1) // 2
        unit = self._weights.unit
        step = steps(self._theta_on, self._theta_off, self.shape)
        self._steps = np.sign(step) if unit is None else step / np.float32(unit)
        self._unit = unit or 1.0
        self._runner: Runner | None = None
        self._input: Array | None = None
        self._clock = StreamClock(self.shape)
        self._turns = Turns()
        self._begin()

    def _begin(self) -> None:
        shapes = model_shapes(self._weights, *self._planes)
        state = np.zeros(shapes["h1"], np.float32)
        light = np.zeros((4, *self._planes), np.float32)
        self._window: int | None = None   # index of the window being filled
        self._state_now = _State(
            state, state, np.zeros((4, 2, *self._planes), np.float32), light,
            np.full_like(light, np.inf), np.full_like(light, -np.inf), 0)
        self._done = False                # whether any window has been run
        self._grid = np.zeros((4, BINS, *self._planes), np.float32)
        self._seen = np.zeros(self._planes, np.uint8)
        self._filled = False              # whether the window has events
        # Cache of `_reached`: its argument and its result.
        self._ahead: tuple[int, _State] | None = None

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal Reconstructor; weights by their hash."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "window_us": self._window_us, "weights": self._weights.digest,
                "backend": self._backend, "scaling": self._scaling,
                "table": self._table}

    # ---- feeding -------------------------------------------------------------

    def add_events(self, events: Events) -> None:
        """Bin events; run the network for each window that they end."""
        events = timed_events(events)
        clock, first = self._clock, 0
        height, width = self.shape
        while first < len(events):
            if self._window is None:
                self._window = int(events["t"][first]) // self._window_us
            start = self._window * self._window_us
            taken = _kernels.voxel_planes(
                events[first:], clock.last_us, start, start + self._window_us,
                self._steps, height, width, self._grid, self._seen)
            if taken:
                self._filled, self._ahead = True, None
                clock.last_us = int(events["t"][first + taken - 1])
                self._turns.add(events[first:first + taken])
                first += taken
            if first < len(events):
                t = int(events["t"][first])
                if t < start + self._window_us:
                    clock.took(events, first)
                self._advance(t // self._window_us)

    def add_frame(self, frame: ApsFrame) -> None:
        """Check the frame and record its time."""
        self._clock.check_frame(frame)

    def _advance(self, window: int) -> None:
        """Run the network on all windows before this one, and begin to fill it."""
        assert self._window is not None
        self._state_now = self._reached(window)
        if self._turns.exceed(window - self._window):
            warnings.warn(
                f"method {self.method!r}: windows of {self._window_us} us are longer "
                "than an eighth of the signal's period: choose a smaller window_us",
                WindowWarning, stacklevel=4)
        self._window, self._done = window, True
        self._grid = np.zeros_like(self._grid)
        self._filled, self._ahead = False, None

    def _reached(self, window: int) -> _State:
        """Return the state after all windows before this one, by the events so far."""
        assert self._window is not None
        at, state = self._window, self._state_now
        grid, filled = self._grid, self._filled
        if self._ahead is not None and self._ahead[0] <= window:
            at, state = self._ahead
            filled = False
            if at < window:
                grid = np.zeros_like(grid)
        while at < window:
            if filled or state.quiet < IDLE:
                state = self._stepped(state, grid, filled)
                at += 1
            else:
                at = window
            if filled:
                grid, filled = np.zeros_like(grid), False
        self._ahead = window, state
        return state

    def _stepped(self, state: _State, grid: Array, filled: bool) -> _State:
        decay = np.exp(-1 / np.array(MEMORY)).astype(np.float32)[:, None, None]
        memory = state.memory * decay
        memory += np.float32(self._unit) * grid.sum(1)[:, None]
        if self._runner is None:
            self._runner = make_runner(self._weights, *self._planes, self._backend)
        light, h1, h2 = self._runner(self._inputs(grid, memory), state.h1, state.h2)
        light = self._light(light.reshape(-1, *self._planes))
        return _State(h1, h2, memory, light, np.minimum(state.low, light),
                      np.maximum(state.high, light), 0 if filled else state.quiet + 1)

    @abstractmethod
    def _inputs(self, grid: Array, memory: Array) -> Array:
        """Return the network's input."""

    @abstractmethod
    def _light(self, planes: Array) -> Array:
        """Return intensity by place, (4, h, w), from the network's output."""

    # ---- reading -------------------------------------------------------------

    def read(self, t_us: int, out: Array | None = None) -> Estimate:
        """Return log intensity, up to a common constant, at the end of the last window.

        A pixel is valid once its macropixel has had an event and a window has ended.
        """
        t = self._clock.check_read(t_us)
        log = output(out, self.shape, np.float32)
        window = t // self._window_us
        if self._window is None or (not self._done and window <= self._window):
            log.fill(0)
            return Estimate(log, None, np.zeros(self.shape, np.bool_))
        state = self._reached(window) if window > self._window else self._state_now
        light = np.log(np.maximum(self._scaled(state), _SMALLEST))
        height, width = self.shape
        for (row, column), plane in zip(PLACES, light, strict=True):
            part = log[row::2, column::2]
            part[:] = plane[:part.shape[0], :part.shape[1]]
        seen = self._seen.view(np.bool_).repeat(2, 0).repeat(2, 1)
        return Estimate(log, None, seen[:height, :width].copy())

    def _scaled(self, state: _State) -> Array:
        if self._scaling is None:
            return state.light
        if self._scaling == "table":
            assert self._table is not None
            return np.stack([np.interp(plane, *curve) for plane, curve in zip(
                state.light, self._table, strict=True)]).astype(np.float32)
        above = state.light - state.low
        if self._scaling == "minimum":
            return above
        return np.asarray(above / np.maximum(state.high - state.low, _SMALLEST))

    # ---- the state -----------------------------------------------------------

    def _state(self) -> State:
        now = {f.name: np.copy(getattr(self._state_now, f.name))
               for f in fields(_State) if f.name != "quiet"}
        return {"last_us": self._clock.last_us, "window": self._window,
                "done": self._done, "filled": self._filled,
                "quiet": self._state_now.quiet, "grid": self._grid.copy(),
                "seen": self._seen.copy(), "turns": self._turns.state(), **now}

    def _restore(self, state: State) -> None:
        self._clock.last_us = state["last_us"]
        self._window, self._done = state["window"], state["done"]
        self._filled, self._ahead = state["filled"], None
        self._grid, self._seen = state["grid"].copy(), state["seen"].copy()
        self._turns.restore(state["turns"])
        self._state_now = _State(quiet=state["quiet"], **{
            f.name: state[f.name].copy() for f in fields(_State) if f.name != "quiet"})

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_runner": None, "_input": None}


class FireNet(_Recurrent):
    """The paper's network: each channel separately, with the same weights.

    Events of a channel are summed into 5 bins per window, windows being aligned to
    multiples of ``window_us``; a recurrent network of 37,777 weights maps them to
    intensity.  It adds an offset to each channel, so DoLP is too low unless ``scaling``
    calibrates it.  Frames are ignored.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    window_us : int
        1,000 to 1,000,000; at most an eighth of the signal's period, or a
        `WindowWarning` says so.
    weights : path or Weights, optional
        Default: those that come with the package.
    backend : {"auto", "onnxruntime", "cv2"}
        Library that runs the network.
    scaling : {None, "minimum", "normalise", "table"}
        The paper's calibrations of intensity, per pixel: subtract the smallest value
        so far; also divide by the range so far; interpolate in ``table``.
    table : array_like of shape (4, 2, K), optional
        Per place in the cell, anticlockwise from the bottom left: output of the
        network, increasing, and the corresponding light.

    Raises
    ------
    ValueError
        If a parameter is out of its range; the message names it.
    WeightsError
        If the weights are not those of this network.
    ImportError
        If there is neither onnxruntime nor OpenCV.

    Notes
    -----
    An event at t in a window [a, b) is divided linearly between the two bins nearest to
    4 (t - a)/(b - a).  After 64 windows without any event the state is kept until the
    next one.  Scheerlinck et al., WACV 2020; Haessig et al.
    """

    method, cheaper, trials = "firenet", "events", {}   # 40 times as slow as kalman
    needs = Needs(frames=False)
    _network = "firenet"

    def _inputs(self, grid: Array, memory: Array) -> Array:
        return grid

    def _light(self, planes: Array) -> Array:
        return planes


class Joint(_Recurrent):
    """One network for all four channels, at about a quarter of the cost of `FireNet`.

    Inputs are 5 bins and two leaky integrals (8 and 64 windows) of each channel;
    outputs are S0 in front of each pixel of a cell and the cell's S1/S0 and S2/S0.
    Parameters, errors and windows are those of `FireNet`; no `scaling` is needed.
    """

    method, cheaper, trials = "joint", "kalman", {}     # 10 times as slow
    needs = Needs(frames=False, crossed_diagonal=True)
    _network = "joint"

    def _inputs(self, grid: Array, memory: Array) -> Array:
        height, width = self._planes
        if self._input is None:  # allocated once: new memory costs more than the copy
            self._input = np.empty((1, 4 * BINS + 8, height, width), np.float32)
        self._input[0, :4 * BINS] = grid.reshape(-1, height, width)
        self._input[0, 4 * BINS:] = memory.reshape(-1, height, width)
        return self._input

    def _light(self, planes: Array) -> Array:
        polar = planes[4:]
        light = np.empty((4, *polar.shape[1:]), np.float32)
        np.divide(polar, np.maximum(np.hypot(*polar), 1), out=light[:2])
        np.negative(light[:2], out=light[2:])
        light += 1
        light *= np.exp(planes[:4]) / 2
        return light


def _weights(given: str | Path | Weights | None, network: str) -> Weights:
    if given is None:
        return Weights.shipped(network)
    found = given if isinstance(given, Weights) else Weights.load(given)
    if found.network != network:
        raise ValueError(
            f"weights must be of network {network!r}, got those of {found.network!r}")
    return found


def _checked_table(table: ArrayLike | None, scaling: str | None) -> Array | None:
    if (table is None) != (scaling != "table"):
        raise ValueError("table must be given with scaling='table', and only then")
    if table is None:
        return None
    curves = np.asarray(table, np.float32)
    if curves.ndim != 3 or curves.shape[:2] != (4, 2) or curves.shape[2] < 2:
        raise ValueError(f"table must have shape (4, 2, K), got {curves.shape}")
    if not (np.isfinite(curves).all() and (np.diff(curves[:, 0]) > 0).all()):
        raise ValueError("table must be finite, and increase in its first row")
    return curves


class Turns:
    """Test whether windows exceed an eighth of the period of the light on pixels.

    The events of a pixel reverse their polarity twice per period.  More than a quarter
    of a reversal per window, as the median over pixels with enough events, means that
    the period is shorter than eight windows.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.int64]] = []
        self._kept = 0
        self._windows = 0
        self._warned = False

    def add(self, events: Events) -> None:
        """Add events of the current window."""
        if self._warned or self._kept > _MOST_EVENTS:
            return
        x, y = events["x"].astype(np.int64), events["y"]
        # One pixel per macropixel is enough, and costs a quarter.
        self._parts.append(((x << 16 | y) << 1 | events["p"])[(x & 1 | y & 1) == 0])
        self._kept += len(self._parts[-1])

    def exceed(self, windows: int) -> bool:
        """Count windows that ended; return True at the first test they fail, once."""
        self._windows += windows
        if self._warned or self._windows < _WINDOWS or not self._parts:
            return False
        coded = np.concatenate(self._parts)
        pixel, p = coded >> 1, coded & 1
        order = np.argsort(pixel, kind="stable")
        pixel, p = pixel[order], p[order]
        turned = (pixel[1:] == pixel[:-1]) & (p[1:] != p[:-1])
        _, first, count = np.unique(pixel, return_index=True, return_counts=True)
        busy = count >= _LEAST_EVENTS
        full, span = self._kept <= _MOST_EVENTS, self._windows
        self._parts, self._kept, self._windows = [], 0, 0
        if not full or not busy.any():
            return False
        sums = np.concatenate(([0], np.cumsum(np.append(turned, False))))
        turns = sums[first + count] - sums[first]
        self._warned = bool(np.median(turns[busy]) > _PER_WINDOW * span)
        return self._warned

    def state(self) -> State:
        """Return copies of everything."""
        return {"parts": [part.copy() for part in self._parts], "kept": self._kept,
                "windows": self._windows, "warned": self._warned}

    def restore(self, state: State) -> None:
        """Take over copies of what `state` returned."""
        self._parts = [part.copy() for part in state["parts"]]
        self._kept, self._windows = state["kept"], state["windows"]
        self._warned = state["warned"]
