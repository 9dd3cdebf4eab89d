"""Online self-calibration: estimates the camera's parameters from a passing stream."""
from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import sensor_shape
from pdavis_cv._types import Events, State
from pdavis_cv.events import timed_events
from pdavis_cv.pixel import sample as pixel_sample
from pdavis_cv.pixel.learn import LearnedPixels, Priors, learn
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.reconstruct.stream_clock import checked_bandwidth
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.selfcal.bandwidth import Bandwidth, combine_bandwidths, fit_bandwidth
from pdavis_cv.selfcal.clock_offset import ClockOffset, fit_clock_offset
from pdavis_cv.selfcal.common_scale import CommonScale, fit_common_scale
from pdavis_cv.selfcal.event_scale import fit_event_scale
from pdavis_cv.selfcal.jitter import Jitter, fit_jitter
from pdavis_cv.selfcal.noise import FRAME_SIGMAS, fit_event_noise
from pdavis_cv.selfcal.pixel_sample import (
    FILTER_NOISE,
    MIN_DN,
    PixelSample,
    select_busy_pixels,
)
from pdavis_cv.selfcal.priors import (
    CLOCK_OFFSET_SIGMA_US,
    LEAK_HZ,
    THRESHOLD_SIGMA,
)
from pdavis_cv.selfcal.ratio_spread import RatioSpread, fit_ratio_spread
from pdavis_cv.selfcal.refractory import Refractory, fit_refractory
from pdavis_cv.selfcal.thresholds import shrink_to_population, variance_inflation
from pdavis_cv.selfcal.uncertainty import frame_systematics
from pdavis_cv.selfcal.window import CellWindow, Item, PixelWindow, SensorWindow
from pdavis_cv.sensor import NOMINAL_THRESHOLDS, Sensor

__all__ = ["OF_EVENTS", "QUANTITIES", "CameraEstimate", "SelfCalibration"]

QUANTITIES = frozenset({"thresholds", "scale", "event_scale", "bandwidth", "noise",
                        "refractory_us", "jitter_us", "clock_offset", "ratio_sigma",
                        "model"})
"""Quantities that a `SelfCalibration` can estimate: thresholds of every pixel (which
include the common scale), or only that scale, from frames or, where they do not tell
it, from events, or from events alone; bandwidth; event noise; refractory period; jitter
of the events' stamps; offset of the frames' clock; spread of the pixels' ratios of
thresholds."""

OF_EVENTS = frozenset({"event_scale", "jitter_us", "ratio_sigma"})
"""The quantities that are estimated from events alone."""

_MIN_INFLATION, _MAX_INFLATION = (1e-4, 1e-3), 4.0
"""Bounds on the factors on variances: least ones of the ratio and of the scale, and the
greatest of both."""

