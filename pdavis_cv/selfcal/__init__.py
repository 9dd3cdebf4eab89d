"""Estimates of a camera's parameters from its own frames and events.

For whoever feeds a stream: `SelfCalibration` looks on and gives a `CameraEstimate`
(contrast thresholds, bandwidth of the photoreceptors, event noise, refractory period)
with covariances.
It knows arrays only: no file, no recording, no calibration file.
"""
from pdavis_cv.selfcal.bandwidth import Bandwidth, combine_bandwidths
from pdavis_cv.selfcal.clock_offset import ClockOffset
from pdavis_cv.selfcal.estimator import CameraEstimate, SelfCalibration
from pdavis_cv.selfcal.priors import LEAK_HZ, TYPICAL_BANDWIDTH, USUAL_BANDWIDTH
from pdavis_cv.selfcal.refractory import Refractory

__all__ = [
    "LEAK_HZ",
    "TYPICAL_BANDWIDTH",
    "USUAL_BANDWIDTH",
    "Bandwidth",
    "CameraEstimate",
    "ClockOffset",
    "Refractory",
    "SelfCalibration",
    "combine_bandwidths",
]
