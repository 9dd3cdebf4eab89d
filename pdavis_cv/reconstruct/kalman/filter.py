"""The Kalman method: de-blurred frames and events, thresholds learned on the way."""
from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, sensor_shape, whole_number
from pdavis_cv.events import FAR, checked_time, timed_events
from pdavis_cv.reconstruct.base import (
    WHOLE_SENSOR,
    Estimate,
    Needs,
    Reconstructor,
)
from pdavis_cv.reconstruct.kalman.adaptation import DOUBT, KEPT, MISFIT, SUMS, adapt
from pdavis_cv.reconstruct.kalman.event_noise import MOTION
from pdavis_cv.reconstruct.kalman.frame_noise import DN_PER_SHOT, READ_NOISE_DN
from pdavis_cv.reconstruct.kalman.saturation import VALID_VARIANCE, Saturated
from pdavis_cv.reconstruct.kalman.smoother import Smoother
from pdavis_cv.reconstruct.kalman.waiting import WaitingFrame
from pdavis_cv.reconstruct.lamp import MEMORY_US, Lamplight, Wave
from pdavis_cv.reconstruct.model import NODE_DTYPE, STATE_DTYPE, TUNING_DTYPE
from pdavis_cv.reconstruct.stream_clock import (
    NEVER,
    StreamClock,
    checked_bandwidth,
    checked_noise,
    checked_refractory,
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
"""How far ahead of an image the offline mode takes frames into account."""

NOISE = (0.01, 0.02, 0.0003)
"""Residual error of a de-blurred frame (standard deviation of log intensity); process
noise per second (leak) and per event, variance in thresholds^2.

For pixels without events: 68 to 77 % of the innovations of the real DAVIS346 are then
within one sigma.  Errors of events and motion are learned (`DOUBT`, `MOTION`); the
differences between pixels (gains, angles of polarizers) are added to images.
"""

CALIBRATED_NOISE = (0.006, 0.02, 0.000005, 0.33)
"""The same if a calibration corrects the pixels' differences: a smaller residual error,
and a third of the variance that is assumed of read and shot noise."""

STILL_US = 250_000.0
"""Gap between two events (us) at which rest and motion are as likely.  Engineering
choice: five frames of the paper's cameras; a threshold of .2 in it is .04 from frame to
frame, which frames tell better than interpolation."""
# Committed events are kept this long, and at least twice the longest exposure; before
# the first frame tells how late frames arrive, for exposures of half a second.
KEEP_US, _FIRST_KEEP_US = 100_000, 500_000
_DIM_SHARE = 0.12
"""Share of a pixel's brightest light at which a lag in inverse proportion to light is
taken.  Log intensity changes fastest in dim light: weighted by the squared slope of
ln(1 + .9 cos), the mean square of the lag is that at .12 of the brightest."""
_LOOKAHEADS = {"buffered": LOOKAHEAD_US, "causal": 0, "offline": SMOOTHING_US}
# Rows that a frame is used by at a time, and what changes all states.
_BAND = 32
_NO_NODES = np.zeros((0, 0), NODE_DTYPE)


class KalmanFilter(Reconstructor):
    """Kalman filter per pixel of log intensity and of both contrast thresholds.

    Events move the log intensity; each frame, de-blurred by the events of its own
    exposure, corrects it and the thresholds by their covariance.  Between two events
    of a pixel the intensity is interpolated, and the lag of the photoreceptor is taken
    out if its bandwidth is given.  What a lamp on the mains adds (`add_wave`) is taken
    out of the events before and put back after: less than a threshold of it shows in
    the events of some pixels only.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds to start from, positive, in natural-log units.
    mode : {"buffered", "causal", "offline"}
        "buffered" waits up to `lookahead_us` for each pixel's next event and
        interpolates; "causal" extrapolates from the last two; "offline" also lets the
        frames up to `lookahead_us` later correct what the frames before say.
    lookahead_us : int, optional
        Default 50,000 when buffered, 500,000 offline, 0 when causal (no other value
        is possible).
    threshold_sigma : float or array_like of shape (2,) or (2, H, W)
        Standard deviation of the thresholds given (ON, OFF), natural-log units;
        0 keeps them as they are.
    bandwidth : (float, float) or (float, float, float), optional
        Corner frequency of the photoreceptor in Hz, what is added to it per unit of
        intensity (Hz per DN/ms), and the relative error of both, default 0.03, which
        counts in the variance.  Default: no lag.
    noise : (float, float, float) or (float, float, float, float)
        Residual error of a de-blurred frame (standard deviation of log intensity), and
        the variance of the sum of events per second and per event, in units of the
        threshold squared; then what the variance of the frames' read and shot noise
        is multiplied by, default 1.  `CALIBRATED_NOISE` is for pixels whose responses
        are known.
    offset_dn : float
        Standard deviation of what a pixel's frames all are off by, DN; it counts in
        the variance, where light is dim above all.
    refractory_us : float
        How long a pixel is held in reset after an event, us; what light does meanwhile
        is put back by its slope before and after.
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
    without any, as in light that saturates every frame, takes its offset from the
    other three of its macropixel (`EventRedundancy`); without these it shows its last
    sample, a bound, and is not valid.  Packet borders do not change results.

    Offline, a fixed-lag smoother replaces one over the whole recording: a few frames
    away, leak and noise have moved the events' sum by as much as the error of a frame.
    Memory does not grow with the recording: 28 bytes per pixel and frame within the
    look-ahead, and 17 bytes per event.  Where frames are dim and noisy, a longer
    look-ahead averages over more of them.
    """

    method = "kalman"
    needs = Needs(lamp=True, learned=frozenset({"bandwidth", "noise", "refractory_us"}),
                  prior=frozenset({"threshold_sigma", "offset_dn"}))
    causal_parameters = MappingProxyType({"mode": "causal"})
    margin = WHOLE_SENSOR  # the noise of motion is learned from all of its innovations
    lookahead_us: int

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        mode: str = "buffered", lookahead_us: int | None = None,
        threshold_sigma: ArrayLike = THRESHOLD_SIGMA,
        bandwidth: Sequence[float] | None = None,
        noise: Sequence[float] = NOISE, offset_dn: float = 0.0,
        refractory_us: float = 0.0, response: ArrayLike | None = None,
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
        # The filter goes ahead of the smoother: it waits for next events only.
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
        self._refractory_us = checked_refractory(refractory_us)
        self._tuning = np.zeros(1, TUNING_DTYPE)
        self._tuning["offset_dn"] = self._offset_dn
        self._tuning["valid_variance"] = VALID_VARIANCE
        self._tuning["read_variance"] = READ_NOISE_DN**2
        self._tuning["shot_variance"] = 1 / DN_PER_SHOT
        self._tuning["doubt"], self._tuning["motion_variance"] = DOUBT[0], MOTION[0]
        self._tuning["still_us"] = STILL_US
        self._tuning["holds_part"] = mode == "causal"   # images know less than samples
        self._saturated = Saturated(
            self.shape, self._theta_on, self._theta_off, response, self.lookahead_us,
            self._bandwidth)
        self._begin()
        self._tune()
        self._begin_thresholds()

    def _begin(self) -> None:
        """Make what changes when the filter is fed; nothing has been yet."""
        offline = self._mode == "offline"
        self._states = np.zeros(self.shape, STATE_DTYPE)
        self._tracks = Tracks(
            self.shape, max(_FIRST_KEEP_US, KEEP_US + self._wait_us), late=offline)
        self._smoother = Smoother(self.shape) if offline else None
        self._reader = Reader(self.shape, smooth=offline)
        self._epoch_us = 0      # not before the last sample of any pixel
        self._interval_us = 0   # between the last two frames used, 0 before
        self._mid_us = NEVER    # of the last frame fed
        self._clock = StreamClock(self.shape)
        self._lamp = Lamplight()
        self._frames: tuple[WaitingFrame, ...] = ()
        self._unsampled: NDArray[np.intp] | None = None
        self._innovations = np.zeros(KEPT)
        self._fed = 0           # how often anything was
        self._scratch: tuple[KalmanFilter, int, int] | None = None

    def _tune(self) -> None:
        names = ("bandwidth_hz", "bandwidth_hz_per_intensity", "bandwidth_sigma",
                 "frame_sigma", "leak_per_s", "noise_per_event", "shot_share")
        for name, value in zip(names, (*self._bandwidth, *self._noise), strict=True):
            self._tuning[name] = value
        self._tuning["refractory_us"] = self._refractory_us
        self._tracks.refractory_us = self._refractory_us

    def _adapt(self) -> None:
        """Take the noise of events, motion and reads for what innovations say it is."""
        adapt(self._innovations, self._tuning, self._noise[2])

    def _begin_thresholds(self) -> None:
        """Set the thresholds of the states to their prior, whatever they were."""
        on, off, *sigmas = (np.broadcast_to(each, self.shape) for each in (
            self._theta_on, self._theta_off, *self._sigma))
        for first in range(0, self.shape[0], _BAND):    # as in `_give_up`
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
        """Go on with another bandwidth, noise or thresholds (see `Reconstructor`).

        Thresholds and their sigma (`theta_on`, `theta_off`, `threshold_sigma`) are a
        new prior, with which pixels begin anew; what gives it has seen what they have.
        So they do with another refractory period: thresholds made up for what was lost.
        With another bandwidth, or frames that are moved from now on, thresholds that
        were learned made up for what was wrong with the delay of events behind frames:
        they become less certain by as much.  What innovations said of noise was said
        of a wrong delay too if frames are moved, and is forgotten.
        """
        prior = {"theta_on", "theta_off", "threshold_sigma"}
        unknown = learned.keys() - self.needs.learned - prior - {"frames_moved_us"}
        if unknown:
            raise TypeError(
                "retune takes bandwidth, noise, refractory_us, theta_on, theta_off, "
                "threshold_sigma and frames_moved_us, got "
                f"{', '.join(sorted(unknown))}")
        before, moved_us = self._lags(), learned.get("frames_moved_us", 0)
        if "bandwidth" in learned:
            self._bandwidth = checked_bandwidth(learned["bandwidth"])
            self._saturated.retune(self._bandwidth)
        if moved_us or "bandwidth" in learned:
            self._give_up(np.abs(self._lags() - before + 1e-6 * moved_us))
        if moved_us:
            self._doubt_bases(1e-6 * moved_us)
            self._frames = ()   # what waits has the stamps of before
        if "refractory_us" in learned:
            before_us, self._refractory_us = self._refractory_us, checked_refractory(
                learned["refractory_us"])
            self._doubt_sums(abs(self._refractory_us - before_us))
        if moved_us or "refractory_us" in learned:
            self._innovations[MISFIT:] = 0
            self._adapt()
        if not prior.isdisjoint(learned) or "refractory_us" in learned:
            for name in ("theta_on", "theta_off"):
                if name in learned:
                    setattr(self, f"_{name}", checked_threshold(
                        name, learned[name], self.shape))
            if "threshold_sigma" in learned:
                self._sigma = checked_threshold_sigma(
                    learned["threshold_sigma"], self.shape)
            self._begin_thresholds()
        if "noise" in learned:
            self._noise = checked_noise(learned["noise"])
        self._tune()
        self._changed()

    def _lags(self) -> NDArray[np.float64]:
        """Return the time constant of every pixel in dim light, s; 0 for none."""
        light = self.intensity(self._states["base"].astype(np.float32))
        hz = self._bandwidth[0] + self._bandwidth[1] * _DIM_SHARE * light.astype(float)
        return np.divide(1 / math.tau, hz, out=np.zeros(self.shape), where=hz > 0)

    def _give_up(self, lag_error_s: NDArray[np.float64]) -> None:
        """Add to the thresholds' covariance what a wrong lag did to them.

        A lag that is wrong by dt shifts a sample by the slope of log intensity times
        dt.  Between two samples T apart the light changed by slope * T at most, so
        thresholds that explain both err by 2 dt / T, relatively.  Their error becomes
        ``kept`` times what it was plus an independent one of the prior's distribution,
        with so much variance but no more than the prior's: a covariance stays one.
        """
        if not self._interval_us:
            return                      # nothing has been learned
        errors = 2 * lag_error_s / (1e-6 * self._interval_us)
        sigmas = [np.broadcast_to(sigma, self.shape) for sigma in self._sigma]
        # By bands whose records stay in a processor's cache.
        for first in range(0, self.shape[0], _BAND):
            rows = slice(first, first + _BAND)
            states, relative = self._states[rows], errors[rows]
            for name, sigma in zip(("on", "off"), (each[rows] for each in sigmas),
                                   strict=True):
                prior = states[f"prior_{name}"].copy()
                share = np.divide(relative * prior, sigma, where=sigma > 0,
                                  out=np.zeros_like(prior))
                part = np.minimum(share**2, 1)
                kept = np.sqrt(1 - part)
                states[f"theta_{name}"] = prior + kept * (
                    states[f"theta_{name}"] - prior)
                states[f"var_{name}"] = (
                    (1 - part) * states[f"var_{name}"] + part * sigma**2)
                states[f"cov_base_{name}"] *= kept
                states["cov_on_off"] *= kept

    def _doubt_bases(self, error_s: float) -> None:
        """Add to the variance of the bases what frames that far off did to them.

        The slope of log intensity is that of the events between frames so far.
        """
        states = self._states
        theta = 0.5 * (states["theta_on"] + states["theta_off"])
        events = (states["seen_on"] + states["seen_off"]) / np.maximum(
            states["samples"], 1)
        if self._interval_us:
            states["var_base"] += (
                1e6 * error_s / self._interval_us * events * theta)**2

    def _doubt_sums(self, lost_us: float) -> None:
        """Add to the variance of the bases what sums of events lost that resets hid.

        Of each event's threshold as much as light changed by in that time; of all of
        them at most as much as if all had one sign.
        """
        states = self._states
        theta = 0.5 * (states["theta_on"] + states["theta_off"])
        events = (states["seen_on"] + states["seen_off"]) / np.maximum(
            states["samples"], 1)
        if self._interval_us:
            states["var_base"] += (
                lost_us / self._interval_us * events**2 * theta)**2

    def _changed(self) -> None:
        """Note that what was computed ahead holds no more, and states may differ."""
        self._fed += 1
        self._reader.forget()
        self._unsampled = None

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters that make an equal KalmanFilter."""
        return {"theta_on": self._theta_on, "theta_off": self._theta_off,
                "mode": self._mode, "lookahead_us": self.lookahead_us,
                "threshold_sigma": self._sigma, "bandwidth": self._bandwidth,
                "noise": self._noise, "offset_dn": self._offset_dn,
                "refractory_us": self._refractory_us,
                "response": self._saturated.response}

    @property
    def thresholds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Thresholds learned so far: (2, H, W) ON and OFF, and their covariance.

        The covariance has shape (H, W, 2, 2).
        """
        s = self._states
        covariance = [s["var_on"], s["cov_on_off"], s["cov_on_off"], s["var_off"]]
        return (np.stack([s["theta_on"], s["theta_off"]]),
                np.stack(covariance, -1).reshape(*self.shape, 2, 2))

    @property
    def misfit(self) -> NDArray[np.float64]:
        """Sums of e^2 / v and of ln v over the innovations e, and their number.

        Returns
        -------
        ndarray of float64, shape (3,)
        """
        return self._innovations[:MISFIT].copy()

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events (see `Reconstructor.add_events`)."""
        events = timed_events(events)
        self._fed += 1
        taken = self._tracks.push(events, self._clock.last_us, self._reader)
        self._saturated.add_events(events[:taken])
        try:
            self._clock.took(events, taken)
        finally:
            self._settle(self._clock.last_us)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame; it acts when the events that it needs are there.

        In mode "causal" also one that is late: when it has been read out.
        """
        first = self._mid_us == NEVER
        self._mid_us = self._clock.check_frame(
            frame, self._mid_us if self.takes_late_frames else None)
        self._fed += 1
        waiting = WaitingFrame(frame, self._wait_us)
        self._frames = (*self._frames, waiting)
        self._saturated.add_frame(
            frame, waiting.samples["log"], waiting.samples["variance"])
        longest = int(np.max(np.subtract(frame.exposure_end_us,
                                         frame.exposure_start_us)))
        delay = frame.available_us - int(np.min(frame.exposure_start_us))
        needed = max(KEEP_US + self._wait_us, 2 * longest, 2 * delay)
        keep = self._tracks
        keep.keep_us = needed if first else max(keep.keep_us, needed)

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers (see `Reconstructor.add_wave`)."""
        self._fed += 1
        self._lamp.add(wave)

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity at t_us (see `Reconstructor.read`)."""
        t = checked_time("t_us", t_us)
        seen = t + self.lookahead_us
        self._clock.check_read(seen)
        log = output(out, self.shape, np.float32)
        variance = np.empty(self.shape, np.float32)
        valid = np.empty(self.shape, np.bool_)
        due = sum(frame.known_us <= seen for frame in self._frames)
        one = self._ahead(due, seen) if due else self
        one._show(t, log, variance, valid.view(np.uint8))
        self._saturated.fill(t, one._unknown, log, variance, valid)
        return Estimate(log, variance, valid)

    def settle(self, t_us: int) -> None:
        """Use the frames that are due (see `Reconstructor.settle`)."""
        self._fed += 1
        self._clock.last_us = max(self._clock.last_us, t_us)
        self._settle(t_us)
        self._saturated.settle(t_us)

    @property
    def _unknown(self) -> NDArray[np.intp]:
        """Flat indices of the pixels without a sample, as of the last read."""
        if self._smoother is not None:
            return self._smoother.unknown
        if self._unsampled is None:
            self._unsampled = np.flatnonzero(self._states["samples"] == 0)
        return self._unsampled

    def _ahead(self, due: int, seen_us: int) -> KalmanFilter:
        """Return a filter that has used the first `due` frames that wait here."""
        if self._scratch is None:
            # What saturates is read and fed here, never there.
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
        # Reads of an earlier time than the last one may follow, down to the last seen.
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
        """Commit what lies in the past of every later read, and use due frames."""
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
            if self._unsampled is not None:     # a pixel with a sample keeps one
                samples = self._states["samples"].reshape(-1).take(self._unsampled)
                self._unsampled = self._unsampled[samples == 0]
            if smoother is not None:
                smoother.pass_until(
                    frame.known_us - self.lookahead_us, self._states)
        self._lamp.forget(seen_us - self.lookahead_us - MEMORY_US)

    def _use(self, frame: WaitingFrame, nodes: NDArray[Any]) -> None:
        """Update the states by a frame, whose events are chained."""
        recent = self._tracks
        # Sums are formed by bands that do not depend on the number of threads.
        bands = range(0, self.shape[0], _BAND)
        innovations = np.zeros((len(bands), SUMS))

        def work(first: int, last: int) -> None:
            for band in range(first, last):
                rows = slice(bands[band], bands[band] + _BAND)
                _kernels.kalman_frame(
                    (frame.samples[rows], frame.exposures, frame.known_us),
                    (recent.store, recent.old[rows]), recent.committed, self._model,
                    recent.tracks[rows], self._states[rows], innovations[band],
                    nodes[rows])

        self.workers.rows(len(bands), work, least=1)
        for sums in innovations:
            self._innovations[:SUMS] += sums

    def assign(self, other: Reconstructor) -> None:
        """Take over the state of an equal filter (see `Reconstructor.assign`)."""
        if not isinstance(other, KalmanFilter) or other.shape != self.shape:
            raise ValueError(f"other must be an equal KalmanFilter, got {other!r}")
        self._take(other)
        self._saturated.assign(other._saturated)

    def _take(self, other: KalmanFilter) -> None:
        """Take over everything but what is known of saturated pixels."""
        self._noise, self._bandwidth = other._noise, other._bandwidth
        self._refractory_us = other._refractory_us
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
        self._changed()

    def _state(self) -> Mapping[str, Any]:
        smoother = self._smoother
        return {"last_us": self._clock.last_us, "epoch_us": self._epoch_us,
                "interval_us": self._interval_us, "mid_us": self._mid_us,
                "frames": self._frames, "tracks": self._tracks.state(),
                "states": as_bytes(self._states).copy(), "lamp": self._lamp.state(),
                "innovations": self._innovations.copy(),
                "tuning": as_bytes(self._tuning).copy(),
                "saturated": self._saturated.state(),
                "smoother": None if smoother is None else smoother.state()}

    def _restore(self, state: Mapping[str, Any]) -> None:
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
        self._changed()
