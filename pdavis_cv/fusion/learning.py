"""Estimation of the camera's parameters that the caller does not state.

A `SelfCalibration` is fed the beginning of a recording before the first image;
`online_learning` feeds it the stream as it passes, with ``causal``.
"""
from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._types import Parameters
from pdavis_cv.calibration.corrected import FrameCorrection
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import resolve_thresholds, threshold_origin
from pdavis_cv.fusion.feed import Feed
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.fusion.tuning import Tuning
from pdavis_cv.pixel.learn import Priors, prior_model
from pdavis_cv.reconstruct.base import Needs
from pdavis_cv.reconstruct.kalman import CALIBRATED_NOISE, NOISE
from pdavis_cv.reconstruct.lamp import LampTracker
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA
from pdavis_cv.recording.base import ApsFrame, Packet, Recording, Source
from pdavis_cv.recording.facts import MEASURED, Fact
from pdavis_cv.selfcal import (
    LEAK_HZ,
    TYPICAL_BANDWIDTH,
    Bandwidth,
    CameraEstimate,
    ClockOffset,
    SelfCalibration,
)
from pdavis_cv.selfcal.estimator import OF_EVENTS, QUANTITIES
from pdavis_cv.selfcal.noise import LEAST_NOISE
from pdavis_cv.selfcal.priors import (
    CLOCK_OFFSET_SIGMA_US,
    THRESHOLD_SIGMA,
    USUAL_MISMATCH,
)
from pdavis_cv.sensor import NOMINAL_THRESHOLDS, Sensor

__all__ = ["Learning", "bandwidth_in_situ", "clock_offset_in_situ",
           "thresholds_in_situ"]

_KNOWN_SIGMA = 0.0005
"""Prior sigma (ln units) of thresholds from a calibration that states none."""

_COMMON_ERROR = math.sqrt(2)
"""Factor on the thresholds' sigma.  The ON and OFF thresholds of a pixel share the
error of their scale; the filter takes the errors as independent, which understates the
sigma of the scale by this factor."""


_STATED_SIGMA, _NOMINAL_SIGMA = 0.05, 0.5
"""Relative error of thresholds that were measured, and of others: those of bias or data
sheet may be wrong by half."""

_USUAL_CLOCK_US = 0.0, 5000.0
"""Offset of the frames' clock and its standard deviation, us: seen were -6 to 4 ms."""


