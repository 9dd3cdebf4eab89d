"""Denoising in plain Python: every event against all that came before."""
import numpy as np


def neighbours(y, x, shape):
    return [(a, b) for a in (y - 2, y, y + 2) for b in (x - 2, x, x + 2)
            if (a, b) != (y, x) and 0 <= a < shape[0] and 0 <= b < shape[1]]


def kept(events, shape, window_us, support, *, rate_window_us=250_000, share=0.25,
         floor_hz=6.0, factor=4.0):
    rates, hot = np.zeros(shape), np.zeros(shape, bool)
    counts = np.zeros(shape)
    last, out, stop = {}, [], None
    for e in events:
        t, y, x, p = (int(e[name]) for name in "tyxp")
        stop = (t // rate_window_us + 1) * rate_window_us if stop is None else stop
        while t >= stop:
            stop += rate_window_us
            rates += share * (counts * 1e6 / rate_window_us - rates)
            counts[:] = 0
            for at in np.ndindex(*shape):
                near = [rates[other] for other in neighbours(*at, shape)]
                hot[at] = len(near) >= 3 and (
                    rates[at] > floor_hz + factor * np.median(near))
        counts[y, x] += 1
        if hot[y, x]:
            out.append(False)
            continue
        last[y, x, p] = t
        seen = [t - last.get((*other, p), -2**62) <= window_us
                for other in neighbours(y, x, shape)]
        out.append(sum(seen) >= support)
    return np.array(out, bool), hot
