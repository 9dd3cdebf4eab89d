"""Guided demosaicing.

A sample is m = G + X cx + Y cy + X Y cd, with X and Y +1 in even and -1 in odd columns
and rows, the mean G of the four channels and their three differences c by place in the
cell.  3x3 sums give all four, blurred, which is bilinear interpolation.

The ratio of each difference to the mean is fitted by least squares in a 5x5 window with
weights that decrease with the change of intensity along the difference's axis.  The
residual is fitted once more, and added as far as the fit explains it, which keeps
detail of the polarization.  The sample itself then gives the mean at its own pixel, of
which noise is filtered, as it is of what 3x3 means have more than wider ones where
`coarse` is above 0.  The equations are in docs/theory/demosaicing.md.
"""
from libc.stdint cimport uint8_t

from _kernels._rows cimport (
    check_places, mirror_ends, mirrored, plane_of_place, row_stride, scratch_row)
from _kernels._types cimport pixel_t

cdef extern from "_guided.h" nogil:
    void guided_columns(const float*, const float*, const float*, Py_ssize_t, float*,
                        float*)
    void guided_differences(const float*, const float*, float, Py_ssize_t, float*,
                            float*, float*, float*)
    void guided_weights(const float*, const float*, const float*, const float*,
                        const float*, const float*, const float*, float, float,
                        Py_ssize_t, float*, float*, float*)
    void guided_terms(const float*, const float*, const float*, Py_ssize_t, float*,
                      float*)
    void guided_residual(const float*, const float*, const float*, const float*,
                         const float*, Py_ssize_t, float*, float*)
    void guided_window(const float*, Py_ssize_t, float*)
    void guided_fit(const float**, const float**, Py_ssize_t, float*, float*)
    void guided_refine(const float**, const float**, const float*, const float*, float,
                       float, Py_ssize_t, float*, float*)
    void guided_detail(const float*, const float*, const float*, const float*,
                       const float*, float, float, const float*, Py_ssize_t, float*,
                       float*)
    void guided_beside(const float*, Py_ssize_t, Py_ssize_t, float*)
    void guided_coarse(const float*, const float**, Py_ssize_t, float*, float*)
    void guided_smooth(const float*, const float**, const float*, float, Py_ssize_t,
                       float*)
    void guided_row(const float*, const float*, const float**, const float**,
                    const float*, float, const float*, const float*, const float*,
                    Py_ssize_t, float*, float*, float*, float*)

# As GUIDED_DTYPE in mosaic.py, where the fields are explained.
cdef packed struct guided_t:
    float floor
    float across
    float gain
    float most
    float additive
    float noise
    float coarse

# Index of the first scratch row of each quantity, and how many image rows it keeps.
# Quantities of a difference have so many rows for each of the three.
cdef enum:
    SAMPLES = 0       # seven
    MEANS = 7         # six
    DIFFERENCES = 13  # three
    WEIGHTS = 22      # three
    WINDOWED = 31     # five of products and five of powers, windowed along the row
    RESIDUAL = 61     # five of products and five of energies, likewise
    INVERSES = 91     # three
    PARTS = 100       # three
    REFINED = 109     # two
    LEAST = 115       # two
    DETAIL = 117      # two
    POWER = 119       # three, followed by three of trust
    SUM = 125
    DIFFERENCE = 126
    TRUST = 127
    VARIANCE = 128
    TERM = 129        # two terms
    BESIDE = 131      # five of means, two pixels apart
    COARSE = 136      # three
    SQUARES = 139     # five, likewise two pixels apart
    ROWS = 144


cdef inline void take_trust(const uint8_t* clean, Py_ssize_t w,
                            float* trust) noexcept nogil:
    cdef float full = 1, last_resort = 1e-20
    cdef Py_ssize_t x
    for x in range(w):
        trust[x] = full if clean[x] else last_resort


cdef inline void sum_along(float** term, Py_ssize_t w, float** sums,
                           Py_ssize_t slot) noexcept nogil:
    """Put the two terms, windowed along the row, into slots of two sets of five."""
    cdef Py_ssize_t k
    for k in range(2):
        mirror_ends(term[k], w)
        guided_window(term[k], w, sums[5 * k + slot])


