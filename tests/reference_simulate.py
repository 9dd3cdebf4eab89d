"""Plain twins of the simulator's kernels."""
import math

import numpy as np
from scipy.signal import lfilter


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


def filtered_pixel(light, cutoff_hz, on, off, leak_hz):
    """Events of one pixel from its light at each microsecond.

    The low-pass of its log, taken as linear over each microsecond.
    """
    v = np.log(light)
    phi = 2e-6 * math.pi * cutoff_hz
    decay = math.exp(-phi)
    ramp = 1 - (1 - decay) / phi
    seen, _ = lfilter([ramp, 1 - decay - ramp], [1, -decay], v - v[0],
                      zi=np.zeros(1))
    seen += leak_hz * on * 1e-6 * np.arange(len(v))
    reference, found = 0.0, []
    for t, y in enumerate(seen):
        while y >= reference + on or y <= reference - off:
            up = y >= reference + on
            found.append((t, up))
            reference += on if up else -off
    return found


def plane_waves(down_c, down_s, cos, sin):
    """Return the sum over waves of down_c cos - down_s sin, (row, column)."""
    total = np.zeros((down_c.shape[1], cos.shape[1]))
    for wave in zip(down_c, down_s, cos, sin, strict=True):
        down_cos, down_sin, along_cos, along_sin = wave
        total += down_cos[:, None] * along_cos
        total -= down_sin[:, None] * along_sin
    return total


def texture_stokes(fields, s0, contrast, dolp, dolp_spread, aop, aop_spread):
    """Return S0, S1 and S2 of fields of ln intensity, DoLP and AoP."""
    light = s0 * np.exp(contrast * fields[0])
    linear = light * (dolp + dolp_spread * np.sin(fields[1]))
    twice = 2 * (aop + aop_spread * fields[2])
    return light, linear * np.cos(twice), linear * np.sin(twice)


def fan_stokes(turns, sectors, rest, steep, light):
    """Return S1 + i S2 (time, place) of a wheel; sectors (time, 18) are complex."""
    place = rest - turns[:, None]
    time = np.arange(len(turns))[:, None]
    nearest = np.rint(place)
    s = np.clip((place - nearest) * steep + 0.5, 0, 1)
    weight = s * s * s * (10 - s * (15 - 6 * s))
    k = nearest.astype(np.intp) + 12
    mixed = sectors[time, k - 1] + weight * (sectors[time, k] - sectors[time, k - 1])
    whole = sectors[time, np.floor(place).astype(np.intp) + 12]
    return light * np.where(np.abs(place - nearest) * steep < 0.5, mixed, whole)
