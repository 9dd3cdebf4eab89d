"""Local means of the colours of a mosaic."""
from libc.stdint cimport uint8_t

cdef extern from "_colours.h" nogil:
    void colour_products(const float*, const float*, float, Py_ssize_t, float*, float*)
    void colour_masked(const float*, const float*, Py_ssize_t, Py_ssize_t, float*)
    void colour_ratio(const float*, const float*, const float*, Py_ssize_t, Py_ssize_t,
                      Py_ssize_t, float*)


cdef inline Py_ssize_t inside(Py_ssize_t i, Py_ssize_t n) noexcept nogil:
    """The index i, or outside 0..n-1 that of the same place in the nearest cell."""
    return i & 3 if i < 0 else n - 4 + ((i - n) & 3) if i >= n else i


def colour_means(const float[:, ::1] image not None,
                 const float[:, ::1] guide not None,
                 const uint8_t[:, ::1] cell not None, const float[::1] taps not None,
                 Py_ssize_t step, float[::1] scratch not None,
                 float[:, :, ::1] out not None):
    """Write the first colours' ratios of image to guide around pixels to out (n, h, w).

    It is sum(t i g) / sum(t g g) over the pixels of a colour, as cell (4, 4) tells, 0
    without any; where the guide is 1 or 0, the mean of those with 1.  t are taps along
    columns times taps along rows, step pixels apart.  The last cell is repeated beyond
    borders; sides >= 4.  scratch is 26 * (w + (taps - 1) * step) floats.
    """
    cdef Py_ssize_t h = image.shape[0], w = image.shape[1], n = taps.shape[0]
    cdef Py_ssize_t reach = n // 2 * step, stride = w + 2 * reach, y, x, k, c, p, at
    cdef float* mask = &scratch[0]                   # (3, 4): of colour and row
    cdef float* part = &scratch[0] + 12 * stride     # (4, 2): sums of rows of a kind
    cdef float* sums = &scratch[0] + 20 * stride     # (3, 2), with repeated ends
    cdef float* above
    cdef float zero = 0, one = 1
    if (h < 4 or w < 4 or guide.shape[0] != h or guide.shape[1] != w
            or out.shape[0] > 3 or out.shape[1] != h or out.shape[2] != w):
        raise ValueError("colour_means: image and guide must be (h, w), sides >= 4, "
                         "out (3 or less, h, w)")
    if cell.shape[0] != 4 or cell.shape[1] != 4 or n % 2 == 0 or step < 1:
        raise ValueError("colour_means: cell must be (4, 4), taps odd, step >= 1")
    if scratch.shape[0] < 26 * stride:
        raise ValueError("colour_means: scratch must be 26 rows with their ends")
    with nogil:
        for x in range(26 * stride):
            scratch[x] = zero
        for k in range(4):
            for x in range(w):
                if cell[k, x & 3] < out.shape[0]:
                    mask[(4 * cell[k, x & 3] + k) * stride + x] = one
        for y in range(h):
            for x in range(8 * stride):
                part[x] = zero
            for k in range(n):
                at = inside(y + (k - n // 2) * step, h)
                above = part + 2 * (at & 3) * stride
                colour_products(
                    &image[at, 0], &guide[at, 0], taps[k], w, above, above + stride)
            for c in range(out.shape[0]):
                for p in range(2):
                    above = sums + (2 * c + p) * stride + reach
                    colour_masked(mask + 4 * c * stride, part + p * stride, stride, w,
                                  above)
                    for x in range(reach):
                        (above - reach)[x] = above[inside(x - reach, w)]
                        above[w + x] = above[inside(w + x, w)]
                above = sums + 2 * c * stride
                colour_ratio(above, above + stride, &taps[0], n, step, w, &out[c, y, 0])