cdef inline void five_of(float** sums, Py_ssize_t y, Py_ssize_t h, const float** first,
                         const float** second) noexcept nogil:
    """Rows y - 2 to y + 2, mirrored, of two sets of five slots."""
    cdef Py_ssize_t r, slot
    for r in range(5):
        slot = mirrored(y + r - 2, h) % 5
        first[r] = sums[slot]
        second[r] = sums[5 + slot]


def guided(const pixel_t[:, ::1] mosaic not None,
           const uint8_t[:, ::1] clean not None,
           const float[:, ::1] variance not None,
           const Py_ssize_t[::1] places not None,
           const guided_t[::1] constants not None,
           float[::1] scratch not None,
           float[:, :, ::1] out not None):
    """Interpolate each channel of mosaic (h, w), sides >= 2, into out (4, h, w).

    clean (h, w) is 1 where a sample and its eight neighbours are usable; if it is
    empty, all are.  variance (h, w) is that of the samples relative to their squares,
    or empty if unknown.  All samples must be finite.  scratch has 144 * (w + 32) + 32
    floats.
    """
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], whole = w, y, x, k, f, i
    cdef Py_ssize_t first, left, count
    cdef Py_ssize_t plane[4]
    cdef bint marked = clean.shape[0] * clean.shape[1] != 0
    cdef bint known = variance.shape[0] * variance.shape[1] != 0
    cdef float zero = 0, one = 1, huge = 1e30, down
    cdef guided_t constant
    cdef float* base
    cdef float* row[144]
    cdef float* to[4]
    cdef const float* noise
    cdef const float* five[5]
    cdef const float* product[5]
    cdef const float* other[5]
    if h < 2 or w < 2 or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w:
        raise ValueError("guided: mosaic must be (h, w), out (4, h, w), sides >= 2")
    if (marked and (clean.shape[0] != h or clean.shape[1] != w)
            or known and (variance.shape[0] != h or variance.shape[1] != w)):
        raise ValueError(
            "guided: clean and variance must be empty or have the size of mosaic")
    if scratch.shape[0] < ROWS * row_stride(w) + 32 or constants.shape[0] != 1:
        raise ValueError(
            "guided: constants must be one, scratch 144 * (w + 32) + 32 floats")
    check_places(places)
    plane_of_place(places, plane)
    base = &scratch[0]
    with nogil:
        constant = constants[0]
        for k in range(ROWS):
            row[k] = scratch_row(base, k, w)
        # By strips whose 144 rows, .8 MB, stay in the cache, and 8 columns beside them.
        for first in range(0, whole, 1280):
            left, count = max(first - 8, 0), min(1280, whole - first)
            w = min(first + 1288, whole) - left
            for x in range(w):
                row[TRUST][x] = one
                row[VARIANCE][x] = zero
            for i in range(h + 7):
                if i < h:      # samples of row i
                    for x in range(w):
                        row[SAMPLES + i % 7][x] = <float>mosaic[i, left + x]
                    mirror_ends(row[SAMPLES + i % 7], w)
                f = i - 2
                if 0 <= f < h:  # differences of row f, and the terms of their fit
                    for k in range(5):
                        five[k] = row[SAMPLES + mirrored(f + k - 2, h) % 7]
                    if marked:
                        take_trust(&clean[f, left], w, row[TRUST])
                    down = -one if f & 1 else one
                    guided_columns(five[1], five[2], five[3], w, row[SUM],
                                   row[DIFFERENCE])
                    k = f % 3
                    guided_differences(
                        row[SUM], row[DIFFERENCE], down, w, row[MEANS + f % 6],
                        row[DIFFERENCES + k], row[DIFFERENCES + 3 + k],
                        row[DIFFERENCES + 6 + k])
                    if constant.coarse > zero:
                        mirror_ends(row[MEANS + f % 6], w)
                        guided_beside(row[MEANS + f % 6], 2, w, row[BESIDE + f % 5])
                    guided_weights(five[0], five[1], five[2], five[3], five[4],
                                   row[MEANS + f % 6], row[TRUST], constant.floor,
                                   constant.across, w, row[WEIGHTS + k],
                                   row[WEIGHTS + 3 + k], row[WEIGHTS + 6 + k])
                    for k in range(3):
                        guided_terms(
                            row[DIFFERENCES + 3 * k + f % 3], row[MEANS + f % 6],
                            row[WEIGHTS + 3 * k + f % 3], w, row[TERM], row[TERM + 1])
                        sum_along(row + TERM, w, row + WINDOWED + 10 * k, f % 5)
                f = i - 4
                if 0 <= f < h:  # first fits of row f, and the terms of their residuals
                    noise = &variance[f, left] if known else row[VARIANCE]
                    for k in range(3):
                        five_of(row + WINDOWED + 10 * k, f, h, product, other)
                        guided_fit(product, other, w, row[INVERSES + 3 * k + f % 3],
                                   row[PARTS + 3 * k + f % 3])
                        guided_residual(
                            row[DIFFERENCES + 3 * k + f % 3], row[MEANS + f % 6],
                            row[WEIGHTS + 3 * k + f % 3], row[PARTS + 3 * k + f % 3],
                            noise, w, row[TERM], row[TERM + 1])
                        sum_along(row + TERM, w, row + RESIDUAL + 10 * k, f % 5)
                    if constant.coarse > zero:
                        for k in range(3):
                            five[k] = row[BESIDE + mirrored(f + 2 * k - 2, h) % 5]
                        guided_coarse(row[MEANS + f % 6], five, w, row[COARSE + f % 3],
                                      row[TERM])
                        mirror_ends(row[TERM], w)
                        guided_beside(row[TERM], 2, w, row[SQUARES + f % 5])
                f = i - 6
                if 0 <= f < h:  # detail of row f
                    for x in range(w):
                        row[LEAST + f % 2][x] = huge
                    for k in range(3):
                        five_of(row + RESIDUAL + 10 * k, f, h, product, other)
                        guided_refine(product, other, row[INVERSES + 3 * k + f % 3],
                                      row[PARTS + 3 * k + f % 3], constant.gain,
                                      constant.most, w, row[REFINED + 2 * k + f % 2],
                                      row[LEAST + f % 2])
                    if marked:
                        take_trust(&clean[f, left], w, row[TRUST])
                    down = -one if f & 1 else one
                    guided_detail(row[SAMPLES + f % 7], row[MEANS + f % 6],
                                  row[REFINED + f % 2], row[REFINED + 2 + f % 2],
                                  row[REFINED + 4 + f % 2], down, constant.additive,
                                  row[TRUST], w, row[DETAIL + f % 2], row[TERM])
                    mirror_ends(row[TERM], w)
                    mirror_ends(row[TRUST], w)
                    guided_beside(row[TERM], 1, w, row[POWER + f % 3])
                    guided_beside(row[TRUST], 1, w, row[POWER + 3 + f % 3])
                    if constant.coarse > zero:
                        for k in range(3):
                            five[k] = row[SQUARES + mirrored(f + 2 * k - 2, h) % 5]
                        guided_smooth(row[COARSE + f % 3], five, row[LEAST + f % 2],
                                      constant.coarse, w, row[MEANS + f % 6])
                y = i - 7
                if y >= 0:     # channels of row y
                    x = first - left
                    for k in range(3):
                        f = mirrored(y + k - 1, h) % 3
                        product[k] = row[POWER + f] + x
                        other[k] = row[POWER + 3 + f] + x
                    for k in range(4):
                        to[k] = &out[plane[k], y, first]
                    guided_row(row[MEANS + y % 6] + x, row[DETAIL + y % 2] + x, product,
                               other, row[LEAST + y % 2] + x, constant.noise,
                               row[REFINED + y % 2] + x, row[REFINED + 2 + y % 2] + x,
                               row[REFINED + 4 + y % 2] + x, count, to[0], to[1], to[2],
                               to[3])
