"""Plain versions of the kernels of colour mosaics, pixel by pixel, in float32."""
import numpy as np

F = np.float32


def inside(i, n):
    """The index, or the nearest one that differs by a multiple of 4."""
    while i < 0:
        i += 4
    while i >= n:
        i -= 4
    return i


def colour_means(image, guide, cell, taps, step):
    h, w = image.shape
    n = len(taps)
    out = np.zeros((3, h, w), F)
    for y in range(h):
        parts = np.zeros((2, 4, w), F)
        for k in range(n):
            at = inside(y + (k - n // 2) * step, h)
            parts[0, at % 4] += taps[k] * (image[at] * guide[at])
            parts[1, at % 4] += taps[k] * (guide[at] * guide[at])
        for c in range(3):
            mask = np.array([[cell[r, x % 4] == c for x in range(w)]
                             for r in range(4)], F)
            sums = [((mask[0] * p[0] + mask[1] * p[1]) + mask[2] * p[2])
                    + mask[3] * p[3] for p in parts]
            for x in range(w):
                above = below = F(0)
                for k in range(n):
                    at = inside(x + (k - n // 2) * step, w)
                    above += taps[k] * sums[0][at]
                    below += taps[k] * sums[1][at]
                out[c, y, x] = above / below if below > 0 else 0
    return out
