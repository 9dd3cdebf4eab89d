"""Sample of busy pixels, and the innovations of candidate cameras on their data."""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.kalman import LOOKAHEAD_US
from pdavis_cv.reconstruct.kalman.frame_noise import DN_PER_SHOT, READ_NOISE_DN
from pdavis_cv.selfcal.priors import THRESHOLD_SIGMA
from pdavis_cv.selfcal.uncertainty import (
    FrameSystematics,
    PixelActivity,
    SystematicErrors,
)
from pdavis_cv.selfcal.window import USABLE_DN, Interval, PixelWindow

__all__ = ["CANDIDATE_DTYPE", "FILTER_NOISE", "INNOVATIONS_DTYPE", "MIN_DN",
           "PixelSample", "candidates_of", "select_busy_pixels"]

FILTER_NOISE = (0.05, 1.3, 0.005)
"""Noise of the candidate filters, as `KalmanFilter`'s ``noise`` but larger: errors of
de-blurring are correlated from frame to frame and accumulate over many frames.
Engineering choice: with one of the three four times smaller or larger, the rms error of
the thresholds falls by at most 4 % (lab/studies/selfcal_thresholds.py)."""

MIN_DN = 16.0
"""Least DN of a sample.  Below it, an offset of the frames changes the contrast by more
than thresholds differ from pixel to pixel.

An offset of o DN changes the greatest contrast, ln(extinction ratio), by o / DN: by the
share `USUAL_MISMATCH` at 2 / (.035 ln 40) = 15.5 DN
(lab/studies/selfcal_thresholds.py)."""

_USABLE_SHARE = 0.8
"""Least fraction of frames in which a pixel of the sample is usable."""

_MIN_CONTRAST = 0.01
"""Lower bound of the contrast of frames, so that the sensitivity to an offset is
finite."""

_MIN_FRAMES = 4
"""Least number of frames for an estimate."""

# Systematic error of the photoreceptor's model, as a share of the model's effect
# (engineering choice: lab/studies/selfcal_thresholds.py finds .57 with two chips, .94
# with six), and that of interpolation, which all pixels share (assumed).
_MODEL_SHARE, _MODEL_MIN_SIGMA = 0.6, 0.002

_SAMPLE_EVENTS, _SAMPLE_PIXELS, _MIN_SAMPLE_PIXELS = 30_000, 256, 16
"""Size of the sample: desired number of events, and bounds of the number of pixels that
have them."""

_BUSY_QUANTILE, _BUSY_FACTOR = 0.95, 2.0
"""A pixel is busy if its count is within a factor of two of the 95 % quantile.  Hot
pixels have more events."""

_CLAIM_SHARE, _SHOWN_SHARE, _CLAIM_SIGMAS, _CLAIM_EVENTS = 0.5, 0.25, 4.0, 3
"""Test whether frames contradict a pixel's events, as in `KalmanFilter` (kalman.md,
"Hot pixels")."""

_HOT_SHARE = 0.5
"""A pixel is hot if frames contradict its events in this fraction of the intervals with
events.  It is not a fraction of the intervals that pass the test of a claim: a
pixel with an unusual ratio of thresholds has few, but is contradicted in all."""

_MAX_BALANCE, _LEAST_COUNT = 0.5, 0.5
"""Greatest distance of ln(OFF / ON events) from the median.  A pixel with thresholds
far from the others' fits no bandwidth, and would dominate the fit.  A count of 0 events
is taken as half an event, so that its ln exists."""

_BRIGHT_QUANTILE, _LEAST_BRIGHT = 0.9, 1e-3
"""Quantile of the frames' intensity that is taken as a bright pixel's, and its lower
bound, DN/ms, so that it can be a divisor; numerical."""

PIXEL_DTYPE = np.dtype([
    ("start", "<i4"), ("stop", "<i4"), ("first", "<i4"), ("last", "<i4"),
    ("theta_on", "<f8"), ("theta_off", "<f8")])
"""A pixel's events, from start to before stop, its frames, from first to before last,
and its prior thresholds (ln units)."""

READING_DTYPE = np.dtype([
    ("log", "<f4"), ("variance", "<f4"), ("begin", "<i8"), ("middle", "<i8"),
    ("end", "<i8"), ("known", "<i8")])
"""A frame's ln intensity (ln DN/ms), the variance of its read and shot noise (0: not
usable), its exposure, and the time up to which events are used (us)."""

_READING = np.dtype(f"V{READING_DTYPE.itemsize}")
"""The same as one item, which NumPy copies at once and not field by field."""

