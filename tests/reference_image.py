"""Plain NumPy versions of the image kernels, written to be read."""
import numpy as np

F32 = np.float32
PI = F32(np.pi)
HALF_ATAN = [-2.177702496e-03, 1.152006630e-02, -2.888679318e-02, 4.897117242e-02,
             -6.988290697e-02, 9.981352091e-02, -1.666582972e-01]


def superpixel(mosaic, layout):
    cells = [mosaic[r::2, c::2] for r in (0, 1) for c in (0, 1)]
    return np.stack([cells[place] for place in layout.places]).astype(F32)


def mean_of_neighbours(rows):
    """Mean of the rows above and below, the missing ones extrapolated."""
    n = len(rows)
    top = 2 * rows[1] - rows[3 if n > 3 else 1]
    bottom = 2 * rows[n - 2] - rows[n - 4 if n > 3 else n - 2]
    padded = np.concatenate([top[None], rows, bottom[None]])
    return (padded[:-2] + padded[2:]) * F32(0.5)


def bilinear(mosaic, layout):
    own = mosaic.astype(F32)
    beside = mean_of_neighbours(own.T).T
    above = mean_of_neighbours(own)
    diagonal = mean_of_neighbours(above.T).T
    y, x = np.indices(mosaic.shape) % 2
    return np.stack([
        np.where(y == p // 2, np.where(x == p % 2, own, beside),
                 np.where(x == p % 2, above, diagonal))
        for p in layout.places])


def stokes(quad, gain=1.0):
    i0, i45, i90, i135 = quad
    return np.stack([((i0 + i90) + (i45 + i135)) * F32(0.5),
                     F32(gain) * (i0 - i90), F32(gain) * (i45 - i135)])


def mix(quad, matrix):
    return np.stack([(row[0] * quad[0] + row[2] * quad[2])
                     + (row[1] * quad[1] + row[3] * quad[3]) for row in matrix])


def ratio(s1, s2):
    a1, a2 = np.abs(s1), np.abs(s2)
    large, small = np.maximum(a1, a2), np.minimum(a1, a2)
    return small / (large + F32(1e-37)), large


def aop(s1, s2):
    """The kernel's own arithmetic, in float32."""
    (r, _), steep = ratio(s1, s2), np.abs(s2) > np.abs(s1)
    t, p = r * r, F32(HALF_ATAN[0])
    for c in HALF_ATAN[1:]:
        p = p * t + F32(c)
    h = F32(0.5) * r + r * t * p
    k = np.zeros_like(h)
    for fold, full in ((steep, 1), (s1 < 0, 2), (s2 < 0, 4)):
        k = np.where(fold, F32(full) - k, k)
        h = np.where(fold, -h, h)
    angle = k * F32(7.85397530e-01) + (k * F32(6.33794e-07) + h)
    return np.where(angle >= PI, F32(0), angle)


def dolp(s0, s1, s2):
    r, large = ratio(s1, s2)
    size = large * np.sqrt(F32(1) + r * r)
    return np.where(s0 > 0, size / np.where(s0 > 0, s0, F32(1)), F32(0))


def cds(reset, signal, dark=0, gain=1):
    dn = (reset.astype(F32) - signal.astype(F32) - F32(dark)) * F32(gain)
    return dn, (reset >= 384) & (signal > 2)
