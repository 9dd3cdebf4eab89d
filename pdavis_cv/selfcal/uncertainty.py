"""Systematic errors of the thresholds: common to all samples, not in the innovations.

The ratio of a pixel's thresholds is estimated from the drift of its events against its
frames, and their scale from the contrast of its frames.  An error that is the same in
every sample does not change the innovations, so the filter's covariance lacks it; this
module computes its variance, which is added.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.sensor import Sensor

__all__ = ["FRAME_CORRELATION", "FrameSystematics", "PixelActivity",
           "SystematicErrors", "frame_systematics"]

_OFFSET_SHARES = (0.7, 0.2)
"""Prior sigma of the frame offset, (per pixel, common), as fractions of
``Sensor.offset_dn``."""

_DARK_OFFSET_DN = (0.2, 0.1)
"""The same in DN, for the residual after subtraction of a dark frame."""

FRAME_CORRELATION, _DARK_FRAME_CORRELATION = 0.45, 0.25
"""Share of the frames' assumed variance that is common to all frames of a pixel,
without and with a dark frame: a lower bound on the variance of the thresholds' scale,
however well frames fit.  Engineering choices: the scale's chi squared is at least .30
of what is assumed (lab/studies/selfcal_thresholds.py, 500 RPM), so .45 is cautious; .25
with a dark frame has no study."""

_MIN_ON_RATE_HZ = 3.0
"""Least rate of ON events for which a leak's effect on the ratio is extrapolated."""


@dataclass(frozen=True, eq=False)
class PixelActivity:
    """Activity of each pixel of the sensor.

    Parameters
    ----------
    events_per_s : ndarray of float64, shape (H, W)
        Rate of events, weighted by themselves: of intervals between frames, one with
        twice as many events counts twice.
    min_dn, max_dn : ndarray of float32, shape (H, W)
        Extremes over the frames.
    """

    events_per_s: NDArray[np.float64]
    min_dn: NDArray[np.float32]
    max_dn: NDArray[np.float32]


@dataclass(frozen=True)
class FrameSystematics:
    """Errors that all frames of a pixel have in common.

    Parameters
    ----------
    offset_dn : (float, float)
        Standard deviation of the frames' offset: per pixel, and common to all pixels.
    correlated : float
        Share of the frames' assumed variance that is common to all of them.
    """

    offset_dn: tuple[float, float]
    correlated: float


def frame_systematics(sensor: Sensor | None, dark: bool) -> FrameSystematics:
    """Return the residual errors of double sampling, or of a dark frame if `dark`."""
    if dark:
        return FrameSystematics(_DARK_OFFSET_DN, _DARK_FRAME_CORRELATION)
    sigma = (sensor or Sensor.PDAVIS).offset_dn
    return FrameSystematics(
        (sigma * _OFFSET_SHARES[0], sigma * _OFFSET_SHARES[1]), FRAME_CORRELATION)


@dataclass(frozen=True, eq=False)
class SystematicErrors:
    """Errors common to all samples of a recording, to be added to the covariance.

    Parameters
    ----------
    on_rate_hz : ndarray of float64, shape (H, W)
        ON events per second.
    per_dn : ndarray of float64, shape (H, W)
        Relative change of both thresholds per DN of offset of all frames.
    frames : FrameSystematics
        Errors that all frames have in common.
    model_sigma : float
        Relative error of the scale by the models of photoreceptor and interpolation.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.
    """

    on_rate_hz: NDArray[np.float64]
    per_dn: NDArray[np.float64]
    frames: FrameSystematics
    model_sigma: float
    leak_hz: tuple[float, float]

    @property
    def common_scale_sigma(self) -> float:
        """Relative error of the scale that all pixels share."""
        return float(np.hypot(
            self.model_sigma,
            self.frames.offset_dn[1] * np.sqrt(np.mean(self.per_dn**2))))

    @property
    def log_ratio_per_leak(self) -> NDArray[np.float64]:
        """Change of ln(off / on) per leak event per second, shape (H, W)."""
        return 1 / np.maximum(self.on_rate_hz, _MIN_ON_RATE_HZ)
