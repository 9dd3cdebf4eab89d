"""Kalman filter that fuses events and de-blurred frames and learns the thresholds."""
from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, positive, sensor_shape, whole_number
from pdavis_cv._types import Events, Parameters, Records, State
from pdavis_cv.events import FAR, checked_time, timed_events
from pdavis_cv.reconstruct.base import (
    WHOLE_SENSOR,
    Estimate,
    Needs,
    Reconstructor,
)
from pdavis_cv.reconstruct.kalman.adaptation import KEPT, MISFIT, P_NOISE, SUMS, adapt
from pdavis_cv.reconstruct.kalman.event_noise import MOTION
from pdavis_cv.reconstruct.kalman.frame_noise import DN_PER_SHOT, READ_NOISE_DN
from pdavis_cv.reconstruct.kalman.inflation import (
    inflate_for_lag,
    inflate_for_resets,
    inflate_for_stamps,
)
from pdavis_cv.reconstruct.kalman.lasting_degree import LastingDegree
from pdavis_cv.reconstruct.kalman.prior_spread import change_spread
from pdavis_cv.reconstruct.kalman.saturation import VALID_VARIANCE, Saturated
from pdavis_cv.reconstruct.kalman.smoother import Smoother
from pdavis_cv.reconstruct.kalman.waiting import WaitingFrame
from pdavis_cv.reconstruct.lamp import MEMORY_US, Lamplight, Wave
from pdavis_cv.reconstruct.model import NODE_DTYPE, STATE_DTYPE, TUNING_DTYPE
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA
from pdavis_cv.reconstruct.stream_clock import (
    NEVER,
    StreamClock,
    checked_bandwidth,
    checked_duration,
    checked_noise,
    checked_threshold,
    checked_threshold_sigma,
)
from pdavis_cv.reconstruct.tracks import (
    LONG_AGO,
    LOOKAHEAD_US,
    Reader,
    Tracks,
    as_bytes,
)
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import THRESHOLD_SIGMA

__all__ = ["LOOKAHEAD_US", "KalmanFilter"]

SMOOTHING_US = 500_000
"""Default look-ahead of the offline mode, us: frames this much later are used."""

NOISE = (0.01, 0.02, 0.0003)
"""Measurement noise of a de-blurred frame (standard deviation of log intensity), then
process noise per second (leak) and per event (variances in thresholds^2).

Chosen on pixels without events: 68 to 77 % of the innovations of the real DAVIS346 are
then within one sigma.  Noise of events and of motion is learned (`P_NOISE`, `MOTION`);
differences between pixels (gains, polarizer angles) are added to the images' sigma.
"""

CALIBRATED_NOISE = (0.006, 0.02, 0.000005, 0.33)
"""`NOISE` where a calibration corrects the differences between pixels: the residual
error is smaller, and read and shot noise have a third of the variance assumed."""

STILL_US = 250_000.0
"""Gap between two events (us) at which rest and motion are equally likely.  Engineering
choice: five frames of the paper's cameras.  A threshold of 0.2 crossed in that gap is a
change of 0.04 per frame, which frames measure better than interpolation does."""
# Committed events are kept for KEEP_US and for at least twice the longest exposure.
# Until the first frame shows how late frames arrive, half a second is kept.
KEEP_US, _FIRST_KEEP_US = 100_000, 500_000
_LOOKAHEADS = {"buffered": LOOKAHEAD_US, "causal": 0, "offline": SMOOTHING_US}
# Rows of the sensor that are processed together by updates of the whole state.
_BAND = 32
# The same by frames, whose bands threads share; ns per pixel (measured).
_FRAME_BAND, _FRAME_NS = 8, 55.0
_NO_NODES = np.zeros((0, 0), NODE_DTYPE)


