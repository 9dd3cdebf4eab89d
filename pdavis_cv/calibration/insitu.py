"""Thresholds and bandwidth from the recording itself: no stage, no known scene.

Frames at their mid-exposure say where log intensity was; events say how it got from
one frame to the next.  What fits both tells each pixel's thresholds, and frames taken
while the light changes tell how late the events are.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._feed import Feed
from pdavis_cv.calibration.bandwidth import Bandwidth, combined
from pdavis_cv.calibration.certainty import LEAK_HZ, settled, shrunk, unseen
from pdavis_cv.calibration.corrected import corrected
from pdavis_cv.calibration.known import calibrated, noise_of, stated_bandwidth
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.receptor_fit import fit_bandwidth, fit_noise
from pdavis_cv.calibration.sample import (
    SIGMA,
    Items,
    bright,
    busy_pixels,
    feed,
    run,
)
from pdavis_cv.calibration.thresholds import Theta, resolve_thresholds
from pdavis_cv.reconstruct.base import Needs
from pdavis_cv.reconstruct.lamp import LampTracker
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.sensor import Sensor

__all__ = ["ThresholdEstimate", "bandwidth_in_situ", "learned", "receptors",
           "thresholds_in_situ"]

LEARNED_SIGMA = 0.003
"""What the filter is told of thresholds learned in situ: it goes on learning."""

# Bounds on what is held in memory and looked at.
_MAX_SECONDS, _MAX_EVENTS = 10.0, 5_000_000


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
    leak_hz: tuple[float, float] = LEAK_HZ,
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
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.  The mean is
        taken out, the rest counts: a turning polarizer does not tell the leak.
    start_us, stop_us : int, optional
        The part to look at, at most 10 s and 5 million events of it; default: from
        the beginning.

    Returns
    -------
    ThresholdEstimate

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
    if np.shape(leak_hz) != (2,) or not (np.isfinite(leak_hz).all()
                                         and min(leak_hz) >= 0):
        raise ValueError(
            "leak_hz must be (mean, standard deviation), each at least 0, got "
            f"{leak_hz!r}")
    shape = recording.info.sensor_size
    items = _window(recording, nominal, calibration, start_us, stop_us)
    sample = busy_pixels(items, shape, nominal, leak_hz)
    found = bandwidth if isinstance(bandwidth, Bandwidth) else None
    if sample is not None and isinstance(bandwidth, str):
        found = fit_bandwidth(sample)
    law = (0.0, 0.0) if found is None else found.law
    at = [i for i, item in enumerate(items) if isinstance(item, ApsFrame)]
    half = at[len(at) // 2] if at else 0
    method = run(map(bright, items[:half]), shape, *nominal, sigma, law)
    early = method.thresholds
    feed(method, map(bright, items[half:]))
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
        None if sample is None else fit_noise(sample, law),
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
    sample = busy_pixels(items, recording.info.sensor_size, nominal)
    return None if sample is None else fit_bandwidth(sample)


def learned(
    recording: Recording,
    thresholds: str | tuple[ArrayLike, ArrayLike] | None,
    nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None,
    parameters: dict[str, Any],
    needs: Needs,
    *,
    causal: bool,
    late: bool,
) -> tuple[Theta, Theta, dict[str, Any]]:
    """Return thresholds and parameters of a method, learned where that was asked for.

    ``fuse`` documents the arguments.  The bandwidth and the noise of events too are
    estimated unless they are given, if `needs` says so; what the calibration states of
    the bandwidth with an uncertainty is where that begins.  With `late` nothing is, and
    a bandwidth that is not given is "in-situ", which `Past` replaces.

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
    if needs.prior:
        parameters = calibrated(parameters, thresholds, calibration)
        if calibration is None or calibration.dark is None:
            sensor = recording.info.sensor or Sensor.PDAVIS
            parameters.setdefault("offset_dn", sensor.offset_dn)
    wanted = parameters.get("bandwidth", "in-situ")
    ask = "bandwidth" in needs.learned and isinstance(wanted, str)
    if ask and wanted != "in-situ":
        raise ValueError(
            "bandwidth must be 'in-situ', (hz, hz_per_intensity) or None, got "
            f"{wanted!r}")
    stated = stated_bandwidth(calibration) if ask else None
    if ask:
        parameters["bandwidth"] = stated
    noise_too = "noise" in needs.learned and not late and "noise" not in parameters
    if ask and late:
        parameters["bandwidth"], ask = "in-situ", False
    if "noise" in needs.learned and not late:
        parameters.setdefault("noise", noise_of(calibration))
    if recording.info.frame_count == 0 or causal or not (ask or learn or noise_too):
        return on, off, parameters
    found: Bandwidth | None = None
    noise: float | None = None
    if learn:
        estimate = thresholds_in_situ(
            recording, nominal=(on, off), calibration=calibration,
            bandwidth="in-situ" if ask or not needs.learned else None)
        on, off = (theta.astype(np.float32)
                   for theta in (estimate.theta_on, estimate.theta_off))
        found, noise = estimate.bandwidth, estimate.noise
        if "threshold_sigma" in needs.prior:
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
    sample = busy_pixels(items, recording.info.sensor_size, nominal)
    if sample is None:
        return None, None
    if bandwidth is None:
        found = fit_bandwidth(sample)
        return found, fit_noise(sample, found.law)
    return None, fit_noise(sample, (bandwidth[0], bandwidth[1]))


def _window(
    recording: Recording, nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None, start_us: int | None, stop_us: int | None,
) -> Items:
    """Return frames, events and the lamp in order of time, from start_us, bounded."""
    items: Items = []
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
