"""Demosaicing of mosaics of colours and polarizers, see docs/theory/demosaicing.md.

Blocks of 2x2 pixels behind one filter are a Bayer mosaic, which tells the colours'
tints; cells of 4x4 pixels tell what is polarized in each colour.  Both turn the mosaic
into a grey one, and its channels into those of the colours.  Cells begin with red.
"""
from libc.stdint cimport uint8_t

from _kernels._rows cimport (
    check_places, mirror_ends, mirrored, plane_of_place, polarization_row, row_stride,
    scratch_row)
from _kernels._types cimport pixel_t

cdef extern from "_colours.h" nogil:
    void colour_bilinear(const float*, const float*, int, Py_ssize_t, float*, float*,
                         float*)
    void colour_blocks(const float*, const float*, Py_ssize_t, float*, float*, float*,
                       float*)
    void colour_columns(const float**, Py_ssize_t, float*, float*, float*, float*)
    void colour_means(const float*, const float*, const float*, int, Py_ssize_t, float*,
                      float*, float*, float*)
    void colour_cells(const float*, Py_ssize_t, Py_ssize_t, float*, float*)
    void colour_window(const float**, Py_ssize_t, float*, float*)
    void colour_green(const float**, int, Py_ssize_t, float*, float*)
    void colour_tints(const float*, const float**, int, Py_ssize_t, float*, float*,
                      float*)
    void colour_between(const float*, const float*, float, Py_ssize_t, float*)
    void colour_over_grey(const float*, const float*, const float*, const float*,
                          const float*, const float*, Py_ssize_t, float, Py_ssize_t,
                          float*, float*, float*, float*)
    void colour_factors(const float*, const float*, float, float, Py_ssize_t, float*)
    void colour_pixels(const float*, Py_ssize_t, float*)
    void colour_divide(const float**, const float**, Py_ssize_t, float*)
    void colour_multiply(const float*, const float*, const float*, Py_ssize_t, float*)

cdef enum:
    ROWS = 55   # twelve rings of four pixel rows, seven more


