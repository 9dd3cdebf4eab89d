"""What a method must know of the camera, where the caller does not say it.

A `SelfCalibration` looks at a recording's beginning before the first image, or, with
``causal``, on while the stream passes.
"""
from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.calibration.corrected import FrameCorrection
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import resolve_thresholds
from pdavis_cv.fusion.feed import Feed
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.fusion.tuning import Tuning
from pdavis_cv.reconstruct.base import Needs
from pdavis_cv.reconstruct.kalman import CALIBRATED_NOISE, NOISE
from pdavis_cv.reconstruct.lamp import LampTracker
from pdavis_cv.reconstruct.stream_clock import checked_bandwidth
from pdavis_cv.recording.base import ApsFrame, Packet, Recording, Source
from pdavis_cv.selfcal import (
    LEAK_HZ,
    TYPICAL_BANDWIDTH,
    Bandwidth,
    CameraEstimate,
    ClockOffset,
    SelfCalibration,
)
from pdavis_cv.selfcal.estimator import QUANTITIES
from pdavis_cv.selfcal.noise import LEAST_NOISE
from pdavis_cv.selfcal.priors import (
    CLOCK_OFFSET_SIGMA_US,
    THRESHOLD_SIGMA,
    USUAL_MISMATCH,
)
from pdavis_cv.selfcal.refractory import Refractory
from pdavis_cv.sensor import NOMINAL_THRESHOLDS, Sensor

__all__ = ["FIRST_LOOK_S", "Learning", "OnlineLearning", "Tuning",
           "bandwidth_in_situ", "clock_offset_in_situ", "thresholds_in_situ"]

FIRST_LOOK_S = 0.5
"""The passing stream is first looked at so long after the first frame, s of stream
time, and then at twice, four times ... that."""

_TIME_TO_TELL = 8
"""What a look tells is computed beside the stream and gone on with after an eighth of
the look's time more: at 1 Mev/s it takes .03 s of processor time at .5 s, .2 to .3 s
from 2 s on, for which images need not wait.  Told at once, left-out frames of
`davis346.aedat4` would be predicted with .355 for .360; after a quarter, .366."""

_WORTHWHILE = 0.05
"""A change of the ln of the corner frequency by less is not worth a change."""

_SIGMAS = 3.0
"""A refractory period that differs by less is the same."""

_KNOWN_SIGMA = 0.0005
"""Prior sigma (ln units) of a calibration's thresholds that come without one."""

_COMMON_ERROR = math.sqrt(2)
"""ON and OFF thresholds of a pixel err together, in their scale.  The filter takes the
errors as independent, which understates the scale's sigma by this factor."""


