"""NumPy twin of the kernel that adds up innovations under candidate cameras."""
import itertools
from types import SimpleNamespace

import numpy as np
from reference_kalman import Pixel, steady


def innovations(events, readings, theta, sigma, camera, deaf=0.0):
    """Sums of e^2 / v, |e|^1.5 / v^.75 and ln v of a pixel, their number, its ln theta.

    events are (t, p), readings rows of (log, variance, begin, middle, end, known).
    """
    theta = np.multiply(theta, (camera["scale_on"], camera["scale_off"]))
    # Pixels of a sample are busy: no event may be noise and no pixel fades to rest,
    # which Pixel takes for granted of a light with any ripple.
    nothing = SimpleNamespace(p_noise=0.0, motion=0.0)
    pixel = Pixel(*theta, sigma, (camera["hz"], camera["hz_per_intensity"], 0),
                  lambda t, hz: steady(t, hz), nothing, 0.0, deaf)
    pixel.events = events
    chi2 = deviation = log_variance = count = 0
    since, reference = 0, None
    for log, variance, *times in readings:
        if not variance > 0:
            continue
        begin, middle, end, known = (t + camera["clock_us"] for t in times)
        here, fresh = pixel.next(middle), reference is None
        n_on, n_off = pixel.counts(since, here)
        if not fresh:
            F = np.eye(3)
            F[0, 1:] = n_on, -n_off
            if n_on + n_off >= 3:
                pixel.P[[1, 2], [1, 2]] += camera["drift"] * pixel.x[1:]**2
            pixel.x, pixel.P = F @ pixel.x, F @ pixel.P @ F.T
            pixel.P[0, 0] += pixel.x[1:].mean()**2 * (
                camera["noise_per_s"] * 1e-6 * (middle - reference)
                + camera["noise_per_event"] * (n_on + n_off))
        level = log if fresh else pixel.x[0]
        inner = sorted({t for t, _ in events if begin < t < end})
        whole, weighted = 0.0, np.zeros(2)
        for a, b in itertools.pairwise([begin, *inner, end]):
            for node in (-1, 1) if inner else (0, 0):
                n, y, u, *_ = pixel.value(
                    (a + b) / 2 + node * (b - a) / np.sqrt(12), known, here, level)
                light = (b - a) / 2 * np.exp(y + u)
                whole, weighted = whole + light, weighted + light * n
        H = np.array([1.0, *(weighted / whole * (1, -1))])
        blur = np.log(whole / (end - begin))
        if fresh:
            pixel.x[0] = log - blur
        error = log - pixel.x[0] - blur
        v = H @ pixel.P @ H + variance + camera["frame_sigma"]**2
        chi2 += min(error**2 / v, 16)
        deviation += min(abs(error) / np.sqrt(v), 4)**1.5
        log_variance += np.log(v)
        count += 1
        if error**2 > 16 * v:
            pixel.P[0, 0] += error**2
            v += error**2
        K = pixel.P @ H / v
        gain = K.copy()
        if fresh or n_on + n_off < 3:
            gain[1:] = 0                    # Schmidt-Kalman: thresholds stay
        pixel.x = pixel.x + gain * error
        pixel.P = (pixel.P - np.outer(gain, K) * v - np.outer(K, gain) * v
                   + np.outer(gain, gain) * v)
        pixel.x[1:] = np.clip(pixel.x[1:], 0.3 * theta, 3 * theta)
        since, reference = here, middle
    return chi2, deviation, log_variance, count, np.log(pixel.x[1:]).sum()
