"""Thresholds and bandwidth from the recording itself: no stage, no known scene.

Feeds a `SelfCalibration` with a recording's beginning.
"""
from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pdavis_cv._feed import Feed
from pdavis_cv.calibration.corrected import corrected
from pdavis_cv.calibration.known import calibrated, noise_of, stated_bandwidth
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import Theta, resolve_thresholds
from pdavis_cv.reconstruct.base import Needs
from pdavis_cv.reconstruct.lamp import LampTracker
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.selfcal import (
    LEAK_HZ,
    Bandwidth,
    CameraEstimate,
    SelfCalibration,
    combine_bandwidths,
)
from pdavis_cv.selfcal.estimator import QUANTITIES
from pdavis_cv.selfcal.priors import THRESHOLD_SIGMA
from pdavis_cv.sensor import NOMINAL_THRESHOLDS, Sensor

__all__ = ["bandwidth_in_situ", "learned", "receptors", "thresholds_in_situ"]

LEARNED_SIGMA = 0.003
"""threshold_sigma (ln units) given to `KalmanFilter` after in-situ estimation."""


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
    camera = _looked_on(recording, nominal, calibration, start_us, stop_us,
                        leak_hz=leak_hz, threshold_sigma=sigma)
    if isinstance(bandwidth, str):
        return camera.estimate(wanted=QUANTITIES)
    found = camera.estimate(wanted={"thresholds", "noise"}, bandwidth=(
        None if bandwidth is None else bandwidth.law))
    return replace(found, bandwidth=bandwidth)


def bandwidth_in_situ(
    recording: Recording,
    *,
    nominal: tuple[ArrayLike, ArrayLike] = NOMINAL_THRESHOLDS,
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
    return _looked_on(
        recording, nominal, calibration, start_us, stop_us, every_pixel=False).estimate(
            wanted={"bandwidth"}).bandwidth


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
        if found is not None and stated is not None:
            found = combine_bandwidths(stated, found)
        if "threshold_sigma" in needs.prior:
            parameters.setdefault("threshold_sigma", LEARNED_SIGMA)
    else:
        found, noise = receptors(
            recording, (on, off), calibration,
            None if ask else parameters.get("bandwidth") or (0.0, 0.0))
    if noise_too and noise is not None:
        parameters["noise"] = noise_of(calibration, noise)
    if ask and found is not None:
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
        As in `CameraEstimate`.
    """
    wanted: Collection[str] = {"bandwidth", "noise"} if bandwidth is None else {"noise"}
    found = _looked_on(
        recording, nominal, calibration, None, by_us, by_us,
        stated_bandwidth=stated_bandwidth(calibration), every_pixel=False).estimate(
            wanted=wanted, bandwidth=bandwidth)
    return found.bandwidth, found.noise


def _looked_on(
    recording: Recording, nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None, start_us: int | None, stop_us: int | None,
    by_us: int | None = None, **options: Any,
) -> SelfCalibration:
    """Return what has seen the frames, events and lamp from start_us on.

    Of frames, only those that had arrived by by_us.
    """
    size = recording.info.sensor_size
    camera = SelfCalibration(
        size, nominal, sensor=recording.info.sensor,
        dark=calibration is not None and calibration.dark is not None, **options)
    lamp = LampTracker(size, *nominal)
    feed = Feed(recording, None if start_us is None else start_us - 1,
                start_us, by_arrival=False)
    for item in feed.until(stop_us):
        if isinstance(item, ApsFrame):
            if by_us is None or item.available_us <= by_us:
                camera.add_frame(corrected(item, calibration))
        else:
            for wave in lamp.push(item):
                camera.add_wave(wave)
            camera.add_events(item)
        if camera.full:
            break
    return camera
