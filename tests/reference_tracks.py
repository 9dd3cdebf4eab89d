"""Log intensity between and beyond a pixel's events: twin of _estimate in NumPy."""
import functools
import importlib
import sys
from pathlib import Path

import numpy as np

US = 1e-6
BLOCK, STALE, REST = 100_000, 10_000_000, 1_000_000


def ripple_of(waves):
    """Return (ripple of log intensity, its change per second) as a function.

    Of time and of the corner frequency of the pixel.
    """
    blocks = {wave.start_us // BLOCK: wave for wave in waves}

    def ripple(t, hz):
        wave = blocks.get(t // BLOCK)
        if wave is None or wave.hz == 0:
            return 0.0, 0.0
        turn = 2 * np.pi * wave.hz
        passed = 1 / (1 + 1j * wave.hz / hz) if hz and wave.of_light else 1
        phasor = passed * (wave.cosine - 1j * wave.sine) * np.exp(
            1j * turn * US * (t - wave.start_us))
        return phasor.real, -turn * phasor.imag

    ripple.lit = True
    return ripple


def steady(t, hz=None):
    return 0.0, 0.0


# What follows returns polarity, fraction of its threshold crossed, and per second; then
# what the lamp adds, and per second.  steps are (on, -off), r its ripple at a time.


def between(before, t0, p0, t1, p1, steps, r, lit, t):
    if t0 is None:
        return p1, 0.0, 0.0, 0.0, 0.0
    r = r if t1 - t0 < STALE else steady
    change = r(t1)[0] - r(t0)[0]
    since = r(t0)[0] - r(before[0])[0] if before and t0 - before[0] < STALE else 0
    last, next = steps[1 - p0] - since, steps[1 - p1] - change
    fraction, rate = line(
        before, t0, p0, t1, abs(last / next), last * next >= 0, t)
    if not lit or r is steady:
        return p1, fraction, rate, 0.0, 0.0
    now, slope = r(t)
    return p1, fraction, rate, now - r(t0)[0] - fraction * change, slope - rate * change


def turning(room):
    """The parabola (1, s, s^2) from 0 to 1 at s = 1 that turns at -room."""
    at = 1 / (1 + np.sqrt((room + 1) / room))     # where it turns
    return np.array([0, -2 * room / at, room / at**2])


def line(before, t0, p0, t1, ratio, same, t):
    gap = max(t1 - t0, 100)
    s, hz = (t - t0) / gap, 1e6 / gap
    if same:
        return s, hz
    path = turning(0.5)
    if before is not None and before[1] == p0:
        q = max(t0 - before[0], 100) / gap
        # Through the event before, this one and the next.
        path = np.linalg.solve(np.vander([-q, 0, 1], 3, True), [ratio, 0, 1])
        if path[1] > 0 or path[2] < 0:
            path = np.array([0, 0, 1])
        elif path[1]**2 > 4 * path[2]:
            path = turning(1)
    return path @ (1, s, s * s), path @ (0, 1, 2 * s) * hz


def after(t0, r, t):
    """What the lamp has added since the last event, and per second."""
    if t - t0 >= STALE:
        return 0.0, 0.0
    return r(t)[0] - r(t0)[0], r(t)[1]


def quiet(t0, p0, known, r, t):
    if t0 is None:
        return p0, 0.0, 0.0, 0.0, 0.0
    s, hz = (t - t0) / (known - t0), 1e6 / (known - t0)
    return p0, 2 * s * (1 - s), (2 - 4 * s) * hz, *after(t0, r, t)


@functools.cache
def prior():
    """Nodes and table of the stated prior, made by its study."""
    folder = str(Path(__file__).resolve().parents[1] / "lab" / "studies")
    sys.path.insert(0, folder)
    try:
        study = importlib.import_module("kalman_extrapolation")
        return study.NODES, study.table()
    finally:
        sys.path.remove(folder)
        for name in ("kalman_extrapolation", "common"):
            sys.modules.pop(name, None)


def ahead(before, t0, p0, steps, r, t):
    if before is None:
        return p0, 0.0, 0.0, 0.0, 0.0
    gap, p, same, room = t0 - before[0], p0, before[1] == p0, 1.0
    if t - before[0] < STALE:
        change = r(t0)[0] - r(before[0])[0]
        if change != 0:
            light = steps[1 - p0] - change
            p = int(light > 0)
            crossed = light / steps[1 - p]
            same = before[1] == p or crossed < 0.5
            gap = gap / max(crossed, 0.1)
        room = np.clip(1 - (r(t)[0] - r(t0)[0]) / steps[1 - p], 0.3, 2)
    gap = max(gap, 200)
    u = (t - t0) / (gap * room)
    nodes, table = prior()
    if u >= nodes[-1]:
        return p, 0.0, 0.0, *after(t0, r, t)
    fraction, rate = (
        np.interp(u, nodes, column) for column in table[0 if same else 1].T[:2])
    return p, fraction * room, rate * 1e6 / gap, *after(t0, r, t)


def lead(slope, level, hz, slope_hz):
    if not slope_hz:
        return np.clip(slope / (2 * np.pi * hz), -3, 3) if hz else 0.0
    c, e = slope / (2 * np.pi), slope_hz * level
    u = c / (hz + e)
    if abs(u) < 0.02:
        return u * (1 - u * e / (hz + e))
    u = 0.0
    for _ in range(8):
        k = e * np.exp(u)
        step = (u * (hz + k) - c) / max(hz + k * (1 + u), 0.05 * (hz + k))
        u = np.clip(u - step, -0.85, 2.0)
        if abs(step) < 1e-4:
            break
    return u


class Pixel:
    """A pixel's events (t, p) and thresholds, its light relative to a base."""

    def __init__(self, events, on, off, bandwidth=(0.0, 0.0), ripple=steady):
        self.events, self.on, self.off = events, on, off
        self.bandwidth, self.ripple = bandwidth, ripple

    def next(self, t):
        return sum(time <= t for time, _ in self.events)

    def part(self, i, t, known, log):
        """Thresholds crossed since event i - 1, which left log, at t; i is the next."""
        last = self.events[i - 1] if i else (None, 0)
        before = self.events[i - 2] if i > 1 else None
        steps = self.on, -self.off
        hz = self.bandwidth[0] + self.bandwidth[1] * np.exp(log)

        def ripple(t):
            return self.ripple(t, hz)

        if i < len(self.events) and self.events[i][0] <= known:
            return between(before, *last, *self.events[i], steps, ripple,
                           hasattr(self.ripple, "lit"), t)
        if last[0] is None or t - last[0] >= REST:
            return last[1], 0.0, 0.0, *(after(last[0], ripple, t) if i else (0.0, 0.0))
        if known > t:
            return quiet(*last, known, ripple, t)
        return ahead(before, *last, steps, ripple, t)

    def sum(self, start, stop):
        return sum(self.on if p else -self.off for _, p in self.events[start:stop])

    def log(self, base, t, known):
        """Log intensity at t, of a base before all events."""
        i = self.next(t)
        level = base + self.sum(0, i)
        p, fraction, rate, ripple, slope = self.part(i, t, known, level)
        step = self.on if p else -self.off
        level += step * fraction + ripple
        slope = self.mean_slope(i, t, known, level, slope + step * rate)
        return level + lead(slope, np.exp(level), *self.bandwidth)

    def mean_slope(self, i, t, known, log, slope):
        """Slope of the output: a mean between known events over its time constant."""
        hz = self.bandwidth[0] + self.bandwidth[1] * np.exp(log)
        if (self.ripple is not steady or hz == 0 or not 0 < i < len(self.events)
                or self.events[i][0] > known):
            return slope
        half = 1e6 / (2 * np.pi * hz) / 2
        first = self.events[i - 2 if i > 1 else i - 1][0]
        begin, end = max(t - half, first), min(t + half, known)
        if begin >= end:
            return slope
        return (self.change(i, end, known) - self.change(i, begin, known)) / (
            US * (end - begin))

    def change(self, i, t, known):
        """Change of the output from event i - 1 to t, linear before it."""
        last, p = self.events[i - 1]
        if t < last:
            return (self.on if p else -self.off) * (t - last) / (
                last - self.events[i - 2][0])
        at = self.next(t)
        p, fraction, *_ = self.part(at, t, known, 0.0)
        return self.sum(i, at) + (self.on if p else -self.off) * fraction
