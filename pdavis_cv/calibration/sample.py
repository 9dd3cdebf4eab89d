"""Some busy pixels of a recording, and a filter run over what they recorded."""
from __future__ import annotations

import math
from collections.abc import Iterable
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv.calibration.certainty import LEAK_HZ, Doubts, Seen, Unseen
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame

__all__ = ["SIGMA", "Items", "Sample", "bright", "busy_pixels", "feed", "run"]

SIGMA = 0.035
"""Standard deviation of a threshold about its nominal value, natural-log units."""

NOISE = (0.05, 1.3, 0.005)
"""As `KalmanFilter`'s, but what de-blurring leaves is not independent from frame to
frame: it counts for more where many frames are added up."""

LEAST_DN = 16.0
"""Below it noise and the offset bend a sample's logarithm more than they scatter it,
the same way at each turn: thresholds come out up to 30 % too small."""

# What the model of the photoreceptors has wrong, as a part of what it changes; and what
# interpolation has wrong in all pixels alike.
_MODEL_SHARE, _MODEL_LEAST = 0.6, 0.002
# For the bandwidth a sample of pixels is enough.
_SAMPLE_EVENTS, _SAMPLE_PIXELS, _SAMPLE_FRAMES = 60_000, 256, 100
# How far, in ln, the balance of their events may be from that of most.
_TYPICAL = 0.5
_EVER = -(2**62), 2**62

Item = ApsFrame | Wave | NDArray[Any]
Items = list[Item]


def run(
    items: Iterable[Item], shape: tuple[int, int], on: ArrayLike, off: ArrayLike,
    sigma: ArrayLike, bandwidth: tuple[float, float] | None,
    noise: tuple[float, float, float] = NOISE,
) -> KalmanFilter:
    """Return the filter after all items; its parameters are `KalmanFilter`'s."""
    method = KalmanFilter(shape, theta_on=on, theta_off=off, threshold_sigma=sigma,
                          bandwidth=bandwidth, noise=noise)
    feed(method, items)
    return method


def bright(item: Item) -> Item:
    """Return the item; of a frame, the samples whose logarithm is straight."""
    if not isinstance(item, ApsFrame) or item.dn.min(initial=LEAST_DN) >= LEAST_DN:
        return item
    valid = item.dn >= LEAST_DN
    return _with(
        item, item.dn, valid if item.valid is None else valid & item.valid)


def _with(
    frame: ApsFrame, dn: NDArray[np.float32], valid: NDArray[np.bool_] | None
) -> ApsFrame:
    """Return the frame with other values."""
    return ApsFrame(
        dn, frame.exposure_start_us, frame.exposure_end_us, valid=valid,
        available_us=frame.available_us, full_scale_dn=frame.full_scale_dn)


def feed(method: KalmanFilter, items: Iterable[Item]) -> None:
    """Give a filter frames, the lamp and events in their order."""
    for item in items:
        if isinstance(item, ApsFrame):
            method.add_frame(item)
        elif isinstance(item, Wave):
            method.add_wave(item)
        else:
            method.add_events(item)


