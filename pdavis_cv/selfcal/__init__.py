"""Estimates of a camera's parameters from its own frames and events.

A `SelfCalibration` is fed a stream and returns a `CameraEstimate`: contrast thresholds,
bandwidth of the photoreceptors, event noise, refractory period and jitter of the
events' stamps, leak and noise events at rest, with standard errors.
The package works on arrays only: it reads no files, recordings or calibrations.
"""
from pdavis_cv.selfcal.bandwidth import Bandwidth, combine_bandwidths
from pdavis_cv.selfcal.clock_offset import ClockOffset
from pdavis_cv.selfcal.estimator import CameraEstimate, SelfCalibration
from pdavis_cv.selfcal.jitter import Jitter
from pdavis_cv.selfcal.priors import LEAK_HZ, TYPICAL_BANDWIDTH, USUAL_BANDWIDTH
from pdavis_cv.selfcal.ratio_spread import RatioSpread
from pdavis_cv.selfcal.refractory import Refractory

__all__ = [
    "LEAK_HZ",
    "TYPICAL_BANDWIDTH",
    "USUAL_BANDWIDTH",
    "Bandwidth",
    "CameraEstimate",
    "ClockOffset",
    "Jitter",
    "RatioSpread",
    "Refractory",
    "SelfCalibration",
    "combine_bandwidths",
]