_MOST_ROUNDS, _SAME_US = 4, 300
"""Most rounds in which the scale and the clock offset are fitted in turn, and the
change of the offset (us) that ends them, twice its model error; numerical."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraEstimate:
    """Parameters of a camera, estimated from its data.

    Parameters
    ----------
    theta_on, theta_off : ndarray of float64, shape (H, W)
        Contrast thresholds, positive magnitudes, ln units; the nominal ones where they
        were not estimated.
    covariance : ndarray of float64, shape (H, W, 2, 2), or None
        Covariance of (theta_on, theta_off), including systematic errors (leak events,
        offsets of the frames, common scale); the ratio is known far better than the
        sum.  None if thresholds were not estimated.
    bandwidth : Bandwidth or None
        Bandwidth of the photoreceptors; None if it was not or could not be estimated.
    noise : float or None
        Process noise of the events (leak and noise events): variance of their sum per
        second, thresholds^2; None if it was not or could not be estimated.
    common_scale_sigma : float
        Standard error of the ln of the scale that all pixels share.  It is part of
        `covariance`, and the same error in every pixel: averaging does not reduce it.
    refractory : Refractory or None
        How long pixels are held in reset after an event; None if it was not estimated
        or there are too few events.  The other quantities account for it.
    jitter : Jitter or None
        Jitter of the events' time stamps, from events alone; None if it was not or
        could not be estimated, as under a flickering lamp.
    clock_offset : ClockOffset or None
        Shift of the frames' time stamps to the clock of the events; None if it was not
        estimated.  The other quantities are estimated with shifted stamps, if the shift
        is significant.
    ratio_spread : RatioSpread or None
        Spread of the pixels' ln(theta_on / theta_off) about the nominal ratio, from
        events alone; None if it was not or could not be estimated.
    nominal_sigma : float
        If the common scale could be estimated and agrees with the nominal thresholds,
        the error of their ln that all pixels share: root mean square over what the
        estimate leaves possible.  0 with a `common_scale_sigma` of 0: it could not be
        estimated.
    pixels : LearnedPixels or None
        What `IncrementFilter` takes; None if it was not wanted.
    """

    theta_on: NDArray[np.float64]
    theta_off: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    bandwidth: Bandwidth | None = None
    noise: float | None = None
    common_scale_sigma: float = 0.0
    refractory: Refractory | None = None
    jitter: Jitter | None = None
    clock_offset: ClockOffset | None = None
    ratio_spread: RatioSpread | None = None
    nominal_sigma: float = 0.0
    pixels: LearnedPixels | None = None

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviation of theta_on and theta_off, shape (2, H, W)."""
        covariance = self._known_covariance()
        return np.sqrt(np.stack([covariance[..., 0, 0], covariance[..., 1, 1]]))

    @property
    def ratio_sigma(self) -> NDArray[np.float64]:
        """Standard deviation of ln(theta_on / theta_off), shape (H, W)."""
        a, b, c = 1 / self.theta_on, -1 / self.theta_off, self._known_covariance()
        return np.sqrt(a * a * c[..., 0, 0] + b * b * c[..., 1, 1]
                       + 2 * a * b * c[..., 0, 1])

    def _known_covariance(self) -> NDArray[np.float64]:
        if self.covariance is None:
            raise ValueError("thresholds were not estimated, so they have no sigma")
        return self.covariance


class _ConstantThresholds(KalmanFilter):
    """A filter without drift of the thresholds, as one pair is estimated per pixel."""

    def _adapt(self) -> None:
        super()._adapt()
        self._tuning["threshold_drift"] = 0


