"""Power of the innovations' density: by errors of the scale where thresholds are wrong.

Supports `LONG_TAILED` of ``pdavis_cv.selfcal.likelihood``: `drawn` and `davis346`
cameras before a turning polarizer of DoLP .8, stated .2; median error of the ln of the
scale with that power, and with a normal density.  No score uses these specimens.  They
have no refractory period: what it loses looks like larger thresholds with any density.
The rms error is printed only: it is that of one or two specimens whose clock offset is
not found.

    python lab/studies/selfcal_tails.py [--quick]
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found, main

from pdavis_cv.selfcal import common_scale
from pdavis_cv.selfcal.estimator import QUANTITIES, SelfCalibration
from pdavis_cv.selfcal.likelihood import (
    LONG_TAILED,
    NORMAL,
    negative_log_likelihood,
)
from pdavis_cv.simulation import Camera, RotatingPolarizer

PRESETS, SPEEDS_RPM, STATED, SECONDS = ("drawn", "davis346"), (200, 1000), 0.2, 2.0


def error_of(preset, rpm, seed):
    """Return the error of the ln of the scale that is found."""
    camera = Camera.preset(preset, seed=seed, size=(8, 8), dvs={"refractory_us": 0.0})
    watch = SelfCalibration(camera.size, (STATED, STATED), every_pixel=False)
    scene = RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * seed, dolp=0.8)
    for packet in camera.record(scene, SECONDS)[0].packets():
        watch.add_events(packet.events)
        for frame in packet.frames:
            watch.add_frame(frame)
    found = watch.estimate(wanted=QUANTITIES - {"thresholds"})
    true = camera.maps["theta_on"].mean() * camera.maps["theta_off"].mean()
    return 0.5 * np.log(found.theta_on[0, 0] * found.theta_off[0, 0] / true)


def median_errors(chips):
    """Return the median error with the density as it is, and with a normal one."""
    medians = []
    for power in (LONG_TAILED, NORMAL):
        # What the scale is fitted by; offsets and bandwidths stay as they are.
        common_scale.negative_log_likelihood = (
            lambda found, power=power: negative_log_likelihood(found, power))
        try:
            errors = np.array([error_of(preset, rpm, seed) for preset in PRESETS
                               for rpm in SPEEDS_RPM
                               for seed in range(4000, 4000 + chips)])
        finally:
            common_scale.negative_log_likelihood = negative_log_likelihood
        print(f"p = {power}: rms {np.sqrt(np.mean(errors**2)):.3f}, median "
              f"{np.median(np.abs(errors)):.3f}, mean {errors.mean():+.3f}")
        medians.append(float(np.median(np.abs(errors))))
    return medians


def study(quick=False):
    """Return the median error with the code's power, beside that of a normal one."""
    tailed, normal = median_errors(4 if quick else 8)
    return [Found("likelihood.LONG_TAILED, median of ln scale (code: normal)", tailed,
                  normal, at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
