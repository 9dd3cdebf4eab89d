"""The online self-calibration: looks on while a stream passes, gives an estimate."""
from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import sensor_shape
from pdavis_cv.events import as_events
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.selfcal.bandwidth import Bandwidth, combine_bandwidths, fit_bandwidth
from pdavis_cv.selfcal.noise import fit_event_noise
from pdavis_cv.selfcal.pixel_sample import (
    Item,
    feed,
    run_filter,
    select_busy_pixels,
    without_dim_samples,
)
from pdavis_cv.selfcal.priors import LEAK_HZ, THRESHOLD_SIGMA
from pdavis_cv.selfcal.thresholds import shrink_to_population, variance_inflation
from pdavis_cv.selfcal.uncertainty import frame_systematics
from pdavis_cv.sensor import Sensor

__all__ = ["QUANTITIES", "CameraEstimate", "SelfCalibration"]

QUANTITIES = frozenset({"thresholds", "bandwidth", "noise"})
"""What a `SelfCalibration` can estimate."""

_MAX_US, _MAX_EVENTS = 10_000_000, 5_000_000
"""Upper bounds of the window: 10 s, 5 million events (65 MB)."""

_MIN_INFLATION, _MAX_INFLATION = (1e-4, 1e-3), 4.0
"""Bounds on the factors on variances, of the ratio and of the scale."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraEstimate:
    """What passing data have told about their camera.

    Parameters
    ----------
    theta_on, theta_off : ndarray of float64, shape (H, W)
        Contrast thresholds, positive magnitudes, ln units; the nominal ones where they
        were not estimated.
    covariance : ndarray of float64, shape (H, W, 2, 2), or None
        Of (theta_on, theta_off), systematic errors included (leak events, offsets of
        the frames, common scale); the ratio is known far better than the sum.  None if
        thresholds were not estimated.
    bandwidth : Bandwidth or None
        Of the photoreceptors; None where it was not estimated or cannot be told.
    noise : float or None
        Process noise of the events (leak and noise events): variance of their sum per
        second, thresholds^2; None where it was not estimated or cannot be told.
    common_scale_sigma : float
        Standard deviation of the ln of the scale that all pixels share.  Part of
        `covariance`, and the same error in every pixel: no mean over pixels reduces it.
    """

    theta_on: NDArray[np.float64]
    theta_off: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    bandwidth: Bandwidth | None = None
    noise: float | None = None
    common_scale_sigma: float = 0.0

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


class SelfCalibration:
    """Estimates a camera's thresholds, bandwidth and event noise from passing data.

    Fed in order of time like a `Reconstructor`: a frame at its mid-exposure, corrected
    by what is known of the camera.  It keeps a window from the first item on, bounded
    in time and events, and ignores what comes after (`full`).

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
        (hz, hz_per_intensity, sigma) of a calibration, combined with what is found.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.  The mean is
        taken out of thresholds and bandwidth, the rest counts in the covariance.
    threshold_sigma : float
        Prior standard deviation of a pixel's thresholds about `nominal`, ln units.

    Raises
    ------
    ValueError
        If `leak_hz` is not two numbers of at least 0, or `threshold_sigma` is not
        positive.
    """

    def __init__(
        self, sensor_size: Sequence[int],
        nominal: tuple[ArrayLike, ArrayLike] = (0.2, 0.2), *,
        sensor: Sensor | None = None, dark: bool = False,
        stated_bandwidth: tuple[float, float, float] | None = None,
        leak_hz: tuple[float, float] = LEAK_HZ,
        threshold_sigma: float = THRESHOLD_SIGMA,
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
        self._items: list[Item] = []
        self._begin_us: int | None = None
        self._events = 0
        self._full = False

    @property
    def full(self) -> bool:
        """Whether the window is complete: what is fed from now on is ignored."""
        return self._full

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events of the whole sensor, later than all before."""
        events = as_events(events)
        if len(events) and self._takes(int(events["t"][0])):
            self._items.append(events)
            self._events += len(events)

    def add_frame(self, frame: ApsFrame) -> None:
        """Take a frame of the whole sensor, corrected, in order of mid-exposure."""
        if self._takes(frame.mid_us):
            self._items.append(frame)

    def add_wave(self, wave: Wave) -> None:
        """Take what the lamp does in a block of time (see `LampTracker`)."""
        if not self._full:
            self._items.append(wave)

    def _takes(self, t_us: int) -> bool:
        if self._begin_us is None:
            self._begin_us = t_us
        self._full |= (t_us - self._begin_us > _MAX_US or self._events > _MAX_EVENTS)
        return not self._full

    def estimate(
        self, *, wanted: Collection[str] = QUANTITIES,
        bandwidth: Sequence[float] | None = None,
    ) -> CameraEstimate:
        """Return what the window tells; the window stays as it is.

        Parameters
        ----------
        wanted : collection of str
            Of `QUANTITIES`.
        bandwidth : (hz, hz_per_intensity, ...), optional
            Used if "bandwidth" is not wanted; default: no lag.

        Returns
        -------
        CameraEstimate
        """
        if not QUANTITIES.issuperset(wanted):
            raise ValueError(
                f"wanted must be among {sorted(QUANTITIES)}, got {sorted(wanted)}")
        sample = select_busy_pixels(
            self._items, self.shape, self._nominal, self._leak_hz)
        found: Bandwidth | None = None
        law = (0.0, 0.0) if bandwidth is None else (bandwidth[0], bandwidth[1])
        if sample is not None and "bandwidth" in wanted:
            found = fit_bandwidth(sample)
            law = found.law
        noise = (fit_event_noise(sample, law)
                 if sample is not None and "noise" in wanted else None)
        if found is not None and self._stated is not None:
            found = combine_bandwidths(self._stated, found)
        if "thresholds" not in wanted:
            on, off = (np.broadcast_to(np.asarray(value, np.float64), self.shape)
                       for value in self._nominal)
            return CameraEstimate(
                theta_on=on, theta_off=off, bandwidth=found, noise=noise)
        frames = [i for i, item in enumerate(self._items) if isinstance(item, ApsFrame)]
        half = frames[len(frames) // 2] if frames else 0
        method = run_filter(map(without_dim_samples, self._items[:half]), self.shape,
                            *self._nominal, self._sigma, law)
        after_half = method.thresholds
        feed(method, map(without_dim_samples, self._items[half:]))
        theta, covariance = method.thresholds
        chi, _, n = method.misfit
        low_ratio, low_scale = _MIN_INFLATION
        of_scale = (float(np.clip(chi / n, low_scale, _MAX_INFLATION)) if n else 1.0)
        of_ratio = variance_inflation(after_half, (theta, covariance))
        inflation = (of_scale if of_ratio is None else float(
            np.clip(of_ratio, low_ratio, _MAX_INFLATION)), of_scale)
        systematics = None if sample is None else sample.systematics(
            law, frame_systematics(self._sensor, self._dark))
        theta, covariance = shrink_to_population(
            theta, covariance, self._nominal, self._sigma, inflation, systematics)
        return CameraEstimate(
            theta_on=theta[0], theta_off=theta[1], covariance=covariance,
            bandwidth=found, noise=noise, common_scale_sigma=(
                0.0 if systematics is None else systematics.common_scale_sigma))

    @property
    def nbytes(self) -> int:
        """Bytes of the window."""
        return sum(
            item.dn.nbytes + (0 if item.valid is None else item.valid.nbytes)
            if isinstance(item, ApsFrame) else
            0 if isinstance(item, Wave) else item.nbytes for item in self._items)

    def state(self) -> Mapping[str, Any]:
        """Return the window, never changed later."""
        return {"items": tuple(self._items), "begin_us": self._begin_us,
                "events": self._events, "full": self._full}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what `state` returned."""
        self._items, self._begin_us = list(state["items"]), state["begin_us"]
        self._events, self._full = state["events"], state["full"]