class SelfCalibration:
    """Estimates a camera's thresholds, bandwidth and event noise from passing data.

    It is fed in order of time like a `Reconstructor`: a frame at its mid-exposure,
    corrected by the camera's calibration.  It keeps the last 10 s, 100 frames or 1
    million events of at most 16384 pixels, 42 MB at most; with `every_pixel` also the
    first 10 s or 5 million events of all pixels, 65 MB and the frames.

    Parameters
    ----------
    sensor_size : (int, int)
        (height, width).
    nominal : (on, off)
        Expected contrast thresholds, ln units, scalars or (H, W).
    sensor : Sensor, optional
        Gives the prior of the frames' offsets; default `Sensor.PDAVIS`.
    dark : bool
        Whether a dark frame was subtracted from the frames.
    stated_bandwidth : (float, float, float), optional
        (hz, hz_per_intensity, sigma) of a calibration, combined with the estimate.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.  Thresholds and
        bandwidth are corrected for the mean; the covariance includes the deviation.
    threshold_sigma : float
        Prior standard deviation of a pixel's thresholds about `nominal`, ln units.
    learns : Priors, optional
        What is known beforehand of what `IncrementFilter` takes; default: that is not
        learned.
    every_pixel : bool
        Keep the data that an estimate of every pixel's thresholds needs; without it,
        memory is small and the window moves with the stream.

    Raises
    ------
    ValueError
        If `leak_hz` is not two numbers of at least 0, or `threshold_sigma` is not
        positive.
    """

    def __init__(
        self, sensor_size: Sequence[int],
        nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS, *,
        sensor: Sensor | None = None, dark: bool = False,
        stated_bandwidth: tuple[float, float, float] | None = None,
        leak_hz: tuple[float, float] = LEAK_HZ,
        threshold_sigma: float = THRESHOLD_SIGMA, every_pixel: bool = True,
        learns: Priors | None = None,
    ) -> None:
        if not threshold_sigma > 0:
            raise ValueError(
                f"threshold_sigma must be positive, got {threshold_sigma}")
        if np.shape(leak_hz) != (2,) or not (np.isfinite(leak_hz).all()
                                             and min(leak_hz) >= 0):
            raise ValueError(
                "leak_hz must be (mean, standard deviation), each at least 0, got "
                f"{leak_hz!r}")
        self.shape = sensor_shape(sensor_size)
        self._nominal, self._sensor, self._dark = nominal, sensor, bool(dark)
        self._stated, self._leak_hz = stated_bandwidth, leak_hz
        self._sigma = float(threshold_sigma)
        self._window, self._cells = PixelWindow(self.shape), CellWindow(self.shape)
        self._whole = SensorWindow(self.shape) if every_pixel else None
        self._learns = learns
        self._pixels = None if learns is None else pixel_sample.PixelSample(
            self.shape)

    @property
    def full(self) -> bool:
        """Whether more data would only replace the oldest, or be ignored."""
        return self._window.full if self._whole is None else self._whole.full

    @property
    def full_without_frames(self) -> bool:
        """Whether more events would be ignored as long as no frame has come."""
        return self._window.full_without_frames

    def add_events(self, events: Events) -> None:
        """Take events of the whole sensor, later than all before."""
        events = timed_events(events)
        if len(events):
            self._window.add_events(events)
            self._cells.add_events(events)
            if self._pixels is not None:
                self._pixels.add_events(events)
            if self._whole is not None:
                self._whole.add(events)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame of the whole sensor, corrected, in order of mid-exposure."""
        self._window.add_frame(frame)
        if self._pixels is not None:
            self._pixels.add_frame(frame)
        if self._whole is not None:
            self._whole.add(frame)

    def add_wave(self, wave: Wave) -> None:
        """Take the lamp's wave in a block of time (see `LampTracker`)."""
        self._window.add_wave(wave)
        if self._whole is not None:
            self._whole.add(wave)

    def estimate(
        self, *, wanted: Collection[str] = QUANTITIES,
        bandwidth: Sequence[float] | None = None, clock_offset_us: int = 0,
        lookahead_us: int = 0, before: PixelModel | None = None,
    ) -> CameraEstimate:
        """Return the estimate from the data kept, which do not change.

        Parameters
        ----------
        wanted : collection of str
            Quantities to estimate, of `QUANTITIES`.
        bandwidth : (hz, hz_per_intensity, ...), optional
            Used if "bandwidth" is not wanted; default: no lag.
        clock_offset_us : int
            Shift of the frames' time stamps if "clock_offset" is not wanted, us.
        lookahead_us : int
            That of the method, for "model".
        before : PixelModel, optional
            The model of an earlier estimate (see `learn`).

        Returns
        -------
        CameraEstimate
        """
        if not QUANTITIES.issuperset(wanted):
            raise ValueError(
                f"wanted must be among {sorted(QUANTITIES)}, got {sorted(wanted)}")
        if "thresholds" in wanted and self._whole is None:
            raise ValueError(
                "wanted: 'thresholds' need SelfCalibration(every_pixel=True), got "
                "every_pixel=False")
        spread = (fit_ratio_spread(self._window, self._nominal)
                  if "ratio_sigma" in wanted else None)
        jitter = (fit_jitter(self._window)
                  if "jitter_us" in wanted and not self._window.flickers else None)
        if self._pixels is not None and self._learns is not None and "model" in wanted:
            learned = learn(self._pixels, self._learns, lookahead_us, before)
            if learned.told and not self._window.flickers:
                by_events = fit_event_scale(self._cells, self._nominal)
                if by_events is not None and by_events.significant:
                    learned = learned.scaled(by_events.factor, by_events.sigma)
            on, off = (np.broadcast_to(value, self.shape) for value in self._nominal)
            return CameraEstimate(
                theta_on=on, theta_off=off, ratio_spread=spread, pixels=learned,
                clock_offset=_clock_of(learned, self._learns))
        sample = None if OF_EVENTS.issuperset(wanted) else select_busy_pixels(
            self._window, self._nominal, self._leak_hz)
        found: Bandwidth | None = None
        scale: CommonScale | None = None
        noise: float | None = None
        law = (0.0, 0.0) if bandwidth is None else (
            float(bandwidth[0]), float(bandwidth[1]))
        clock: ClockOffset | None = None
        known = None if "bandwidth" in wanted or bandwidth is None else (
            checked_bandwidth(bandwidth))
        refractory: Refractory | None = None
        nominal_sigma, told = 0.0, False
        moved_us = 0 if "clock_offset" in wanted else clock_offset_us
        if sample is not None:
            sample = sample.with_frames_moved(moved_us)
            if "refractory_us" in wanted and not self._window.flickers:
                refractory = fit_refractory(sample)
                if refractory is not None:
                    sample = sample.with_refractory(refractory.us)
            stamped = sample
            # A lamp's ripple triggers events that hide the timing of the scene's.
            if "clock_offset" in wanted and not self._window.flickers:
                clock = fit_clock_offset(stamped, known)
                sample = stamped.with_frames_moved(clock.applied_us)
            first = sample
            if "bandwidth" in wanted:
                found = fit_bandwidth(sample)
                law = found.law
            if not {"scale", "thresholds"}.isdisjoint(wanted):
                likeliest, clock = _scale_and_clock(
                    stamped, law, clock, known, found is not None)
                scale = likeliest if likeliest.significant else None
                told = likeliest.determined
                if (scale is None and likeliest.determined
                        and not likeliest.off_nominal):
                    nominal_sigma = likeliest.error_of_nominal
            if scale is not None:
                stamped = stamped.with_thresholds_scaled(scale.on, scale.off)
                sample = stamped
            if clock is not None:
                sample = stamped.with_frames_moved(clock.applied_us)
            if found is not None and sample is not first:
                found = fit_bandwidth(sample)
                law = found.law
            if "noise" in wanted:
                noise = fit_event_noise(sample, law, FRAME_SIGMAS)
        if found is not None and self._stated is not None:
            found = combine_bandwidths(self._stated, found)
        factors, scale_sigma = (1.0, 1.0), 0.0
        if scale is not None:
            factors, scale_sigma = (scale.on, scale.off), scale.sigma
        elif not self._window.flickers and (
                "event_scale" in wanted or ("scale" in wanted and not told)):
            by_events = fit_event_scale(self._cells, self._nominal)
            if by_events is not None and by_events.significant:
                factors, scale_sigma = (by_events.factor,) * 2, by_events.sigma
        nominal = tuple(np.asarray(value, np.float64) * factor for value, factor in zip(
            self._nominal, factors, strict=True))
        if "thresholds" in wanted and self._whole is not None:
            theta, covariance, common = self._thresholds(
                self._whole, sample, law, (nominal[0], nominal[1]),
                moved_us if clock is None else clock.applied_us)
            return CameraEstimate(
                theta_on=theta[0], theta_off=theta[1], covariance=covariance,
                bandwidth=found, noise=noise, common_scale_sigma=common,
                refractory=refractory, jitter=jitter, clock_offset=clock,
                ratio_spread=spread, nominal_sigma=nominal_sigma)
        on, off = (np.broadcast_to(value, self.shape) for value in nominal)
        return CameraEstimate(
            theta_on=on, theta_off=off, bandwidth=found, noise=noise,
            common_scale_sigma=scale_sigma,
            refractory=refractory, jitter=jitter, clock_offset=clock,
            ratio_spread=spread, nominal_sigma=nominal_sigma)

    def _thresholds(
        self, whole: SensorWindow, sample: PixelSample | None,
        law: tuple[float, float],
        nominal: tuple[NDArray[np.float64], NDArray[np.float64]], clock_us: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Return all thresholds, their covariance and the common scale's sigma."""
        ordered = _in_order(whole.items, clock_us)
        frames = sum(isinstance(item, ApsFrame) for item in whole.items)
        on, off = nominal
        method = _ConstantThresholds(
            self.shape, theta_on=on, theta_off=off, threshold_sigma=self._sigma,
            bandwidth=law, noise=FILTER_NOISE,
            refractory_us=0.0 if sample is None else sample.refractory_us)
        _feed(method, ordered, frames // 2)
        after_half = method.thresholds
        _feed(method, ordered, -1)
        theta, covariance = method.thresholds
        chi, _, n = method.misfit
        low_ratio, low_scale = _MIN_INFLATION
        of_scale = float(np.clip(chi / n, low_scale, _MAX_INFLATION)) if n else 1.0
        of_ratio = variance_inflation(after_half, (theta, covariance))
        inflation = (of_scale if of_ratio is None else float(
            np.clip(of_ratio, low_ratio, _MAX_INFLATION)), of_scale)
        systematics = None if sample is None else sample.systematics(
            law, whole.activity(), frame_systematics(self._sensor, self._dark))
        theta, covariance = shrink_to_population(
            theta, covariance, nominal, self._sigma, inflation, systematics)
        return theta, covariance, (
            0.0 if systematics is None else systematics.common_scale_sigma)

    @property
    def nbytes(self) -> int:
        """Bytes of the data kept."""
        return self._window.nbytes + self._cells.nbytes + (
            0 if self._pixels is None else self._pixels.nbytes) + (
            0 if self._whole is None else self._whole.nbytes)

    def state(self) -> State:
        """Return the data kept; they are never changed in place."""
        return {"window": self._window.state(),
                "cells": self._cells.state(),
                "pixels": None if self._pixels is None else self._pixels.state(),
                "whole": None if self._whole is None else self._whole.state()}

    def restore(self, state: State) -> None:
        """Return to what `state` returned."""
        self._window.restore(state["window"])
        self._cells.restore(state["cells"])
        if self._pixels is not None:
            self._pixels.restore(state["pixels"])
        if self._whole is not None:
            self._whole.restore(state["whole"])


def _clock_of(learned: LearnedPixels, known: Priors) -> ClockOffset | None:
    """Return the clock offset that was learned; None if it was known."""
    if not known.clock_us[1]:
        return None
    sigma = learned.sigmas.get("shift", CLOCK_OFFSET_SIGMA_US)
    return ClockOffset(
        learned.clock_offset_us, min(sigma, CLOCK_OFFSET_SIGMA_US),
        decided=learned.clock_offset_us != 0)


def _scale_and_clock(
    stamped: PixelSample, law: tuple[float, float], clock: ClockOffset | None,
    known: tuple[float, float, float] | None, learn_bandwidth: bool,
) -> tuple[CommonScale, ClockOffset | None]:
    """Return the common scale, and the clock offset that belongs to it.

    Wrong thresholds and wrong time stamps hide each other.  So a likelier scale, even
    if not significant, is fitted again with the clock offset that belongs to it.  Once
    a scale has been significant, it stays accepted; a scale that cannot be estimated is
    not used.  Without a significant scale the offset is that of nominal thresholds.
    """
    first_us = applied_us = 0 if clock is None else clock.applied_us
    scale, there, significant = None, clock, False
    for _ in range(_MOST_ROUNDS):
        again = fit_common_scale(
            stamped.with_frames_moved(applied_us), law, before=scale,
            learn_bandwidth=learn_bandwidth, clock_us=first_us - applied_us)
        if scale is not None and not again.determined:
            break
        significant = significant or again.significant
        scale = again._replace(significant=significant)
        if clock is None or not scale.off_nominal:
            break
        there = fit_clock_offset(
            stamped.with_thresholds_scaled(scale.on, scale.off), known)
        moved_us, applied_us = there.applied_us - applied_us, there.applied_us
        if abs(moved_us) <= _SAME_US:
            break
    assert scale is not None
    return scale, there if significant else clock


def _in_order(items: Sequence[Item], clock_us: int) -> Iterator[Item]:
    """Yield a window's items in order of time, with the frames' stamps shifted."""
    frames = deque(item.moved(clock_us) for item in items if isinstance(item, ApsFrame))
    for item in items:
        if isinstance(item, Wave):
            yield item
        elif isinstance(item, np.ndarray):
            events = item
            while frames and frames[0].mid_us <= events["t"][-1]:
                n = int(np.searchsorted(events["t"], frames[0].mid_us))
                if n:
                    yield events[:n]
                yield frames.popleft()
                events = events[n:]
            yield events
    yield from frames


def _feed(method: KalmanFilter, items: Iterator[Item], frames: int) -> None:
    """Feed the next items to a filter, up to a number of frames; all if negative.

    The frames' samples below `MIN_DN` are left out.
    """
    while frames:
        item = next(items, None)
        if item is None:
            return
        if isinstance(item, ApsFrame):
            bright = item.dn >= MIN_DN
            method.add_frame(item.replace(
                valid=bright if item.valid is None else bright & item.valid))
            frames -= 1
        elif isinstance(item, Wave):
            method.add_wave(item)
        else:
            method.add_events(item)
