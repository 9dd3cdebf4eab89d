"""Plain versions of the kernels of colour mosaics, image by image, in float32."""
import numpy as np

F = np.float32


def inside(i, n):
    """Indices, or the nearest ones that differ by a multiple of 4."""
    return np.where(i < 0, i % 4, np.where(i < n, i, n - 4 + (i - n) % 4))


def bilinear_planes(mosaic, cell):
    """Each colour from its nearest samples behind the same polarizer."""
    image, (h, w) = mosaic.astype(F), mosaic.shape
    y, x = np.arange(h), np.arange(w)
    seen = cell[np.ix_(y % 4, x % 4)]
    nearest = F(0.5) * (image[inside(y - 2, h)] + image[inside(y + 2, h)])
    left, right = inside(x - 2, w), inside(x + 2, w)
    along = F(0.5) * (image[:, left] + image[:, right])
    diagonal = F(0.5) * (nearest[:, left] + nearest[:, right])
    in_row = np.stack([(seen == c).any(1) for c in range(3)])[..., None]
    out = []
    for c in range(3):
        if c == 1:
            other = F(0.5) * (along + nearest)
        else:
            other = np.where(in_row[c], along, np.where(seen == 1, nearest, diagonal))
        out.append(np.where(seen == c, image, other))
    return np.stack(out)


def beside(image, dy, dx):
    """The image moved, mirrored at its borders without repeating them."""
    h, w = image.shape
    y, x = (np.pad(np.arange(n), 2, "reflect")[2 + d:2 + d + n]
            for n, d in ((h, dy), (w, dx)))
    return image[np.ix_(y, x)]


def colour_ratios(mosaic):
    """Tints of blocks, and what cells of colours have over grey at four places."""
    m = mosaic.astype(F)
    a, b, c, d = m[::2, ::2], m[::2, 1::2], m[1::2, ::2], m[1::2, 1::2]
    light = np.maximum((a + b) + (c + d), F(1e-20))
    parts = [np.clip(change / light, F(-1), F(1)) for change in (
        (a + c) - (b + d), (a + b) - (c + d), (a + d) - (b + c))]
    for part, step in zip(parts, ((0, 2), (2, 0)), strict=False):
        before, behind = beside(light, -step[0], -step[1]), beside(light, *step)
        part += F(0.25) * (behind - before) / ((behind + before) + F(2) * light)
    y, x = np.indices(light.shape)
    green, red_row = (x + y) % 2 == 1, y % 2 == 0

    def own(image, *step):
        return F(0.2) * ((beside(image, -step[0], -step[1]) + beside(image, *step))
                         + F(3) * image)

    def other(image, *step):
        return F(0.5) * (beside(image, -step[0], -step[1]) + beside(image, *step))

    same, across = own(light, 2, 0), other(light, 1, 0)
    a, b, c, d = own(same, 0, 2), other(same, 0, 1), own(across, 0, 2), other(
        across, 0, 1)
    of_own = np.where(green, (F(25) * a + F(16) * d) / F(41), a)
    n_mean, o_mean = np.where(green, b, a), np.where(green, c, d)
    green_mean = np.where(green, of_own, F(0.5) * (b + c))
    grey = light / of_own
    bent = [F(2) * grey - (beside(grey, -s, -t) + beside(grey, s, t))
            for s, t in ((0, 2), (2, 0))]
    change = [np.abs(beside(grey, s, t) - beside(grey, -s, -t)) + np.abs(one)
              for one, (s, t) in zip(bent, ((0, 1), (1, 0)), strict=True)]
    least = F(1e-3) * (grey * grey) + F(1e-20)
    wx, wy = change[1] * change[1] + least, change[0] * change[0] + least
    level = np.where(green, grey, (
        wx * (other(grey, 0, 1) + F(0.1875) * bent[0])
        + wy * (other(grey, 1, 0) + F(0.1875) * bent[1])) / (wx + wy))
    more = grey - level
    up, down = (beside(beside(more, s, 0), 0, -1) + beside(beside(more, s, 0), 0, 1)
                for s in (-1, 1))
    more_n = np.where(green, other(more, 0, 1), more)
    more_o = np.where(green, other(more, 1, 0), F(0.25) * (up + down))
    lights = [np.maximum(mean * of, F(0)) for mean, of in (
        (n_mean, level + more_n), (green_mean, level), (o_mean, level + more_o))]
    scale = F(1) / np.maximum((lights[0] + (lights[1] + lights[2])) / F(3), F(1e-20))
    n, g, o = (np.maximum(one * scale, F(0.02)) for one in lights)
    tints = np.stack([np.where(red_row, n, o), g, np.where(red_row, o, n)])
    cells = np.array([
        [part[::2, ::2] for part in parts],
        [F(0.5) * part[::2, 1::2] + F(0.5) * part[1::2, ::2] for part in parts],
        [part[1::2, 1::2] for part in parts]])

    def window(image, axis):
        pad = [(0, 0)] * image.ndim
        pad[axis] = (3, 3)
        a, b, c, d, e, f, g = (
            np.take(np.pad(image, pad, "edge"), np.arange(image.shape[axis]) + k, axis)
            for k in range(7))
        return (F(3) * (b + f) - F(2) * (a + g)) + (F(6) * (c + e) + F(7) * d)

    def at_places(x, y, d):
        return np.maximum([(1 + x) + (y + d), (1 - x) + (y - d), (1 + x) + (-y - d),
                           (1 - x) + (-y + d)], F(0.02))

    cells = window(window(cells, 2), 3) / F(441)
    grey = F(0.25) * ((cells[0] + cells[2]) + (cells[1] + cells[1]))
    ratios = []
    for c, (own, share) in enumerate(zip(cells, F([0.25, 0, 0.25]), strict=True)):
        near = grey
        for axis in (1, 2):     # where red or blue blocks are
            n = near.shape[axis]
            side = near.take(np.clip(np.arange(n) + c - 1, 0, n - 1), axis)
            near = (F(1) - share) * near + share * side
        ratios.append(at_places(*own) / at_places(*near))
    return tints, np.array(ratios)