def colour_bilinears(const pixel_t[:, ::1] mosaic not None,
                     const uint8_t[:, ::1] cell not None, float[::1] scratch not None,
                     float[:, :, ::1] out not None):
    """Interpolate the colours of mosaic (h, w), sides >= 4, to out (3, h, w).

    cell (4, 4) has those of the filters, each over 2x2 pixels.  Beyond borders the last
    cell is repeated.  scratch is 2 * (w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], y, x, k, c
    cdef bint first, second
    cdef float half = 0.5
    cdef float* row[2]
    cdef const pixel_t* above
    cdef const pixel_t* below
    if (h < 4 or w < 4 or out.shape[0] != 3 or out.shape[1] != h or out.shape[2] != w
            or cell.shape[0] != 4 or cell.shape[1] != 4
            or scratch.shape[0] < 2 * row_stride(w) + 32):
        raise ValueError("colour_bilinears: mosaic must be (h, w), sides >= 4, cell "
                         "(4, 4), scratch 2 * (w + 32) + 32 floats, out (3, h, w)")
    row[0], row[1] = scratch_row(&scratch[0], 0, w), scratch_row(&scratch[0], 1, w)
    with nogil:
        for y in range(h):
            above = &mosaic[y - 2 if y > 1 else y + 2, 0]
            below = &mosaic[y + 2 if y + 2 < h else y - 2, 0]
            for x in range(w):
                row[0][x] = <float>mosaic[y, x]
                row[1][x] = half * (<float>above[x] + <float>below[x])
            for k in range(2):
                for x in range(2):
                    (row[k] - 2)[x] = row[k][2 + x]
                    row[k][w + x] = row[k][w - 4 + x]
            first, second = cell[y & 3, 0] == 1, cell[y & 3, 1] == 1   # are green
            c = cell[y & 3, 2 * first] & 2
            colour_bilinear(row[0], row[1], 2 * first + (first != second), w,
                            &out[c, y, 0], &out[1, y, 0], &out[2 - c, y, 0])


cdef int begin(Py_ssize_t h, Py_ssize_t w, const float[:, :, ::1] tints,
               const float[:, :, :, ::1] parts, float[::1] scratch,
               float** row) except -1:
    cdef Py_ssize_t k
    if (h < 4 or w < 4 or h % 4 or w % 4 or tints.shape[0] != 3
            or 2 * tints.shape[1] != h or 2 * tints.shape[2] != w or parts.shape[0] != 3
            or parts.shape[1] != 8 or 4 * parts.shape[2] != h or 4 * parts.shape[3] != w
            or scratch.shape[0] < ROWS * row_stride(w) + 32):
        raise ValueError("images must be (4h, 4w), of blocks (3, 2h, 2w), of cells "
                         "(3, 8, h, w), scratch 55 * (4 w + 32) + 32 floats")
    for k in range(ROWS):
        row[k] = scratch_row(&scratch[0], k, w)
    return 0


cdef inline void rows_around(float** ring, Py_ssize_t y, Py_ssize_t h, Py_ssize_t reach,
                             const float** rows) noexcept nogil:
    """Rows y - reach to y + reach of a ring of eight, mirrored."""
    cdef Py_ssize_t k
    for k in range(2 * reach + 1):
        rows[k] = ring[mirrored(y + k - reach, h) & 7]


def colour_ratios(const float[:, ::1] mosaic not None, float[::1] scratch not None,
                  float[:, :, ::1] tints not None,
                  float[:, :, :, ::1] parts not None):
    """Find the colours of mosaic (4h, 4w).

    tints (3, 2h, 2w): red, green and blue of each block over their mean.  parts
    (3, 8, h, w), of each colour: around each cell what is seen at the four places of a
    block over that of grey; differences of columns, of rows and of diagonals over their
    light; one of those of grey.  scratch is 55 * (4 w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = tints.shape[1], w = tints.shape[2], i, f, j, k, c, y, x
    cdef float share, quarter = 0.25
    cdef float* row[55]    # of eight each: light, three differences, grey, more than
    cdef const float* around[7]     # green; then two of green, two single ones
    begin(mosaic.shape[0], mosaic.shape[1], tints, parts, scratch, row)
    with nogil:
        for i in range(h + 5):
            if i < h:      # samples of row i of blocks
                k = i & 7
                colour_blocks(&mosaic[2 * i, 0], &mosaic[2 * i + 1, 0], w, row[k],
                              row[8 + k], row[16 + k], row[24 + k])
                mirror_ends(row[k], w)
            f = i - 2
            if 0 <= f < h:  # means of row f, and its share of the cells
                rows_around(row, f, h, 2, around)
                colour_columns(around, w, row[50], row[51], row[8 + (f & 7)],
                               row[16 + (f & 7)])
                c = 2 * (f & 1)
                colour_means(row[50], row[51], row[f & 7], f & 1, w, &tints[c, f, 0],
                             &tints[1, f, 0], &tints[2 - c, f, 0], row[32 + (f & 7)])
                mirror_ends(row[32 + (f & 7)], w)
                for k in range(3):
                    colour_cells(row[8 + 8 * k + (f & 7)], f & 1, w // 2,
                                 &parts[c, k, f // 2, 0],
                                 &parts[1, k, f // 2, 0])
            f = i - 4
            if 0 <= f < h:  # green of row f
                rows_around(row + 32, f, h, 2, around)
                colour_green(around, f & 1, w, row[48 + (f & 1)], row[40 + (f & 7)])
                mirror_ends(row[40 + (f & 7)], w)
            f = i - 5
            if f >= 0:      # tints of row f
                rows_around(row + 40, f, h, 1, around)
                c = 2 * (f & 1)
                colour_tints(row[48 + (f & 1)], around, f & 1, w, &tints[c, f, 0],
                             &tints[1, f, 0], &tints[2 - c, f, 0])
        h, w = h // 2, w // 2
        for c in range(3):
            for k in range(3):
                for y in range(h):
                    for j in range(7):
                        i = min(max(y + j - 3, 0), h - 1)
                        around[j] = &parts[c, k, i, 0]
                    colour_window(around, w, row[0] + 1, &parts[c, 4 + k, y, 0])
        for k in range(3):
            for y in range(h):
                for x in range(w):
                    parts[k, 7, y, x] = quarter * (
                        (parts[0, 4 + k, y, x] + parts[2, 4 + k, y, x])
                        + (parts[1, 4 + k, y, x] + parts[1, 4 + k, y, x]))
        for c in range(3):
            # Red blocks lie half a block before the centre of a cell, blue ones behind.
            share = 0 if c == 1 else 0.25
            for y in range(h):
                i = min(max(y + c - 1, 0), h - 1)
                for k in range(3):
                    colour_between(&parts[k, 7, y, 0], &parts[k, 7, i, 0],
                                   share, w, row[k])
                colour_over_grey(
                    &parts[c, 4, y, 0], &parts[c, 5, y, 0], &parts[c, 6, y, 0], row[0],
                    row[1], row[2], c - 1, share, w, &parts[c, 0, y, 0],
                    &parts[c, 1, y, 0], &parts[c, 2, y, 0], &parts[c, 3, y, 0])


cdef inline void factors(const float[:, :, ::1] tints, const float[:, :, :, ::1] parts,
                         Py_ssize_t i, float** row) noexcept nogil:
    """Put the pixels of row i of blocks into slot i % 4 of twelve rings."""
    cdef Py_ssize_t j = i // 2, n = parts.shape[3], beside, k, c
    cdef float share, before, behind
    for c in range(3 if i < tints.shape[1] else 0):
        before, behind = 0.25 * c, 0.5 - 0.25 * c
        share, beside = (behind, j + 1) if i & 1 else (before, j - 1)
        beside = min(max(beside, 0), parts.shape[2] - 1)
        for k in range(4):
            colour_between(&parts[c, k, j, 0], &parts[c, k, beside, 0], share, n,
                           row[48])
            colour_factors(&tints[c, i, 0], row[48], before, behind, n, row[49])
            colour_pixels(row[49], 2 * n, row[16 * c + 4 * k + (i & 3)])


cdef inline Py_ssize_t slot_beside(Py_ssize_t y, Py_ssize_t h) noexcept nogil:
    """Slot of the row of blocks, of h, next to row y of pixels beside its own."""
    return min(max(y // 2 + (1 if y & 1 else -1), 0), h - 1) & 3


def grey_mosaic(const float[:, :, ::1] tints not None,
                const float[:, :, :, ::1] parts not None, float[::1] scratch not None,
                float[:, ::1] mosaic not None):
    """Divide each sample of mosaic by what its colour is in parts of grey."""
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1], y, k, p
    cdef float* row[55]
    cdef const float* here[4]
    cdef const float* beside[4]
    begin(h, w, tints, parts, scratch, row)
    with nogil:
        factors(tints, parts, 0, row)
        for y in range(h):
            if not y & 1:
                factors(tints, parts, y // 2 + 1, row)
            for k in range(4):  # of the filters of even and of odd blocks
                p = 16 * (k // 2 + (y // 2 & 1)) + 4 * (2 * (y & 1) + k % 2)
                here[k] = row[p + (y // 2 & 3)]
                beside[k] = row[p + slot_beside(y, h // 2)]
            colour_divide(here, beside, w, &mosaic[y, 0])


def colour_planes(const float[:, :, ::1] quad not None,
                  const Py_ssize_t[::1] places not None,
                  const float[:, :, ::1] tints not None,
                  const float[:, :, :, ::1] parts not None, float gain,
                  float[::1] scratch not None, float[:, :, :, ::1] out not None):
    """Multiply the channels of a grey mosaic by what each colour is in parts of grey.

    Those of the three colours go to out (3, 4, 4h, 4w), of which out[1] may be quad; or
    what `s0_aop_dolp` makes of them with gain to out (3, 3, 4h, 4w).
    """
    cdef Py_ssize_t h = quad.shape[1], w = quad.shape[2], y, k, c, p
    cdef bint polarizes = out.shape[1] == 3
    cdef Py_ssize_t plane[4]
    cdef float* to[4]
    cdef float* row[55]
    begin(h, w, tints, parts, scratch, row)
    if (quad.shape[0] != 4 or out.shape[0] != 3 or out.shape[1] != 4 - polarizes
            or out.shape[2] != h or out.shape[3] != w):
        raise ValueError("colour_planes: quad must be (4, 4h, 4w), out (3, 4, 4h, 4w) "
                         "or (3, 3, 4h, 4w)")
    check_places(places)
    plane_of_place(places, plane)
    with nogil:
        factors(tints, parts, 0, row)
        for y in range(h):
            if not y & 1:
                factors(tints, parts, y // 2 + 1, row)
            for k in range(12):
                c, p = 2 * (k // 4) % 3, k & 3      # green last, which may be read
                to[plane[p]] = row[50 + p] if polarizes else &out[c, plane[p], y, 0]
                colour_multiply(
                    row[16 * c + 4 * p + (y // 2 & 3)],
                    row[16 * c + 4 * p + slot_beside(y, h // 2)],
                    &quad[plane[p], y, 0], w, to[plane[p]])
                if polarizes and p == 3:
                    polarization_row(
                        to[0], to[1], to[2], to[3], gain, w, &out[c, 0, y, 0],
                        &out[c, 1, y, 0], &out[c, 2, y, 0])
