"""Filter of log intensity: learned increments of events, joined with frames."""
from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
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
from pdavis_cv._types import Events, Parameters, Records, State
from pdavis_cv.events import FAR, checked_time, timed_events
from pdavis_cv.pixel.model import AROUND_S, PAST_S, PixelModel
from pdavis_cv.pixel.rows import holes_of
from pdavis_cv.reconstruct.base import (
    WHOLE_SENSOR,
    Estimate,
    Needs,
    Reconstructor,
    Shown,
)
from pdavis_cv.reconstruct.kalman.frames import (
    ANCHOR_DTYPE,
    COURSE_DTYPE,
    NO_HOLE,
    NODE_DTYPE,
    SHOWN_DTYPE,
    Hole,
    Waiting,
    between,
    thresholds_of,
)
from pdavis_cv.reconstruct.kalman.lasting_degree import LastingDegree
from pdavis_cv.reconstruct.kalman.saturation import VALID_VARIANCE, Saturated
from pdavis_cv.reconstruct.lamp import MEMORY_US, Lamplight, Wave
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA
from pdavis_cv.reconstruct.store import EventStore, as_bytes
from pdavis_cv.reconstruct.stream_clock import NEVER, StreamClock
from pdavis_cv.recording.base import ApsFrame

LOOKAHEADS = {"buffered": 50_000, "causal": 0, "offline": 500_000}
"""How long after its time an image is made, us: events and frames up to then count."""

_REACH_US = -round(1e6 * min(PAST_S))    # how far back events count, us
_AHEAD_US = round(1e6 * max(AROUND_S))
_LATE_US = 500_000      # how late a frame may come, us
_PLANES, _PIXEL_NS = 5, 100.0   # of an image in the making; ns by listed pixel
# As PD_UNKNOWN, PD_PRIOR_ODDS, PD_NEVER, PD_CHANGED and PD_QUIET of _increments.h.
_UNKNOWN, _HOT, _NO_TIME = 1e3, 6.91, 1 << 62
_CHANGED, _QUIET = -_NO_TIME, -_NO_TIME - 1


