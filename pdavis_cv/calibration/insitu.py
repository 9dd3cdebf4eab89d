"""Thresholds and bandwidth from the recording itself: no stage, no known scene.

Frames at their mid-exposure say where log intensity was; events say how it got from
one frame to the next.  What fits both tells each pixel's thresholds, and frames taken
while the light changes tell how late the events are.
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._feed import Feed
from pdavis_cv.calibration.bandwidth import TYPICAL_BANDWIDTH, Bandwidth, combined
from pdavis_cv.calibration.certainty import (
    Doubts,
    Seen,
    Unseen,
    brighter,
    settled,
    shrunk,
    unseen,
    vertex,
)
from pdavis_cv.calibration.corrected import corrected
from pdavis_cv.calibration.known import calibrated, noise_of, stated_bandwidth
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import Theta, resolve_thresholds
from pdavis_cv.reconstruct.kalman import NOISE, KalmanFilter
from pdavis_cv.reconstruct.lamp import LampTracker, Wave
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.sensor import Sensor

__all__ = ["USUAL_BANDWIDTH", "ThresholdEstimate", "bandwidth_in_situ",
           "learned", "receptors", "thresholds_in_situ"]

SIGMA = 0.035
"""Standard deviation of a threshold about its nominal value, natural-log units."""

LEARNED_SIGMA = 0.003
"""What the filter is told of thresholds learned in situ: it goes on learning."""

# As `KalmanFilter`'s, but what de-blurring leaves is not independent from frame to
# frame: it counts for more where many frames are added up.
_NOISE = (0.05, 1.3, 0.005)
# Of images, variance of the sum of events per second: from quiet pixels to noisy ones.
_GRID_NOISE = (NOISE[1], 0.4, 1.5, 5.0, 15.0)
# Bounds on what is held in memory and looked at.
_MAX_SECONDS, _MAX_EVENTS = 10.0, 5_000_000
# Below it noise and the offset bend a sample's logarithm more than they scatter it, the
# same way at each turn: thresholds come out up to 30 % too small.
_LEAST_DN = 16.0
# What the model of the photoreceptors has wrong, as a part of what it changes; and what
# interpolation has wrong in all pixels alike.
_MODEL_SHARE, _MODEL_LEAST = 0.6, 0.002
# For the bandwidth a sample of pixels is enough.
_SAMPLE_EVENTS, _SAMPLE_PIXELS, _SAMPLE_FRAMES = 60_000, 256, 100
# How far, in ln, the balance of their events may be from that of most.
_TYPICAL = 0.5

# Corner frequency at bright pixels that a DAVIS has at usual biases, and the standard
# deviation of its ln.
USUAL_BANDWIDTH = (TYPICAL_BANDWIDTH[0], 0.0, 1.5)
_LN_HZ, _LN_HZ_SIGMA = np.log(USUAL_BANDWIDTH[0]), USUAL_BANDWIDTH[2]
# By how much the misfit's curvature overrates what is known of it; what is wrong with
# the law, and seconds of a lag by which interpolation errs, this way at one speed and
# that way at another.  All measured.
_ALIKE, _LAW, _TIMING_S = 2.5, 0.02, 12e-6
_GRID_HZ = (30.0, 80.0, 160.0, 300.0, 600.0, 2000.0)
# How much likelier, in ln, a bandwidth that follows the light must be than a constant
# one (a fan's steps make it up to 18, pixels that do follow 37 or more, but for the
# dimmest light); and how near a coarse look must come for the constant one to have a
# chance.
_EVIDENCE, _NEAR = 20.0, 500.0

_EVER = -(2**62), 2**62

_Item = ApsFrame | Wave | NDArray[Any]
_Items = list[_Item]


@dataclass(frozen=True, eq=False)
class ThresholdEstimate:
    """Contrast thresholds of every pixel, as its own recording tells them.

    Parameters
    ----------
    theta_on, theta_off : ndarray of float64, shape (H, W)
        Positive magnitudes, natural-log units.
    covariance : ndarray of float64, shape (H, W, 2, 2)
        Of (theta_on, theta_off); their ratio is known far better than their sum.
        It holds what no frame of the recording shows: leak events, offsets of the
        frames, and the common scale.
    bandwidth : Bandwidth or None
        What was assumed or found out about the photoreceptors.
    noise : float or None
        Variance of the sum of events per second, in thresholds^2: leak and noise
        events; None where frames or events are too few.
    common : float
        Standard deviation of the log of the scale that all pixels share: a part of
        the covariance, and the same error in each of them, so that no mean over
        pixels lessens it.
    """

    theta_on: NDArray[np.float64]
    theta_off: NDArray[np.float64]
    covariance: NDArray[np.float64]
    bandwidth: Bandwidth | None
    noise: float | None = None
    common: float = 0.0

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviation of theta_on and theta_off, shape (2, H, W)."""
        return np.sqrt(np.stack([self.covariance[..., 0, 0],
                                 self.covariance[..., 1, 1]]))

    @property
    def ratio_sigma(self) -> NDArray[np.float64]:
        """Standard deviation of ln(theta_on / theta_off), shape (H, W)."""
        a, b, c = 1 / self.theta_on, -1 / self.theta_off, self.covariance
        return np.sqrt(a * a * c[..., 0, 0] + b * b * c[..., 1, 1]
                       + 2 * a * b * c[..., 0, 1])


