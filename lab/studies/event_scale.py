"""Errors of the thresholds' scale from events alone, and when it is accepted.

Checks `_LEAST_FALL`, `_LEAST_GAIN`, `_BIAS` and `_MODEL_SIGMA` of
``pdavis_cv.fusion.events_alone``.  The first two must reject what light with structure
fakes on `nominal` cameras whose thresholds are stated right, and accept what a turning
polarizer tells of `drawn` and `davis346` cameras, whose thresholds of .26 to .43 are
stated as .2, if they are off by more than a third.  The others are the mean and the
rest of the error on all three.  That lost events make the scale smaller, never larger,
is printed.  No score uses these specimens.

    python lab/studies/event_scale.py [--quick]
"""
from __future__ import annotations

import math
import sys

import numpy as np
from common import Found, main

from lab.paper.light import edges
from pdavis_cv.fusion import events_alone
from pdavis_cv.pixel.sample import PixelSample
from pdavis_cv.sensor import NOMINAL_THRESHOLDS
from pdavis_cv.simulation import Camera, Faults, RotatingPolarizer, Texture

SEED, SIZE, SECONDS = 4000, (16, 16), 1.5
FAR = math.log(1.35)    # a scale that must be found


def scale_of(preset, scene, seed, lost=0.0):
    """Return the scale that is found, and its error (ln); None without a scale."""
    more = {"faults": Faults(lost=lost)} if lost else {}
    camera = Camera.preset(preset, seed=seed, size=SIZE, **more)
    nominal = (NOMINAL_THRESHOLDS if preset != "nominal"
               else (camera.dvs.theta_on, camera.dvs.theta_off))
    watch = PixelSample(camera.size)
    for packet in camera.record(scene, SECONDS)[0].packets():
        watch.add_events(packet.events)
    found = events_alone.event_scale(watch, nominal)
    true = 0.5 * math.log(np.prod([
        camera.maps[f"theta_{part}"].mean() / one
        for part, one in zip(("on", "off"), nominal, strict=True)]))
    return None if found is None else (found, found.ln - true)


def told(name, scales):
    """Print scales, and return those that are found."""
    scales = [one for one, _ in filter(None, scales)]
    print(name, *(f"{one.ln:+.2f} ({one.fall:.2f})" for one in scales))
    return scales


def study(quick=False):
    """Return what the limits must be, beside what the code has."""
    chips = range(SEED, SEED + (2 if quick else 6))

    def polarizer(rpm, seed):
        return RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * seed)

    structure = told("structure", [
        scale_of("nominal", scene, seed) for speed in (200.0, 600.0) for seed in chips
        for scene in (edges(speed), Texture(velocity=(speed, 0.3 * speed), seed=seed))])
    told("lost events", [
        scale_of("nominal", polarizer(1000, seed), seed, 0.1) for seed in chips])
    scales = [scale_of(preset, polarizer(rpm, seed), seed)
              for preset in ("drawn", "davis346") for rpm in (200, 1000)
              for seed in chips]
    true = told("true scales", [
        each for each in filter(None, scales) if abs(each[0].ln - each[1]) > FAR])
    right = [scale_of("nominal", polarizer(rpm, seed), seed)
             for rpm in (200, 1000) for seed in chips]
    errors = [error for _, error in filter(None, scales + right)]
    print("errors", *(f"{error:+.3f}" for error in errors))
    least = events_alone._LEAST_FALL
    return [
        Found("events_alone._LEAST_FALL", max(one.fall for one in structure), least,
              at_least=True),
        Found("events_alone._LEAST_GAIN", min(one.gain for one in true),
              events_alone._LEAST_GAIN, at_most=True),
        Found("events_alone._LEAST_FALL", min(one.fall for one in true), least,
              at_most=True),
        Found("events_alone._BIAS", events_alone._BIAS - float(np.mean(errors)),
              events_alone._BIAS, 0.4),
        Found("events_alone._MODEL_SIGMA", float(np.std(errors)),
              events_alone._MODEL_SIGMA, 0.4)]


if __name__ == "__main__":
    sys.exit(main(study))
