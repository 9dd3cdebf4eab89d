"""How far the fitted bandwidth is off, and what its stated sigma must hold.

Regenerates the constants of ``pdavis_cv.selfcal.bandwidth``: the inflation of the sigma
that the curvature of -ln L gives, the error of the model, and the lag that
interpolation between events makes where a pixel turns.  Fitted on simulated `nominal`
cameras (250 Hz, constant) before a turning polarizer; the tests use other chips.
300 RPM is left out of the fit: with 20 frames per second it is near a resonance.

    python lab/studies/selfcal_bandwidth.py [--quick]
"""
from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np

from pdavis_cv.selfcal import SelfCalibration
from pdavis_cv.selfcal.bandwidth import _Cost, fit_bandwidth
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.selfcal.priors import LEAK_HZ
from pdavis_cv.simulation import Camera, RotatingPolarizer

NOMINAL, TRUE_HZ = (0.16, 0.18), 250.0
SPEEDS_RPM = (30, 40, 60, 100, 200, 300, 500, 800)
QUICK_RPM = (40, 100, 200, 500)
LARGEST_RATIO = 1.75
"""Of the rms error over the stated sigma: chi squared of three chips, 5 % level."""


class Row(NamedTuple):
    """One chip at one speed.

    Events per second, error of ln hz, sigma by the curvature alone, sigma as stated.
    """

    rate_hz: float
    error: float
    curvature_sigma: float
    stated_sigma: float


def looked_on(recording):
    """Return what has seen a recording."""
    camera = SelfCalibration(recording.info.sensor_size, NOMINAL, every_pixel=False)
    for packet in recording.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    return camera


def measure(chips, speeds=SPEEDS_RPM, seconds=2.0):
    """Return Rows, shape (chips, speeds, 4)."""
    rows = []
    for chip in range(chips):
        for rpm in speeds:
            camera = Camera.preset("nominal", seed=1000 + chip, size=(6, 6))
            scene = RotatingPolarizer(rpm=1.013 * rpm, start_angle=0.5 * chip)
            window = looked_on(camera.record(scene, seconds)[0])._window
            sample = select_busy_pixels(window, NOMINAL, LEAK_HZ)
            cost = _Cost(sample)
            found = cost.minimum(0.0, cost.coarse()[0][0])
            rows.append(Row(sample.events_per_s, found.ln_hz - np.log(TRUE_HZ),
                            found.sigma, fit_bandwidth(sample).sigma))
    return np.reshape(rows, (chips, len(speeds), 4))


def rms(values):
    """Root mean square over chips."""
    return np.sqrt(np.mean(np.square(values), axis=0))


def main(argv):
    """Print the rows and the constants that follow; 1 if sigmas are far too small."""
    speeds, chips = (QUICK_RPM, 3) if "--quick" in argv else (SPEEDS_RPM, 12)
    table = measure(chips, speeds)
    rate, error, curvature, stated = np.moveaxis(table, 2, 0)
    print("| RPM | events/s | mean error | rms error | curvature | stated "
          "| rms error / stated |\n|---|---|---|---|---|---|---|")
    for i, rpm in enumerate(speeds):
        print(f"| {rpm} | {rate[:, i].mean():.0f} | {error[:, i].mean():+.3f} | "
              f"{rms(error[:, i]):.3f} | {rms(curvature[:, i]):.3f} | "
              f"{rms(stated[:, i]):.3f} | {rms(error[:, i] / stated[:, i]):.2f} |")
    chosen = [i for i, rpm in enumerate(speeds) if rpm != 300]
    found = rms(error)[chosen]**2
    inner = np.array(speeds)[chosen] >= 60
    # Weighted least squares of E e^2 = (inflation curvature)^2 + model^2.
    terms = np.stack([rms(curvature)[chosen]**2, np.ones(len(chosen))], axis=1)
    weighted, target = (terms / found[:, None])[inner], np.ones(inner.sum())
    inflation2, model2 = np.linalg.lstsq(weighted, target, rcond=None)[0]
    print(f"inflation {np.sqrt(inflation2):.2f}, model sigma "
          f"{np.sqrt(max(model2, 0)):.4f}")
    slow = np.sqrt(np.maximum(found - inflation2 * terms[:, 0] - model2, 0))
    print("lag of interpolation, ms: " + ", ".join(
        f"{1e3 * lag / (2 * np.pi * TRUE_HZ):.3f} at {rate[:, i].mean():.0f} events/s"
        for lag, i in zip(slow, chosen, strict=True)))
    ratios = [rms(error[:, i] / stated[:, i]) for i in chosen]
    return 0 if max(ratios) < LARGEST_RATIO else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
