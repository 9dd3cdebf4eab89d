"""Errors of the clock offset on cameras whose offset is known.

Checks `_MODEL_US`, `_CURVATURE_INFLATION` and `_LAG_SHARE` of
``pdavis_cv.selfcal.clock_offset``: on `nominal` cameras, the frames of whose sample are
moved by 5 ms, the error of offset and lag together and its sigma by the curvature; on
`realistic` ones, whose lag is in proportion to 1 / light, what is found without any.

    python lab/studies/selfcal_clock_offset.py [--quick]
"""
from __future__ import annotations

import math
import sys

import numpy as np
from common import Found, main

from pdavis_cv.selfcal import SelfCalibration, clock_offset
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.selfcal.priors import LEAK_HZ, TYPICAL_BANDWIDTH
from pdavis_cv.simulation import Camera, RotatingPolarizer

SPEEDS_RPM, SECONDS, MOVED_US = (30, 60, 200, 1000), 2.0, 5000
_TYPICAL_LAG_US = 1e6 / (2 * math.pi * TYPICAL_BANDWIDTH[0])


def sample_of(preset, rpm, seed):
    """Return a camera, and a sample of its pixels before a turning polarizer."""
    camera = Camera.preset(preset, seed=seed, size=(10, 10))
    nominal = camera.dvs.theta_on, camera.dvs.theta_off
    watch = SelfCalibration(camera.size, nominal, every_pixel=False)
    scene = RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * seed)
    for packet in camera.record(scene, SECONDS)[0].packets():
        watch.add_events(packet.events)
        for frame in packet.frames:
            watch.add_frame(frame)
    return camera, select_busy_pixels(watch._window, nominal, LEAK_HZ)


def delay_errors(rpm, seed):
    """Return the error of offset and lag together, and its sigma by the curvature."""
    camera, sample = sample_of("nominal", rpm, seed)
    lag_us = 1e6 / (2 * math.pi * camera.dvs.cutoff_hz)
    found = clock_offset.fit_clock_offset(sample.with_frames_moved(-MOVED_US))
    error = found.us + _TYPICAL_LAG_US - MOVED_US - lag_us
    other = math.hypot(clock_offset._MODEL_US, TYPICAL_BANDWIDTH[2] * _TYPICAL_LAG_US)
    stated = math.sqrt(max(found.sigma_us**2 - other**2, 0.0))
    return error, stated / clock_offset._CURVATURE_INFLATION


def study(quick=False):
    """Return what is found beside what the code has."""
    seeds = range(4000, 4002 if quick else 4006)
    errors = np.array([[delay_errors(rpm, seed) for seed in seeds]
                       for rpm in SPEEDS_RPM])
    for rpm, (error, sigma) in zip(SPEEDS_RPM, np.moveaxis(errors, 1, 2), strict=True):
        print(f"{rpm} RPM: mean error {error.mean():+.0f} us, rms "
              f"{np.sqrt(np.mean(error**2)):.0f}, by curvature {sigma.mean():.0f}")
    rms = np.sqrt(np.mean(errors[..., 0]**2))
    sure = errors[errors[..., 1] > clock_offset._MODEL_US / 4]
    share = max(
        abs(found.us) / _lag_of(sample) for found, sample in (
            (clock_offset.fit_clock_offset(sample), sample) for sample in (
                sample_of("realistic", 30, seed)[1] for seed in seeds)))
    return [
        Found("clock_offset._MODEL_US", float(rms), clock_offset._MODEL_US,
              at_least=True),
        Found("clock_offset._CURVATURE_INFLATION",
              float(np.sqrt(np.mean((sure[:, 0] / sure[:, 1])**2))),
              clock_offset._CURVATURE_INFLATION, at_least=True),
        Found("clock_offset._LAG_SHARE, at 3 sigma", share / clock_offset._SIGMAS,
              clock_offset._LAG_SHARE, at_least=True)]


def _lag_of(sample):
    """Return the delay that a constant bandwidth would have, us."""
    clean = sample.with_leak_in_frames()
    law = TYPICAL_BANDWIDTH[0], 0.0
    return clock_offset._minimum(
        clean.between_like_events(_TYPICAL_LAG_US), 5000.0, law).us


if __name__ == "__main__":
    sys.exit(main(study))
