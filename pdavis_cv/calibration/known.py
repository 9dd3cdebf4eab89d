"""What a calibration tells a method, where the caller does not."""
from __future__ import annotations

import math
from typing import Any

import numpy as np

from pdavis_cv.calibration.model import Calibration
from pdavis_cv.reconstruct.kalman import CALIBRATED_NOISE, NOISE

__all__ = ["calibrated", "noise_of", "stated_bandwidth"]

_KNOWN_SIGMA = 0.0005
"""Standard deviation of a calibration's thresholds that come without an uncertainty."""

_TOGETHER = math.sqrt(2)
"""ON and OFF thresholds of a pixel err together, in their scale.  The filter takes them
to err independently, and would take the scale for known better by so much."""


def noise_of(
    calibration: Calibration | None, found: float = 0.0
) -> tuple[float, ...]:
    """Return the `noise` of `KalmanFilter`, with that of the events as it was found.

    The least that is ever found stands for all that is less.
    """
    known_pixels = calibration is not None and calibration.analyser is not None
    sigma, per_s, *rest = CALIBRATED_NOISE if known_pixels else NOISE
    return sigma, found if found > NOISE[1] else per_s, *rest


def calibrated(
    parameters: dict[str, Any], thresholds: object, calibration: Calibration | None
) -> dict[str, Any]:
    """Return the parameters with what the calibration says and the caller does not.

    A bandwidth that comes with an uncertainty is left to be learned onwards.
    """
    if calibration is None:
        return parameters
    known = dict(parameters)
    hz, per_dn = calibration.bandwidth_hz, calibration.bandwidth_hz_per_dn
    if (hz is not None or per_dn is not None) and calibration.bandwidth_sigma is None:
        known.setdefault("bandwidth", (hz or 0.0, per_dn or 0.0))
    if calibration.theta_on is not None and thresholds in (None, "calibration"):
        on, off = calibration.theta_on_sigma, calibration.theta_off_sigma
        known.setdefault("threshold_sigma", _KNOWN_SIGMA if on is None or off is None
                         else _TOGETHER * float(np.median([on, off])))
    return known


def stated_bandwidth(
    calibration: Calibration | None
) -> tuple[float, float, float] | None:
    """Return (hz, hz_per_intensity, sigma), None where one of them is not stated."""
    if calibration is None or calibration.bandwidth_sigma is None:
        return None
    hz, per_dn = calibration.bandwidth_hz, calibration.bandwidth_hz_per_dn
    if hz is None and per_dn is None:
        return None
    return hz or 0.0, per_dn or 0.0, calibration.bandwidth_sigma