class Learning:
    """Which parameters of a method are estimated, and how an estimate is applied.

    Parameters
    ----------
    source : Source
        The stream to reconstruct.
    options : FusionOptions
        Options of the fusion.
    parameters : mapping of str to object
        Parameters of the method that the caller states.
    needs : Needs
        Inputs that the method needs.
    lookahead_us : int or None
        That of the method.

    Raises
    ------
    TypeError, ValueError
        If thresholds or a bandwidth are requested that are not available.
    """

    def __init__(
        self, source: Source, options: FusionOptions, parameters: Parameters,
        needs: Needs, lookahead_us: int | None = 0,
    ) -> None:
        self._lookahead_us = lookahead_us or 0
        self._info, self._calibration = source.info, options.calibration
        self._needs = needs
        on, off = resolve_thresholds(
            source, options.thresholds, options.nominal_thresholds, self._calibration)
        given = dict(parameters)
        if "bandwidth" in needs.learned and given.get("bandwidth") == "in-situ":
            del given["bandwidth"]
        elif "bandwidth" in needs.learned and isinstance(given.get("bandwidth"), str):
            raise ValueError(
                "bandwidth must be 'in-situ', (hz, hz_per_intensity) or None, got "
                f"{given['bandwidth']!r}")
        known = {**self._of_calibration(options), **given}
        wanted = set(needs.learned - known.keys())
        # Others that are wanted below only tell how certain these are.
        self._learned = frozenset(wanted)
        if needs.frames and wanted <= {"jitter_us", "ratio_sigma", "refractory_us"}:
            wanted = set()      # alone they do not justify reading ahead
        if "model" in wanted:
            pass                # it has thresholds and their spread
        elif options.thresholds == "in-situ":
            # Thresholds of each pixel need a window of data that a passing stream
            # does not keep.
            wanted.add("scale" if options.causal else "thresholds")
            # Known thresholds have another spread than those that are stated.
            wanted.discard("ratio_sigma")
        elif wanted and needs.frames and options.thresholds is None and (
                self._calibration is None or self._calibration.theta_on is None):
            wanted.add("scale")     # biases or data sheet give it only roughly
            if "threshold_sigma" in needs.prior and "threshold_sigma" not in known:
                wanted.add("ratio_sigma")   # how far pixels are from that scale
        elif "ratio_sigma" in wanted and options.thresholds is None and (
                self._calibration is None or self._calibration.theta_on is None):
            wanted.add("event_scale")
        clock = _stated_clock(options)
        if needs.learned and needs.frames and clock is None:
            wanted.add("clock_offset")
        self.wanted = frozenset(
            wanted if source.info.frame_count != 0
            else wanted & OF_EVENTS & (needs.learned | {"event_scale"}))
        self.uses_frames = not self.wanted <= OF_EVENTS
        self.thresholds = Fact((on, off), MEASURED if self.wanted & {
            "scale", "thresholds", "model"} else threshold_origin(
                source, options.thresholds, options.nominal_thresholds,
                self._calibration))
        self._stated = _stated_bandwidth(self._calibration)
        self._learns = None
        if "model" in needs.learned:
            self._learns = self._priors(options, (off, on), clock)
            if "model" not in known:
                known["model"] = prior_model(self._learns, self._lookahead_us)
        if "bandwidth" in wanted:
            # Images follow before any estimate: start from a typical camera's value.
            known["bandwidth"] = self._stated or (
                TYPICAL_BANDWIDTH if options.causal else None)
        if "refractory_us" in wanted:
            known["refractory_us"] = 0.0
        if "jitter_us" in wanted:
            known["jitter_us"] = 0.0
        if "noise" in wanted:
            known["noise"] = self._noise(0.0)
        if "ratio_sigma" in wanted & self._learned:
            known["ratio_sigma"] = RATIO_SIGMA
        self.prior = Tuning(on, off, known, clock or ClockOffset(
            0.0, CLOCK_OFFSET_SIGMA_US))

    def _priors(
        self, options: FusionOptions, thetas: tuple[ArrayLike, ArrayLike],
        clock: ClockOffset | None,
    ) -> Priors:
        """Return what is known of the pixels beforehand."""
        calibration, chosen = self._calibration, options.thresholds
        measured = chosen is not None and not isinstance(chosen, str)
        if chosen in (None, "calibration") and not measured:
            measured = calibration is not None and calibration.theta_on is not None
        law = self._stated or (None if calibration is None else (
            calibration.bandwidth_hz or 0.0, calibration.bandwidth_hz_per_dn or 0.0,
            0.0))
        return Priors(
            theta=(float(np.asarray(thetas[0], float).mean()),
                   float(np.asarray(thetas[1], float).mean())),
            theta_sigma=_STATED_SIGMA if measured else _NOMINAL_SIGMA,
            clock_us=_USUAL_CLOCK_US if clock is None else (clock.us, 0.0),
            **({} if law is None or not any(law) else {
                "bandwidth": law[:2], "bandwidth_sigma": (law[2], law[2])}))

    def _of_calibration(self, options: FusionOptions) -> dict[str, Any]:
        """Return the parameters known from calibration and sensor.

        A bandwidth that comes with a standard error is left out: it is a prior only.
        """
        needs, calibration = self._needs, self._calibration
        known: dict[str, Any] = {}
        if "offset_dn" in needs.prior and (
                calibration is None or calibration.dark is None):
            known["offset_dn"] = (self._info.sensor or Sensor.PDAVIS).offset_dn
        if calibration is None:
            return known
        hz, per_dn = calibration.bandwidth_hz, calibration.bandwidth_hz_per_dn
        if "bandwidth" in needs.learned and calibration.bandwidth_sigma is None and (
                hz is not None or per_dn is not None):
            known["bandwidth"] = (hz or 0.0, per_dn or 0.0)
        if "threshold_sigma" in needs.prior and calibration.theta_on is not None and (
                options.thresholds is None or options.thresholds == "calibration"):
            on, off = calibration.theta_on_sigma, calibration.theta_off_sigma
            known["threshold_sigma"] = (
                _KNOWN_SIGMA if on is None or off is None
                else _COMMON_ERROR * np.stack([on, off]).astype(np.float64))
        return known

    def estimator(self) -> SelfCalibration:
        """Return a new estimator, to which nothing has been fed."""
        return SelfCalibration(
            self._info.sensor_size, (self.prior.theta_on, self.prior.theta_off),
            sensor=self._info.sensor, stated_bandwidth=self._stated,
            dark=self._calibration is not None and self._calibration.dark is not None,
            every_pixel="thresholds" in self.wanted,
            learns=self._learns if "model" in self.wanted else None)

    def estimate(
        self, camera: SelfCalibration, before: Tuning | None = None,
    ) -> CameraEstimate:
        """Return the estimate of an estimator that was fed, after an earlier one."""
        wanted = set(self.wanted)
        if "model" in wanted:
            return camera.estimate(
                wanted=wanted, clock_offset_us=self.prior.clock_us,
                lookahead_us=self._lookahead_us,
                before=None if before is None else before.parameters.get("model"))
        if self.uses_frames and "bandwidth" not in self.prior.parameters:
            wanted.add("bandwidth")      # the thresholds need it, if not the method
        return camera.estimate(
            wanted=wanted, bandwidth=self.prior.parameters.get("bandwidth"),
            clock_offset_us=self.prior.clock_us)

    def beginning(self, source: Source, packets: Iterator[Packet]) -> Tuning:
        """Return the tuning estimated from the beginning of a source.

        The estimate is cached by source, so that a second call reads nothing.

        Parameters
        ----------
        source : Source
            The stream to reconstruct.
        packets : iterator of Packet
            Packets of the source; read as far as the estimator's window reaches.
        """
        if not self.wanted:
            return self.prior
        kept = _kept.setdefault(source, {})
        key = self._key()
        if key not in kept:
            camera = self.estimator()
            _feed_estimator(camera, source, packets, self._calibration,
                            (self.prior.theta_on, self.prior.theta_off),
                            with_frames=self.uses_frames)
            # The calibration is kept too, as its identity is part of the key.
            kept[key] = self.estimate(camera), self._calibration
        return self.tuned(self.prior, kept[key][0])

    def _key(self) -> tuple[Any, ...]:
        bandwidth = self.prior.parameters.get("bandwidth")
        return (self.wanted, id(self._calibration), self.prior.clock_us,
                self._learns and (self._learns, self._lookahead_us),
                None if bandwidth is None else tuple(bandwidth),
                "bandwidth" in self.prior.parameters,
                *(np.asarray(theta, np.float64).tobytes()
                  for theta in (self.prior.theta_on, self.prior.theta_off)))

    def tuned(self, tuning: Tuning, estimate: CameraEstimate) -> Tuning:
        """Return a tuning in which an estimate replaces the parameters it gives."""
        found: dict[str, Any] = {}
        if "model" in self.wanted and estimate.pixels is not None:
            found["model"] = estimate.pixels.model
        if "bandwidth" in self.wanted and estimate.bandwidth is not None:
            found["bandwidth"] = (*estimate.bandwidth.law, estimate.bandwidth.sigma)
        if "noise" in self.wanted and estimate.noise is not None:
            found["noise"] = self._noise(estimate.noise)
        if "ratio_sigma" in self._learned & self.wanted and (
                estimate.ratio_spread is not None):
            found["ratio_sigma"] = estimate.ratio_spread.sigma
        scaled = estimate.common_scale_sigma > 0 and not (
            self.wanted.isdisjoint({"scale", "event_scale"}))
        if "refractory_us" in self.wanted and estimate.refractory is not None:
            found["refractory_us"] = estimate.refractory.us
        if "jitter_us" in self.wanted and estimate.jitter is not None:
            found["jitter_us"] = estimate.jitter.us
        if "thresholds" in self.wanted or scaled:
            tuning = dataclasses.replace(
                tuning, theta_on=estimate.theta_on.astype(np.float32),
                theta_off=estimate.theta_off.astype(np.float32))
            if "threshold_sigma" in self._needs.prior:
                found["threshold_sigma"] = self.prior.parameters.get(
                    "threshold_sigma", _sigma_of(estimate))
        elif "scale" in self.wanted and (estimate.nominal_sigma > 0 or (
                "refractory_us" in found and not tuning.has_thresholds_of(self.prior))):
            # They are those stated, if the scale agrees.  If an earlier estimate moved
            # it, that was on less data, or it did not yet account for the refractory
            # period.
            tuning = dataclasses.replace(
                tuning, theta_on=self.prior.theta_on, theta_off=self.prior.theta_off)
            if "threshold_sigma" in self._needs.prior:
                found["threshold_sigma"] = self.prior.parameters.get(
                    "threshold_sigma", _sigma_of_nominal(estimate))
        if estimate.clock_offset is not None:
            tuning = dataclasses.replace(tuning, clock=estimate.clock_offset)
        return tuning.changed(**found)

    def _noise(self, of_events: float) -> tuple[float, ...]:
        """Return `noise` of `KalmanFilter` with the estimated noise of events.

        The lowest grid value means "at or below the default", which is then kept.
        """
        exact = self._calibration is not None and self._calibration.analyser is not None
        sigma, per_s, *rest = CALIBRATED_NOISE if exact else NOISE
        return sigma, of_events if of_events > LEAST_NOISE else per_s, *rest