CANDIDATE_DTYPE = np.dtype([
    ("noise_per_s", "<f8"), ("noise_per_event", "<f8"), ("drift", "<f8"),
    ("hz", "<f8"), ("hz_per_intensity", "<f8"), ("frame_sigma", "<f8"),
    ("scale_on", "<f8"), ("scale_off", "<f8"), ("clock_us", "<i8")])
"""A candidate camera: process noise in thresholds^2 per second and per event, variance
of the thresholds' relative change from frame to frame, bandwidth in Hz and Hz per
DN/ms, residual error of de-blurring (ln units), factors on the nominal thresholds, and
shift of the frames' times (us)."""

INNOVATIONS_DTYPE = np.dtype([
    ("chi2", "<f8"), ("deviation", "<f8"), ("log_variance", "<f8"), ("count", "<f8"),
    ("log_theta", "<f8")])
"""Sums of e^2 / v, of |e / sqrt(v)|^1.5 and of ln v over the innovations e, their
number, and the sum over pixels of ln theta_on + ln theta_off at the end."""


def candidates_of(
    laws: Sequence[tuple[float, float]] | NDArray[np.float64],
    noise: tuple[float, float, float] = FILTER_NOISE,
) -> NDArray[np.void]:
    """Return candidates with these bandwidths and one noise, as `KalmanFilter`'s."""
    out = np.zeros(len(laws), CANDIDATE_DTYPE)
    out["scale_on"] = out["scale_off"] = 1
    out["hz"], out["hz_per_intensity"] = np.reshape(laws, (-1, 2)).T
    out["frame_sigma"], out["noise_per_s"], out["noise_per_event"] = noise
    return out


