"""A sample of busy pixels, and the innovations of a filter run over their data."""
from __future__ import annotations

import math
from collections.abc import Iterable
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.selfcal.priors import THRESHOLD_SIGMA
from pdavis_cv.selfcal.uncertainty import (
    FrameSystematics,
    PixelActivity,
    SystematicErrors,
)

__all__ = ["Item", "PixelSample", "feed", "run_filter", "select_busy_pixels",
           "without_dim_samples"]

FILTER_NOISE = (0.05, 1.3, 0.005)
"""As `KalmanFilter`'s ``noise``, but larger: what de-blurring leaves is correlated from
frame to frame, and accumulates where many frames are added up."""

MIN_DN = 16.0
"""Below 16 DN ln(DN) is biased (convexity and offset), not merely noisy: thresholds
come out up to 30 % too small."""

_USABLE_DN, _USABLE_SHARE = 8, 0.8
"""A pixel of the sample has at least 8 DN in at least 80 % of the frames."""

_MIN_FRAMES = 4
"""Fewer frames tell nothing."""

# Systematic error of the model of the photoreceptors, as a share of what the model
# changes; and that of interpolation, which all pixels share.
_MODEL_SHARE, _MODEL_MIN_SIGMA = 0.6, 0.002

_SAMPLE_EVENTS, _SAMPLE_PIXELS, _SAMPLE_FRAMES = 60_000, 256, 100
"""Upper bounds of the sample."""

_BUSY_QUANTILE, _BUSY_FACTOR = 0.95, 2.0
"""Busy: within a factor of two of the 95 % quantile of the counts.  Hot pixels have
more."""

_MAX_BALANCE = 0.5
"""Greatest distance of ln(OFF / ON events) from the median.  A pixel whose thresholds
are far from the others' fits no bandwidth, and would decide on it."""

_BRIGHT_QUANTILE = 0.9
"""A bright pixel: this quantile of the frames' intensity."""

_EVER = -(2**62), 2**62

Item = ApsFrame | Wave | NDArray[Any]


def run_filter(
    items: Iterable[Item], shape: tuple[int, int], on: ArrayLike, off: ArrayLike,
    sigma: ArrayLike, bandwidth: tuple[float, float] | None,
    noise: tuple[float, float, float] = FILTER_NOISE,
) -> KalmanFilter:
    """Return the filter after all items; its parameters are `KalmanFilter`'s."""
    method = KalmanFilter(shape, theta_on=on, theta_off=off, threshold_sigma=sigma,
                          bandwidth=bandwidth, noise=noise)
    feed(method, items)
    return method


def feed(method: KalmanFilter, items: Iterable[Item]) -> None:
    """Give a filter frames, the lamp's waves and events in their order."""
    for item in items:
        if isinstance(item, ApsFrame):
            method.add_frame(item)
        elif isinstance(item, Wave):
            method.add_wave(item)
        else:
            method.add_events(item)


def without_dim_samples(item: Item) -> Item:
    """Return the item; in a frame, samples below `MIN_DN` are not valid."""
    if not isinstance(item, ApsFrame) or item.dn.min(initial=MIN_DN) >= MIN_DN:
        return item
    valid = item.dn >= MIN_DN
    return _replaced(
        item, item.dn, valid if item.valid is None else valid & item.valid)


def _replaced(
    frame: ApsFrame, dn: NDArray[np.float32], valid: NDArray[np.bool_] | None
) -> ApsFrame:
    """Return the frame with other values."""
    return ApsFrame(
        dn, frame.exposure_start_us, frame.exposure_end_us, valid=valid,
        available_us=frame.available_us, full_scale_dn=frame.full_scale_dn)


class PixelSample:
    """Data of some busy pixels, in one row, and how well a filter predicts them.

    Parameters
    ----------
    pixels : ndarray of intp, shape (N,)
        Their places in the flattened sensor.
    items : list of Item
        Frames (1, N), events and waves in order of time.
    nominal : (on, off)
        Thresholds of the sensor, scalars or (H, W).
    activity : PixelActivity
        Of the whole sensor.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.
    """

    def __init__(
        self, pixels: NDArray[np.intp], items: list[Item],
        nominal: tuple[ArrayLike, ArrayLike], activity: PixelActivity,
        leak_hz: tuple[float, float],
    ) -> None:
        self.items, self.shape, self.leak_hz = items, (1, len(pixels)), leak_hz
        self._pixels, self._activity = pixels, activity
        sensor = activity.events_per_s.shape
        self.on, self.off = (
            np.broadcast_to(np.asarray(value, np.float64), sensor).ravel()[pixels][None]
            for value in nominal)
        bright = np.quantile(np.concatenate(
            [item.dn.ravel() / max(item.exposure_ms, 1e-3) for item in items
             if isinstance(item, ApsFrame)]), _BRIGHT_QUANTILE)
        self.bright = max(float(bright), 1e-3)

    @property
    def events_per_s(self) -> float:
        """Events of a pixel per second."""
        return float(np.mean(self._activity.events_per_s.ravel()[self._pixels]))

    def with_leak_in_frames(self) -> PixelSample:
        """Return the sample with frames that grow as the mean leak moves events' sums.

        The leak, left in, looks like a photoreceptor up to 7 % too slow.
        """
        frames = [item for item in self.items if isinstance(item, ApsFrame)]
        middle = float(np.mean([frame.mid_us for frame in frames]))
        rate = self.leak_hz[0] * float(self.on.mean()) / 1e6
        other = copy(self)
        other.items = [
            _replaced(item, item.dn * math.exp(rate * (item.mid_us - middle)),
                      item.valid)
            if isinstance(item, ApsFrame) else item for item in self.items]
        return other

    def innovations(
        self, law: tuple[float, float],
        noise: tuple[float, float, float] = FILTER_NOISE,
    ) -> tuple[float, float, int]:
        """Return sum e^2 / v and sum ln v over the innovations e, and their number."""
        chi, log, n = run_filter(
            self.items, self.shape, self.on, self.off, THRESHOLD_SIGMA, law,
            noise).misfit
        return float(chi), float(log), int(n)

    def systematics(
        self, law: tuple[float, float], frames: FrameSystematics
    ) -> SystematicErrors:
        """Return the errors that innovations do not show, for the whole sensor."""
        activity, scale = self._activity, self._log_scale(self.items, law)
        brightened = self._log_scale(
            [_replaced(item, item.dn + 1, item.valid) if isinstance(item, ApsFrame)
             else item for item in self.items], law)
        model_sigma = _MODEL_MIN_SIGMA
        if law != (0.0, 0.0):
            by_lag = abs(self._log_scale(self.items, (0.0, 0.0)) - scale)
            model_sigma = math.hypot(_MODEL_MIN_SIGMA, _MODEL_SHARE * by_lag)
        low = np.maximum(activity.min_dn, MIN_DN)
        high = np.maximum(activity.max_dn, MIN_DN)
        low = np.minimum(low, 0.99 * high)
        # An offset changes the contrast ln(high / low) by this, relatively, per DN.
        contrast = (1 / low - 1 / high) / np.log(high / low)
        here = np.mean(contrast.ravel()[self._pixels])
        per_dn = (brightened - scale) / here * contrast
        return SystematicErrors(
            activity.events_per_s / 2, per_dn, frames, model_sigma, self.leak_hz)

    def _log_scale(self, items: list[Item], law: tuple[float, float]) -> float:
        """Return the mean ln of the thresholds that a filter finds."""
        theta, _ = run_filter(map(without_dim_samples, items), self.shape, self.on,
                              self.off, THRESHOLD_SIGMA, law).thresholds
        return float(np.mean(np.log(theta)))


