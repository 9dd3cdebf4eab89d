"""Plain twins of the simulator's kernels."""
import math

import numpy as np


def sort_events(events):
    return events[np.argsort(events["t"], kind="stable")]


def read_out(events, until, event_us, row_us, size):
    """Arbiter with a list of requests per row; returns events out, and losses."""
    height, _ = size
    waiting = [[] for _ in range(height)]
    out, lost, clock, row = [], 0, 0.0, 0
    for t, x, y, p in [*events.tolist(), (until, None, None, None)]:
        while any(waiting) and clock < t:
            row = next(r % height for r in range(row + 1, row + 1 + height)
                       if waiting[r % height])
            out += [(math.floor(clock + 0.5), a, row, b) for a, b in waiting[row]]
            clock += row_us + len(waiting[row]) * event_us
            waiting[row] = []
        if x is None:
            break
        if any(a == x for a, _ in waiting[y]):
            lost += 1
            continue
        if not any(waiting):
            clock = max(clock, t)
        waiting[y].append((x, p))
    return np.array(out, events.dtype), lost


def film_pixel(v, step_us, cutoff_hz, on, off, leak_hz):
    """Events of one pixel whose log light is linear between v[k] at k step_us.

    The filter's solution in closed form, looked at every microsecond.
    """
    phi = 2e-6 * math.pi * cutoff_hz * step_us
    level = reference = v[0]
    drift = leak_hz * on * step_us / 1e6
    found = []
    x = np.arange(1, step_us + 1) / step_us
    for k in range(len(v) - 1):
        dv = v[k + 1] - v[k]
        p0 = v[k] - dv / phi
        seen = np.exp(-phi * x) * (level - p0) + p0 + dv * x + drift * x
        for i, y in enumerate(seen):
            while y >= reference + on or y <= reference - off:
                up = y >= reference + on
                found.append((k * step_us + i + 1, up))
                reference += on if up else -off
        level = seen[-1] - drift
        reference -= drift
    return found