class KalmanFilter(Reconstructor):
    """Filter that joins learned increments of events with frames.

    How much light changes by an event, and what silence means, are regressions on the
    recording itself (`PixelModel`).  A Kalman filter of three numbers per pixel, level
    and the deviations of both thresholds, joins them with frames; frames after the
    time of an image, within the look-ahead, count as those before it do.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.  Of maps, the deviations
        from the mean are what the pixels' gains begin with.
    mode : {"buffered", "causal", "offline"}
        What an image knows beyond its time: `lookahead_us`, nothing, or 0.5 s.
    lookahead_us : int, optional
        Default 50,000 when buffered, 500,000 offline, 0 when causal (no other value
        is possible).
    model : PixelModel, optional
        Learned numbers of the camera; its thresholds replace the mean of those stated.
    ratio_sigma : float
        As for `EventRedundancy`, which estimates pixels that every frame saturates.
    response : array_like of shape (2, 2, 3) or (H, W, 3), optional
        Response of each pixel (of the cell) to S0, S1, S2; default: ideal polarizers,
        orthogonal ones on the diagonals.

    Raises
    ------
    ValueError
        If a parameter is out of range; the message names it.

    Notes
    -----
    A pixel is valid from its first usable sample on, while its variance is at most
    0.25; a hot one holds the last frame, and is valid.  Results do not depend on how
    the stream is cut up.
    """

    method, cheaper = "kalman", "cf"
    trials = MappingProxyType({"kalman": {}, "kalman offline": {"mode": "offline"}})
    needs = Needs(lamp=True, learned=frozenset({"model", "ratio_sigma"}))
    causal_parameters = MappingProxyType({"mode": "causal"})
    margin = WHOLE_SENSOR
    lookahead_us: int
    _sight: tuple[Any, ...]
    _grows: tuple[Hole, float]

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        mode: str = "buffered", lookahead_us: int | None = None,
        model: PixelModel | None = None, ratio_sigma: float = RATIO_SIGMA,
        response: ArrayLike | None = None,
    ) -> None:
        self.shape = sensor_shape(shape)
        if not isinstance(mode, str) or mode not in LOOKAHEADS:
            raise ValueError(
                f"mode must be 'buffered', 'causal' or 'offline', got {mode!r}")
        lookahead_us = whole_number("lookahead_us", (
            LOOKAHEADS[mode] if lookahead_us is None else lookahead_us), 0, FAR)
        if (lookahead_us > 0) != (mode != "causal"):
            raise ValueError(
                "lookahead_us must be positive in modes 'buffered' and 'offline' and 0 "
                f"in mode 'causal', got {lookahead_us} in {mode!r}")
        self._mode, self.lookahead_us = mode, lookahead_us
        self.takes_late_frames = mode == "causal"
        # What is known beyond a frame after an image, offline: half, to have both.
        self._wait_us = lookahead_us // 2
        self._theta = tuple(checked_threshold(name, theta, self.shape) for name, theta
                            in (("theta_off", theta_off), ("theta_on", theta_on)))
        self._ratio_sigma = positive("ratio_sigma", ratio_sigma)
        self._given = model
        self._saturated = Saturated(
            self.shape, *self._thresholds, response, lookahead_us, self._model,
            self._ratio_sigma)
        self._begin()

    @property
    def _thresholds(self) -> tuple[ArrayLike, ArrayLike]:
        """Those of the model, ON and OFF, with the stated deviations of the pixels."""
        off, on = (mean * (theta / np.mean(theta)) for mean, theta in zip(
            self._model.thresholds, self._theta, strict=True))
        return on, off

    @property
    def _model(self) -> PixelModel:
        return self._given or PixelModel(
            theta=np.array([float(np.mean(t)) for t in self._theta]))

    def _begin(self) -> None:
        """Create the state of a filter to which nothing has been fed."""
        self._clock = StreamClock(self.shape)
        self._numbers = self._model.numbers
        self._store = EventStore(self.shape)
        self._store.pixels["quiet_t"] = _NO_TIME
        self._store.due = np.empty(self.shape, np.int64)
        self._store.awake = np.empty(self.shape[0] * self.shape[1], np.int32)
        self._anchors = np.zeros(self.shape, ANCHOR_DTYPE)
        self._begin_gains()
        self._frames: tuple[Waiting, ...] = ()     # the anchor, then later ones
        self._passed = 0                            # 1: the first is the anchor
        self._lasting = LastingDegree(self.shape, self._saturated.response)
        self._lamp = Lamplight()
        # What an image is made of: see `increments_move`.
        self._shown = np.zeros(self.shape, SHOWN_DTYPE)
        self._courses: Records | None = None
        self._ended = np.zeros(self.shape, NODE_DTYPE)
        self._planes = np.zeros((_PLANES, *self.shape), np.float32)
        self._around = np.zeros((3, *self.shape), np.float32)
        self._hot: NDArray[np.bool_] | None = None
        self._unknown = self._held = np.empty(0, np.intp)
        self._changed()

    def _begin_gains(self) -> None:
        for i, theta in enumerate(self._theta):
            self._anchors["gain"][..., i] = theta / np.mean(theta) - 1

    def _changed(self) -> None:
        """Invalidate what is made for reads."""
        self._back: NDArray[np.float32] | None = None
        self._fresh, self._hot = False, None
        self._scratch: tuple[int, int, KalmanFilter] | None = None
        store, lit = self._store, self._lit
        last = store.pixels["newest"]
        quiet = (store.pixels["next"] < 0) & (self._anchors["hot"] <= _HOT) & (
            (last["run"] == 0) | (last["t"] == store.pixels["quiet_t"])) & (not lit)
        store.due[:] = np.where(quiet, _QUIET, _CHANGED)
        store.woken = int(np.count_nonzero(~quiet))
        self._awake[:] = np.flatnonzero(~quiet)
        self._around[:, quiet] = 0

    @property
    def _awake(self) -> NDArray[np.int32]:
        """Pixels that are not quiet (see `increments_rest`)."""
        return self._store.awake[:self._store.woken]

    @property
    def _lit(self) -> bool:
        """Whether a lamp's ripple is in what is computed."""
        return bool(self._lamp.waves.size) or any(frame.lit for frame in self._frames)

    @property
    def thresholds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Contrast thresholds of the pixels as learned so far, and their covariance.

        Shapes (2, H, W), ON then OFF, and (H, W, 2, 2), with what is common to all.
        """
        return thresholds_of(self._anchors, self._model)

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal filter."""
        return {"theta_on": self._theta[1], "theta_off": self._theta[0],
                "mode": self._mode, "lookahead_us": self.lookahead_us,
                "model": self._given, "ratio_sigma": self._ratio_sigma,
                "response": self._saturated.response}

    def retune(self, **learned: Any) -> None:
        """Continue with another model or `ratio_sigma` (see `Reconstructor`)."""
        unknown = learned.keys() - {"model", "ratio_sigma", "theta_on", "theta_off",
                                    "frames_moved_us"}
        if unknown:
            raise TypeError("retune takes model, ratio_sigma, theta_on, theta_off and "
                            f"frames_moved_us, got {', '.join(sorted(unknown))}")
        self._ratio_sigma = positive(
            "ratio_sigma", learned.get("ratio_sigma", self._ratio_sigma))
        if {"theta_off", "theta_on"} & learned.keys():
            off, on = (learned.get(name, old) for name, old in zip(
                ("theta_off", "theta_on"), self._theta, strict=True))
            self._theta = (checked_threshold("theta_off", off, self.shape),
                           checked_threshold("theta_on", on, self.shape))
            self._begin_gains()
        old, self._given = self._model, learned.get("model", self._given)
        moved = learned.get("frames_moved_us", 0)
        self._forget_gains(old)
        self._saturated.retune(self._model, self._ratio_sigma, self._thresholds)
        self._numbers = self._model.numbers
        if self._store.stop:
            _kernels.increments_weigh(
                self._store.events, self._store.stop, self._store.first_us or 0,
                self._store.pixels, self._numbers)
        self._changed()
        # Frames that wait still have the old stamps.
        frames = self._frames[:self._passed] if moved else self._frames
        self._frames = tuple(frame.copy() for frame in frames)
        for frame in self._frames:
            known = frame.known_us
            log = frame.sample[0].copy() if frame is self._frames[0] else None
            frame.set_model(self._model)
            if log is not None and self._passed:
                # ln(I + black) with another black level
                self._anchors["log"] += np.where(
                    frame.sample[1] > 0, frame.sample[0] - log, 0)
            if known is not None:
                frame.known_us = None
                self._look(frame, known)

    def _forget_gains(self, old: PixelModel) -> None:
        """Keep of the gains what another model could tell.

        They hold in units of their spread, but may be as wrong as thresholds were.
        """
        variance = self._model.spread ** 2
        wrong = np.abs(np.log(self._model.theta / old.theta)).max()
        kept = variance / (variance + wrong**2)
        ratio = kept * self._model.spread / old.spread
        self._anchors["p"] *= np.array(
            [1, ratio, ratio, ratio**2, ratio**2, ratio**2], np.float32)
        self._anchors["p"][..., [3, 5]] += (1 - kept**2) * variance
        for i, theta in enumerate(self._theta):
            gain = self._anchors["gain"][..., i]
            gain += (1 - kept) * (theta / np.mean(theta) - 1 - gain)

    # ---- feeding -----------------------------------------------------------------

    def add_events(self, events: Events) -> None:
        """Take events (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        if not len(events):
            return
        taken = self._store.push(
            events, self._clock.last_us, self._numbers, self._keep_us)
        self._scratch = None
        self._saturated.add_events(events[:taken], self.workers)
        try:
            self._clock.took(events, taken)
        finally:
            self._settle(self._clock.last_us)

    def _keep_us(self) -> int:
        """Return from when on committed events are kept."""
        store = self._store
        last = int(store.events["t"][store.committed - 1])
        keep = last - _REACH_US - (_LATE_US if self._mode == "causal" else 0)
        if self._frames:
            first = self._frames[0]
            oldest = first.begin_us - _REACH_US
            keep = max(min(keep, oldest), last - 2 * _LATE_US)
            if keep > oldest and first.known_us is not None:
                _kernels.increments_close(
                    store.pixels, store.events, first.arrays, self.lookahead_us,
                    oldest, self._numbers, self._lamp.waves, self._awake)
                self._changed()
        return keep

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame, which counts once the events of its exposure are there.

        In mode "causal" a frame may also be fed late, when it has been read out.
        """
        last = self._frames[-1].frame.mid_us if self._frames else NEVER
        self._clock.check_frame(frame, last if self.takes_late_frames else None)
        self._settle(max(self._clock.last_us, frame.mid_us))
        waiting = Waiting(frame, self._model, self._anchors["gain"].copy())
        self._frames = (*self._frames, waiting)
        self._scratch = None
        self._saturated.add_frame(
            frame, waiting.sample[0].copy(), waiting.sample[1], self.workers)

    def add_wave(self, wave: Wave) -> None:
        """Take the lamp's flicker in a block (see `Reconstructor.add_wave`)."""
        self._lamp.add(wave)
        self._scratch = None
        if self._lamp.waves.size and len(self._awake) < len(self._store.awake):
            self._changed()

    def settle(self, t_us: int) -> None:
        """Use what is due (see `Reconstructor.settle`)."""
        self._clock.last_us = max(self._clock.last_us, t_us)
        self._settle(t_us)
        self._saturated.settle(t_us, self.workers)

    def _settle(self, seen_us: int) -> None:
        """Commit what precedes every later read."""
        until = max(seen_us - self.lookahead_us, NEVER)
        while self._next_passes(seen_us):
            self._pass_next()
        before = self._store.committed
        self._store.commit(until)
        if self._store.committed != before:
            self._scratch = None
        self._lamp.forget(until - MEMORY_US)

    def _next_passes(self, seen_us: int) -> bool:
        """Whether the frame after the anchor precedes every later read."""
        if len(self._frames) == self._passed:
            return False
        return self._passes_us(self._frames[self._passed]) <= seen_us

    def _passes_us(self, frame: Waiting) -> int:
        """Time of the stream from which on a frame is the anchor."""
        return max(frame.end_us + 1, frame.arrived_us if self._mode == "causal"
                   else frame.mid_us + self.lookahead_us)

    def _usable_us(self, frame: Waiting) -> int:
        """Time of the stream from which on a frame after the time read counts."""
        if self._mode == "causal":
            return self._passes_us(frame)
        return max(frame.end_us + 1, frame.mid_us + (
            self._wait_us if self._mode == "offline" else 0))

    def _pass_next(self) -> None:
        """Let the next frame be the anchor."""
        frame = self._frames[self._passed]
        old = self._frames[0] if self._passed else None
        known = self._passes_us(frame)
        self._look(frame, known)
        if old is not None:
            self._look(old, known)
            self._differ(old, frame)
        middles = np.empty(self.shape, np.float32)
        before = frame if old is None else old
        self.workers.rows(self.shape[0], lambda first, last: _kernels.increments_pass(
            before.arrays, frame.arrays, self._store.due, self._numbers, self._anchors,
            middles, (first, last)))
        self._lasting.add_frame(middles)
        self._frames = self._frames[self._passed:]
        self._passed = 1
        self._back, self._fresh = None, False
        if not self._lit:
            self._rest(known - 1)

    def _rest(self, known: int) -> None:
        """Let pixels be quiet that have been still since before the last frame."""
        store, rested = self._store, np.empty(self._store.woken, np.int32)
        n, store.woken = _kernels.increments_rest(
            store.events, known, self._frames[0].begin_us - _REACH_US, store.pixels,
            self._anchors, self._numbers, store.due, store.awake, store.woken, rested)
        for frame in self._frames:
            if frame.known_us is not None:
                self._evaluate(frame, rested[:n])
        self._around.reshape(3, -1)[:, rested[:n]] = 0
        self._awake.sort()    # neighbours are near in memory

    def _look(self, frame: Waiting, until_us: int) -> None:
        """Evaluate the exposure of a frame by the events before a time of the stream.

        What earlier events settled stays as it is.
        """
        if frame.known_us == until_us:
            return
        before_us, frame.known_us = frame.known_us, until_us
        same = before_us is not None and frame.around is not None and (
            before_us - 1 - frame.mid_us >= min(
                _AHEAD_US, until_us - 1 - frame.mid_us, self.lookahead_us))
        if not self._model.looks_around:
            frame.around = None
        elif frame.around is None:
            frame.around = np.zeros((3, *self.shape))
        frame.lit = frame.lit or bool(self._lamp.waves.size)
        self._evaluate(frame, self._awake, (before_us is not None, same))
        self._back, self._fresh = None, False

    def _hole(self, first_us: int, last_us: int, known_us: int) -> Hole:
        """Return where events are missing between two times, as known at a third."""
        if not self._model.missing:
            return NO_HOLE
        t, start_us = self._store.events["t"], max(first_us, known_us - 2 * _LATE_US)
        begin, end = np.searchsorted(t[:self._store.stop], (start_us, known_us + 1))
        begins, ends = holes_of(
            np.append(t[max(begin - 1, 0):end], known_us), last_us - first_us)
        if not len(begins):
            return NO_HOLE
        begin, end = np.clip((begins[0], ends[-1]), first_us, last_us).tolist()
        return begin, end, self._model.missing / self._model.noise[0]

    def _evaluate(self, frame: Waiting, pixels: NDArray[np.int32],
                  again: tuple[bool, bool] = (False, False)) -> None:
        assert frame.known_us is not None
        known = frame.known_us - 1
        self.workers.rows(len(pixels), lambda *rows: _kernels.increments_node(
            self._store.pixels, self._store.events, frame.arrays, known,
            min(known - frame.mid_us, self.lookahead_us), self._numbers,
            self._lamp.waves, again, pixels, rows), row_ns=_PIXEL_NS)

    def _differ(self, old: Waiting, new: Waiting) -> None:
        """Set what other times and pixels say of the time between two frames."""
        new.hole = self._hole(old.mid_us, new.mid_us, new.end_us)
        if new.around is None or old.around is None:
            new.sample[2] = 0
            return
        _kernels.increments_differ(
            new.around, old.around, self._anchors, self._awake,
            self._around, new.sample[2])

    # ---- reading -----------------------------------------------------------------

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity at t_us (see `Reconstructor.read`)."""
        estimate, weighed = self._unweighed(t_us, out)
        log, light = estimate.log_intensity, weighed()
        changed = light != self.intensity(log)
        log[changed] = np.log(light[changed])
        return estimate

    def begin_read(self, t_us: int) -> Callable[[], Shown]:
        """Leave the weighing of the degree (see `Reconstructor.begin_read`)."""
        estimate, weighed = self._unweighed(t_us)
        return lambda: (weighed(), *estimate[1:])

    def _unweighed(
        self, t_us: int, out: NDArray[np.float32] | None = None
    ) -> tuple[Estimate, Callable[[], NDArray[np.float32]]]:
        """Return each pixel's estimate, and what weighs its intensity by the degree."""
        t = checked_time("t_us", t_us)
        seen = t + self.lookahead_us
        self._clock.check_read(seen)
        log = output(out, self.shape, np.float32)
        variance, valid = np.empty_like(log), np.empty(self.shape, np.bool_)
        one = self._at(t, seen)
        one._show(t, seen, log, variance, valid)
        self._saturated.fill(t, one._unknown, log, variance, valid, self.workers)
        lasting = copy.copy(one._lasting)

        def weighed() -> NDArray[np.float32]:
            light = self.intensity(log)
            lasting.weigh(light, variance, valid.view(np.uint8), self.workers)
            return light

        return Estimate(log, variance, valid), weighed

    def _at(self, t: int, seen: int) -> KalmanFilter:
        """Return this filter, or a copy that has used what a later read may not use."""
        waiting_us = self._store.waiting_us
        if not self._next_passes(seen) and (waiting_us is None or waiting_us > t):
            return self
        if self._scratch is None or self._scratch[:2] != (self._store.stop, seen):
            one = copy.copy(self)
            one._begin()
            one._restore({**self._state(), "saturated": None})
            one.workers = self.workers
            one._settle(seen)
            self._scratch = self._store.stop, seen, one
        return self._scratch[2]

    def _show(
        self, t: int, seen: int, log: NDArray[np.float32],
        variance: NDArray[np.float32], valid: NDArray[np.bool_],
    ) -> None:
        later = [frame for frame in self._frames[self._passed:]
                 if self._usable_us(frame) <= seen]
        for frame in later:
            if frame.known_us is None:
                self._look(frame, self._usable_us(frame))
        if self._back is None or self._backs != len(later):
            self._join(later)
        anchor = self._frames[0] if self._passed else None
        hole = NO_HOLE if anchor is None else later[0].hole if later else self._hole(
            anchor.mid_us, t, seen)
        grows = hole, 1 + hole[2] * (hole[0] <= t < hole[1])
        fresh = not self._fresh or grows != self._grows
        self._grows = grows
        numbers = self._numbers
        if grows[1] > 1:
            alpha, *others = self._model.noise
            numbers = self._model.replace(noise=(grows[1] * alpha, *others)).numbers
        if fresh:
            self._sight = (*between(
                anchor, later, self._ended, self.shape, t, hole), self._anchors,
                           self._back, next((f.mid_us for f in self._frames), t))
            self.workers.rows(
                self.shape[0], lambda *rows: _kernels.increments_rest_planes(
                    self._sight, numbers, self._planes, rows))
        around = self._around if self._model.looks_around else None
        if around is not None and self._courses is None:
            self._courses = np.empty(self.shape, COURSE_DTYPE)
        store, awake = self._store, self._awake
        self.workers.rows(len(awake), lambda first, last: _kernels.increments_move(
            store.pixels, store.events, self._sight, (t, seen, fresh), self._lamp.waves,
            numbers, awake, store.due, self._shown, self._courses, self._planes,
            around, (first, last)), row_ns=_PIXEL_NS)
        if fresh:
            self._unknown = np.flatnonzero(self._planes[2] == _UNKNOWN)
            self._held = np.flatnonzero(
                (self._anchors["hot"] > _HOT) & (self._anchors["sampled"] > 0))
            self._fresh = True
        self.workers.rows(self.shape[0], lambda first, last: _kernels.increments_image(
            self._planes, around, (t, self._sight[-1]), self._lamp.waves,
            VALID_VARIANCE, (log, variance, valid.view(np.uint8)),
            (first, last)), row_ns=3.0 * self.shape[1])
        valid.reshape(-1)[self._held] = True    # their variance says how wrong

    def _join(self, later: list[Waiting]) -> None:
        """Carry the estimate from later frames back to the first of them."""
        hot = self._anchors["hot"] > _HOT
        same = self._hot is not None and np.array_equal(hot, self._hot)
        self._hot = hot
        anchor = self._frames[:self._passed]
        for old, new in itertools.pairwise([*anchor, *later]):
            # The anchor changes as silences end, and frames after it do not.
            if not same or old in anchor or new.after_us != old.mid_us:
                self._differ(old, new)
                new.after_us = old.mid_us
        back = np.empty((2, *self.shape), np.float32)
        arrays = [frame.arrays for frame in later]
        self.workers.rows(self.shape[0], lambda first, last: _kernels.increments_back(
            arrays, self._store.due, self._numbers, self._anchors, back, (first, last)))
        self._back, self._backs, self._fresh = back, len(later), False

    # ---- states ------------------------------------------------------------------

    def assign(self, other: Reconstructor) -> None:
        """Take over the state of an equal filter (see `Reconstructor.assign`)."""
        if not isinstance(other, KalmanFilter) or other.shape != self.shape:
            raise ValueError(f"other must be an equal KalmanFilter, got {other!r}")
        self._restore(other._state())

    def _state(self) -> State:
        return {"last_us": self._clock.last_us, "store": self._store.state(),
                "model": self._given, "theta": self._theta,
                "ratio_sigma": self._ratio_sigma,
                "anchors": as_bytes(self._anchors).copy(),
                "lamp": self._lamp.state(),
                "frames": [frame.copy() for frame in self._frames],
                "passed": self._passed, "lasting": self._lasting.state(),
                "saturated": self._saturated.state()}

    def _restore(self, state: State) -> None:
        self._clock.last_us = state["last_us"]
        self._given, self._theta = state["model"], state["theta"]
        self._ratio_sigma = state["ratio_sigma"]
        self._numbers = self._model.numbers
        self._store.restore(state["store"])
        as_bytes(self._anchors)[:] = state["anchors"]
        self._frames = tuple(frame.copy() for frame in state["frames"])
        self._passed = state["passed"]
        self._lamp.restore(state["lamp"])
        self._lasting.restore(state["lasting"])
        if state["saturated"] is not None:
            self._saturated.restore(state["saturated"])
        self._changed()