def select_busy_pixels(
    items: list[Item], shape: tuple[int, int], nominal: tuple[ArrayLike, ArrayLike],
    leak_hz: tuple[float, float],
) -> PixelSample | None:
    """Return some busy pixels, None if frames or events are too few."""
    interval, polarities = np.zeros((2, 2, *shape), np.int32)
    squares = np.zeros(shape, np.int64)
    usable = np.zeros(shape, np.int64)
    min_dn = np.full(shape, np.inf, np.float32)
    max_dn = np.zeros(shape, np.float32)
    mids: list[int] = []

    def end_interval() -> None:
        """Add the counts since the last frame."""
        both = np.add(interval[0], interval[1], dtype=np.int64)
        np.add(squares, both * both, out=squares)
        np.add(polarities, interval, out=polarities)
        interval.fill(0)

    for item in items:
        if isinstance(item, ApsFrame):
            good = item.dn >= _USABLE_DN
            usable += good if item.valid is None else good & item.valid
            np.minimum(min_dn, item.dn, out=min_dn)
            np.maximum(max_dn, item.dn, out=max_dn)
            mids.append(item.mid_us)
            end_interval()
        elif not isinstance(item, Wave):
            _kernels.count(item, *_EVER, interval)
    end_interval()
    counts = (polarities[0] + polarities[1]).ravel()
    if len(mids) < _MIN_FRAMES:
        return None
    seconds = max(mids[-1] - mids[0], 1) / 1e6 / (len(mids) - 1)
    activity = PixelActivity(
        squares / np.maximum(counts.reshape(shape) * seconds, 1e-9), min_dn, max_dn)
    counts[usable.ravel() < _USABLE_SHARE * len(mids)] = 0
    if not counts.any():
        return None
    level = np.quantile(counts[counts > 0], _BUSY_QUANTILE)
    pixels = np.flatnonzero(
        (counts >= level / _BUSY_FACTOR) & (counts <= level * _BUSY_FACTOR))
    off, on = np.log(np.maximum(polarities.reshape(2, -1)[:, pixels], 0.5))
    balance = off - on
    pixels = pixels[np.abs(balance - np.median(balance)) <= _MAX_BALANCE]
    n = int(np.clip(_SAMPLE_EVENTS / level, 16, _SAMPLE_PIXELS))
    pixels = np.sort(np.random.default_rng(0).permutation(pixels)[:n])
    place = np.full(len(counts), -1, np.int32)
    place[pixels] = np.arange(len(pixels))
    rows, columns = np.unravel_index(pixels, shape)
    part: list[Item] = []
    frames = 0
    pending: list[NDArray[Any]] = []
    for item in items:
        if isinstance(item, Wave):
            part.append(item)
            continue
        if not isinstance(item, ApsFrame):
            at = place.take(item["y"].astype(np.int32) * shape[1] + item["x"])
            chosen = np.flatnonzero(at >= 0)
            mine = item.take(chosen)
            mine["x"], mine["y"] = at.take(chosen), 0
            pending.append(mine)
            continue
        frames += 1
        if frames > _SAMPLE_FRAMES:
            break
        if pending:
            part.append(np.concatenate(pending))
            pending = []
        times = [np.broadcast_to(time, shape[1:])[columns] for time in (
            item.exposure_start_us, item.exposure_end_us)]
        valid = None if item.valid is None else item.valid[rows, columns][None]
        part.append(ApsFrame(
            item.dn[rows, columns][None], *times, valid=valid,
            available_us=max(item.available_us, int(times[1].max())),
            full_scale_dn=item.full_scale_dn))
    if pending:
        part.append(np.concatenate(pending))
    return PixelSample(pixels, part, nominal, activity, leak_hz)
