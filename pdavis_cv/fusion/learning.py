"""Estimation of the camera's parameters that the caller does not state.

A `PixelSample` is fed the beginning of a recording before the first image;
`online_learning` feeds it the stream as it passes, with ``causal``.
"""
from __future__ import annotations

import dataclasses
import itertools
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._types import Events, Parameters
from pdavis_cv.calibration.corrected import FrameCorrection
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import Theta, resolve_thresholds, threshold_origin
from pdavis_cv.fusion.events_alone import event_scale, ratio_spread
from pdavis_cv.fusion.feed import Feed
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.pixel.learn import LearnedPixels, Priors, learn, prior_model
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.pixel.sample import PixelSample
from pdavis_cv.reconstruct.base import Needs
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA
from pdavis_cv.recording.base import ApsFrame, Packet, Recording, Source
from pdavis_cv.recording.facts import ASSUMED, MEASURED, Fact
from pdavis_cv.sensor import NOMINAL_THRESHOLDS

_OF_EVENTS = frozenset({"event_scale", "ratio_sigma"})
"""What is learned from events alone: the scale of the thresholds, and the spread of the
pixels' ratios of them.  Frames tell "model", or "thresholds" for other methods."""

_STATED_SIGMA, _NOMINAL_SIGMA = 0.05, Priors.theta_sigma
"""Relative error of thresholds that were measured, and of others: those of bias or data
sheet may be wrong by half.  Told to 5 %, half and twice of it change errors of AoP by
x 1.003 and 1.026 (five cells, seeds 1001 to 1003)."""

MEASURED_RATIO = 1.25
"""Thresholds from which learning starts where nobody states any, in those of data
sheets, .2: the geometric mean of these and of what was measured (ON/OFF .29/.32 and
.29/.37 of two DAVIS346, .25/.38 of an IMX636)."""

_OWN_ERROR = 0.02
"""Relative error of a pixel's threshold that the filter's variance lacks: ratios of ON
and OFF err by .025 (rms) on `nominal` cameras before a polarizer at 30 to 200 RPM."""

_CLOCK_SIGMA_US = 5000.0
"""Standard deviation of the offset of the frames' clock: seen were -6 to 4 ms."""

_UNSET = object()


@dataclass(frozen=True, eq=False)
class Tuning:
    """The camera's parameters that a method is made with, as known at one time.

    Parameters
    ----------
    theta_on, theta_off : float or ndarray of float32, shape (H, W)
        Contrast thresholds, natural-log units.
    parameters : mapping of str to object
        Further parameters of the method.
    clock_us : int
        Offset of the frames' clock, which is added to their exposure times, us.
    pixels : LearnedPixels or None
        What `parameters` and the offset were learned as, with their errors.
    """

    theta_on: Theta
    theta_off: Theta
    parameters: Parameters
    clock_us: int
    pixels: LearnedPixels | None = None

    @property
    def photoreceptors(self) -> tuple[Theta, Theta, tuple[float, float] | None]:
        """Thresholds, ON and OFF, and bandwidth, by whichever the method knows."""
        model: PixelModel | None = self.parameters.get("model")
        if model is None:
            return self.theta_on, self.theta_off, self.parameters.get("bandwidth")
        return float(model.thresholds[1]), float(model.thresholds[0]), model.bandwidth

    def changes(self, before: Tuning) -> dict[str, Any]:
        """Return the parameters to `retune` a method with that has another tuning."""
        out = {name: value for name, value in self.parameters.items()
               if not np.array_equal(value, before.parameters.get(name, _UNSET))}
        for name in ("theta_on", "theta_off"):
            value = getattr(self, name)
            if not np.array_equal(value, getattr(before, name)):
                out[name] = value
        return out

    def changed(self, **parameters: Any) -> Tuning:
        """Return the tuning with other parameters."""
        return dataclasses.replace(self, parameters={**self.parameters, **parameters})


@dataclass(frozen=True, eq=False, kw_only=True)
class Learned:
    """What a stream told; None: it did not, or was not asked.

    Parameters
    ----------
    pixels : LearnedPixels or None
        From frames and events.
    ratio_sigma : float or None
        Spread of the pixels' ratios, as `EventRedundancy` takes it.
    scale : float or None
        Factor on the thresholds.
    thetas : ndarray of float64, shape (2, H, W), or None
        Thresholds of each pixel, ON and OFF.
    """

    pixels: LearnedPixels | None = None
    ratio_sigma: float | None = None
    scale: float | None = None
    thetas: NDArray[np.float64] | None = None


