"""Event pixels behind a turning analyser, independent of the library's simulator.

Each follows the logarithm of the light, linear between samples, and gives an event
where it has moved by a threshold since the last one.
"""
import math

import numpy as np

import pdavis_cv
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import TRIGGER_DTYPE


def events_of(light, on, off, seconds, *, step=1e-4, jitter=0.0, seed=0):
    """Return events of n pixels in a row.

    light(t) gives the light of all of them at t seconds; on and off are their
    thresholds, each of which differs by the relative `jitter` from event to event.
    """
    rng, n = np.random.default_rng(seed), len(on)
    before = level = np.log(light(0.0))
    level = level.copy()
    up, down = on * (1 + jitter * rng.standard_normal(n)), off.copy()
    t, x, p = [], [], []
    for k in range(1, round(seconds / step) + 1):
        now = np.log(light(k * step))
        while True:
            rises, falls = now - level >= up, level - now >= down
            hit = np.flatnonzero(rises | falls)
            if not len(hit):
                break
            target = level[hit] + np.where(rises[hit], up[hit], -down[hit])
            part = (target - before[hit]) / (now[hit] - before[hit])
            t.append((k - 1 + np.clip(part, 0, 1)) * step)
            x.append(hit)
            p.append(rises[hit])
            level[hit] = target
            up[hit] = on[hit] * (1 + jitter * rng.standard_normal(len(hit)))
            down[hit] = off[hit] * (1 + jitter * rng.standard_normal(len(hit)))
        before = now
    t, x, p = (np.concatenate(part) for part in (t, x, p))
    order = np.argsort(t, kind="stable")
    events = np.zeros(len(t), EVENT_DTYPE)
    events["t"], events["x"], events["p"] = np.round(t * 1e6)[order], x[order], p[order]
    return events


class Still:
    """Pixels that see still light of random polarization, with their events."""

    def __init__(self, n=300, *, hz=20.0, seconds=1.2, degree=(0.3, 0.95),
                 thetas=(0.23, 0.27), spread=0.045, logarithmic=True, phase=0.0,
                 seed=1, **pixel):
        rng = np.random.default_rng(seed)
        self.dolp = rng.uniform(*degree, n)
        self.aop = rng.uniform(0, np.pi, n)
        error = spread * rng.standard_normal((2, n))
        self.on, self.off = np.asarray(thetas)[:, None] * (
            np.exp(error) if logarithmic else 1 + error)
        self.hz, self.stop_us, self.phase = hz, round(seconds * 1e6), phase
        self.events = events_of(self.light, self.on, self.off, seconds, **pixel)

    def light(self, t):
        angle = 2 * np.pi * self.hz * t + self.phase
        return 1 + self.dolp * np.cos(2 * (angle - self.aop))


def errors(found, dolp, aop):
    """Return errors of AoP, radians, and DoLP of a Polarization of one row."""
    i0, i45, i90, i135 = found.quad[:, 0]
    q1, q2 = (i0 - i90) / (i0 + i90), (i45 - i135) / (i45 + i135)
    angle = np.arctan2(q2, q1) / 2 - aop
    return (angle + np.pi / 2) % np.pi - np.pi / 2, np.hypot(q1, q2) - dolp


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def pulses(hz, seconds, n=1, drift=0.0, ramp=0.0):
    """Return times of pulses, us, and turns by then, of a motor."""
    t = np.linspace(0, seconds, 200_001)
    speed = hz * (1 + drift * t / 10) * np.clip(t / ramp if ramp else 1, 0.05, 1)
    turns = np.concatenate(([0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t))))
    which = np.arange(0, math.floor(turns[-1] * n) + 1)
    return np.interp(which / n, turns, t) * 1e6, (t * 1e6, turns)


def turned(segments, t_us):
    """Return turns of the analyser at times, from its segments."""
    k = np.maximum(np.searchsorted(segments[:, 0], t_us, "right") - 1, 0)
    return (segments[k, 1] + segments[k, 2] * (t_us - segments[k, 0])) / (4 * np.pi)


def as_recording(scene, pulses_us=()):
    """Return a scene as a recording of blocks of 16 pixels that see the same."""
    events = np.repeat(scene.events, 2)
    events["x"] = events["x"] * 16 + np.arange(len(events)) % 2
    triggers = np.zeros(len(pulses_us), TRIGGER_DTYPE)
    triggers["t"], triggers["type"] = pulses_us, 1
    return pdavis_cv.recording_from_arrays(
        events, sensor_size=(1, 16 * len(scene.on)), triggers=triggers)