class PixelSample:
    """Data of some busy pixels, and the innovations of candidate cameras on them.

    Parameters
    ----------
    window : PixelWindow
        The window that holds the data.
    chosen : ndarray of intp, shape (N,)
        Indices among the window's pixels.
    nominal : (on, off)
        Thresholds of the sensor, scalars or (H, W).
    events_per_s : float
        Rate of a pixel's events.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.
    """

    def __init__(
        self, window: PixelWindow, chosen: NDArray[np.intp],
        nominal: tuple[ArrayLike, ArrayLike], events_per_s: float,
        leak_hz: tuple[float, float],
    ) -> None:
        self.events_per_s, self.leak_hz = events_per_s, leak_hz
        self.refractory_us = 0.0
        self._packed: dict[int, tuple[NDArray[np.void], NDArray[np.void]]] = {}
        self.pixels = window.pixels[chosen]
        place = np.full(len(window.pixels), -1, np.int32)
        place[chosen] = np.arange(len(chosen))
        events = window.events
        at = place.take(events["x"])
        order = np.argsort(at, kind="stable")
        order = order[np.count_nonzero(at < 0):]
        self._events, at = events.take(order), at.take(order)
        self._traits = np.zeros(len(chosen), PIXEL_DTYPE)
        self._traits["start"] = np.searchsorted(at, np.arange(len(chosen)))
        self._traits["stop"] = np.searchsorted(at, np.arange(len(chosen)), "right")
        for name, value in zip(("theta_on", "theta_off"), nominal, strict=True):
            self._traits[name] = np.broadcast_to(
                np.asarray(value, np.float64), window.shape).ravel()[self.pixels]
        # A frame is used once the events around its exposure have been fed.
        frames = [each for each in window.intervals if max(
            each.known_us, int(each.exposure_us[1].max()) + LOOKAHEAD_US
        ) <= window.last_us]
        self._dn = np.array([each.dn[chosen] for each in frames], np.float32).reshape(
            len(frames), len(chosen))
        self._usable = np.array([each.usable[chosen] for each in frames], bool).reshape(
            len(frames), len(chosen))
        self._frames = np.zeros(self._dn.shape, READING_DTYPE)
        columns = self.pixels % window.shape[1]
        for row, each in zip(self._frames, frames, strict=True):
            for i, name in enumerate(("begin", "middle", "end")):
                row[name] = each.exposure_us[i, columns]
            row["known"] = max(
                each.known_us, int(each.exposure_us[1].max()) + LOOKAHEAD_US)
        self._exposure_ms = (self._frames["end"] - self._frames["begin"]) / 1000
        self._waves, self._last_us = window.waves, window.last_us
        self._read(self._dn, self._usable)
        bright = (np.quantile(self._dn / self._exposure_ms, _BRIGHT_QUANTILE)
                  if self._dn.size else 0.0)
        self.bright = max(float(bright), _LEAST_BRIGHT)

    def _read(self, dn: NDArray[np.float32], usable: NDArray[np.bool_]) -> None:
        """Set log intensity and variance from the DN of frames, shape (F, N)."""
        light = np.fmax(dn, 1)
        self._frames["log"] = np.log(light) - np.log(self._exposure_ms)
        self._frames["variance"] = np.where(
            usable, (READ_NOISE_DN**2 + light / DN_PER_SHOT) / light**2, 0)

    def _copy(self) -> PixelSample:
        """Return a copy of the sample; its arrays are the same."""
        other = copy(self)
        other._packed = {}
        return other

    def _copy_with_frames(self) -> PixelSample:
        """Return a copy of the sample whose frames may be changed."""
        other = self._copy()
        other._frames = self._frames.view(_READING).copy().view(READING_DTYPE)
        return other

    def thinned(self, least: int) -> PixelSample:
        """Return a part of the pixels, spread evenly: at least `least`, or all."""
        every = max(len(self.pixels) // least, 1)
        if every == 1:
            return self
        other = self._copy()
        other.pixels, other._traits = self.pixels[::every], self._traits[::every].copy()
        counts = self._traits["stop"] - self._traits["start"]
        pixel = np.repeat(np.arange(len(counts)), counts)
        other._events = self._events.take(np.flatnonzero(pixel % every == 0))
        other._traits["stop"] = np.cumsum(counts[::every])
        other._traits["start"] = other._traits["stop"] - counts[::every]
        for name in ("_dn", "_usable", "_exposure_ms"):
            setattr(other, name, getattr(self, name)[:, ::every])
        other._frames = np.ascontiguousarray(
            self._frames.view(_READING)[:, ::every]).view(READING_DTYPE)
        return other

    def with_thresholds_scaled(self, on: float, off: float) -> PixelSample:
        """Return the sample with other prior thresholds."""
        other = self._copy()
        other._traits = self._traits.copy()
        other._traits["theta_on"] *= on
        other._traits["theta_off"] *= off
        return other

    @property
    def samples(self) -> int:
        """Number of usable samples, of all pixels and frames."""
        return int(np.count_nonzero(self._frames["variance"] > 0))

    @property
    def gaps_us(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times between consecutive events of one pixel, and where the sign changes."""
        first = np.zeros(len(self._events) + 1, np.bool_)
        first[self._traits["start"]] = True
        inside = ~first[1:-1]
        p = self._events["p"]
        return np.diff(self._events["t"])[inside], (p[1:] != p[:-1])[inside]

    def with_refractory(self, us: float) -> PixelSample:
        """Return the sample with a refractory period after each event."""
        other = self._copy()
        other.refractory_us = us
        return other

    def without_dim_samples(self) -> PixelSample:
        """Return the sample without values below `MIN_DN`."""
        return self._with_offset(0.0)

    def with_leak_in_frames(self) -> PixelSample:
        """Return the sample with frames that grow as the mean leak adds to event sums.

        An uncorrected leak makes the photoreceptors appear up to 7 % too slow.
        """
        other = self._copy_with_frames()
        middle = other._frames["middle"]
        rate = self.leak_hz[0] * float(self._traits["theta_on"].mean()) / 1e6
        if middle.size:
            other._frames["log"] += rate * (middle - middle.mean())
        return other

    def with_frames_moved(self, us: int) -> PixelSample:
        """Return the sample with the frames' times shifted by us."""
        other = self._copy_with_frames()
        for name in ("begin", "middle", "end", "known"):
            other._frames[name] += us
        return other

    def that_may_move(self, us: int) -> PixelSample:
        """Return the sample without frames that lack events if shifted by up to us."""
        return self._with_usable(self._frames["known"] + us <= self._last_us)

    def between_like_events(
        self, delay_us: float, or_in_exposure: int | None = None
    ) -> PixelSample:
        """Return the sample of frames between events of one sign, three in a row.

        There interpolation is best: where the light turns or rests, it may have an
        error of a threshold, which looks like a delay.

        Parameters
        ----------
        delay_us : float
            Delay of events behind frames.
        or_in_exposure : int, optional
            Also use frames with at least so many events within the exposure.
        """
        p, start, stop = (self._events["p"], self._traits["start"],
                          self._traits["stop"])
        like = np.zeros(self._frames.shape, np.bool_)
        find = self._places(delay_us)
        after = find("middle", "right")
        inside = (after >= start + 2) & (after < stop)
        k = after[inside]
        like[inside] = (p[k] == p[k - 1]) & (p[k] == p[k - 2])
        if or_in_exposure is not None:
            like |= find("end", "left") - find("begin", "left") >= or_in_exposure
        return self._with_usable(like)

    def _places(
        self, delay_us: float
    ) -> Callable[[str, Literal["left", "right"]], NDArray[np.intp]]:
        """Return a function that finds delayed times of exposures among the events.

        Events are stored pixel by pixel, so one search finds all times, shape (F, N).
        """
        if not self._frames.size:
            return lambda name, side: np.zeros(self._frames.shape, np.intp)
        before = int(self._frames["begin"].min()) + round(delay_us) - 1
        after = int(self._frames["end"].max()) + round(delay_us) + 1
        pixel = np.arange(len(self._traits)) * (after - before + 1)
        times = np.repeat(pixel, self._traits["stop"] - self._traits["start"])
        times += self._events["t"].clip(before, after) - before

        def find(name: str, side: Literal["left", "right"]) -> NDArray[np.intp]:
            """Return the first event after a time (right), or not before it (left)."""
            wanted = self._frames[name] + (round(delay_us) - before)
            return np.searchsorted(times, wanted + pixel, side)

        return find

    def _with_usable(self, usable: NDArray[np.bool_]) -> PixelSample:
        other = self._copy_with_frames()
        other._frames["variance"][~usable] = 0
        return other

    def innovations(
        self, candidates: NDArray[np.void], every: int = 1
    ) -> NDArray[np.void]:
        """Return the innovations of a filter under each candidate.

        Parameters
        ----------
        candidates : ndarray of CANDIDATE_DTYPE, shape (C,)
            The cameras to try.
        every : int
            One in so many pixels is used.

        Returns
        -------
        ndarray of INNOVATIONS_DTYPE, shape (C,)
        """
        out = np.zeros(len(candidates), INNOVATIONS_DTYPE)
        traits, frames = self._readings(every)
        _kernels.sample_innovations(
            self._events, traits, frames, self._waves, THRESHOLD_SIGMA,
            self.refractory_us, candidates, out)
        return out

    def innovations_by_time(
        self, candidates: NDArray[np.void], blocks: int
    ) -> NDArray[np.void]:
        """Return the innovations of each of B blocks of frames, shape (C, B).

        Blocks are equal parts of the frames in order of time.  The filter runs through
        all of them; a block's sums are the differences of the cumulative sums.

        Parameters
        ----------
        candidates : ndarray of CANDIDATE_DTYPE, shape (C,)
            The cameras to try.
        blocks : int
            Number of blocks.
        """
        number = np.arange(len(self._frames))[:, None]
        sums = np.stack([
            self._with_usable(np.broadcast_to(
                number * blocks < (k + 1) * len(number), self._frames.shape))
            .innovations(candidates) for k in range(blocks)], axis=1)
        out = sums.copy()
        for name in out.dtype.names or ():
            out[name][:, 1:] -= sums[name][:, :-1]
        return out

    def _readings(self, every: int) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """Return one in `every` pixels, and their usable frames, pixel after pixel."""
        if every not in self._packed:
            usable = self._frames["variance"][:, ::every] > 0
            pixel, k = np.nonzero(usable.T)
            traits = self._traits[::every].copy()
            traits["last"] = np.cumsum(usable.sum(0))
            traits["first"][1:] = traits["last"][:-1]
            self._packed[every] = traits, self._frames.view(_READING).ravel().take(
                k * len(self._traits) + every * pixel).view(READING_DTYPE)
        return self._packed[every]

    def systematics(
        self, law: tuple[float, float], activity: PixelActivity,
        frames: FrameSystematics,
    ) -> SystematicErrors:
        """Return the systematic errors of the thresholds, for the whole sensor."""
        as_is, without_lag = self._log_scales([law, (0.0, 0.0)], 0.0)
        brightened, = self._log_scales([law], 1.0)
        model_sigma = math.hypot(_MODEL_MIN_SIGMA, _MODEL_SHARE * (without_lag - as_is))
        low = np.maximum(activity.min_dn, MIN_DN)
        high = np.maximum(activity.max_dn, MIN_DN)
        low = np.minimum(low, (1 - _MIN_CONTRAST) * high)
        # Relative change of the contrast ln(high / low) per DN of offset.
        contrast = (1 / low - 1 / high) / np.log(high / low)
        here = np.mean(contrast.ravel()[self.pixels])
        per_dn = (brightened - as_is) / here * contrast
        return SystematicErrors(
            activity.events_per_s / 2, per_dn, frames, model_sigma, self.leak_hz)

    def _log_scales(
        self, laws: list[tuple[float, float]], offset_dn: float
    ) -> NDArray[np.float64]:
        """Return the mean ln of the estimated thresholds, for frames with an offset."""
        sums: NDArray[np.float64] = self._with_offset(offset_dn).innovations(
            candidates_of(laws))["log_theta"]
        return sums / (2 * len(self.pixels))

    def _with_offset(self, offset_dn: float) -> PixelSample:
        """Return the sample with an offset added to frames, without dim values."""
        other = self._copy_with_frames()
        dn = self._dn + np.float32(offset_dn)
        other._read(dn, self._usable & (dn >= MIN_DN))
        return other


def contradicted_share(
    intervals: Sequence[Interval], counts: NDArray[np.int32],
    theta_on: NDArray[np.float64], theta_off: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how often frames contradict the change that a pixel's events imply.

    Events between two frames are tested if their sum is a large part of the sum of
    their magnitudes; frames contradict them if they show almost none of that change.

    Parameters
    ----------
    intervals : sequence of Interval
        Intervals, each with a frame (F of them).
    counts : ndarray of int32, shape (F, 2, K)
        OFF and ON events before each frame.
    theta_on, theta_off : ndarray of float64, shape (K,)
        Thresholds, ln units.

    Returns
    -------
    ndarray of float64, shape (K,)
        Fraction of the intervals with events that are contradicted; 0 without any.
    """
    # Only pixels and intervals with events are computed.
    good = np.array([each.usable for each in intervals])
    eventful = good[1:] & good[:-1] & (counts[1:].sum(1) >= _CLAIM_EVENTS)
    k, pixel = np.nonzero(eventful)
    dn = np.array([each.dn for each in intervals])
    before, after = (np.fmax(dn[at, pixel], 1).astype(np.float64) for at in (k, k + 1))
    fell, rose = theta_off[pixel] * counts[k + 1, 0, pixel], (
        theta_on[pixel] * counts[k + 1, 1, pixel])
    claim, path = rose - fell, rose + fell
    shown = (np.log(after) - np.log(before)) * np.sign(claim)
    variance = sum((READ_NOISE_DN**2 + light / DN_PER_SHOT) / light**2
                   for light in (after, before))
    against = ((np.abs(claim) > _CLAIM_SHARE * path)
               & (_SHOWN_SHARE * np.abs(claim) - shown
                  > _CLAIM_SIGMAS * np.sqrt(variance)))
    share: NDArray[np.float64] = np.bincount(
        pixel[against], minlength=len(theta_on)) / np.maximum(eventful.sum(0), 1)
    return share


def select_busy_pixels(
    window: PixelWindow, nominal: tuple[ArrayLike, ArrayLike],
    leak_hz: tuple[float, float],
) -> PixelSample | None:
    """Return a sample of busy pixels, None if there are too few frames or events."""
    intervals = window.intervals
    if len(intervals) < _MIN_FRAMES:
        return None
    counts = np.array([each.counts[:, 0] for each in intervals])
    total = counts.sum(0)
    both = total.sum(0)
    usable = np.sum([each.usable & (each.dn >= USABLE_DN) for each in intervals], 0)
    on, off = (np.broadcast_to(np.asarray(theta, np.float64), window.shape).ravel()[
        window.pixels] for theta in nominal)
    hot = contradicted_share(intervals, counts, on, off) >= _HOT_SHARE
    busy = np.where((usable >= _USABLE_SHARE * len(intervals)) & ~hot, both, 0)
    if not busy.any():
        return None
    # The count of an existing pixel, so that at least this pixel is busy.
    level = np.quantile(busy[busy > 0], _BUSY_QUANTILE, method="nearest")
    chosen = np.flatnonzero(
        (busy >= level / _BUSY_FACTOR) & (busy <= level * _BUSY_FACTOR))
    off, on = np.log(np.maximum(total[:, chosen], _LEAST_COUNT))
    balance = off - on
    typical = np.quantile(balance, 0.5, method="nearest")
    chosen = chosen[np.abs(balance - typical) <= _MAX_BALANCE]
    n = int(np.clip(_SAMPLE_EVENTS / level, _MIN_SAMPLE_PIXELS, _SAMPLE_PIXELS))
    chosen = np.sort(np.random.default_rng(0).permutation(chosen)[:n])
    mids = [int(each.exposure_us[1].max()) for each in intervals]
    seconds = max(mids[-1] - mids[0], 1) / 1e6 / (len(mids) - 1)
    # Rates are weighted by themselves, so that intervals with more events count more.
    rates = np.sum(counts[..., chosen].sum(1, dtype=np.int64)**2, 0) / np.maximum(
        both[chosen] * seconds, np.finfo(float).tiny)
    return PixelSample(window, chosen, nominal, float(rates.mean()), leak_hz)
