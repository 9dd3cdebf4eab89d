"""How much likelier a bandwidth that follows the light must be to be believed.

Regenerates ``_LAW_EVIDENCE`` of ``pdavis_cv.selfcal.bandwidth``: the difference of ln L
of the best corner frequency that grows with the light and the best constant, with
variances as stated or larger.  Of `nominal` pixels, whose bandwidth is constant, the
largest is found, and of `realistic` ones, whose bandwidth follows the light, the least;
the constant must lie between.  Half a second and two seconds before fans, whose steps
de-blurring gets most wrong, and before polarizers.  What a common factor of the
deviations below 1 would make of the fakes is printed beside.

    python lab/studies/selfcal_law.py [--quick]
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found, main as run

from pdavis_cv.selfcal import SelfCalibration, bandwidth
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.selfcal.priors import LEAK_HZ
from pdavis_cv.simulation import Camera, Fan, RotatingPolarizer

NOMINAL, SECONDS = (0.16, 0.18), (0.52, 2.0)
CHIPS, QUICK_CHIPS = range(500, 506), range(500, 502)
START_DEG, STRIP, PLACE = 17.0, (4, 32), (54, 156)
"""The strip of the wheel that `python -m lab.paper fig4a --quick` looks at; with other
start angles the fan fakes less."""


def gains(preset, chip, scene, seconds, **place):
    """Return how much likelier the law is, and by a factor that may be less than 1."""
    recording, _ = Camera.preset(preset, seed=chip, **place).record(scene, seconds)
    camera = SelfCalibration(recording.info.sensor_size, NOMINAL, every_pixel=False)
    for packet in recording.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    cost = bandwidth._Cost(select_busy_pixels(camera._window, NOMINAL, LEAK_HZ))
    minima = cost.minima()
    best = min((one for one in minima if one.share > 0), key=lambda one: one.cost)
    return cost.evidence(best, minima[0]), minima[0].cost - best.cost


def of_scenes(preset, chips, seconds):
    """Return the gains of chips before fans, and before polarizers."""
    start = np.deg2rad(START_DEG)
    fans = [gains(preset, chip, Fan(rpm=rpm, start_angle=start, s0=30.75), seconds,
                  size=STRIP, origin=PLACE) for chip in chips for rpm in (202.6, 1013)]
    turning = [gains(preset, chip, RotatingPolarizer(rpm=rpm, start_angle=start),
                     seconds, size=(8, 8)) for chip in chips for rpm in (202.6, 1013)]
    return np.array(fans), np.array(turning)


def study(quick: bool) -> list[Found]:
    """How much likelier a bandwidth that follows the light must be to be believed."""
    chips = QUICK_CHIPS if quick else CHIPS
    faked, real = [], []
    for seconds in SECONDS[:1] if quick else SECONDS:
        for preset, every in (("nominal", faked), ("realistic", real)):
            for name, found in zip(("fan", "polarizer"), of_scenes(
                    preset, chips, seconds), strict=True):
                print(f"{preset}, {name}, {seconds} s: {found[:, 0].min():.1f} to "
                      f"{found[:, 0].max():.1f}; with any factor "
                      f"{found[:, 1].min():.1f} to {found[:, 1].max():.1f}")
                every.append(found[:, 0])
    name, code = "selfcal.bandwidth._LAW_EVIDENCE", bandwidth._LAW_EVIDENCE
    return [Found(f"{name}, faked", max(map(np.max, faked)), code, at_least=True),
            Found(f"{name}, real", min(map(np.min, real)), code, at_most=True)]


if __name__ == "__main__":
    sys.exit(run(study))
