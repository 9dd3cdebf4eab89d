"""Plain NumPy versions of the image kernels, written to be read."""
import numpy as np

F32 = np.float32
PI = F32(np.pi)
HALF_ATAN = [-2.177702496e-03, 1.152006630e-02, -2.888679318e-02, 4.897117242e-02,
             -6.988290697e-02, 9.981352091e-02, -1.666582972e-01]


def superpixel(mosaic, layout):
    cells = [mosaic[r::2, c::2] for r in (0, 1) for c in (0, 1)]
    return np.stack([cells[place] for place in layout.places]).astype(F32)


def mean_of_neighbours(rows, slope):
    """Mean of the rows above and below, the missing ones extrapolated."""
    n, slope = len(rows), F32(slope)
    more = F32(1) + slope
    top = more * rows[1] - slope * rows[3 if n > 3 else 1]
    bottom = more * rows[n - 2] - slope * rows[n - 4 if n > 3 else n - 2]
    padded = np.concatenate([top[None], rows, bottom[None]])
    return (padded[:-2] + padded[2:]) * F32(0.5)


def bilinear(mosaic, layout, slope=1.0):
    own = mosaic.astype(F32)
    beside = mean_of_neighbours(own.T, slope).T
    above = mean_of_neighbours(own, slope)
    diagonal = mean_of_neighbours(above.T, slope).T
    y, x = np.indices(mosaic.shape) % 2
    return np.stack([
        np.where(y == p // 2, np.where(x == p % 2, own, beside),
                 np.where(x == p % 2, above, diagonal))
        for p in layout.places])


def bilinear_variance(variance, layout):
    """Beyond a border stands what is opposite."""
    padded = np.pad(variance, 2, mode="reflect")
    return bilinear(padded, layout)[:, 2:-2, 2:-2]


def binned(mosaic, layout):
    quad = bilinear(mosaic, layout)
    above, below = quad[:, 0::2], quad[:, 1::2]
    return ((above[..., 0::2] + above[..., 1::2])
            + (below[..., 0::2] + below[..., 1::2])) * F32(0.25)


def beside(image, axis, by):
    """The neighbours before and after, mirrored at the ends without repeating them."""
    n = image.shape[axis]
    index = np.abs(np.arange(-by, n + by)) % (2 * n - 2)
    index = np.where(index < n, index, 2 * n - 2 - index)
    return image.take(index[:n], axis), image.take(index[2 * by:], axis)


def binomial(image, axis):
    before, after = beside(image, axis, 1)
    return (before + after) + F32(2) * image


def apart(image, axis):
    before, after = beside(image, axis, 2)
    return (before + after) + F32(2) * image


def second_difference(image, axis):
    before, after = beside(image, axis, 1)
    return F32(2) * image - (before + after)


def square_of_change(image, axis):
    """Of differences over two pixels, those before, at and after the pixel: 1, 2, 1."""
    far, near = beside(image, axis, 2), beside(image, axis, 1)
    return F32(1 / 16) * (((image - far[0])**2 + (far[1] - image)**2)
                          + F32(2) * (near[1] - near[0])**2)


def window(terms):
    for axis in (1, 0):
        before2, after2 = beside(terms, axis, 2)
        before, after = beside(terms, axis, 1)
        terms = (before2 + after2) + F32(5) * (before + after) + F32(8) * terms
    return terms


def guided(mosaic, layout, clean=None, variance=0, floor=1e-3, across=0.3, gain=3.0,
           most=2.0, additive=1.0, noise=3.5, coarse=0.0):
    own = mosaic.astype(F32)
    y, x = np.indices(own.shape)
    right, down = (F32(1) - F32(2) * (i % 2).astype(F32) for i in (x, y))
    sixteenth, additive, tiny = F32(1 / 16), F32(additive), F32(1e-30)
    total, difference = binomial(own, 0), second_difference(own, 0)
    mean = binomial(total, 1) * sixteenth
    dn = np.maximum(mean, F32(0))
    trust = F32(1) if clean is None else np.where(clean, F32(1), F32(1e-20))
    along = (right * sixteenth * second_difference(total, 1),
             down * (binomial(difference, 1) * sixteenth),
             down * (right * sixteenth * second_difference(difference, 1)))
    change_x, change_y = square_of_change(own, 1), square_of_change(own, 0)
    least = F32(floor) * (dn * dn) + tiny
    wx = trust / ((change_x + F32(across) * change_y) + least)
    wy = trust / ((change_y + F32(across) * change_x) + least)
    parts, least = [], F32(1e30)
    for c, w in zip(along, (wx, wy, np.maximum(wx, wy)), strict=True):
        weighted = w * dn
        inverse = F32(1) / (window(weighted * dn) + tiny)
        part = window(weighted * c) * inverse
        left = c - part * mean
        energy = (w * left) * left + (weighted * dn) * (F32(9 / 64) * F32(variance))
        summed = window(weighted * left)
        step, energy = summed * inverse, window(energy) + tiny
        taken = F32(gain) * (summed * step / energy)
        parts.append(part + np.minimum(taken, F32(most)) * step)
        least = np.minimum(least, (energy - summed * step) * inverse)
    ax, ay, ad = parts
    change = (right * ax + down * ay) + right * (down * ad)
    share = F32(1) + change
    detail = (share * own + additive * (own - change * mean)) / (
        share * share + additive) - mean
    if coarse:
        more = mean - sixteenth * apart(apart(mean, 1), 0)
        power = sixteenth * apart(apart(more * more, 1), 0)
        noisy = F32(coarse) * (least * (mean * mean))
        mean_kept = mean - np.minimum(noisy / (power + tiny), F32(1)) * more
    power, trusted = (binomial(binomial(a, 1), 0) for a in (
        trust * (detail * detail), trust * np.ones_like(own)))
    mean = mean_kept if coarse else mean
    taken = F32(1) - trusted * (F32(noise) * (least * (mean * mean))) / (
        power + tiny * trusted)
    dn = mean + np.maximum(taken, F32(0)) * detail
    plus, minus, one = ay + ad, ay - ad, F32(1)
    cell = (dn * ((one + ax) + plus), dn * ((one - ax) + minus),
            dn * ((one + ax) - plus), dn * ((one - ax) - minus))
    return np.stack([cell[place] for place in layout.places])


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