class Sample:
    """Some busy pixels, in one row, and how badly a filter fits them."""

    def __init__(self, pixels: NDArray[np.intp], items: Items, shape: tuple[int, int],
                 nominal: tuple[ArrayLike, ArrayLike], seen: Seen,
                 leak_hz: tuple[float, float]) -> None:
        self.items, self.shape, self.leak_hz = items, (1, len(pixels)), leak_hz
        self._pixels, self._seen = pixels, seen
        self.on, self.off = (
            np.broadcast_to(np.asarray(value, np.float64), shape).ravel()[pixels][None]
            for value in nominal)
        bright = np.quantile(np.concatenate(
            [item.dn.ravel() / max(item.exposure_ms, 1e-3) for item in items
             if isinstance(item, ApsFrame)]), 0.9)
        self.bright = max(float(bright), 1e-3)

    @property
    def per_s(self) -> float:
        """Events of a pixel per second."""
        return float(np.mean(self._seen.per_s.ravel()[self._pixels]))

    def with_leak(self) -> Sample:
        """Return the sample with frames that grow as the leak makes events' sums grow.

        Left in, it passes for a photoreceptor up to 7 % too slow.
        """
        frames = [item for item in self.items if isinstance(item, ApsFrame)]
        middle = float(np.mean([frame.mid_us for frame in frames]))
        rate = self.leak_hz[0] * float(self.on.mean()) / 1e6
        other = copy(self)
        other.items = [
            _with(item, item.dn * math.exp(rate * (item.mid_us - middle)), item.valid)
            if isinstance(item, ApsFrame) else item for item in self.items]
        return other

    def misfit(
        self, law: tuple[float, float],
        noise: tuple[float, float, float] = NOISE,
    ) -> tuple[float, float, int]:
        """Return the sums of e^2 / v and of ln v over the innovations, their number."""
        chi, log, n = run(
            self.items, self.shape, self.on, self.off, SIGMA, law, noise).misfit
        return float(chi), float(log), int(n)

    def doubts(self, law: tuple[float, float], frames: Unseen) -> Doubts:
        """Return what does not show in the misfit, for all pixels of the sensor."""
        seen, as_it_is = self._seen, self._scale(self.items, law)
        brightened = self._scale(
            [_with(item, item.dn + 1, item.valid) if isinstance(item, ApsFrame)
             else item for item in self.items], law)
        model = _MODEL_LEAST
        if law != (0.0, 0.0):
            lag = abs(self._scale(self.items, (0.0, 0.0)) - as_it_is)
            model = math.hypot(_MODEL_LEAST, _MODEL_SHARE * lag)
        low, high = np.maximum(seen.least, LEAST_DN), np.maximum(seen.most, LEAST_DN)
        low = np.minimum(low, 0.99 * high)
        # An offset weighs as it bends the log of the frames.
        bend = (1 / low - 1 / high) / np.log(high / low)
        here = np.mean(bend.ravel()[self._pixels])
        per_dn = (brightened - as_it_is) / here * bend
        return Doubts(seen.per_s / 2, per_dn, frames, model, self.leak_hz)

    def _scale(self, items: Items, law: tuple[float, float]) -> float:
        """Return the mean log of the thresholds that the pixels learn."""
        theta, _ = run(map(bright, items), self.shape, self.on, self.off, SIGMA,
                       law).thresholds
        return float(np.mean(np.log(theta)))


def busy_pixels(
    items: Items, shape: tuple[int, int], nominal: tuple[ArrayLike, ArrayLike],
    leak_hz: tuple[float, float] = LEAK_HZ,
) -> Sample | None:
    """Return some busy pixels, None if frames or events are too few."""
    here, polarities = np.zeros((2, 2, *shape), np.int32)
    squares = np.zeros(shape, np.int64)
    usable = np.zeros(shape, np.int64)
    least, most = np.full(shape, np.inf, np.float32), np.zeros(shape, np.float32)
    mids: list[int] = []

    def settle() -> None:
        """Count what has come since the last frame."""
        both = np.add(here[0], here[1], dtype=np.int64)
        np.add(squares, both * both, out=squares)
        np.add(polarities, here, out=polarities)
        here.fill(0)

    for item in items:
        if isinstance(item, ApsFrame):
            good = item.dn >= 8
            usable += good if item.valid is None else good & item.valid
            np.minimum(least, item.dn, out=least)
            np.maximum(most, item.dn, out=most)
            mids.append(item.mid_us)
            settle()
        elif not isinstance(item, Wave):
            _kernels.count(item, *_EVER, here)
    settle()
    counts = (polarities[0] + polarities[1]).ravel()
    if len(mids) < 4:
        return None
    seconds = max(mids[-1] - mids[0], 1) / 1e6 / (len(mids) - 1)
    seen = Seen(
        squares / np.maximum(counts.reshape(shape) * seconds, 1e-9), least, most)
    counts[usable.ravel() < 0.8 * len(mids)] = 0
    if not counts.any():
        return None
    # The busiest without hot pixels: of those within a factor of two of the 95 % level.
    level = np.quantile(counts[counts > 0], 0.95)
    pixels = np.flatnonzero((counts >= 0.5 * level) & (counts <= 2 * level))
    # One whose thresholds are far from the others' fits no bandwidth, and would decide.
    off, on = np.log(np.maximum(polarities.reshape(2, -1)[:, pixels], 0.5))
    balance = off - on
    pixels = pixels[np.abs(balance - np.median(balance)) <= _TYPICAL]
    n = int(np.clip(_SAMPLE_EVENTS / level, 16, _SAMPLE_PIXELS))
    pixels = np.sort(np.random.default_rng(0).permutation(pixels)[:n])
    place = np.full(len(counts), -1, np.int32)
    place[pixels] = np.arange(len(pixels))
    rows, columns = np.unravel_index(pixels, shape)
    part: Items = []
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
    return Sample(pixels, part, shape, nominal, seen, leak_hz)