class Learning:
    """Which parameters of a method are estimated, and how an estimate is applied.

    `parameters` are those of the method that the caller states.  If thresholds are
    requested that are not available, that is an error.
    """

    def __init__(
        self, source: Source, options: FusionOptions, parameters: Parameters,
        needs: Needs, lookahead_us: int | None = 0,
    ) -> None:
        self._lookahead_us = lookahead_us or 0
        self._info, self._calibration = source.info, options.calibration
        on, off = resolve_thresholds(
            source, options.thresholds, options.nominal_thresholds, self._calibration)
        known = dict(parameters)
        wanted = set(needs.learned - known.keys())
        unknown = options.thresholds is None and (
            self._calibration is None or self._calibration.theta_on is None)
        if needs.frames and wanted <= {"ratio_sigma"}:
            wanted = set()      # alone it does not justify reading ahead
        if "model" in wanted:
            pass                # it has the thresholds
        elif options.thresholds == "in-situ":
            # Known thresholds have another spread than those that are stated.
            wanted = {"thresholds"}
        elif "ratio_sigma" in wanted and unknown:
            wanted.add("event_scale")
        if source.info.frame_count == 0:
            wanted &= _OF_EVENTS
        self.wanted = frozenset(wanted)
        self.uses_frames = not self.wanted <= _OF_EVENTS
        origin = threshold_origin(source, options.thresholds,
                                  options.nominal_thresholds, self._calibration)
        if origin == ASSUMED and "model" in needs.learned:
            on, off = _scaled(on, MEASURED_RATIO), _scaled(off, MEASURED_RATIO)
        self.thresholds = Fact((on, off), MEASURED if self.wanted & {
            "model", "thresholds"} else origin)
        clock = _stated_clock(options)
        self._priors = _priors(options.thresholds, self._calibration, on, off, clock)
        if "model" in needs.learned and "model" not in known:
            known["model"] = prior_model(self._priors, self._lookahead_us)
        if "ratio_sigma" in self.wanted:
            known["ratio_sigma"] = RATIO_SIGMA
        self.prior = Tuning(on, off, known, round(clock[0]))

    def sample(self) -> PixelSample:
        """Return what the stream is fed to, empty."""
        return PixelSample(self._info.sensor_size)

    def estimate(self, sample: PixelSample, before: Tuning | None = None) -> Learned:
        """Return what a sample tells, after an earlier one."""
        nominal, wanted = (self.prior.theta_on, self.prior.theta_off), self.wanted
        spread = ratio_spread(sample, nominal) if "ratio_sigma" in wanted else None
        pixels = None
        if self.uses_frames:
            pixels = learn(sample, self._priors, self._lookahead_us,
                           None if before is None else before.pixels)
        scale = None
        stated = self._priors.theta_sigma < _NOMINAL_SIGMA
        if "event_scale" in wanted or (
                pixels is not None and pixels.told and not stated):
            scale = event_scale(sample, nominal)
        if scale is not None and not scale.significant:
            scale = None
        if pixels is not None and scale is not None:
            pixels = pixels.scaled(scale.factor, scale.sigma)
        return Learned(
            pixels=pixels, ratio_sigma=None if spread is None else spread.sigma,
            scale=None if scale is None else scale.factor)

    def beginning(self, source: Source, packets: Iterator[Packet]) -> Tuning:
        """Return the tuning estimated from the beginning of a source.

        Its packets are read as far as the sample's window reaches.  The estimate is
        cached by source, so that a second call reads nothing.
        """
        if not self.wanted:
            return self.prior
        kept = _kept.setdefault(source, {})
        key = (self.wanted, id(self._calibration), self._priors, self._lookahead_us,
               *(np.asarray(theta, np.float64).tobytes()
                 for theta in (self.prior.theta_on, self.prior.theta_off)))
        if key not in kept:
            # The calibration is kept too, as its identity is part of the key.
            kept[key] = self._of_beginning(source, packets), self._calibration
        return self.tuned(self.prior, kept[key][0])

    def _of_beginning(self, source: Source, packets: Iterator[Packet]) -> Learned:
        sample = self.sample()
        packets, again = itertools.tee(packets)
        if "thresholds" not in self.wanted:
            again = iter(())
        for _ in _fed(sample, source, packets, self._calibration,
                      with_frames=self.uses_frames):
            pass
        found = self.estimate(sample)
        if "thresholds" in self.wanted and found.pixels is not None:
            thetas, _ = _of_each_pixel(
                found.pixels, source, again, self._calibration,
                (self.prior.theta_on, self.prior.theta_off))
            found = dataclasses.replace(found, thetas=thetas)
        return found

    def tuned(self, tuning: Tuning, found: Learned) -> Tuning:
        """Return a tuning in which an estimate replaces the parameters it gives."""
        changes: dict[str, Any] = {}
        if found.ratio_sigma is not None:
            changes["ratio_sigma"] = found.ratio_sigma
        thetas: tuple[Theta, Theta] | None = None
        stated = self.prior.theta_on, self.prior.theta_off
        if "event_scale" in self.wanted and found.scale is not None:
            thetas = _scaled(stated[0], found.scale), _scaled(stated[1], found.scale)
        if found.thetas is not None:
            on, off = found.thetas.astype(np.float32)
            thetas = on, off
        elif "thresholds" in self.wanted and found.pixels is not None:
            mean_off, mean_on = found.pixels.model.thresholds
            thetas = (_scaled(stated[0], mean_on / np.mean(stated[0])),
                      _scaled(stated[1], mean_off / np.mean(stated[1])))
        if thetas is not None:
            tuning = dataclasses.replace(
                tuning, theta_on=thetas[0], theta_off=thetas[1])
        first = tuning.parameters.get("model") is self.prior.parameters.get("model")
        # Where frames say nothing, what they said before stays.
        if "model" in self.wanted and found.pixels is not None and (
                first or not found.pixels.told):
            changes["model"] = found.pixels.model
            tuning = dataclasses.replace(
                tuning, clock_us=round(found.pixels.clock_offset_us),
                pixels=found.pixels)
        return tuning.changed(**changes)

    def camera(self, tuning: Tuning) -> Calibration:
        """Return the calibration with what a tuning was learned as."""
        size = self._info.sensor_size
        known = self._calibration or Calibration(
            sensor_size=size, serial=self._info.serial)
        parts = {} if tuning.pixels is None else learned_parts(tuning.pixels)
        for name in parts.keys() & {"theta_on", "theta_off"}:
            stated = getattr(self.prior, name)
            parts[name] = np.full(size, _scaled(stated, parts[name] / np.mean(stated)))
        return known.merge(Calibration(sensor_size=size, **parts))


