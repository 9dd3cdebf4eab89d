"""Over how long the slope of a pixel's output is a mean, to undo its lag.

Checks `SLOPE_SPAN` of _kernels/_estimate.pxd, in time constants of the pixel: the
longest mean that, without jitter, nowhere errs more than the slope at the time itself,
for polarizers that turn at 10 to 1000 RPM before pixels of 30 to 500 Hz that can follow
them.  What it gains where time stamps jitter is printed.  No simulated camera has a
part in it.

    python lab/studies/lag_slope.py [--quick]
"""
from __future__ import annotations

import itertools
import sys

import numpy as np
from common import Found, kernel_constant, main

THETA, DOLP, STEP_S = 0.17, 0.95, 2e-5
HZ, RPM = (30.0, 80.0, 250.0, 500.0), (10.0, 60.0, 200.0, 1000.0)
SPANS, JITTER_S = (0.5, 1.0, 2.0, 4.0), 1e-3


def output(hz, rpm, turns):
    """Return times and the log intensity behind a low-pass of corner frequency hz."""
    seconds = turns * 30 / rpm
    t = np.arange(0, seconds, STEP_S)
    light = np.log(1 + DOLP * np.cos(2 * np.pi * t * rpm / 30))
    # Of a periodic light the response is exact in the frequency domain.
    passed = np.fft.rfft(light) / (1 + 1j * np.fft.rfftfreq(len(t), STEP_S) / hz)
    return t, np.fft.irfft(passed, len(t))


def crossings(t, y):
    """Return the times of events, and the log intensity that each of them marks."""
    times, levels, reference = [], [], y[0]
    for at, level in zip(t, y, strict=True):
        if abs(level - reference) >= THETA:
            reference += np.sign(level - reference) * THETA
            times.append(at)
            levels.append(reference)
    return np.array(times), np.array(levels)


def errors(hz, rpm, jitter_s, turns):
    """Return the RMS error of the lag by the slope at a time, and by means."""
    rng = np.random.default_rng(1)
    t, y = output(hz, rpm, turns)
    times, levels = crossings(t, y)
    times = times + rng.normal(0, jitter_s, len(times))
    order = np.argsort(times)       # where events change places, their signs do too
    steps = np.diff(levels, prepend=y[0])[order]
    times, levels = times[order], y[0] + np.cumsum(steps)
    inner = (t > times[2]) & (t < times[-3])
    t, true = t[inner], np.gradient(y, STEP_S)[inner]
    tau = 1 / (2 * np.pi * hz)
    at = np.searchsorted(times, t, "right") - 1     # the last event
    gaps = np.maximum(times[at + 1] - times[at], 1e-4)
    found = [(levels[at + 1] - levels[at]) / gaps]
    for span in SPANS:
        begin = np.maximum(t - span * tau / 2, times[at - 1])
        end = t + span * tau / 2
        found.append((np.interp(end, times, levels) - np.interp(begin, times, levels))
                     / (end - begin))
    return [tau * np.sqrt(np.mean((slope - true) ** 2)) for slope in found]


def study(quick=False):
    """Return the longest span that costs nothing, beside what the code has."""
    turns = 2 if quick else 10
    worst = np.zeros(len(SPANS))
    print("RMS error of the lag: at a time; mean over", *SPANS, "time constants")
    for hz, rpm in itertools.product(HZ, RPM):
        for jitter_s in (0.0, JITTER_S):
            local, *means = errors(hz, rpm, jitter_s, turns)
            print(f"{hz:3g} Hz, {rpm:4g} RPM, jitter {1e3 * jitter_s:g} ms: "
                  f"{local:.4f};", *(f"{mean:.4f}" for mean in means))
            # Beyond the corner frequency, light cannot be told from its slope.
            if not jitter_s and rpm / 30 < hz:
                worst = np.maximum(worst, np.array(means) / local)
    print("largest ratio without jitter:", *(f"{one:.2f}" for one in worst))
    longest = max((span for span, one in zip(SPANS, worst, strict=True) if one <= 1),
                  default=0.0)
    return [Found("SLOPE_SPAN of _estimate.pxd", longest,
                  kernel_constant("_estimate.pxd", "SLOPE_SPAN"))]


if __name__ == "__main__":
    sys.exit(main(study))
