"""Between and beyond a pixel's events: twins of _tracks and _lag in NumPy."""
import functools
import importlib
import sys
from pathlib import Path

import numpy as np

US = 1e-6
BLOCK, STALE = 100_000, 10_000_000
# Anywhere between the two thresholds.
UNKNOWN = np.mean(np.linspace(-1, 1, 100_001) ** 2)
STILL = 250_000


def silence(gap):
    """Probability that a pixel without an event for a gap (us) is at rest."""
    return 1 / (1 + (STILL / max(gap, 1e-9)) ** 4)


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


def audible(t0, t1, deaf):
    """Time (us) in which a pixel compares between two events."""
    return max(t1 - t0 - deaf, 100)


def lost(before, t, after, deaf):
    """What light does in reset after t: thresholds of the event there, of the next.

    The slopes, one threshold per audible time, hold in the middle of these times.
    """
    if not deaf or t is None:
        return np.zeros(2)
    second = audible(t, after, deaf)
    if before is None:
        return np.array([0, deaf / second])
    first = audible(before, t, deaf)
    middles = -first / 2, deaf + second / 2
    return deaf * np.array([np.interp(deaf / 2, middles, (1 / first, 0)),
                            np.interp(deaf / 2, middles, (0, 1 / second))])


def between(before, t0, p0, t1, p1, steps, r, lit, deaf, t):
    """Polarity, fraction of its threshold crossed, per second, variances of both, fall.

    fall is the thresholds per second that the intensity last fell by.  Then what the
    lamp adds, and per second; steps are (on, -off), r its ripple and rate at a time.
    """
    if t0 is None:
        return p1, 0.0, 0.0, UNKNOWN, 0.0, 0.0, 0.0, 0.0
    r = r if t1 - t0 < STALE else steady
    change = r(t1)[0] - r(t0)[0]
    since = r(t0)[0] - r(before[0])[0] if before and t0 - before[0] < STALE else 0
    last, next = steps[1 - p0] - since, steps[1 - p1] - change
    ours, theirs = lost(before and before[0], t0, t1, deaf)
    # Thresholds of the next event from the last one to it.
    whole = 1 + theirs + ours * steps[1 - p0] / steps[1 - p1]
    if not lit or r is steady:
        part = line(before, t0, p0, t1, p1, abs(last / next), last * next >= 0, whole,
                    ours, deaf, t)
        return *part, 0.0, 0.0
    p, fraction, rate, *spread = line(
        before, t0, p0, t1, p1, abs(last / next), last * next >= 0, 1, 0, deaf, t)
    now, slope = r(t)
    return (p, whole * fraction, whole * rate, *spread,
            now - r(t0)[0] - fraction * change, slope - rate * change)


def turning(room, whole):
    """The parabola (1, s, s^2) from 0 to `whole` at s = 1 that turns at -room."""
    at = 1 / (1 + np.sqrt(max(room + whole, 0) / room))     # where it turns
    return np.array([0, -2 * room / at, room / at**2])


def line(before, t0, p0, t1, p1, ratio, same, whole, ours, deaf, t):
    gap = max(t1 - t0, 100)
    s, hz = (t - t0) / gap, 1e6 / gap
    if same:
        return p1, s * whole, hz * whole, 0.0005, 0.0008 * hz**2, 0.0 if p1 else hz
    path, spread, fall = turning(0.5 + ours, whole), (0.05, 1.0), 0.0
    if before is not None and before[1] == p0:
        past = max(t0 - before[0], 100)
        q = past / gap
        fall = hz / q if p1 else 0.0
        height = ratio * past / audible(before[0], t0, deaf)
        # Through the event before, this one and the next.
        path = np.linalg.solve(np.vander([-q, 0, 1], 3, True), [height, 0, whole])
        if path[1] > 0 or path[2] < 0:
            path = np.array([0, 0, whole] if whole > 0 else [0, whole, 0])
        elif path[1]**2 > 4 * path[2] * (1 + ours):
            path = turning(1 + ours, whole)
        spread = (0.003, 0.02)
    return (p1, path @ (1, s, s * s), path @ (0, 1, 2 * s) * hz, spread[0],
            spread[1] * hz**2, fall)


def after(t0, r, t):
    """What the lamp has added since the last event, and per second."""
    if t - t0 >= STALE:
        return 0.0, 0.0
    return r(t)[0] - r(t0)[0], r(t)[1]


def in_reset(since, gap, first, deaf):
    """Thresholds crossed in reset at `first` per gap, and per second."""
    return first * min(since, deaf) / gap, (first * 1e6 / gap if since < deaf else 0)


def quiet(before, t0, p0, known, r, deaf, t):
    if t0 is None:
        return p0, 0.0, 0.0, UNKNOWN, 0.0, 0.0, 0.0, 0.0
    s, hz = (t - t0) / (known - t0), 1e6 / (known - t0)
    more, faster = (in_reset(t - t0, audible(before[0], t0, deaf), 1, deaf)
                    if deaf and before else (0, 0))
    return (p0, 2 * s * (1 - s) + more, (2 - 4 * s) * hz + faster, 0.08, 0.3 * hz**2,
            0.0, *after(t0, r, t))


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