_kept: weakref.WeakKeyDictionary[
    Source, dict[tuple[Any, ...], tuple[Learned, Calibration | None]]
] = weakref.WeakKeyDictionary()


def learned_pixels(
    recording: Recording, *,
    nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS,
    calibration: Calibration | None = None,
) -> LearnedPixels:
    """Return what all pixels of a camera have in common, as frames and events show it.

    At most 10 s are read.  The nominal thresholds (on, off) are scalars or (H, W);
    dark, gain and clip level of the calibration are applied to the frames.
    """
    sample = PixelSample(recording.info.sensor_size)
    for _ in _fed(sample, recording, recording.packets(), calibration):
        pass
    on, off = nominal
    return learn(sample, Priors(theta=(_mean(off), _mean(on))), 0)


def learned_parts(found: LearnedPixels) -> dict[str, Any]:
    """Return what is told of all pixels, named as the fields of a Calibration."""
    model, sigmas = found.model, found.sigmas
    if found.told or not sigmas:
        return {}
    off, on = model.thresholds.tolist()
    parts: dict[str, Any] = {"theta_on": on, "theta_off": off}
    learned = {"model": model, "thresholds_sigma": max(sigmas["on"], sigmas["off"])}
    if "f0" in sigmas and any(model.bandwidth):
        parts["bandwidth_hz"], parts["bandwidth_hz_per_dn"] = model.bandwidth
        parts["bandwidth_sigma"] = max(sigmas["f0"], sigmas.get("slope", 0.0))
    if found.clock_offset_us and "shift" in sigmas:
        parts["clock_offset_us"] = found.clock_offset_us
        learned["clock_offset_sigma_us"] = sigmas["shift"]
    if model.black and "black" in sigmas:
        learned["black_dn"], learned["black_sigma_dn"] = (
            found.exposure_ms * value for value in (model.black, sigmas["black"]))
    return {name: value for name, value in parts.items() if value} | {
        "learned": learned}