class KalmanFilter(Reconstructor):
    """Kalman filter per pixel of log intensity and of both contrast thresholds.

    Events are the transition: they move the log intensity.  Each frame, de-blurred by
    the events of its own exposure, is a measurement that corrects log intensity and
    thresholds by their covariance.  Between two events of a pixel the intensity is
    interpolated, and the lag of the photoreceptor is removed if its bandwidth is given.
    The flicker of a mains lamp (`add_wave`) is subtracted from the events and added
    back to the images, because flicker below a threshold triggers only some pixels.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds to start from, positive, in natural-log units.
    mode : {"buffered", "causal", "offline"}
        "buffered" waits up to `lookahead_us` for each pixel's next event and
        interpolates; "causal" extrapolates from the last two events; "offline" also
        smooths the estimate with the frames up to `lookahead_us` later.
    lookahead_us : int, optional
        Default 50,000 when buffered, 500,000 offline, 0 when causal (no other value
        is possible).
    threshold_sigma : float or array_like of shape (2,) or (2, H, W)
        Prior standard deviation of the thresholds (ON, OFF), natural-log units;
        0 keeps the thresholds fixed.
    bandwidth : (float, float) or (float, float, float), optional
        Corner frequency of the photoreceptor in Hz, its increase per unit of intensity
        (Hz per DN/ms), and the relative standard error of both, default 0.03, which
        is propagated to the variance.  Default: no lag.
    noise : (float, float, float) or (float, float, float, float)
        Residual error of a de-blurred frame (standard deviation of log intensity),
        process noise of the sum of events per second and per event (variances in
        thresholds^2), and a factor on the variance of the frames' read and shot noise,
        default 1.  `CALIBRATED_NOISE` is for pixels whose responses are known.
    offset_dn : float
        Standard deviation of the error that all frames of a pixel share, DN; it adds
        to the variance, most where light is dim.
    refractory_us : float
        How long a pixel is held in reset after an event, us; the change lost meanwhile
        is restored from the slope before and after.
    jitter_us : float
        Standard deviation of the events' time stamps, us: a slope is found over longer
        than that, to undo the lag and to extrapolate.
    ratio_sigma : float
        As for `EventRedundancy`, which estimates the pixels that every frame saturates.
    response : array_like of shape (2, 2, 3) or (H, W, 3), optional
        Response of each pixel (of the cell) to S0, S1, S2; default: ideal polarizers,
        orthogonal ones on the diagonals.

    Raises
    ------
    ValueError
        If a parameter is out of range; the message names it.

    Notes
    -----
    Samples that are not valid are not used.  A pixel is valid from its first usable
    sample on, while its variance (without that of the lag) is at most 0.25.  A pixel
    that every frame saturates gets its offset from the other three pixels of its
    macropixel (`EventRedundancy`); without these it shows its last sample, which is a
    bound, and is not valid.  Results do not depend on how the stream is cut up.

    The offline mode is a fixed-lag smoother, not one over the whole recording: within
    a few frames the leak and noise of summed events exceed the error of a frame.
    Memory does not grow with the recording: 28 bytes per pixel and frame within the
    look-ahead, and 17 bytes per event.  Where frames are dim and noisy, a longer
    look-ahead averages over more of them.
    """

    method, cheaper = "kalman", "cf"
    trials = MappingProxyType({"kalman": {}, "kalman offline": {"mode": "offline"}})
    needs = Needs(
        lamp=True, prior=frozenset({"threshold_sigma", "offset_dn"}),
        learned=frozenset({"bandwidth", "jitter_us", "noise", "ratio_sigma",
                           "refractory_us"}))
    causal_parameters = MappingProxyType({"mode": "causal"})
    margin = WHOLE_SENSOR  # the noise of motion is learned from all pixels' innovations
    lookahead_us: int

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        mode: str = "buffered", lookahead_us: int | None = None,
        threshold_sigma: ArrayLike = THRESHOLD_SIGMA,
        bandwidth: Sequence[float] | None = None,
        noise: Sequence[float] = NOISE, offset_dn: float = 0.0,
        refractory_us: float = 0.0, jitter_us: float = 0.0,
        ratio_sigma: float = RATIO_SIGMA, response: ArrayLike | None = None,
    ) -> None:
        self.shape = sensor_shape(shape)
        if mode not in _LOOKAHEADS:
            raise ValueError(
                f"mode must be 'buffered', 'causal' or 'offline', got {mode!r}")
        if lookahead_us is None:
            lookahead_us = _LOOKAHEADS[mode]
        lookahead_us = whole_number("lookahead_us", lookahead_us, 0, FAR)
        if (lookahead_us > 0) != (mode != "causal"):
            raise ValueError(
                "lookahead_us must be positive in modes 'buffered' and 'offline' and 0 "
                f"in mode 'causal', got {lookahead_us} in {mode!r}")
        self._mode, self.lookahead_us = mode, lookahead_us
        self.takes_late_frames = mode == "causal"
        # The filter runs ahead of the smoother: it waits for each pixel's next event,
        # not for later frames.
        self._wait_us = (min(self.lookahead_us, LOOKAHEAD_US) if mode == "offline"
                         else self.lookahead_us)
        self._theta_on = checked_threshold("theta_on", theta_on, self.shape)
        self._theta_off = checked_threshold("theta_off", theta_off, self.shape)
        self._sigma = checked_threshold_sigma(threshold_sigma, self.shape)
        self._bandwidth = checked_bandwidth(bandwidth)
        self._noise = checked_noise(noise)
        if not (np.isfinite(offset_dn) and offset_dn >= 0):
            raise ValueError(
                f"offset_dn must be finite and not negative, got {offset_dn}")
        self._offset_dn = float(offset_dn)
        self._refractory_us = checked_duration("refractory_us", refractory_us)
        self._jitter_us = checked_duration("jitter_us", jitter_us)
        self._ratio_sigma = positive("ratio_sigma", ratio_sigma)
        self._tuning = np.zeros(1, TUNING_DTYPE)
        self._tuning["offset_dn"] = self._offset_dn
        self._tuning["valid_variance"] = VALID_VARIANCE
        self._tuning["read_variance"] = READ_NOISE_DN**2
        self._tuning["shot_variance"] = 1 / DN_PER_SHOT
        self._tuning["p_noise"], self._tuning["motion_variance"] = P_NOISE[0], MOTION[0]
        self._tuning["still_us"] = STILL_US
        self._tuning["holds_part"] = mode == "causal"   # images see no later events
        self._tuning["needs_sample"] = 1        # `Saturated.fill` replaces the others
        self._saturated = Saturated(
            self.shape, self._theta_on, self._theta_off, response, self.lookahead_us,
            self._bandwidth, self._ratio_sigma)
        self._begin()
        self._tune()
        self._begin_thresholds()

    def _begin(self) -> None:
        """Create the state of a filter to which nothing has been fed."""
        offline = self._mode == "offline"
        self._states = np.zeros(self.shape, STATE_DTYPE)
        self._tracks = Tracks(
            self.shape, max(_FIRST_KEEP_US, KEEP_US + self._wait_us), late=offline)
        self._smoother = Smoother(self.shape) if offline else None
        self._reader = Reader(self.shape, smooth=offline)
        self._lasting = LastingDegree(self.shape, self._saturated.response)
        self._epoch_us = 0      # at or after the last sample of every pixel
        self._interval_us = 0   # time between the last two frames used; 0: fewer
        self._mid_us = NEVER    # mid-exposure of the last frame fed
        self._clock = StreamClock(self.shape)
        self._lamp = Lamplight()
        self._frames: tuple[WaitingFrame, ...] = ()
        self._unsampled: NDArray[np.intp] | None = None
        self._innovations = np.zeros(KEPT)
        self._fed = 0           # calls that changed the state so far
        self._scratch: tuple[KalmanFilter, int, int] | None = None

    def _tune(self) -> None:
        names = ("bandwidth_hz", "bandwidth_hz_per_intensity", "bandwidth_sigma",
                 "frame_sigma", "leak_per_s", "noise_per_event", "shot_share")
        for name, value in zip(names, (*self._bandwidth, *self._noise), strict=True):
            self._tuning[name] = value
        self._tuning["refractory_us"] = self._refractory_us
        self._tuning["jitter_us"] = self._jitter_us
        self._tracks.refractory_us = self._refractory_us

    def _adapt(self) -> None:
        """Re-estimate the noise of events, motion and frames from the innovations."""
        adapt(self._innovations, self._tuning, self._noise[2])

    def _begin_thresholds(self) -> None:
        """Reset the thresholds of all states, and their covariance, to the prior."""
        on, off, *sigmas = (np.broadcast_to(each, self.shape) for each in (
            self._theta_on, self._theta_off, *self._sigma))
        for first in range(0, self.shape[0], _BAND):    # they fit into the cache
            rows = slice(first, first + _BAND)
            states = self._states[rows]
            for part, theta, sigma in zip(
                    ("on", "off"), (on, off), sigmas, strict=True):
                for name in (f"theta_{part}", f"prior_{part}"):
                    states[name] = theta[rows]
                states[f"var_{part}"] = sigma[rows]**2
                states[f"cov_base_{part}"] = 0
            states["cov_on_off"] = 0

    def retune(self, **learned: Any) -> None:
        """Continue with another bandwidth, noise or thresholds (see `Reconstructor`).

        `theta_on` and `theta_off` are a new prior, which replaces the learned
        thresholds: its estimator has seen the same data.  `threshold_sigma` alone
        changes how much the prior counts in what was learned.  Another refractory
        period also resets them, because they had compensated for the events
        lost.  Another bandwidth, or frames moved in time from now on, means that
        learned thresholds had compensated for a wrong delay of events against frames:
        their variance grows accordingly.  Moved frames and another refractory period
        also discard the noise statistics, which held the same error.
        """
        unknown = learned.keys() - self.needs.learned - {
            "theta_on", "theta_off", "threshold_sigma", "frames_moved_us"}
        if unknown:
            raise TypeError(
                "retune takes bandwidth, noise, refractory_us, jitter_us, ratio_sigma, "
                "theta_on, theta_off, threshold_sigma and frames_moved_us, got "
                f"{', '.join(sorted(unknown))}")
        before, moved_us = self._bandwidth, learned.get("frames_moved_us", 0)
        if "threshold_sigma" in learned:
            spread, self._sigma = self._sigma, checked_threshold_sigma(
                learned["threshold_sigma"], self.shape)
            change_spread(self._states, spread, self._sigma)
        if "bandwidth" in learned:
            self._bandwidth = checked_bandwidth(learned["bandwidth"])
        # Without an interval no threshold has been learned.
        if (moved_us or "bandwidth" in learned) and self._interval_us:
            inflate_for_lag(self._states, self._sigma, before, self._bandwidth,
                            moved_us, self._interval_us)
        if moved_us:
            if self._interval_us:
                inflate_for_stamps(self._states, moved_us / self._interval_us)
            self._frames = ()   # waiting frames still have the old time stamps
        if "refractory_us" in learned:
            before_us, self._refractory_us = (
                self._refractory_us,
                checked_duration("refractory_us", learned["refractory_us"]))
            if self._interval_us:
                inflate_for_resets(
                    self._states, (self._refractory_us - before_us) / self._interval_us)
        if moved_us or "refractory_us" in learned:
            self._innovations[MISFIT:] = 0
            self._adapt()
        if not {"theta_on", "theta_off", "refractory_us"}.isdisjoint(learned):
            for name in ("theta_on", "theta_off"):
                if name in learned:
                    setattr(self, f"_{name}", checked_threshold(
                        name, learned[name], self.shape))
            self._begin_thresholds()
        if "ratio_sigma" in learned:
            self._ratio_sigma = positive("ratio_sigma", learned["ratio_sigma"])
        self._saturated.retune(
            self._bandwidth, self._ratio_sigma,
            None if {"theta_on", "theta_off"}.isdisjoint(learned)
            else (self._theta_on, self._theta_off))
        if "noise" in learned:
            self._noise = checked_noise(learned["noise"])
        if "jitter_us" in learned:
            self._jitter_us = checked_duration("jitter_us", learned["jitter_us"])
        self._tune()
        self._changed()

    def _changed(self) -> None:
        """Invalidate everything cached from the state."""
        self._fed += 1
        self._reader.forget()
        self._unsampled = None

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal KalmanFilter."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "mode": self._mode, "lookahead_us": self.lookahead_us,
                "threshold_sigma": self._sigma, "bandwidth": self._bandwidth,
                "noise": self._noise, "offset_dn": self._offset_dn,
                "refractory_us": self._refractory_us, "jitter_us": self._jitter_us,
                "ratio_sigma": self._ratio_sigma, "response": self._saturated.response}

    @property
    def thresholds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Thresholds learned so far and their covariance.

        Shapes (2, H, W), ON then OFF, and (H, W, 2, 2).
        """
        s = self._states
        covariance = [s["var_on"], s["cov_on_off"], s["cov_on_off"], s["var_off"]]
        return (np.stack([s["theta_on"], s["theta_off"]]),
                np.stack(covariance, -1).reshape(*self.shape, 2, 2))

    @property
    def misfit(self) -> NDArray[np.float64]:
        """Sums of e^2 / v and of ln v over innovations e of variance v, and the count.

        Returns
        -------
        ndarray of float64, shape (3,)
        """
        return self._innovations[:MISFIT].copy()

    def add_events(self, events: Events) -> None:
        """Take events (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        self._fed += 1
        taken = self._tracks.push(events, self._clock.last_us, self._reader)
        self._saturated.add_events(events[:taken], self.workers)
        try:
            self._clock.took(events, taken)
        finally:
            self._settle(self._clock.last_us)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame, which updates the state once the events it needs are there.

        In mode "causal" a frame may also be fed late, when it has been read out.
        """
        first = self._mid_us == NEVER
        self._mid_us = self._clock.check_frame(
            frame, self._mid_us if self.takes_late_frames else None)
        self._fed += 1
        waiting = WaitingFrame(frame, self._wait_us)
        self._frames = (*self._frames, waiting)
        self._saturated.add_frame(
            frame, waiting.samples["log"], waiting.samples["variance"], self.workers)
        longest = int(np.max(np.subtract(frame.exposure_end_us,
                                         frame.exposure_start_us)))
        delay = frame.available_us - int(np.min(frame.exposure_start_us))
        needed = max(KEEP_US + self._wait_us, 2 * longest, 2 * delay)
        keep = self._tracks
        keep.keep_us = needed if first else max(keep.keep_us, needed)

    def add_wave(self, wave: Wave) -> None:
        """Take the lamp's flicker in a block (see `Reconstructor.add_wave`)."""
        self._fed += 1
        self._lamp.add(wave)

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity at t_us (see `Reconstructor.read`)."""
        estimate, weigh = self._unweighed(t_us, out)
        weigh(estimate.log_intensity)
        return estimate

    def begin_read(self, t_us: int) -> Callable[[], Estimate]:
        """Leave the weighing of the degree (see `Reconstructor.begin_read`)."""
        if type(self).read is not KalmanFilter.read:
            return super().begin_read(t_us)
        estimate, weigh = self._unweighed(t_us)

        def weighed() -> Estimate:
            log = np.empty(self.shape, np.float32)
            weigh(log)
            return estimate._replace(log_intensity=log)

        return weighed

    def _unweighed(
        self, t_us: int, out: NDArray[np.float32] | None = None
    ) -> tuple[Estimate, Callable[[NDArray[np.float32]], None]]:
        """Return each pixel's estimate, and what weighs it by the degree that lasts."""
        t = checked_time("t_us", t_us)
        seen = t + self.lookahead_us
        self._clock.check_read(seen)
        log = output(out, self.shape, np.float32)
        variance = np.empty(self.shape, np.float32)
        valid = np.empty(self.shape, np.bool_)
        due = sum(frame.known_us <= seen for frame in self._frames)
        one = self._ahead(due, seen) if due else self
        one._show(t, log, variance, valid.view(np.uint8))
        self._saturated.fill(t, one._unknown, log, variance, valid, self.workers)
        lasting = copy.copy(one._lasting)
        return Estimate(log, variance, valid), lambda out: lasting.weigh(
            log, variance, valid.view(np.uint8), self.workers, out)

    def settle(self, t_us: int) -> None:
        """Use the frames that are due (see `Reconstructor.settle`)."""
        self._fed += 1
        self._clock.last_us = max(self._clock.last_us, t_us)
        self._settle(t_us)
        self._saturated.settle(t_us, self.workers)

    @property
    def _unknown(self) -> NDArray[np.intp]:
        """Flat indices of the pixels without any sample at the last read."""
        if self._smoother is not None:
            return self._smoother.unknown
        if self._unsampled is None:
            self._unsampled = np.flatnonzero(self._states["samples"] == 0)
        return self._unsampled

    def _ahead(self, due: int, seen_us: int) -> KalmanFilter:
        """Return a copy of this filter that has used the first `due` waiting frames."""
        if self._scratch is None:
            # The copy shares `_saturated`, which is fed and read through self only.
            one, fed, done = copy.copy(self), -1, 0
            one._tuning = self._tuning.copy()
            one._begin()
        else:
            one, fed, done = self._scratch
        if (fed, done) != (self._fed, due):
            one.workers = self.workers
            one._take(self)
            one._settle(seen_us)
            self._scratch = one, self._fed, due
        return one

    def _show(
        self, t: int, log: NDArray[np.float32], variance: NDArray[np.float32],
        valid: NDArray[np.uint8],
    ) -> None:
        # No later read can be of a time before `rest`.
        rest = min(t, max(self._clock.last_us, LONG_AGO) - self.lookahead_us)
        shown = log, variance, valid
        if self._smoother is not None:
            self._smoother.read(
                t, t + self._wait_us, rest, self._tracks, self._reader, self._model,
                self._states, shown, self.workers)
            return
        self._reader.read(
            t, t + self.lookahead_us, rest, self._epoch_us, self._tracks.chain,
            self._states, self._model, shown, self.workers)

    @property
    def _model(self) -> tuple[NDArray[Any], NDArray[Any]]:
        return self._tuning, self._lamp.waves

    def _settle(self, seen_us: int) -> None:
        """Commit the events that precede every later read, and use the frames due."""
        recent, smoother = self._tracks, self._smoother
        recent.commit(seen_us - self._wait_us)
        if smoother is not None:
            recent.commit_late(seen_us - self.lookahead_us)
        while self._frames and self._frames[0].known_us <= seen_us:
            frame, *rest = self._frames
            self._frames = tuple(rest)
            middles = frame.exposures["middle"]
            nodes = _NO_NODES if smoother is None else smoother.slot(middles)
            recent.chain_since(int(frame.exposures["begin"].min()))
            self._use(frame, nodes)
            self._adapt()
            middle = int(middles.max())
            self._interval_us = middle - self._epoch_us if self._epoch_us else 0
            self._epoch_us = max(self._epoch_us, middle)
            self._reader.forget()
            if self._unsampled is not None:     # pixels only ever leave this list
                # Not by take(), which would copy the whole field first.
                samples = self._states["samples"].reshape(-1)[self._unsampled]
                self._unsampled = self._unsampled[samples == 0]
            if smoother is not None:
                smoother.pass_until(frame.known_us - self.lookahead_us, self._states)
        self._lamp.forget(seen_us - self.lookahead_us - MEMORY_US)

    def _use(self, frame: WaitingFrame, nodes: Records) -> None:
        """Update the states with a frame whose events are chained."""
        recent = self._tracks
        # Each band has its own sums, so that results do not depend on the threads.
        count = -(-self.shape[0] // _FRAME_BAND)
        innovations = np.zeros((count, SUMS))
        middles = np.empty(self.shape, np.float32)
        self.workers.rows(count, lambda first, last: _kernels.kalman_frame(
            (frame.samples, frame.exposures, frame.known_us),
            (recent.store, recent.old), recent.committed, self._model, recent.tracks,
            self._states, innovations, nodes, middles, (first, last, _FRAME_BAND)),
            least=1, row_ns=_FRAME_NS * _FRAME_BAND * self.shape[1])
        for sums in innovations:
            self._innovations[:SUMS] += sums
        self._lasting.add_frame(middles)

    def assign(self, other: Reconstructor) -> None:
        """Take over the state of an equal filter (see `Reconstructor.assign`)."""
        if not isinstance(other, KalmanFilter) or other.shape != self.shape:
            raise ValueError(f"other must be an equal KalmanFilter, got {other!r}")
        self._take(other)
        self._saturated.assign(other._saturated)

    def _take(self, other: KalmanFilter) -> None:
        """Copy the state of another filter, except that of saturated pixels."""
        self._noise, self._bandwidth = other._noise, other._bandwidth
        self._refractory_us = other._refractory_us
        self._jitter_us = other._jitter_us
        self._theta_on, self._theta_off = other._theta_on, other._theta_off
        self._sigma = other._sigma
        np.copyto(self._tuning, other._tuning)
        np.copyto(as_bytes(self._states), as_bytes(other._states))
        np.copyto(self._innovations, other._innovations)
        self._clock.last_us, self._epoch_us = other._clock.last_us, other._epoch_us
        self._interval_us, self._mid_us = other._interval_us, other._mid_us
        self._frames = other._frames
        self._tracks.assign(other._tracks)
        self._tracks.refractory_us = other._refractory_us
        self._lamp.restore(other._lamp.state())
        if self._smoother is not None and other._smoother is not None:
            self._smoother.assign(other._smoother)
        self._lasting.assign(other._lasting)
        self._changed()

    def _state(self) -> State:
        smoother = self._smoother
        return {"last_us": self._clock.last_us, "epoch_us": self._epoch_us,
                "interval_us": self._interval_us, "mid_us": self._mid_us,
                "frames": self._frames, "tracks": self._tracks.state(),
                "states": as_bytes(self._states).copy(), "lamp": self._lamp.state(),
                "innovations": self._innovations.copy(),
                "tuning": as_bytes(self._tuning).copy(),
                "saturated": self._saturated.state(),
                "smoother": None if smoother is None else smoother.state(),
                "lasting": self._lasting.state()}

    def _restore(self, state: State) -> None:
        self._clock.last_us, self._epoch_us = state["last_us"], state["epoch_us"]
        self._interval_us, self._mid_us = state["interval_us"], state["mid_us"]
        self._frames = state["frames"]
        self._tracks.restore(state["tracks"])
        as_bytes(self._states)[:] = state["states"]
        np.copyto(self._innovations, state["innovations"])
        as_bytes(self._tuning)[:] = state["tuning"]
        self._lamp.restore(state["lamp"])
        self._saturated.restore(state["saturated"])
        if self._smoother is not None:
            self._smoother.restore(state["smoother"])
        self._lasting.restore(state["lasting"])
        self._changed()