_kept: weakref.WeakKeyDictionary[
    Source, dict[tuple[Any, ...], tuple[CameraEstimate, Calibration | None]]
] = weakref.WeakKeyDictionary()


def _sigma_of(estimate: CameraEstimate) -> NDArray[np.float64]:
    """Return threshold_sigma for a filter that takes ON and OFF errors as independent.

    The ratio ON / OFF is known far better than the scale, so the independent errors are
    chosen to give the ratio its standard error.  Where only the common scale has been
    estimated, pixels differ from it by the usual mismatch.  Shape (2, H, W).
    """
    relative = (
        _COMMON_ERROR * math.hypot(USUAL_MISMATCH, estimate.common_scale_sigma)
        if estimate.covariance is None else estimate.ratio_sigma / math.sqrt(2))
    return np.stack([estimate.theta_on, estimate.theta_off]) * relative


def _sigma_of_nominal(estimate: CameraEstimate) -> float | NDArray[np.float64]:
    """Return threshold_sigma of stated thresholds, as far as their scale is known.

    The spread of the pixels' ratios is that of independent errors of ON and OFF; until
    it is known, it has the prior that `EventRedundancy` starts from.  Shape (2, H, W).
    """
    if not estimate.nominal_sigma:
        return THRESHOLD_SIGMA
    spread = estimate.ratio_spread
    mismatch = (RATIO_SIGMA if spread is None else spread.sigma) / math.sqrt(2)
    return np.stack([estimate.theta_on, estimate.theta_off]) * (
        _COMMON_ERROR * math.hypot(mismatch, estimate.nominal_sigma))


