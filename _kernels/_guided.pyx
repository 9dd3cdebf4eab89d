"""Guided demosaicing.

A sample is mean + X(x) cx + Y(y) cy + X(x) Y(y) cd, X and Y being 1 at even and -1 at
odd columns and rows: the mean of the four channels and their three differences, by
place in the cell.  3x3 sums tell all four, blurred (they are bilinear interpolation);
what the differences are in proportion to the mean is fitted in a 5x5 window, each 3x3
sum weighted by how little the intensity changes along its axis; and the sample itself
then tells the mean at its own pixel.
"""
from libc.stdint cimport uint8_t

from _kernels._rows cimport check_places, plane_of_place, row_stride, scratch_row
from _kernels._types cimport pixel_t

cdef extern from "_guided.h" nogil:
    void guided_columns(const float*, const float*, const float*, Py_ssize_t, float*,
                        float*)
    void guided_differences(const float*, const float*, float, Py_ssize_t, float*,
                            float*, float*, float*)
    void guided_terms(const float*, const float*, const float*, const float*,
                      const float*, const float*, const float*, float, float,
                      Py_ssize_t, float*, float*, float*, float*, float*, float*)
    void guided_window(const float*, Py_ssize_t, float*)
    void guided_quotient(const float**, const float**, Py_ssize_t, float*)
    void guided_row(const float*, const float*, const float*, const float*,
                    const float*, float, float, Py_ssize_t, float*, float*, float*,
                    float*)

# Scratch rows: samples, means and windowed terms of five rows, one row of the rest.
cdef enum:
    SAMPLES = 0
    MEANS = 5
    WINDOWED = 10
    SUM = 40
    DIFFERENCE = 41
    TRUST = 42
    TERM = 43
    PARTS = 49
    ROWS = 52


cdef inline Py_ssize_t mirrored(Py_ssize_t i, Py_ssize_t n) noexcept nogil:
    """Index i of a row of n >= 2, mirrored at its ends without repeating them."""
    i = (i if i >= 0 else -i) % (2 * n - 2)
    return i if i < n else 2 * n - 2 - i


cdef inline void mirror_ends(float* row, Py_ssize_t w) noexcept nogil:
    (row - 2)[0] = row[mirrored(-2, w)]
    (row - 1)[0] = row[1]
    row[w] = row[w - 2]
    row[w + 1] = row[mirrored(w + 1, w)]


cdef inline void take_trust(const uint8_t* clean, Py_ssize_t w,
                            float* trust) noexcept nogil:
    cdef float full = 1, last_resort = 1e-20
    cdef Py_ssize_t x
    for x in range(w):
        trust[x] = full if clean[x] else last_resort


def guided(const pixel_t[:, ::1] mosaic not None,
           const uint8_t[:, ::1] clean not None,
           const Py_ssize_t[::1] places not None,
           float floor, float across, float additive,
           float[::1] scratch not None,
           float[:, :, ::1] out not None):
    """Interpolate each channel of mosaic (h, w), sides >= 2, into out (4, h, w).

    clean (h, w) is 1 where a sample and its eight neighbours are usable; empty: all
    are.  Every sample must be finite.  scratch is 52 * (w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], y, x, k, f, i, r
    cdef Py_ssize_t plane[4]
    cdef bint marked = clean.shape[0] * clean.shape[1] != 0
    cdef float one = 1, down
    cdef float* base
    cdef float* row[52]
    cdef float* to[4]
    cdef const float* five[5]
    cdef const float* product[5]
    cdef const float* weight[5]
    if h < 2 or w < 2 or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w:
        raise ValueError("guided: mosaic must be (h, w), out (4, h, w), sides >= 2")
    if marked and (clean.shape[0] != h or clean.shape[1] != w):
        raise ValueError("guided: clean must be empty or have the size of mosaic")
    if scratch.shape[0] < ROWS * row_stride(w) + 32:
        raise ValueError("guided: scratch must be 52 * (w + 32) + 32 floats")
    check_places(places)
    plane_of_place(places, plane)
    base = &scratch[0]
    with nogil:
        for k in range(ROWS):
            row[k] = scratch_row(base, k, w)
        for x in range(w):
            row[TRUST][x] = one
        for i in range(h + 4):
            if i < h:      # samples of row i
                for x in range(w):
                    row[SAMPLES + i % 5][x] = <float>mosaic[i, x]
                mirror_ends(row[SAMPLES + i % 5], w)
            f = i - 2
            if 0 <= f < h:  # terms of row f
                for k in range(5):
                    five[k] = row[SAMPLES + mirrored(f + k - 2, h) % 5]
                if marked:
                    take_trust(&clean[f, 0], w, row[TRUST])
                down = -one if f & 1 else one
                guided_columns(five[1], five[2], five[3], w, row[SUM],
                               row[DIFFERENCE])
                guided_differences(row[SUM], row[DIFFERENCE], down, w,
                                   row[MEANS + f % 5], row[TERM], row[TERM + 2],
                                   row[TERM + 4])
                guided_terms(five[0], five[1], five[2], five[3], five[4],
                             row[MEANS + f % 5], row[TRUST], floor, across, w,
                             row[TERM], row[TERM + 2], row[TERM + 4], row[TERM + 1],
                             row[TERM + 3], row[TERM + 5])
                for k in range(6):
                    mirror_ends(row[TERM + k], w)
                    guided_window(row[TERM + k], w, row[WINDOWED + 5 * k + f % 5])
            y = i - 4
            if y >= 0:     # channels of row y
                for k in range(3):
                    for r in range(5):
                        f = mirrored(y + r - 2, h) % 5
                        product[r] = row[WINDOWED + 10 * k + f]
                        weight[r] = row[WINDOWED + 10 * k + 5 + f]
                    guided_quotient(product, weight, w, row[PARTS + k])
                for k in range(4):
                    to[k] = &out[plane[k], y, 0]
                down = -one if y & 1 else one
                guided_row(row[SAMPLES + y % 5], row[MEANS + y % 5], row[PARTS],
                           row[PARTS + 1], row[PARTS + 2], down, additive, w, to[0],
                           to[1], to[2], to[3])