def thresholds_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = (0.2, 0.2),
    sigma: float = SIGMA,
    bandwidth: Bandwidth | str | None = "in-situ",
    calibration: Calibration | None = None,
    start_us: int | None = None,
    stop_us: int | None = None,
) -> ThresholdEstimate:
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
    start_us, stop_us : int, optional
        The part to look at, at most 10 s and 5 million events of it; default: from
        the beginning.

    Returns
    -------
    ThresholdEstimate

    Raises
    ------
    ValueError
        If ``sigma`` is not positive or ``bandwidth`` is another word.
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    if isinstance(bandwidth, str) and bandwidth != "in-situ":
        raise ValueError(
            f"bandwidth must be 'in-situ', a Bandwidth or None, got {bandwidth!r}")
    shape = recording.info.sensor_size
    items = _window(recording, nominal, calibration, start_us, stop_us)
    sample = _sample(items, shape, nominal)
    found = bandwidth if isinstance(bandwidth, Bandwidth) else None
    if sample is not None and isinstance(bandwidth, str):
        found = _bandwidth(sample)
    law = (0.0, 0.0) if found is None else found.law
    at = [i for i, item in enumerate(items) if isinstance(item, ApsFrame)]
    half = at[len(at) // 2] if at else 0
    method = _run(map(_bright, items[:half]), shape, *nominal, sigma, law)
    early = method.thresholds
    _feed(method, map(_bright, items[half:]))
    theta, covariance = method.thresholds
    chi, _, n = method.misfit
    # The noise was assumed; what is left over says how large it is.
    scale = float(np.clip(chi / n, 1e-3, 4.0)) if n else 1.0
    of_ratio = settled(early, (theta, covariance))
    scales = (scale if of_ratio is None else float(np.clip(of_ratio, 1e-4, 4.0)), scale)
    doubts = None
    if sample is not None:
        dark = calibration is not None and calibration.dark is not None
        doubts = sample.doubts(law, unseen(recording.info.sensor, dark))
    theta, covariance = shrunk(theta, covariance, nominal, sigma, scales, doubts)
    return ThresholdEstimate(
        theta[0], theta[1], covariance, found,
        None if sample is None else _noise(sample, law),
        0.0 if doubts is None else doubts.common)


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
    recording, nominal, calibration, start_us, stop_us
        As for `thresholds_in_situ`.

    Returns
    -------
    Bandwidth or None
        None where frames or events are too few to tell anything.
    """
    items = _window(recording, nominal, calibration, start_us, stop_us)
    sample = _sample(items, recording.info.sensor_size, nominal)
    return None if sample is None else _bandwidth(sample)


def learned(
    recording: Recording,
    thresholds: str | tuple[ArrayLike, ArrayLike] | None,
    nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None,
    parameters: dict[str, Any],
    method: str,
    *,
    causal: bool,
) -> tuple[Theta, Theta, dict[str, Any]]:
    """Return thresholds and parameters of a method, learned where that was asked for.

    ``fuse`` documents the arguments.  For ``kalman`` the bandwidth and the noise of
    events too are estimated unless they are given; what the calibration states of the
    bandwidth with an uncertainty is where that begins.  With `causal` nothing is, and a
    bandwidth that is not given is "in-situ", which `Past` replaces.

    Returns
    -------
    theta_on, theta_off : floats or ndarrays of float32, shape (H, W)
    parameters : dict
        With ``bandwidth`` and ``noise`` as numbers.
    """
    learn = isinstance(thresholds, str) and thresholds == "in-situ"
    on, off = resolve_thresholds(
        recording, None if learn else thresholds, nominal, calibration)
    parameters = dict(parameters)
    if method == "kalman":
        parameters = calibrated(parameters, thresholds, calibration)
        if calibration is None or calibration.dark is None:
            sensor = recording.info.sensor or Sensor.PDAVIS
            parameters.setdefault("offset_dn", sensor.offset_dn)
    late = causal or parameters.get("mode") == "causal"
    wanted = parameters.get("bandwidth", "in-situ")
    ask = method == "kalman" and isinstance(wanted, str)
    if ask and wanted != "in-situ":
        raise ValueError(
            "bandwidth must be 'in-situ', (hz, hz_per_intensity) or None, got "
            f"{wanted!r}")
    stated = stated_bandwidth(calibration) if ask else None
    if ask:
        parameters["bandwidth"] = stated
    noise_too = method == "kalman" and not late and "noise" not in parameters
    if ask and late:
        parameters["bandwidth"], ask = "in-situ", False
    if method == "kalman" and not late:
        parameters.setdefault("noise", noise_of(calibration))
    if recording.info.frame_count == 0 or causal or not (ask or learn or noise_too):
        return on, off, parameters
    found: Bandwidth | None = None
    noise: float | None = None
    if learn:
        estimate = thresholds_in_situ(
            recording, nominal=(on, off), calibration=calibration,
            bandwidth="in-situ" if ask or method != "kalman" else None)
        on, off = (theta.astype(np.float32)
                   for theta in (estimate.theta_on, estimate.theta_off))
        found, noise = estimate.bandwidth, estimate.noise
        if method == "kalman":
            parameters.setdefault("threshold_sigma", LEARNED_SIGMA)
    else:
        found, noise = receptors(
            recording, (on, off), calibration,
            None if ask else parameters.get("bandwidth") or (0.0, 0.0))
    if noise_too and noise is not None:
        parameters["noise"] = noise_of(calibration, noise)
    if ask and found is not None:
        found = found if stated is None else combined(stated, found)
        parameters["bandwidth"] = (*found.law, found.sigma)
    return on, off, parameters


def receptors(
    recording: Recording, nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None, bandwidth: Sequence[float] | None,
    by_us: int | None = None,
) -> tuple[Bandwidth | None, float | None]:
    """Return the bandwidth, unless it is given, and the noise of the events.

    Parameters
    ----------
    recording, nominal, calibration
        As for `thresholds_in_situ`.
    bandwidth : sequence of float, or None
        (hz, hz_per_intensity, ...), of which only the noise is then estimated.
    by_us : int, optional
        Only what had arrived by then is looked at.

    Returns
    -------
    bandwidth : Bandwidth or None
        None if it is given, or cannot be told.
    noise : float or None
        As in `ThresholdEstimate`.
    """
    items = _window(recording, nominal, calibration, None, by_us)
    if by_us is not None:
        items = [item for item in items if not isinstance(item, ApsFrame)
                 or item.available_us <= by_us]
    sample = _sample(items, recording.info.sensor_size, nominal)
    if sample is None:
        return None, None
    if bandwidth is None:
        found = _bandwidth(sample)
        return found, _noise(sample, found.law)
    return None, _noise(sample, (bandwidth[0], bandwidth[1]))


def _window(
    recording: Recording, nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None, start_us: int | None, stop_us: int | None,
) -> _Items:
    """Return frames, events and the lamp in order of time, from start_us, bounded."""
    items: _Items = []
    lamp = LampTracker(recording.info.sensor_size, *nominal)
    events = 0
    begin: int | None = None
    feed = Feed(recording, None if start_us is None else start_us - 1,
                start_us, by_arrival=False)
    for item in feed.until(stop_us):
        t = item.mid_us if isinstance(item, ApsFrame) else int(item["t"][0])
        begin = t if begin is None else begin
        if t - begin > _MAX_SECONDS * 1e6 or events > _MAX_EVENTS:
            break
        if isinstance(item, ApsFrame):
            items.append(corrected(item, calibration))
        else:
            items += [*lamp.push(item), item]
            events += len(item)
    return items


def _run(
    items: Iterable[_Item], shape: tuple[int, int], on: ArrayLike, off: ArrayLike,
    sigma: ArrayLike, bandwidth: tuple[float, float] | None,
    noise: tuple[float, float, float] = _NOISE,
) -> KalmanFilter:
    method = KalmanFilter(shape, theta_on=on, theta_off=off, threshold_sigma=sigma,
                          bandwidth=bandwidth, noise=noise)
    _feed(method, items)
    return method


def _bright(item: _Item) -> _Item:
    """Return the item; of a frame, the samples whose logarithm is straight."""
    if not isinstance(item, ApsFrame) or item.dn.min(initial=_LEAST_DN) >= _LEAST_DN:
        return item
    valid = item.dn >= _LEAST_DN
    return ApsFrame(
        item.dn, item.exposure_start_us, item.exposure_end_us,
        valid=valid if item.valid is None else valid & item.valid,
        available_us=item.available_us, full_scale_dn=item.full_scale_dn)


def _feed(method: KalmanFilter, items: Iterable[_Item]) -> None:
    for item in items:
        if isinstance(item, ApsFrame):
            method.add_frame(item)
        elif isinstance(item, Wave):
            method.add_wave(item)
        else:
            method.add_events(item)


class _Sample:
    """Some busy pixels, in one row, and how badly a filter fits them."""

    def __init__(self, pixels: NDArray[np.intp], items: _Items, shape: tuple[int, int],
                 nominal: tuple[ArrayLike, ArrayLike], seen: Seen) -> None:
        self.items, self.shape = items, (1, len(pixels))
        self._pixels, self._seen = pixels, seen
        self.on, self.off = (
            np.broadcast_to(np.asarray(value, np.float64), shape).ravel()[pixels][None]
            for value in nominal)
        bright = np.quantile(np.concatenate(
            [item.dn.ravel() / max(item.exposure_ms, 1e-3) for item in items
             if isinstance(item, ApsFrame)]), 0.9)
        self.bright = max(float(bright), 1e-3)

    def misfit(
        self, law: tuple[float, float],
        noise: tuple[float, float, float] = _NOISE,
    ) -> tuple[float, float, int]:
        """Return the sums of e^2 / v and of ln v over the innovations, their number."""
        chi, log, n = _run(
            self.items, self.shape, self.on, self.off, SIGMA, law, noise).misfit
        return float(chi), float(log), int(n)

    def doubts(self, law: tuple[float, float], frames: Unseen) -> Doubts:
        """Return what does not show in the misfit, for all pixels of the sensor."""
        seen, as_it_is = self._seen, self._scale(self.items, law)
        brightened = self._scale(
            [brighter(item) if isinstance(item, ApsFrame) else item
             for item in self.items], law)
        model = _MODEL_LEAST
        if law != (0.0, 0.0):
            lag = abs(self._scale(self.items, (0.0, 0.0)) - as_it_is)
            model = math.hypot(_MODEL_LEAST, _MODEL_SHARE * lag)
        low, high = np.maximum(seen.least, _LEAST_DN), np.maximum(seen.most, _LEAST_DN)
        low = np.minimum(low, 0.99 * high)
        # An offset weighs as it bends the log of the frames.
        bend = (1 / low - 1 / high) / np.log(high / low)
        here = np.mean(bend.ravel()[self._pixels])
        per_dn = (brightened - as_it_is) / here * bend
        return Doubts(seen.per_s / 2, per_dn, frames, model)

    def _scale(self, items: _Items, law: tuple[float, float]) -> float:
        """Return the mean log of the thresholds that the pixels learn."""
        theta, _ = _run(map(_bright, items), self.shape, self.on, self.off, SIGMA,
                        law).thresholds
        return float(np.mean(np.log(theta)))


def _bandwidth(sample: _Sample) -> Bandwidth:
    from scipy.optimize import minimize, minimize_scalar  # slow to load

    def cost(point: NDArray[np.float64]) -> float:
        prior = ((point[0] - _LN_HZ) / _LN_HZ_SIGMA) ** 2
        chi, log, n = sample.misfit(_law(point, sample.bright))
        # The scale of the variances, which a fast light overrates by tens, is what
        # makes the innovations likeliest: else sum ln v decides, not what fits.
        return 0.5 * float(n * np.log(max(chi / max(n, 1), 1e-9)) + log + prior)

    # Between the grid's points the misfit may be far less than at them.
    tried: list[tuple[float, NDArray[np.float64]]] = []
    for share in (0.0, 1.0):
        points = [np.array([np.log(hz), share]) for hz in _GRID_HZ]
        tried += (costs := [(cost(point), point) for point in points])
        ln_hz = vertex(np.log(_GRID_HZ), [each for each, _ in costs])
        point = np.array([ln_hz, share])
        tried.append((cost(point), point))
    _, best = min(tried, key=lambda each: each[0])
    toward = np.diag([0.3, 0.3 - 0.6 * best[1]])
    found = minimize(cost, best, method="Nelder-Mead", options={
        "maxfev": 22, "xatol": 0.01, "fatol": 0.1, "initial_simplex": [
            best, best + toward[0], best + toward[1]]})
    near, (ln_hz, _) = min((each for each in tried if each[1][1] == 0),
                           key=lambda each: each[0])
    if found.x[1] > 0 and near < found.fun + _NEAR:
        # A law of the light is followed beyond the light that told it, as where frames
        # saturate: without evidence for it the bandwidth is constant.
        constant = minimize_scalar(
            lambda at: cost(np.array([at, 0.0])), method="bounded",
            bounds=(ln_hz - 0.3, ln_hz + 0.3), options={"maxiter": 10})
        if constant.fun < found.fun + _EVIDENCE:
            found.x, found.fun = np.array([constant.x, 0.0]), constant.fun
    hz, slope = _law(found.x, sample.bright)
    step = np.array([0.1, 0.0])
    bend = (cost(found.x + step) + cost(found.x - step) - 2 * found.fun) / 0.1**2
    sigma = 1 / np.sqrt(max(bend, 1 / _LN_HZ_SIGMA**2))
    # Misfits are alike from frame to frame, so that there are fewer than frames.
    at = 0.1 * sample.bright
    timing = 2 * np.pi * (hz + slope * at) * _TIMING_S
    sigma = min(math.hypot(_ALIKE * sigma, _LAW, timing), _LN_HZ_SIGMA)
    return Bandwidth(hz, slope, at, sigma)


def _noise(sample: _Sample, law: tuple[float, float]) -> float:
    """Return the noise of events under which frames are the most likely."""
    best, least = _GRID_NOISE[0], np.inf
    for each in _GRID_NOISE:
        chi, log, _ = sample.misfit(law, (NOISE[0], each, NOISE[2]))
        if chi + log >= least:
            break
        best, least = each, chi + log
    return best


def _law(point: NDArray[np.float64], bright: float) -> tuple[float, float]:
    hz, share = float(np.exp(point[0])), float(np.clip(point[1], 0, 1))
    return hz * (1 - share), hz * share / bright


def _sample(
    items: _Items, shape: tuple[int, int], nominal: tuple[ArrayLike, ArrayLike]
) -> _Sample | None:
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
    part: _Items = []
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
    return _Sample(pixels, part, shape, nominal, seen)