class Learning:
    """What is to be learned for a method, and how an estimate changes its tuning.

    Parameters
    ----------
    source : Source
    options : FusionOptions
    parameters : mapping of str to object
        Of the method, as the caller gives them.
    needs : Needs
        Of the method.

    Raises
    ------
    TypeError, ValueError
        If thresholds or a bandwidth are asked for that cannot be had.
    """

    def __init__(
        self, source: Source, options: FusionOptions, parameters: Mapping[str, Any],
        needs: Needs,
    ) -> None:
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
        wanted = {name for name in needs.learned if name not in known}
        if wanted == {"refractory_us"}:
            wanted = set()      # alone it is not worth to look ahead for
        if options.thresholds == "in-situ":
            # A stream that passes is not kept for what each pixel needs.
            wanted.add("scale" if options.causal else "thresholds")
        elif wanted and options.thresholds is None and (
                self._calibration is None or self._calibration.theta_on is None):
            wanted.add("scale")     # of what only biases or data sheet say
        clock = _stated_clock(options)
        if needs.learned and clock is None:
            wanted.add("clock_offset")
        self.wanted = frozenset(wanted) if source.info.frame_count != 0 else frozenset()
        self._stated = _stated_bandwidth(self._calibration)
        if "bandwidth" in wanted:
            # Nothing is known yet of what follows at once: the usual camera's then.
            known["bandwidth"] = self._stated or (
                TYPICAL_BANDWIDTH if options.causal else None)
        if "refractory_us" in wanted:
            known["refractory_us"] = 0.0
        if "noise" in wanted:
            known["noise"] = self._noise(0.0)
        self.prior = Tuning(on, off, known, clock or ClockOffset(
            0.0, CLOCK_OFFSET_SIGMA_US))

    def _of_calibration(self, options: FusionOptions) -> dict[str, Any]:
        """Return what calibration and sensor say; learned bandwidths are left out."""
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
        """Return what is to look on; it has seen nothing yet."""
        return SelfCalibration(
            self._info.sensor_size, (self.prior.theta_on, self.prior.theta_off),
            sensor=self._info.sensor, stated_bandwidth=self._stated,
            dark=self._calibration is not None and self._calibration.dark is not None,
            every_pixel="thresholds" in self.wanted)

    def estimate(self, camera: SelfCalibration) -> CameraEstimate:
        """Return what an estimator that has looked on tells."""
        wanted = set(self.wanted)
        if "bandwidth" not in self.prior.parameters:
            wanted.add("bandwidth")      # the method asks for none, thresholds need it
        return camera.estimate(
            wanted=wanted, bandwidth=self.prior.parameters.get("bandwidth"))

    def beginning(self, source: Source, packets: Iterator[Packet]) -> Tuning:
        """Return the tuning by what the beginning of a source tells.

        The estimate of a recording is kept: asked for again, nothing is read.

        Parameters
        ----------
        source : Source
        packets : iterator of Packet
            Of the source; read as far as the estimator's window reaches.
        """
        if not self.wanted:
            return self.prior
        kept = _kept.setdefault(source, {})
        key = self._key()
        if key not in kept:
            camera = self.estimator()
            _look_on(camera, source, packets, self._calibration,
                     (self.prior.theta_on, self.prior.theta_off))
            # With the calibration, whose identity is part of the key.
            kept[key] = self.estimate(camera), self._calibration
        return self.tuned(self.prior, kept[key][0])

    def _key(self) -> tuple[Any, ...]:
        bandwidth = self.prior.parameters.get("bandwidth")
        return (self.wanted, id(self._calibration),
                None if bandwidth is None else tuple(bandwidth),
                "bandwidth" in self.prior.parameters,
                *(np.asarray(theta, np.float64).tobytes()
                  for theta in (self.prior.theta_on, self.prior.theta_off)))

    def tuned(self, tuning: Tuning, estimate: CameraEstimate) -> Tuning:
        """Return a tuning with what an estimate tells in place of what it was."""
        found: dict[str, Any] = {}
        if "bandwidth" in self.wanted and estimate.bandwidth is not None:
            found["bandwidth"] = (*estimate.bandwidth.law, estimate.bandwidth.sigma)
        if "noise" in self.wanted and estimate.noise is not None:
            found["noise"] = self._noise(estimate.noise)
        scaled = "scale" in self.wanted and estimate.common_scale_sigma > 0
        if "refractory_us" in self.wanted and estimate.refractory is not None:
            found["refractory_us"] = estimate.refractory.us
        if "thresholds" in self.wanted or scaled:
            tuning = dataclasses.replace(
                tuning, theta_on=estimate.theta_on.astype(np.float32),
                theta_off=estimate.theta_off.astype(np.float32))
            if "threshold_sigma" in self._needs.prior:
                found["threshold_sigma"] = self.prior.parameters.get(
                    "threshold_sigma", _sigma_of(estimate))
        elif ("scale" in self.wanted and not tuning.has_thresholds_of(self.prior)
              and (estimate.nominal_holds or "refractory_us" in found)):
            # Less told another scale, or what resets hide made it.
            tuning = dataclasses.replace(
                tuning, theta_on=self.prior.theta_on, theta_off=self.prior.theta_off)
            if "threshold_sigma" in self._needs.prior:
                found["threshold_sigma"] = self.prior.parameters.get(
                    "threshold_sigma", THRESHOLD_SIGMA)
        if estimate.clock_offset is not None:
            tuning = dataclasses.replace(tuning, clock=estimate.clock_offset)
        return tuning.changed(**found)

    def _noise(self, of_events: float) -> tuple[float, ...]:
        """Return `noise` of `KalmanFilter`, with that of the events as it was found.

        The lowest value that is ever found stands for all that is less.
        """
        exact = self._calibration is not None and self._calibration.analyser is not None
        sigma, per_s, *rest = CALIBRATED_NOISE if exact else NOISE
        return sigma, of_events if of_events > LEAST_NOISE else per_s, *rest


_kept: weakref.WeakKeyDictionary[
    Source, dict[tuple[Any, ...], tuple[CameraEstimate, Calibration | None]]
] = weakref.WeakKeyDictionary()


def _sigma_of(estimate: CameraEstimate) -> NDArray[np.float64]:
    """Return threshold_sigma of a filter that takes ON and OFF as independent.

    The ratio is known far better than the scale: independent errors that give the
    ratio's sigma keep what is known of it.  Where only the common scale is known, a
    pixel differs from it by the usual mismatch.  Shape (2, H, W).
    """
    relative = (
        _COMMON_ERROR * math.hypot(USUAL_MISMATCH, estimate.common_scale_sigma)
        if estimate.covariance is None else estimate.ratio_sigma / math.sqrt(2))
    return np.stack([estimate.theta_on, estimate.theta_off]) * relative


