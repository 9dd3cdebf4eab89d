"""How much likelier a scale of the thresholds must be, for how far it is off.

Checks `_LEAST_GAIN` of ``pdavis_cv.selfcal.common_scale``, a limit on the fall of -ln L
per sample, relative to the squared ln of the scale and a quarter of that of the ratio.
It must lie above what lost events fake (`nominal` cameras that lose a tenth of them at
1000 RPM) and below what true scales give (`drawn` and `davis346` cameras, whose
thresholds of .26 to .43 are stated as .2).  No score uses these specimens.

    python lab/studies/selfcal_least_gain.py [--quick]
"""
from __future__ import annotations

import sys

from common import Found, main

from pdavis_cv.selfcal import SelfCalibration, common_scale, estimator
from pdavis_cv.selfcal.bandwidth import fit_bandwidth
from pdavis_cv.selfcal.clock_offset import fit_clock_offset
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.selfcal.priors import LEAK_HZ
from pdavis_cv.sensor import NOMINAL_THRESHOLDS
from pdavis_cv.simulation import Camera, Faults, RotatingPolarizer

SEED, SIZE, SECONDS = 3000, (12, 12), 1.5


def gain_of(preset, rpm, seed, lost=0.0):
    """Return the gain of the scale that is found, None for one that is not told."""
    more = {"faults": Faults(lost=lost)} if lost else {}
    camera = Camera.preset(preset, seed=seed, size=SIZE, **more)
    nominal = (NOMINAL_THRESHOLDS if preset != "nominal"
               else (camera.dvs.theta_on, camera.dvs.theta_off))
    watch = SelfCalibration(camera.size, nominal, every_pixel=False)
    scene = RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * seed)
    for packet in camera.record(scene, SECONDS)[0].packets():
        watch.add_events(packet.events)
        for frame in packet.frames:
            watch.add_frame(frame)
    sample = select_busy_pixels(watch._window, nominal, LEAK_HZ)
    scale, _ = estimator._scale_and_clock(
        sample, fit_bandwidth(sample).law, fit_clock_offset(sample), None, True)
    return scale.gain if scale.determined and scale.off_nominal else None


def study(quick=False):
    """Return what the limit must be, beside what the code has."""
    chips = range(SEED, SEED + (2 if quick else 6))
    false = [gain_of("nominal", 1000, seed, 0.1) for seed in chips]
    true = [gain_of(preset, rpm, seed) for preset in ("drawn", "davis346")
            for rpm in (60, 1000) for seed in chips]
    for name, gains in (("lost events", false), ("true scales", true)):
        print(name, *("-" if gain is None else f"{gain:.2f}" for gain in gains))
    code = common_scale._LEAST_GAIN
    return [
        Found("common_scale._LEAST_GAIN", max((one for one in false if one), default=0),
              code, at_least=True),
        Found("common_scale._LEAST_GAIN", min(one for one in true if one), code,
              at_most=True)]


if __name__ == "__main__":
    sys.exit(main(study))