def moving(before, t0, p0, known, deaf, least=200):
    """Probability that light moves that was silent from t0 to the time known."""
    u = max(known - t0 - deaf, 0) / max(t0 - before[0] - deaf, least)
    nodes, table = prior()
    return np.interp(u, nodes, table[0 if before[1] == p0 else 1][:, 4])


def ahead(before, t0, p0, steps, r, deaf, t, least=200):
    if before is None:
        return p0, 0.0, 0.0, UNKNOWN, 0.0, 0.0, 0.0, 0.0
    gap, p, same, room = t0 - before[0] - deaf, p0, before[1] == p0, 1.0
    if t - before[0] < STALE:
        change = r(t0)[0] - r(before[0])[0]
        if change != 0:
            light = steps[1 - p0] - change
            p = int(light > 0)
            crossed = light / steps[1 - p]
            same = before[1] == p or crossed < 0.5
            gap = gap / max(crossed, 0.1)
        room = np.clip(1 - (r(t)[0] - r(t0)[0]) / steps[1 - p], 0.3, 2)
    gap = max(gap, least)
    u = max(t - t0 - deaf, 0) / (gap * room)
    nodes, table = prior()
    if u >= nodes[-1]:
        return p, 0.0, 0.0, UNKNOWN, 0.0, 0.0, *after(t0, r, t)
    fraction, rate, *spread = (
        np.interp(u, nodes, column) for column in table[0 if same else 1].T[:4])
    fall = 1e6 / gap if same and p == 0 else 0.0
    fraction, rate = fraction * room, rate * 1e6 / gap
    if deaf:
        if t - t0 < deaf:
            fraction = rate = 0.0
        more, faster = in_reset(t - t0, gap, table[0 if same else 1][0, 1], deaf)
        fraction, rate = fraction + more, rate + faster
    return (p, fraction, rate, spread[0],
            spread[1] * (1e6 / gap) ** 2, fall, *after(t0, r, t))


def ahead_of_sample(before, t0, p0, deaf, t, least, rest, held, noise, sampled):
    """As `ahead` where a sample has measured the part held, with the variance noise."""
    nodes, table = prior()
    if before is None:
        return p0, held, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    gap, kind = max(t0 - before[0] - deaf, least), int(before[1] != p0)
    active = max(t - t0 - deaf, 0)
    u = active / gap
    if u >= nodes[-1]:
        return p0, held, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    fraction, rate, _, rate_var, share, spread, middle, common = (
        np.interp(u, nodes, column) for column in table[kind].T)
    share = max(share, 1e-6)
    lost = table[kind][0, 1] * min(t - t0, deaf) / gap
    s = max(active - (t - sampled), 0) / active if active else 0.0
    # Joint normal distribution of the parts now and at the sample, of light that moves.
    mean, slope = fraction / share, rate / share
    then = s * mean + 4 * s * (1 - s) * (middle - mean / 2)
    joint = s * spread**2 * max(1 - 4 * (1 - common) * (1 - s)**2, 0)
    variance = (s * spread)**2 + max(noise, 1e-6)
    far = held - lost - then
    part = mean + lost + joint / variance * far
    odds = (normal(far, variance) / normal(held, 1 / 3 + max(noise, 1e-6))
            * (1 - rest) * share / (1 - (1 - rest) * share))
    moves = odds / (1 + odds)
    faster = slope + joint / variance * far / max(u, 1 / 16)
    var = moves * (spread**2 - joint**2 / variance + (1 - moves) * (part - held)**2)
    rate_var = moves * (max((rate_var + rate**2) / share - slope**2, 0)
                        + (1 - moves) * faster**2)
    return (p0, held + moves * (part - held), moves * faster * 1e6 / gap, var,
            rate_var * (1e6 / gap)**2, 1e6 / gap if not kind and p0 == 0 else 0.0, 0.0,
            0.0)


def normal(x, variance):
    return np.exp(-x**2 / 2 / variance) / np.sqrt(variance)


def lead_variance(u, rate_var, fall, level, hz, slope_hz, sigma):
    """Of u in u (hz + k e^u) = rate / 2 pi, k = slope_hz * level, by its derivatives.

    And of what a pixel that follows its light's intensity can lose in a fall.
    """
    if not hz and not slope_hz:
        return 0.0
    k = slope_hz * level
    lost = max(3 * (fall / (2 * np.pi) * k / (hz + k) ** 2 - 0.24), 0)
    e = slope_hz * level * np.exp(u)
    d = max(hz + e * (1 + u), 0.05 * (hz + e))
    return min((rate_var / (2 * np.pi) ** 2 + (sigma * u * (hz + e)) ** 2) / d**2
               + lost**2, 1.0)


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