def factors(tints, parts):
    """What each colour is in parts of grey at the places of a cell: (3, 4, 4h, 4w)."""
    def twice(image, axis, first, second):
        """The image with two rows for one, functions of rows before, here, behind."""
        here = np.moveaxis(image, axis, 0)
        three = np.concatenate([here[:1], here[:-1]]), here, np.concatenate(
            [here[1:], here[-1:]])
        out = np.stack([first(*three), second(*three)], 1)
        return np.moveaxis(out.reshape(-1, *here.shape[1:]), 0, axis)

    def of_cells(image, share, axis):
        before, behind = F(share), F(0.5 - share)
        if axis == 1:
            return twice(image, axis, lambda a, b, c: (F(1) - before) * b + before * a,
                         lambda a, b, c: (F(1) - behind) * b + behind * c)
        return twice(image, axis, lambda a, b, c: b + before * (a - b),
                     lambda a, b, c: b + behind * (c - b))

    def of_blocks(image, axis):
        return twice(image, axis, lambda a, b, c: F(0.75) * b + F(0.25) * a,
                     lambda a, b, c: F(0.75) * b + F(0.25) * c)

    out = []
    for c, (tint, ratio) in enumerate(zip(tints, parts, strict=True)):
        blocks = tint * of_cells(of_cells(ratio, 0.25 * c, 1), 0.25 * c, 2)
        pixels = of_blocks(blocks, 2)
        pixels[..., 0], pixels[..., -1] = blocks[..., 0], blocks[..., -1]
        out.append(of_blocks(pixels, 1))
    return np.stack(out)


def grey_mosaic(mosaic, tints, parts):
    y, x = np.indices(mosaic.shape)
    colour = np.array([[0, 1], [1, 2]])[y // 2 % 2, x // 2 % 2]
    return mosaic.astype(F) / factors(tints, parts)[colour, 2 * (y % 2) + x % 2, y, x]


def colour_planes(quad, places, tints, parts):
    return quad * factors(tints, parts)[:, places]
