"""Local means of the colours of a mosaic."""
from libc.stdint cimport uint8_t


cdef inline Py_ssize_t inside(Py_ssize_t i, Py_ssize_t n) noexcept nogil:
    """The index i, or outside 0..n-1 that of the same place in the nearest cell."""
    return i & 3 if i < 0 else n - 4 + ((i - n) & 3) if i >= n else i


def smooth(const float[:, ::1] image not None, const float[::1] taps not None,
           float[::1] scratch not None, float[:, ::1] out not None):
    """Convolve image (h, w), sides >= 4, with 5 taps along columns, then along rows.

    The last cell of 4x4 is repeated beyond borders; scratch is w + 4 floats.
    """
    cdef Py_ssize_t h = image.shape[0], w = image.shape[1], y, x, k
    cdef const float* row[5]
    cdef float* sums
    cdef float a, b, c, d, e
    if h < 4 or w < 4 or out.shape[0] != h or out.shape[1] != w or taps.shape[0] != 5:
        raise ValueError("smooth: image and out must be (h, w), sides >= 4, taps 5")
    if scratch.shape[0] < w + 4:
        raise ValueError("smooth: scratch must be w + 4 floats")
    a, b, c, d, e = taps[0], taps[1], taps[2], taps[3], taps[4]
    sums = &scratch[0]
    with nogil:
        for y in range(h):
            for k in range(5):
                row[k] = &image[inside(y + k - 2, h), 0]
            for x in range(w):
                sums[x + 2] = (a * row[0][x] + b * row[1][x] + c * row[2][x]
                               + d * row[3][x] + e * row[4][x])
            sums[0], sums[1] = sums[4], sums[5]
            sums[w + 2], sums[w + 3] = sums[w - 2], sums[w - 1]
            for x in range(w):
                out[y, x] = (a * sums[x] + b * sums[x + 1] + c * sums[x + 2]
                             + d * sums[x + 3] + e * sums[x + 4])


def colour_means(const float[:, ::1] image not None,
                 const float[:, ::1] guide not None,
                 const uint8_t[:, ::1] cell not None, const float[::1] taps not None,
                 Py_ssize_t step, float[::1] scratch not None,
                 float[:, :, ::1] out not None):
    """Write each colour's ratio of image to guide around each pixel to out (3, h, w).

    It is sum(t i g) / sum(t g g) over the pixels of a colour, as cell (4, 4) tells, 0
    without any; t are taps along columns times taps along rows, step pixels apart.
    The last cell is repeated beyond borders; sides >= 4.  scratch is 27 * (w +
    (taps - 1) * step) floats.
    """
    cdef Py_ssize_t h = image.shape[0], w = image.shape[1], n = taps.shape[0]
    cdef Py_ssize_t reach = n // 2 * step, stride = w + 2 * reach, y, x, k, c, p, at
    cdef float* mask = &scratch[0]                   # (3, 4): of colour and row
    cdef float* part = &scratch[0] + 12 * stride     # (4, 2): sums of rows of a kind
    cdef float* sums = &scratch[0] + 20 * stride     # (3, 2), with repeated ends
    cdef float* above
    cdef float* below
    cdef const float* i
    cdef const float* g
    cdef float t, zero = 0, one = 1
    if (h < 4 or w < 4 or guide.shape[0] != h or guide.shape[1] != w
            or out.shape[0] != 3 or out.shape[1] != h or out.shape[2] != w):
        raise ValueError(
            "colour_means: image and guide must be (h, w), sides >= 4, out (3, h, w)")
    if cell.shape[0] != 4 or cell.shape[1] != 4 or n % 2 == 0 or step < 1:
        raise ValueError("colour_means: cell must be (4, 4), taps odd, step >= 1")
    if scratch.shape[0] < 27 * stride:
        raise ValueError("colour_means: scratch must be 27 rows with their ends")
    with nogil:
        for x in range(27 * stride):
            scratch[x] = zero
        for k in range(4):
            for x in range(w):
                if cell[k, x & 3] > 2:
                    continue
                mask[(4 * cell[k, x & 3] + k) * stride + x] = one
        for y in range(h):
            for x in range(8 * stride):
                part[x] = zero
            for k in range(n):
                at = inside(y + (k - n // 2) * step, h)
                i, g, t = &image[at, 0], &guide[at, 0], taps[k]
                above = part + 2 * (at & 3) * stride
                below = above + stride
                for x in range(w):
                    above[x] += t * (i[x] * g[x])
                    below[x] += t * (g[x] * g[x])
            for c in range(3):
                for p in range(2):
                    above = sums + (2 * c + p) * stride + reach
                    add_masked(above, mask + 4 * c * stride, part + p * stride, stride,
                               w)
                    for x in range(reach):
                        (above - reach)[x] = above[inside(x - reach, w)]
                        above[w + x] = above[inside(w + x, w)]
                above = sums + 2 * c * stride
                below = above + stride
                ratio_row(above, below, &taps[0], n, step, w, &out[c, y, 0],
                          &scratch[0] + 26 * stride)


cdef inline void add_masked(float* to, const float* mask, const float* part,
                            Py_ssize_t stride, Py_ssize_t w) noexcept nogil:
    """Sum the four kinds of rows where their pixels have the colour."""
    cdef Py_ssize_t x
    for x in range(w):
        to[x] = (mask[x] * part[x]
                 + mask[stride + x] * part[2 * stride + x]
                 + mask[2 * stride + x] * part[4 * stride + x]
                 + mask[3 * stride + x] * part[6 * stride + x])


cdef inline void ratio_row(const float* above, const float* below, const float* taps,
                           Py_ssize_t n, Py_ssize_t step, Py_ssize_t w, float* out,
                           float* spare) noexcept nogil:
    cdef Py_ssize_t x, k
    cdef float zero = 0, t
    for x in range(w):
        out[x] = zero
        spare[x] = zero
    for k in range(n):
        t = taps[k]
        for x in range(w):
            out[x] += t * above[x + k * step]
            spare[x] += t * below[x + k * step]
    for x in range(w):
        out[x] = out[x] / spare[x] if spare[x] > zero else zero