class OnlineLearning:
    """Learns while a stream passes: at stated times of the stream, from what passed.

    The estimator is fed what the state of the method is fed.  What it tells at a look
    is computed in a thread; at a stated time after the look the tuning may change, the
    state goes on with it, and the past is left as it is.

    Parameters
    ----------
    learning : Learning
    """

    def __init__(self, learning: Learning) -> None:
        self._learning = learning
        self.tuning = learning.prior
        self.camera = learning.estimator()
        self.next_us: int | None = None
        self._start_us: int | None = None
        self._looks = 0
        self._told: Future[CameraEstimate] | None = None

    def saw_frame(self, mid_us: int, now_us: int) -> None:
        """Note that a frame passed: the first one sets the times of the looks."""
        if self._start_us is None:
            self._start_us = mid_us
            while self._look_us() < now_us:
                self._looks += 1
            self.next_us = self._look_us()

    def _look_us(self) -> int:
        assert self._start_us is not None
        return self._start_us + round(1e6 * FIRST_LOOK_S * 2.0 ** self._looks)

    def look(self) -> dict[str, Any]:
        """Do what is due at `next_us`; return the parameters that change by it.

        Begin to estimate from what has passed, or go on with what that told.
        """
        assert self.next_us is not None
        assert self._start_us is not None
        before = self.tuning
        if self._told is None:
            self._told = self._begun()
            self.next_us += (self.next_us - self._start_us) // _TIME_TO_TELL
            return {}
        estimate, self._told = self._told.result(), None
        clock = estimate.clock_offset
        if clock is not None and clock.ambiguous:
            estimate = dataclasses.replace(estimate, bandwidth=None)
        if clock is not None and clock.sigma_us > before.clock.sigma_us:
            estimate, clock = dataclasses.replace(estimate, clock_offset=None), None
        if estimate.refractory is not None and not _is_other(
                estimate.refractory, before.parameters.get("refractory_us", 0.0)):
            estimate = dataclasses.replace(estimate, refractory=None)
        moved = clock is not None and clock.applied_us != before.clock_us
        # What was found of the lag with other stamps holds no more.
        known = before.parameters.get("bandwidth")
        if (estimate.bandwidth is not None and known is not None and not moved
                and not _is_news(estimate.bandwidth, checked_bandwidth(known))):
            estimate = dataclasses.replace(estimate, bandwidth=None)
        self.tuning = self._learning.tuned(before, estimate)
        self._looks += 1
        self.next_us = self._look_us()
        return self.tuning.changes(before)

    def _begun(self) -> Future[CameraEstimate]:
        """Begin to estimate from what has passed, in a thread."""
        passed = self.camera.state()

        def estimated() -> CameraEstimate:
            """Estimate from a copy, while the camera looks on."""
            camera = self._learning.estimator()
            camera.restore(passed)
            return self._learning.estimate(camera)

        one = ThreadPoolExecutor(1, "pdavis-learning")
        told = one.submit(estimated)
        one.shutdown(wait=False)
        return told

    def state(self) -> Mapping[str, Any]:
        """Return everything that passing data change; arrays in it never change."""
        return {"tuning": self.tuning, "next_us": self.next_us,
                "start_us": self._start_us, "looks": self._looks,
                "told": None if self._told is None else self._told.result(),
                "camera": self.camera.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what `state` returned."""
        self.tuning, self.next_us = state["tuning"], state["next_us"]
        self._start_us, self._looks = state["start_us"], state["looks"]
        self._told = None
        if state["told"] is not None:
            self._told = Future()
            self._told.set_result(state["told"])
        self.camera.restore(state["camera"])


def _is_news(found: Bandwidth, known: Sequence[float]) -> bool:
    """Tell whether a bandwidth is better known than before, and another one."""
    if found.sigma > known[2]:
        return False
    level = found.at_intensity * np.array([1.0, 10.0])
    change = np.log((found.hz + found.hz_per_intensity * level)
                    / (known[0] + known[1] * level))
    return bool(np.abs(change).max() > _WORTHWHILE
                or found.sigma < known[2] / 2)


def _is_other(found: Refractory, known_us: float) -> bool:
    """Tell whether a refractory period is another one than was known."""
    return abs(found.us - known_us) > max(
        _SIGMAS * found.sigma_us if found.us else 0.0, _WORTHWHILE * known_us)


def _stated_clock(options: FusionOptions) -> ClockOffset | None:
    """Return what is to be added to frames' stamps, None if it is to be learned."""
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
    """Return (hz, hz_per_intensity, sigma), None where one of them is not stated."""
    if calibration is None or calibration.bandwidth_sigma is None:
        return None
    hz, per_dn = calibration.bandwidth_hz, calibration.bandwidth_hz_per_dn
    if hz is None and per_dn is None:
        return None
    return hz or 0.0, per_dn or 0.0, calibration.bandwidth_sigma


def _look_on(
    camera: SelfCalibration, source: Source, packets: Iterator[Packet],
    calibration: Calibration | None, thresholds: tuple[ArrayLike, ArrayLike],
    start_us: int | None = None, stop_us: int | None = None,
) -> None:
    """Let an estimator see frames, events and lamp until its window is full."""
    lamp = LampTracker(source.info.sensor_size, *thresholds)
    feed = Feed(packets, by_arrival=False, has_frames=source.info.frame_count != 0,
                after_us=None if start_us is None else start_us - 1,
                frames_after_us=start_us)
    corrected = FrameCorrection(calibration)
    for item in feed.until(stop_us):
        if isinstance(item, ApsFrame):
            camera.add_frame(corrected(item))
        else:
            for wave in lamp.push(item):
                camera.add_wave(wave)
            camera.add_events(item)
        if camera.full:
            return


def thresholds_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = (0.2, 0.2),
    sigma: float = THRESHOLD_SIGMA,
    bandwidth: Bandwidth | str | None = "in-situ",
    calibration: Calibration | None = None,
    leak_hz: tuple[float, float] = LEAK_HZ,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> CameraEstimate:
    """Estimate each pixel's thresholds from its events and the de-blurred frames.

    The difference between two frames must be theta_on N_on - theta_off N_off; a
    Kalman filter per pixel adds up what all frames say about it.  Pixels then borrow
    from each other: the spread over the chip is estimated too, and where the
    recording says little the estimate stays near `nominal`.

    Parameters
    ----------
    recording : Recording
        With frames and events; the light must change.
    nominal : (on, off)
        Expected thresholds, scalars or (H, W).
    sigma : float
        How far a pixel may lie from them at first, natural-log units.
    bandwidth : Bandwidth, "in-situ" or None
        Of the photoreceptors; estimated first, or lag is neglected.
    calibration : Calibration, optional
        Its dark, gain and clip level are applied to the frames.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.  The mean is
        taken out, the rest counts: a turning polarizer does not tell the leak.
    start_us, stop_us : int, optional
        The part to look at, at most 10 s and 5 million events of it; default: from
        the beginning.

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
    camera = _that_looked_on(recording, nominal, calibration, start_us, stop_us,
                             leak_hz=leak_hz, threshold_sigma=sigma)
    if isinstance(bandwidth, str):
        return camera.estimate(wanted=QUANTITIES)
    found = camera.estimate(wanted=QUANTITIES - {"bandwidth"}, bandwidth=(
        None if bandwidth is None else (*bandwidth.law, bandwidth.sigma)))
    return dataclasses.replace(found, bandwidth=bandwidth)


def bandwidth_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = (0.2, 0.2),
    calibration: Calibration | None = None,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> Bandwidth | None:
    """Estimate how fast the photoreceptors are, from frames and events alone.

    Frames have no lag: the bandwidth that makes the events of a sample of busy pixels
    agree with them best is the one.  It may be constant, in proportion to the
    intensity, or anything between.

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
        None where frames or events are too few to tell anything.
    """
    return _that_looked_on(
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
    """Estimate how far the frames' stamps are off the clock of the events.

    Events that trail frames at all intensities and speeds alike tell it; the lag of
    photoreceptors, which does nearly the same, is taken for the usual one unless it is
    seen to depend on the light.

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
        None where frames or events are too few to tell anything, or a lamp flickers:
        the times of its events say nothing of the scene's.
    """
    return _that_looked_on(
        recording, nominal, calibration, start_us, stop_us, every_pixel=False).estimate(
            wanted={"bandwidth", "scale", "clock_offset"}).clock_offset


def _that_looked_on(
    recording: Recording, nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None, start_us: int | None, stop_us: int | None,
    **options: Any,
) -> SelfCalibration:
    camera = SelfCalibration(
        recording.info.sensor_size, nominal, sensor=recording.info.sensor,
        dark=calibration is not None and calibration.dark is not None, **options)
    _look_on(camera, recording, recording.packets(start_us), calibration, nominal,
             start_us, stop_us)
    return camera