def _stated_clock(options: FusionOptions) -> ClockOffset | None:
    """Return the stated offset of the frames' clock, None if it is to be estimated."""
    stated = options.clock_offset_us
    if stated == "learned":
        known = options.calibration
        if known is None or known.clock_offset_us is None:
            return None
        stated = known.clock_offset_us
    return ClockOffset(0.0 if stated is None else float(stated), 0.0)


def _stated_bandwidth(
    calibration: Calibration | None
) -> tuple[float, float, float] | None:
    """Return (hz, hz_per_intensity, sigma); None if no bandwidth or sigma is stated."""
    if calibration is None or calibration.bandwidth_sigma is None:
        return None
    hz, per_dn = calibration.bandwidth_hz, calibration.bandwidth_hz_per_dn
    if hz is None and per_dn is None:
        return None
    return hz or 0.0, per_dn or 0.0, calibration.bandwidth_sigma


def _feed_estimator(
    camera: SelfCalibration, source: Source, packets: Iterator[Packet],
    calibration: Calibration | None, thresholds: tuple[ArrayLike, ArrayLike],
    start_us: int | None = None, stop_us: int | None = None, with_frames: bool = True,
) -> None:
    """Feed frames, events and the lamp to an estimator until its window is full."""
    lamp = LampTracker(source.info.sensor_size, *thresholds)
    feed = Feed(packets, by_arrival=False, has_frames=source.info.frame_count != 0,
                after_us=None if start_us is None else start_us - 1,
                frames_after_us=start_us)
    corrected = FrameCorrection(calibration)
    for item in feed.until(stop_us):
        if isinstance(item, ApsFrame):
            if with_frames:
                camera.add_frame(corrected(item))
        else:
            for wave in lamp.push(item):
                camera.add_wave(wave)
            camera.add_events(item)
        if camera.full or (not with_frames and camera.full_without_frames):
            return


