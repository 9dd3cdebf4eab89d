"""How much a bandwidth that follows the light must explain to be believed.

Regenerates ``_LAW_FALL`` of ``pdavis_cv.selfcal.bandwidth``: by how much the mean
square of the innovations falls, relatively, from the best constant corner frequency to
the best that grows with the light.  Of `nominal` pixels, whose bandwidth is constant,
the largest fall is found, and of `realistic` ones, whose bandwidth follows the light,
the least; the constant must lie between.  Half a second before a fan at 1000 RPM, whose
steps de-blurring gets most wrong, and before polarizers.

Below ``_SLOW_HZ`` ``_SLOW_EVIDENCE`` decides alone: it must be more than what `nominal`
pixels with a constant bandwidth of 60 to 140 Hz fake before a fan.

    python studies/selfcal_law.py [--quick]
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found
from common import main as run

from pdavis_cv.selfcal import SelfCalibration, bandwidth
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.selfcal.priors import LEAK_HZ
from pdavis_cv.simulation import Camera, Fan, RotatingPolarizer

NOMINAL, SECONDS = (0.16, 0.18), 0.52
CHIPS, QUICK_CHIPS = range(500, 506), range(500, 502)
SLOW_HZ = (60.0, 80.0, 100.0, 120.0, 140.0)
START_DEG, STRIP, PLACE = 17.0, (4, 32), (54, 156)
"""The strip of the wheel that `pdavis reproduce fig4a --quick` looks at; with other
start angles the fan fakes less."""


def evidence(preset, chip, scene, **place):
    """Return by how much -ln L falls, 0 if no law fits better, and the innovations."""
    recording, _ = Camera.preset(preset, seed=chip, **place).record(scene, SECONDS)
    camera = SelfCalibration(recording.info.sensor_size, NOMINAL, every_pixel=False)
    for packet in recording.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    cost = bandwidth._Cost(select_busy_pixels(camera._window, NOMINAL, LEAK_HZ))
    minima = cost.minima()
    return minima[0].cost - min(each.cost for each in minima), cost.count


def fall(*args, **place):
    """Return the relative fall of the mean square."""
    found, count = evidence(*args, **place)
    return 2 * found / count


def falls(preset, chips):
    """Return the fall of chips before the fan, and before polarizers."""
    start = np.deg2rad(START_DEG)
    fans = [fall(preset, chip, Fan(rpm=1013, start_angle=start, s0=30.75),
                 size=STRIP, origin=PLACE) for chip in chips]
    turning = [fall(preset, chip, RotatingPolarizer(rpm=rpm, start_angle=start),
                    size=(8, 8)) for chip in chips for rpm in (202.6, 1013)]
    return np.array(fans), np.array(turning)


def study(quick: bool) -> list[Found]:
    """How much a bandwidth that follows the light must explain to be believed."""
    chips = QUICK_CHIPS if quick else CHIPS
    faked, real = falls("nominal", chips), falls("realistic", chips)
    for name, found in (("constant", faked), ("following", real)):
        for scene, values in zip(("fan", "polarizer"), found, strict=True):
            print(f"{name}, {scene}: {values.min():.3f} to {values.max():.3f}")
    fan = Fan(rpm=1013, start_angle=np.deg2rad(START_DEG), s0=30.75)
    slow = [evidence("nominal", chip, fan, size=STRIP, origin=PLACE,
                     dvs={"cutoff_hz": hz})[0] for hz in SLOW_HZ for chip in chips]
    name = "selfcal.bandwidth._LAW_FALL"
    code = bandwidth._LAW_FALL
    return [Found(f"{name}, faked", max(map(np.max, faked)), code, at_least=True),
            Found(f"{name}, real", min(map(np.min, real)), code, at_most=True),
            Found("selfcal.bandwidth._SLOW_EVIDENCE", max(slow),
                  bandwidth._SLOW_EVIDENCE, at_least=True)]


if __name__ == "__main__":
    sys.exit(run(study))
