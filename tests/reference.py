"""Plain NumPy versions of the kernels, written to be read."""
import numpy as np

from pdavis_cv import render


def floor_sum(events, step, out):
    np.add.at(out, (events["y"], events["x"]), step[events["p"]])


def log_frame(dn, usable, log_exposure):
    above = dn >= 1
    return np.log(np.where(above, dn, 1.0)) - log_exposure, above & usable


class ComplementaryFilter:
    """docs/theory/complementary-filter.md in float64, an event at a time."""

    def __init__(self, shape, theta_on, theta_off, cutoff_hz, adaptive_gain, rule):
        self.on = np.broadcast_to(theta_on, shape)
        self.off = np.broadcast_to(theta_off, shape)
        self.tau_us = 1e6 / (2 * np.pi * cutoff_hz)
        self.adaptive_gain, self.rule = adaptive_gain, rule
        self.t = np.zeros(shape)
        self.L, self.held, self.log_exposure = np.zeros((3, *shape))
        self.gain = np.ones(shape)
        self.valid = np.zeros(shape, bool)
        self.started = False

    def add_events(self, events):
        for e in events:
            at = e["y"], e["x"]
            a = np.exp(-(e["t"] - self.t[at]) * self.gain[at] / self.tau_us)
            step = self.on[at] if e["p"] else -self.off[at]
            pull = 0 if self.rule == "printed" else (1 - a) * self.held[at]
            self.L[at] = a * self.L[at] + pull + step
            self.t[at] = e["t"]

    def add_frame(self, frame):
        dn = np.maximum(frame.dn.astype(float), 1)
        log_exposure = np.log(frame.exposure_ms) if frame.exposure_ms else 0.0
        sample = np.log(dn) - (0 if self.rule == "printed" else log_exposure)
        if not self.started:
            self.L, self.held, self.started = sample.copy(), sample, True
        self.valid = frame.dn >= 1
        if frame.valid is not None:
            self.valid &= frame.valid
        gain = (np.where(self.valid, adaptive_gain(frame.dn), 0.1)
                if self.adaptive_gain else np.ones_like(self.gain))
        weighing = gain if self.rule == "authors" else self.gain
        a = np.exp(-(frame.mid_us - self.t) * weighing / self.tau_us)
        pull = self.held if self.rule == "transfer" else sample
        self.L = a * self.L + (1 - a) * pull
        self.held, self.log_exposure = sample, log_exposure
        self.t[:] = frame.mid_us
        self.gain = gain

    def read(self, t_us):
        if self.rule == "authors":
            return self.L
        if self.rule == "printed":
            return self.L - self.log_exposure
        a = np.exp(-(t_us - self.t) * self.gain / self.tau_us)
        return a * self.L + (1 - a) * self.held


def adaptive_gain(dn):
    """m(v) for 10-bit DN."""
    v = np.maximum(np.minimum(dn.astype(float), 1023) / 4, 1)
    low = np.clip(np.log(v) / np.log(10), 0, 1)
    high = np.clip(np.log(255 / v) / np.log(255 / 200), 0, 1)
    return 0.1 + 0.9 * np.where(v < 10, low, np.where(v > 200, high, 1))


def unpack_lsb_first(data, bits, n):
    """Mono10p, Mono12p: one stream of bits, the least significant first."""
    stream = np.unpackbits(data, bitorder="little")[:n * bits].reshape(n, bits)
    return (stream.astype(int) << np.arange(bits)).sum(axis=1)


