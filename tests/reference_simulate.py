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


def log32(x):
    """Cephes' logf of positive, normal float32, each step rounded to float32."""
    bits = x.view(np.int32)
    k = (bits - 0x3f3504f3) >> 23
    m = (bits - k * (1 << 23)).view(np.float32) - np.float32(1)
    y = np.full_like(m, 7.0376836292e-2)
    for c in (-1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
              -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1):
        y = y * m + np.float32(c)
    z, e = m * m, k.astype(np.float32)
    y = y * m * z + e * np.float32(-2.12194440e-4) - np.float32(0.5) * z
    return m + y + e * np.float32(0.693359375)


def film_step(quad, weights, level, v, phi, dark):
    """Light, filtered log light and log light at the end of a step, in float32."""
    i0, i45, i90, i135 = quad.reshape(4, -1)
    half, along, across = weights
    light = np.maximum(
        np.float32(dark) + half * ((i0 + i90) + (i45 + i135))
        + (along * (i0 - i90) + across * (i45 - i135)), np.float32(1e-9))
    after = log32(light)
    if phi is None:
        return light, after, after
    # What remains of a step, and of a ramp, after the time of the filter.
    w0 = np.float32(-math.expm1(-phi))
    w1 = np.float32(1 + math.expm1(-phi) / phi)
    return light, level + w0 * (v - level) + w1 * (after - v), after


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