def thresholds_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS,
    sigma: float = THRESHOLD_SIGMA,
    bandwidth: Bandwidth | str | None = "in-situ",
    calibration: Calibration | None = None,
    leak_hz: tuple[float, float] = LEAK_HZ,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> CameraEstimate:
    """Estimate each pixel's thresholds from its events and the de-blurred frames.

    The difference between two frames must be theta_on N_on - theta_off N_off; a
    Kalman filter per pixel combines all frames.  The distribution of the thresholds
    over the chip is then estimated from all pixels and serves as their prior (empirical
    Bayes), so that a pixel with few data stays near the others and near `nominal`.

    Parameters
    ----------
    recording : Recording
        With frames and events; the light must change.
    nominal : (on, off)
        Expected thresholds, scalars or (H, W).
    sigma : float
        Prior standard deviation of a pixel's thresholds, natural-log units.
    bandwidth : Bandwidth, "in-situ" or None
        Bandwidth of the photoreceptors; "in-situ" estimates it first, and None
        neglects the lag.
    calibration : Calibration, optional
        Its dark, gain and clip level are applied to the frames.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.  The mean is
        subtracted and the standard deviation adds to the uncertainty, as light from a
        rotating polarizer does not determine the leak.
    start_us, stop_us : int, optional
        The part of the recording to use, of which at most 10 s and 5 million events
        are read; default: from the beginning.

    Returns
    -------
    CameraEstimate

    Raises
    ------
    ValueError
        If ``sigma`` is not positive, ``bandwidth`` is another word, or ``leak_hz`` is
        not two numbers of at least 0.
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    if isinstance(bandwidth, str) and bandwidth != "in-situ":
        raise ValueError(
            f"bandwidth must be 'in-situ', a Bandwidth or None, got {bandwidth!r}")
    camera = _fed_estimator(recording, nominal, calibration, start_us, stop_us,
                            leak_hz=leak_hz, threshold_sigma=sigma)
    if isinstance(bandwidth, str):
        return camera.estimate(wanted=QUANTITIES)
    found = camera.estimate(wanted=QUANTITIES - {"bandwidth"}, bandwidth=(
        None if bandwidth is None else (*bandwidth.law, bandwidth.sigma)))
    return dataclasses.replace(found, bandwidth=bandwidth)


def bandwidth_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS,
    calibration: Calibration | None = None,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> Bandwidth | None:
    """Estimate the bandwidth of the photoreceptors from frames and events alone.

    Frames have no lag, so the estimate is the bandwidth with which the events of a
    sample of busy pixels agree best with them.  It may be constant, proportional to
    the intensity, or anything between.

    Parameters
    ----------
    recording : Recording
        With frames and events; the light must change.
    nominal : (on, off)
        Expected thresholds, scalars or (H, W).
    calibration : Calibration, optional
        Its dark, gain and clip level are applied to the frames.
    start_us, stop_us : int, optional
        The part to look at; as for `thresholds_in_situ`.

    Returns
    -------
    Bandwidth or None
        None if there are too few frames or events for an estimate.
    """
    return _fed_estimator(
        recording, nominal, calibration, start_us, stop_us, every_pixel=False).estimate(
            wanted={"bandwidth", "clock_offset"}).bandwidth


def clock_offset_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS,
    calibration: Calibration | None = None,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> ClockOffset | None:
    """Estimate the offset between the frames' time stamps and the clock of the events.

    A clock offset shows as events that trail the frames equally at all intensities and
    speeds.  The lag of the photoreceptors looks nearly the same; it is assumed to be
    the usual one, unless it can be seen to depend on the light.

    Parameters
    ----------
    recording : Recording
        With frames and events; the light must change.
    nominal : (on, off)
        Expected thresholds, scalars or (H, W); their common scale is found too.
    calibration : Calibration, optional
        Its dark, gain and clip level are applied to the frames.
    start_us, stop_us : int, optional
        The part to look at; as for `thresholds_in_situ`.

    Returns
    -------
    ClockOffset or None
        None if there are too few frames or events for an estimate, or if a lamp
        flickers, because its events hide the timing of the scene's.
    """
    return _fed_estimator(
        recording, nominal, calibration, start_us, stop_us, every_pixel=False).estimate(
            wanted={"bandwidth", "scale", "clock_offset"}).clock_offset


def _fed_estimator(
    recording: Recording, nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None, start_us: int | None, stop_us: int | None,
    **options: Any,
) -> SelfCalibration:
    camera = SelfCalibration(
        recording.info.sensor_size, nominal, sensor=recording.info.sensor,
        dark=calibration is not None and calibration.dark is not None, **options)
    _feed_estimator(camera, recording, recording.packets(start_us), calibration,
                    nominal, start_us, stop_us)
    return camera
