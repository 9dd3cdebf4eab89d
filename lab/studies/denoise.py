"""`EventDenoiser`: window, support, and when a pixel is hot.

Window: noise of a dark chip and events of a polarizer that turns at 30 RPM, the slowest
of the paper, are made apart, so that of each event its origin is known.  The longer
the window, the more noise finds support; the window is the shortest whose doubling
would save hardly any true events.

Support: an edge as wide as the samples of one polarizer are apart passes at least so
many of a pixel's eight neighbours behind the same polarizer, whatever its direction.

A pixel is hot above floor + factor x the median rate of its neighbours; the floor must
not take one that is not.
"""
from __future__ import annotations

import inspect
import itertools
import sys

import numpy as np
from common import Found, main
from scipy.stats import gamma

from pdavis_cv.reconstruct.denoise import (
    HOT_FACTOR,
    HOT_FLOOR_HZ,
    RATE_SHARE,
    RATE_WINDOW_US,
    EventDenoiser,
)
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer

SIZE = (32, 32)
RPM = 30.4
WINDOWS_US = (12_500, 25_000, 50_000, 100_000, 200_000)
WORTH = 0.005
"""Part of the true events that doubling a window must save to be worth its noise."""
SETTLE_US = 500_000
"""Until when hot pixels are not known."""
FALSE_ALARMS = 1.0
"""Pixels of a DAVIS346 that may be taken for hot in an hour, and are not."""


def recorded(seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return events in the order of time, and which of them are true."""
    camera = {"seed": seed, "size": SIZE, "aps": None, "bus": None}
    dark, lit = (
        Camera.preset("nominal", dvs=dvs, **camera).record(scene, seconds)[0].events()
        for scene, dvs in (
            (FlatLight(s0=0.02), {"hot_fraction": 0.01, "hot_hz": 100.0}),
            (RotatingPolarizer(rpm=RPM), {"shot_noise_hz": 0.0, "leak_hz": 0.0})))
    both = np.concatenate([dark, lit])
    order = np.argsort(both["t"], kind="stable")
    return both[order], order >= len(dark)


def kept(events: np.ndarray, of: np.ndarray, window_us: int, support: int) -> float:
    """Return the part that is kept of some of the events."""
    keep = EventDenoiser(SIZE, window_us=window_us, support=support).keep(events)
    return float(np.mean(keep[of & (events["t"] >= SETTLE_US)]))


def least_support() -> int:
    """Return how many neighbours an edge passes in the least favourable direction."""
    angles = np.linspace(0, np.pi, 3601)
    passed = sum(
        (np.abs(dx * np.sin(angles) - dy * np.cos(angles)) <= 0.5).astype(int)
        for dx, dy in itertools.product((-1, 0, 1), repeat=2) if dx or dy)
    return int(np.min(passed))


def hot_floor(factor: float) -> float:
    """Return the floor at which a chip has FALSE_ALARMS per hour, in Hz.

    A rate is an exponential mean of counts in windows; its distribution is taken as
    that of a count over as long as gives the same variance.
    """
    keep = 1 - RATE_SHARE
    seconds = RATE_WINDOW_US / 1e6 * (1 + keep) / (1 - keep)
    chance = FALSE_ALARMS / (260 * 346 * 3600e6 / RATE_WINDOW_US)
    floors = np.arange(0.0, 20.0, 0.05)
    rates = np.geomspace(0.05, 30.0, 60)
    for floor in floors:
        limit = (floor + factor * rates) * seconds
        # P(Poisson(m) > k) = P(Gamma(k + 1) < m)
        if np.all(gamma.cdf(rates * seconds, np.floor(limit) + 1) <= chance):
            return float(floor)
    return float(floors[-1])


def study(quick: bool) -> list[Found]:
    """Try windows on simulated chips; derive the rest."""
    seconds, seeds = (2.0, (1,)) if quick else (4.0, (1, 2, 3))
    cases = [recorded(seconds, seed) for seed in seeds]
    defaults = {name: parameter.default for name, parameter
                in inspect.signature(EventDenoiser).parameters.items()}
    support = least_support()
    true = {window: float(np.mean([kept(events, of, window, support)
                                   for events, of in cases])) for window in WINDOWS_US}
    if not quick:
        for window, part in true.items():
            left = np.mean([kept(events[~of], np.ones(np.sum(~of), bool), window,
                                 support) for events, of in cases])
            print(f"window {window / 1000:g} ms: {part:.2%} of true events kept, "
                  f"{left:.2%} of noise left")
    enough = next(window for window, longer in itertools.pairwise(WINDOWS_US)
                  if true[longer] - true[window] < WORTH)
    return [Found("EventDenoiser window_us", enough, defaults["window_us"], 0),
            Found("EventDenoiser support", support, defaults["support"], 0),
            Found("HOT_FLOOR_HZ", hot_floor(HOT_FACTOR), HOT_FLOOR_HZ, at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