def unpack_in_pairs(data, bits, n):
    """Mono10Packed, Mono12Packed: high byte, both low parts, high byte."""
    low = bits - 8
    out = []
    for i in range(n):
        group = [int(b) for b in data[3 * (i // 2):3 * (i // 2) + 3]]
        high = group[2] if i % 2 else group[0]
        out.append((high << low) + (group[1] // 16 ** (i % 2)) % 2 ** low)
    return np.array(out, int)


def hue_bgr(plane, valid, scale, least, table):
    value = np.where(np.isfinite(plane), plane, 0).astype(float) * scale
    index = np.floor((value + 0.5) % (len(table) - 4)).astype(int)
    return coloured(plane, valid, least, table, index, np.isfinite(plane))


def ramp_bgr(plane, valid, scale, least, table):
    value = np.where(np.isnan(plane), 0, plane).astype(float) * scale
    index = (np.clip(value, 0, len(table) - 5) + 0.5).astype(int)
    return coloured(plane, valid, least, table, index, ~np.isnan(plane))


def tone_bgr(plane, valid, scale, least, table):
    value = np.where(np.isnan(plane), 0, plane).astype(float) * scale
    root = np.sqrt(np.maximum(value, 0))
    index = (np.minimum(root, len(table) - 5) + 0.5).astype(int)
    return coloured(plane, valid, least, table, index, ~np.isnan(plane))


def fade_bgr(weight, valid, scale, ground, picture):
    share = np.nan_to_num(np.clip(weight * np.float32(scale), 0, 1))
    share = np.where(valid, (share * 256 + np.float32(0.5)).astype(int), 256)
    off = picture.astype(int) - ground
    return (ground + (off * share[..., None] + 128 >> 8)).astype(np.uint8)


def coloured(plane, valid, least, table, index, has_colour):
    marks = len(table) - 4 + 2 * stripes(plane.shape)
    index = np.where(has_colour, index, marks)
    index = np.where(valid, index, marks + (plane >= least))
    return table[index, :3]


def stripes(shape):
    """Every other diagonal stripe: of 2 pixels, twice that beyond 513, 1027, ..."""
    width = 2
    while shape[1] // width > 256:
        width *= 2
    return sum(np.ogrid[:shape[0], :shape[1]]) // width % 2


def hatched(picture):
    """Where a picture has the mark of pixels that are not valid."""
    colours = np.array(render.INVALID)[stripes(picture.shape)]
    return (picture == colours).all(axis=-1)


def count(events, shape, start_us, stop_us):
    events = events[(events["t"] >= start_us) & (events["t"] < stop_us)]
    out = np.zeros((2, *shape), np.int32)
    np.add.at(out, (events["p"], events["y"], events["x"]), 1)
    return out


def voxel_grid(events, shape, bins, start_us, stop_us):
    """Every event against every bin, in float64."""
    events = events[(events["t"] >= start_us) & (events["t"] < stop_us)]
    place = (bins - 1) * (events["t"] - start_us) / (stop_us - start_us)
    sign = np.where(events["p"], 1.0, -1.0)
    out = np.zeros((bins, *shape))
    for k in range(bins):
        share = np.maximum(0, 1 - np.abs(place - k))
        np.add.at(out[k], (events["y"], events["x"]), sign * share)
    return out


def time_surface(events, shape, tau_us, t_us):
    last = np.full((2, *shape), -np.inf)
    for e in events[events["t"] <= t_us]:
        last[e["p"], e["y"], e["x"]] = e["t"]
    return np.exp((last - t_us) / tau_us)


def event_high_pass(events, shape, theta_on, theta_off, cutoff_hz, radius, t_us, hold):
    """Each pixel's sum, and means over the macropixels within the radius, in float64.

    With hold a pixel's weights count from its own last event, else from t_us.
    """
    tau_us = 1e6 / (2 * np.pi * cutoff_hz)
    own, last = np.zeros(shape), np.full(shape, t_us)
    ys, xs = np.mgrid[:shape[0], :shape[1]]
    on, off = np.broadcast_to(theta_on, shape), np.broadcast_to(theta_off, shape)
    for e in events:
        last[e["y"], e["x"]] = e["t"]
    now = last if hold else np.full(shape, t_us)
    for e in events:
        at = int(e["y"]), int(e["x"])
        step = on[at] if e["p"] else -off[at]
        own[at] += step * np.exp(-(int(now[at]) - int(e["t"])) / tau_us)
    seen_here = np.zeros(shape, bool)
    seen_here[events["y"], events["x"]] = True

    def near(y, x):
        apart = ((ys - y) // 2) ** 2 + ((xs - x) // 2) ** 2
        return (apart <= radius**2) & ((ys - y) % 2 == 0) & ((xs - x) % 2 == 0)

    mean, seen = np.zeros(shape), np.zeros(shape, bool)
    for y, x in np.ndindex(*shape):
        mean[y, x] = own[near(y, x)].mean()
        seen[y, x] = seen_here[near(y, x)].any()
    return mean, seen


class AopEvents:
    """High-passed sums by macropixel in float64, one event at a time."""

    def __init__(self, shape, on, off, angle_deg, cutoff_hz, radius, correct):
        self.rate = 2e-6 * np.pi * cutoff_hz
        self.on, self.off = np.broadcast_to(on, shape), np.broadcast_to(off, shape)
        self.angle = np.deg2rad(angle_deg)
        self.radius, self.correct = radius, correct
        cells = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
        self.s = np.zeros(cells, complex)            # S1 + i S2
        self.swept, self.energy = np.zeros(cells), np.zeros(cells)
        self.most_swept = np.zeros(cells)            # were all steps across s
        self.t = np.zeros(cells)

    def add(self, e):
        y, x, t = int(e["y"]), int(e["x"]), int(e["t"])
        rows, columns = np.indices(self.s.shape)
        near = (rows - y // 2) ** 2 + (columns - x // 2) ** 2 <= self.radius**2
        dt = t - self.t[near]
        a = np.exp(-self.rate * dt / 2)              # of the rotation: half the rate
        s = self.s[near] * np.exp(-self.rate * dt)
        step = self.on[y, x] if e["p"] else -self.off[y, x]
        step = step * np.exp(2j * self.angle[y % 2][x % 2])
        self.energy[near] = self.energy[near] * a + np.abs(s) ** 2 * dt
        self.swept[near] = self.swept[near] * a + np.imag(np.conj(s) * step)
        self.most_swept[near] = self.most_swept[near] * a + np.abs(s) * np.abs(step)
        self.s[near], self.t[near] = s + step, t
        s = self.s[y // 2, x // 2]
        if self.correct:
            swept, energy = self.swept[y // 2, x // 2], self.energy[y // 2, x // 2]
            if abs(swept) <= 1e-5 * self.most_swept[y // 2, x // 2]:
                return 0        # no sense of rotation, but for rounding
            s *= np.exp(-1j * np.copysign(
                np.arctan2(self.rate * energy, abs(swept)), swept))
        return s
