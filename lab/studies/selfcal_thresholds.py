"""What the samples' variances must be for the thresholds' errors to be as stated.

Checks the constants of ``pdavis_cv.selfcal`` that say how well frames fit:
`FILTER_NOISE`, `FRAME_CORRELATION`, `_MODEL_SHARE`, and derives `MIN_DN`.  Simulated
`nominal` cameras before a turning polarizer; no score uses them.

    python lab/studies/selfcal_thresholds.py [--quick]
"""
from __future__ import annotations

import math
import sys

import numpy as np
from common import Found, main

from pdavis_cv.fusion.learning import _feed_estimator
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.selfcal import SelfCalibration, pixel_sample
from pdavis_cv.selfcal.estimator import _feed
from pdavis_cv.selfcal.priors import LEAK_HZ, USUAL_MISMATCH
from pdavis_cv.selfcal.thresholds import _inverse, _times
from pdavis_cv.selfcal.uncertainty import FRAME_CORRELATION
from pdavis_cv.sensor import THRESHOLD_SIGMA, Sensor
from pdavis_cv.simulation import Camera, RotatingPolarizer

NOMINAL, BANDWIDTH = (0.16, 0.18), (250.0, 0.0)
SPEEDS_RPM = (60, 200, 500)
FACTORS = (0.25, 1.0, 4.0)
WITHIN_SHARE = 0.65
"""Relative: the share is an order of magnitude, by the rms of few chips."""
LARGEST_LOSS = 1.15
"""Of the rms error by `FILTER_NOISE`, over the least with one of its numbers changed:
the thresholds hardly depend on it."""


def chip(seed, rpm, preset="nominal", seconds=2.0):
    """Return the thresholds of a chip and what has seen its recording."""
    camera = Camera.preset(preset, seed=seed, size=(10, 10))
    scene = RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * seed)
    watch = SelfCalibration(camera.size, NOMINAL, every_pixel=True)
    recording = camera.record(scene, seconds)[0]
    _feed_estimator(watch, recording, recording.packets(), None, NOMINAL)
    return np.stack([camera.maps["theta_on"], camera.maps["theta_off"]]), watch


def scale_errors(truth, watch, noise):
    """Return each pixel's error of ln scale by its samples alone, and its variance."""
    on, off = NOMINAL
    method = KalmanFilter(
        watch.shape, theta_on=on, theta_off=off, threshold_sigma=THRESHOLD_SIGMA,
        bandwidth=BANDWIDTH, noise=noise)
    _feed(method, iter(watch._whole.items), -1)
    theta, covariance = method.thresholds
    prior = 1 / THRESHOLD_SIGMA**2
    a, b, d = _inverse(covariance[..., 0, 0], covariance[..., 0, 1],
                       covariance[..., 1, 1])
    pull = _times((a, b, d), (theta[0] - on, theta[1] - off))
    own = _inverse(a - prior, b, d - prior)
    by = _times(own, pull)
    error = np.log((on + by[0]) * (off + by[1]) / truth.prod(0)) / 2
    variance = (own[0] / on**2 + own[2] / off**2 + 2 * own[1] / (on * off)) / 4
    return error, variance


def least_dn():
    """Return the DN below which an offset says more than pixels differ.

    An offset of o DN changes a contrast ln(high / low) by o / low: of the greatest
    contrast, the polarizers' ln(extinction ratio), a share that is `USUAL_MISMATCH`
    at o / (USUAL_MISMATCH ln ER).
    """
    sensor = Sensor.PDAVIS
    return sensor.offset_dn / (USUAL_MISMATCH * math.log(sensor.extinction_ratio))


def study(quick=False):
    """Return what the constants are, beside what the code has."""
    errors = {}             # rms error of ln scale over chips and speeds
    z2, wrong, lag = [], [], []
    for seed in range(2000, 2002 if quick else 2006):
        for rpm in SPEEDS_RPM:
            truth, watch = chip(seed, rpm)
            for i in range(3):
                for factor in FACTORS:
                    noise = np.array(pixel_sample.FILTER_NOISE)
                    noise[i] *= factor
                    error, variance = scale_errors(truth, watch, tuple(noise))
                    errors.setdefault((i, factor), []).append(np.mean(error**2))
                    if i == 0 and factor == 1:
                        z2.append(np.mean((error - error.mean())**2 / variance))
            sample = pixel_sample.select_busy_pixels(watch._window, NOMINAL, LEAK_HZ)
            with_lag, without = sample._log_scales([BANDWIDTH, (0.0, 0.0)], 0.0)
            place = np.unravel_index(sample.pixels, watch.shape)
            wrong.append(with_lag - np.mean(np.log(truth[:, place[0], place[1]])))
            lag.append(without - with_lag)
    z2, wrong, lag = (np.reshape(each, (-1, len(SPEEDS_RPM)))
                      for each in (z2, wrong, lag))
    print("chi squared of the scale over the stated one, by RPM: " + ", ".join(
        f"{rpm}: {each:.2f}" for rpm, each in zip(SPEEDS_RPM, z2.mean(0), strict=True)))
    rms = {key: math.sqrt(np.mean(each)) for key, each in errors.items()}
    # What a chip errs by at its slowest is offsets; the rest is the model of the lag.
    share = math.sqrt(np.mean((wrong[:, -1] - wrong[:, 0])**2) / np.mean(lag[:, -1]**2))
    return [
        Found("pixel_sample.FILTER_NOISE, rms error over the least",
              rms[0, 1.0] / min(rms.values()), LARGEST_LOSS, at_least=True),
        Found("uncertainty.FRAME_CORRELATION", z2.mean(0).min(), FRAME_CORRELATION,
              at_least=True),
        Found("pixel_sample._MODEL_SHARE", share, pixel_sample._MODEL_SHARE,
              WITHIN_SHARE),
        Found("pixel_sample.MIN_DN", least_dn(), pixel_sample.MIN_DN, 0.05)]


if __name__ == "__main__":
    sys.exit(main(study))