def learned_camera(
    recording: Recording, *,
    nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS,
    calibration: Calibration | None = None,
) -> tuple[dict[str, Any], NDArray[np.float64]]:
    """Return the fields of a Calibration, with the thresholds of each pixel.

    The second is the standard deviation of ln(theta_on / theta_off), shape (H, W).  The
    parameters are those of `learned_pixels`; the light must change.
    """
    found = learned_pixels(recording, nominal=nominal, calibration=calibration)
    thetas, covariance = _of_each_pixel(
        found, recording, recording.packets(), calibration, nominal)
    for i, theta in enumerate(thetas):
        covariance[..., i, i] += (_OWN_ERROR * theta) ** 2
    slope = np.stack([1 / thetas[0], -1 / thetas[1]], -1)
    parts = learned_parts(found)
    for i, name in enumerate(("theta_on", "theta_off")):
        parts[name], parts[f"{name}_sigma"] = thetas[i], np.sqrt(covariance[..., i, i])
    return parts, np.asarray(np.sqrt(
        np.einsum("yxi,yxij,yxj->yx", slope, covariance, slope)))


def _fed(
    sample: PixelSample, source: Source, packets: Iterator[Packet],
    calibration: Calibration | None, *, clock_us: int = 0, with_frames: bool = True,
) -> Iterator[ApsFrame | Events]:
    """Feed frames and events to a sample until it is full; yield them."""
    feed = Feed(packets, by_arrival=False, has_frames=source.info.frame_count != 0,
                clock_us=clock_us)
    corrected = FrameCorrection(calibration)
    for item in feed.until(None):
        if not isinstance(item, ApsFrame):
            sample.add_events(item)
            yield item
        elif with_frames:
            frame = corrected(item)
            sample.add_frame(frame)
            yield frame
        if sample.full:
            return


def _of_each_pixel(
    found: LearnedPixels, source: Source, packets: Iterator[Packet],
    calibration: Calibration | None, nominal: tuple[ArrayLike, ArrayLike],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return thresholds of all pixels as the filter learns them, and covariances.

    It passes once over what the camera was learned from; where that told nothing, they
    are the nominal ones.
    """
    sample = PixelSample(source.info.sensor_size)
    one = KalmanFilter(
        sample.shape, theta_on=nominal[0], theta_off=nominal[1], mode="causal",
        model=found.model)
    for item in _fed(
            sample, source, iter(()) if found.told else packets, calibration,
            clock_us=round(found.clock_offset_us)):
        if isinstance(item, ApsFrame):
            one.add_frame(item)
        else:
            one.add_events(item)
    return one.thresholds


def _priors(
    chosen: str | tuple[ArrayLike, ArrayLike] | None, calibration: Calibration | None,
    on: ArrayLike, off: ArrayLike, clock_us: tuple[float, float],
) -> Priors:
    """Return what is known of the pixels beforehand."""
    measured = chosen is not None and not isinstance(chosen, str)
    sigma = _STATED_SIGMA
    if chosen in (None, "calibration") and not measured and calibration is not None:
        measured = calibration.theta_on is not None
        sigma = min(max(calibration.learned.get("thresholds_sigma", 0.0), sigma),
                    _NOMINAL_SIGMA)
    priors = Priors(theta=(_mean(off), _mean(on)), clock_us=clock_us,
                    theta_sigma=sigma if measured else _NOMINAL_SIGMA)
    if calibration is None:
        return priors
    law = calibration.bandwidth_hz or 0.0, calibration.bandwidth_hz_per_dn or 0.0
    if any(law):
        of_law = calibration.bandwidth_sigma or 0.0
        hz, slope = priors.bandwidth_sigma      # of any camera: it is at most so large
        priors = dataclasses.replace(priors, bandwidth=law, bandwidth_sigma=(
            min(of_law, hz), min(of_law, slope)))
    learned = calibration.learned
    if "black_dn" in learned:
        priors = dataclasses.replace(priors, black=(
            learned["black_dn"], learned.get("black_sigma_dn", 0.0)))
    return dataclasses.replace(priors, model=learned.get("model"))


def _mean(theta: ArrayLike) -> float:
    return float(np.asarray(theta, np.float64).mean())


def _scaled(theta: Theta, factor: float) -> Theta:
    return theta * np.float32(factor) if isinstance(theta, np.ndarray) else (
        theta * float(factor))


def _stated_clock(options: FusionOptions) -> tuple[float, float]:
    """Return the offset of the frames' clock and its standard deviation, us."""
    stated, known = options.clock_offset_us, options.calibration
    if not isinstance(stated, str):
        return stated or 0.0, 0.0
    if known is None or known.clock_offset_us is None:
        return 0.0, _CLOCK_SIGMA_US
    return known.clock_offset_us, known.learned.get("clock_offset_sigma_us", 0.0)
