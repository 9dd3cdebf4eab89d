"""The lamp's wave in plain float64 NumPy: least squares over lists of triples."""
import numpy as np

RATES = (100.0, 120.0, 75.0, 90.0)


def triples(events, on, off, shift=0):
    """Return (t_a, t_b, t_c, e, place): three events of a pixel, how far off b is."""
    rows = []
    for y, x in {(int(y), int(x)) for y, x in zip(events["y"], events["x"],
                                                  strict=True)}:
        if (y // 2 % (1 << shift)) or (x // 2 % (1 << shift)):
            continue
        mine = events[(events["y"] == y) & (events["x"] == x)]
        t = mine["t"].astype(np.int64)
        level = np.cumsum(np.where(mine["p"] == 1, on, -off))
        for i in range(1, len(t) - 1):
            if 200 <= t[i + 1] - t[i - 1] <= 40_000:
                straight = np.interp(t[i], t[[i - 1, i + 1]], level[[i - 1, i + 1]])
                rows.append((*t[i - 1:i + 2], level[i] - straight, y % 2 * 2 + x % 2))
    return np.array(rows, float).reshape(-1, 5)


def design(rows, hz, t0, corner_hz=0):
    """Columns of cosine and sine: the wave beside the straight line, phase 0 at t0.

    As a low-pass of corner_hz passes it on.
    """
    a, b, c = rows[:, :3].T
    s = (b - a) / (c - a)
    wave = [np.exp(2e-6j * np.pi * hz * (t - t0)) for t in (a, b, c)]
    off = wave[1] - (1 - s) * wave[0] - s * wave[2]
    if corner_hz:
        off = off / (1 + 1j * hz / corner_hz)
    return np.stack([off.real, off.imag], 1)


def fitted(rows, hz, t0, even_us, corner_hz=0):
    """Amplitudes, and what they explain of the weighted sum of squares."""
    weight = 1 / (1 + ((rows[:, 2] - rows[:, 0]) / even_us) ** 4)
    h = design(rows, hz, t0, corner_hz)
    m, b = h.T @ (weight[:, None] * h), h.T @ (weight * rows[:, 3])
    x = np.linalg.solve(m + 1e-6 * np.eye(2), b)
    return x, x @ b, weight
