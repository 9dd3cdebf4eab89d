"""Event pixels that are not ours: v2e's, EventCV's, and one of circuit equations.

v2e: Hu, Liu, Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021,
sections 3.1 to 3.6.  Neither shares our model of crossings: both step through samples
of the light, count whole thresholds in a step, and place the events evenly in it.

Circuit: the photoreceptor as a differential equation of the photocurrent with two
poles, noise as a fluctuating voltage before the comparator, a refractory period and a
leak that grows with light (Graca, McReynolds, Delbruck, arXiv:2304.04706; Nozaki,
Delbruck, IEEE Trans. Electron Devices 64, 2017).  Nothing was chosen on it; what is due
to v2e's first two specimens, lab/docs/reproduced.md says.
"""
import numpy as np

from pdavis_cv import recording_from_arrays
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import Layout

SIDE = 12
THETA, THETA_SIGMA, CUTOFF_HZ, LEAK_HZ, SHOT_HZ = 0.2, 0.03, 200.0, 0.3, 1.0
FULL_DN = 620.0     # of a 10-bit frame, where the video is white


class Chip:
    """Polarizers of a small sensor with their faults: angle, contrast, gain.

    `video` gives linear light, 0..1, that its pixels see of polarized light.
    """

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        shape = (SIDE, SIDE)
        angles = np.tile(np.deg2rad(Layout.PDAVIS.angles_deg), (SIDE // 2, SIDE // 2))
        self.angle = angles + np.deg2rad(0.7) * self.rng.standard_normal(shape)
        ratio = 40 + 3 * self.rng.standard_normal(shape)
        self.purity = (ratio - 1) / (ratio + 1)
        self.gain = 1 + 0.02 * self.rng.standard_normal(shape)

    def video(self, t_us, rpm, dolp):
        """Light at times (N,) behind a polarizer that turns: (N, SIDE, SIDE)."""
        aop = np.asarray(aop_of(t_us, rpm))[:, None, None]
        wave = np.cos(2 * (aop - self.angle))
        return np.clip(self.gain * (1 + self.purity * dolp * wave) / 2 * 0.95, 0, 1)

    def frames(self, seconds, rpm, dolp, offset_us=0):
        """20 frames per second, exposed for 20 ms, read out in 12, quantised."""
        made = []
        for start in range(0, int(seconds * 1e6) - 32_000, 50_000):
            t = start + (np.arange(200) + 0.5) * 100
            light = self.video(t, rpm, dolp).mean(0) * FULL_DN
            noise = np.sqrt(2.0**2 + light / 10 * 0.125)
            dn = np.round(light + noise * self.rng.standard_normal(light.shape))
            stated = start + offset_us
            made.append(ApsFrame(dn.astype(np.float32), stated, stated + 20_000,
                                 available_us=start + 32_000))
        return made


class Light:
    """Truth as `truth_errors.errors_of` takes it."""

    def __init__(self, rpm, dolp):
        self.rpm, self.degree = rpm, dolp

    def aop(self, t_us, x, y):
        return np.full(np.shape(x), aop_of(t_us, self.rpm))

    def dolp(self, t_us, x, y):
        return np.full(np.shape(x), self.degree)


def aop_of(t_us, rpm):
    """Angle of the polarizer in radians."""
    return (0.3 + 2 * np.pi * rpm / 60e6 * np.asarray(t_us, np.float64)) % np.pi


def step_of(rpm):
    """Sampling interval in whole us, for 0.25 degrees or more of AoP."""
    return int(np.clip(40_000 / rpm, 50, 500))


def v2e_events(chip, seconds, rpm, dolp):
    """Events of v2e's pixel."""
    rng, step = chip.rng, step_of(rpm)
    shape = (SIDE, SIDE)
    on = np.maximum(THETA + THETA_SIGMA * rng.standard_normal(shape), 0.01)
    off = np.maximum(THETA + THETA_SIGMA * rng.standard_normal(shape), 0.01)
    times = np.arange(0, int(seconds * 1e6), step)
    found, filtered, base = [], None, None
    for t, light in zip(times, chip.video(times, rpm, dolp), strict=True):
        value = light * 255
        # Linear below 20, logarithmic above (section 3.2).
        log = np.where(value < 20, value * np.log(20) / 20,
                       np.log(np.maximum(value, 1)))
        if filtered is None:
            filtered, base = log, log.copy()
            continue
        part = np.minimum(2e-6 * np.pi * CUTOFF_HZ * step * (value + 20) / 275, 1)
        filtered = (1 - part) * filtered + part * log
        base -= step * 1e-6 * LEAK_HZ * on
        rise = np.floor(np.maximum(filtered - base, 0) / on).astype(int)
        fall = np.floor(np.maximum(base - filtered, 0) / off).astype(int)
        base += rise * on - fall * off
        # Noise of dim pixels (section 3.6), which also moves the memorised level.
        chance = rng.random(shape)
        noise = SHOT_HZ / 2 * step * 1e-6 * (1 - 0.75 * value / 255)
        for polarity, count, extra, theta in (
                (1, rise, chance > 1 - noise, on), (0, fall, chance < noise, -off)):
            base += extra * theta
            n = count + extra
            row, column = np.nonzero(n)
            many = n[row, column]
            which = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
            each = np.repeat(many, many)
            found.append(np.stack((
                t - step + step * (which + 1) // (each + 1), np.repeat(column, many),
                np.repeat(row, many), np.full(len(which), polarity))))
    t, x, y, p = np.concatenate(found, axis=1)
    return stream(t, x, y, p)


CIRCUIT_STEP_US = 100
STAMP_ERROR_US = -5000
"""Of frames, of a DAVIS346: events trail them."""


def circuit_events(chip, seconds, rpm, dolp):
    """Events of a pixel by its circuit's equations, 100 us at a time.

    The first pole is that of the photocurrent, dv/dt = w (i - exp(v)): as fast as light
    is bright, faster for rises than for falls.  Thresholds: .29 ON, .33 OFF, 8 % of
    mismatch.
    """
    rng, dt = chip.rng, 1e-6 * CIRCUIT_STEP_US
    shape = (SIDE, SIDE)
    on = 0.29 * (1 + 0.08 * rng.standard_normal(shape))
    off = 0.33 * (1 + 0.08 * rng.standard_normal(shape))
    refractory = np.maximum(400e-6 * (1 + 0.2 * rng.standard_normal(shape)), 0)
    times = np.arange(0, int(seconds * 1e6), CIRCUIT_STEP_US)
    light = chip.video(times, rpm, dolp) + 2e-3         # and dark current
    first = 2 * np.pi * 2500.0                          # 1/s, in white light
    second = 2 * np.pi * 400.0
    # Noise of .02 rms and 300 Hz, more in dim light, where few electrons make it.
    fade, found = np.exp(-2 * np.pi * 300.0 * dt), []
    v = np.log(light[0])
    passed, base, noise = v.copy(), v.copy(), np.zeros(shape)
    held = np.zeros(shape)
    for t, current in zip(times, light, strict=True):
        for _ in range(4):
            v += dt / 4 * first * (current - np.exp(v))
        passed += (1 - np.exp(-second * dt)) * (v - passed)
        noise = fade * noise + 0.02 * np.sqrt(
            (1 - fade**2) * (1 + 0.02 / current)) * rng.standard_normal(shape)
        base -= dt * (0.1 + 0.5 * current) * on
        seen = passed + noise
        free = held <= 0
        held -= dt
        base = np.where((held <= 0) & ~free, seen, base)    # the end of its reset
        up, down = free & (seen - base >= on), free & (base - seen >= off)
        for p, fires in ((1, up), (0, down)):
            y, x = np.nonzero(fires)
            found.append(np.stack((
                t + rng.integers(0, CIRCUIT_STEP_US, len(x)), x, y,
                np.full(len(x), p))))
        held = np.where(up | down, refractory, held)
        base = np.where(up | down, seen, base)
    t, x, y, p = np.concatenate(found, axis=1)
    return stream(t, x, y, p)


def eventcv_events(chip, seconds, rpm, dolp):
    """Events of EventCV's simulator, noise and mismatch as it has them by default."""
    import eventcv
    step = step_of(rpm)
    light = chip.video(np.arange(0, int(seconds * 1e6), step), rpm, dolp)
    coded = np.where(light <= 0.0031308, 12.92 * light,
                     1.055 * light ** (1 / 2.4) - 0.055)  # sRGB, which it undoes
    events = eventcv.simulate(coded.astype(np.float32), fps=1e6 / step, seed=5,
                              pos_thres=THETA, neg_thres=THETA)
    x, y, t, p = events.numpy().T
    return stream(t, x, y, p)


def stream(t, x, y, p):
    events = np.empty(len(t), EVENT_DTYPE)
    events["t"], events["x"], events["y"], events["p"] = t, x, y, p
    return events[np.argsort(events["t"], kind="stable")]


def recording(pixel, rpm, *, seed=1, seconds=3.0, dolp=0.8, offset_us=0):
    """Return a recording of a turning polarizer by other pixels.

    offset_us is added to the times that frames state.
    """
    chip = Chip(seed)
    events = pixel(chip, seconds, rpm, dolp)
    return recording_from_arrays(events, chip.frames(seconds, rpm, dolp, offset_us),
                                 sensor_size=(SIDE, SIDE), layout=Layout.PDAVIS)
