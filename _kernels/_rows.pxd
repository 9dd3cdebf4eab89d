"""Row functions of _stencil.h, and helpers that the image kernels share."""
from libc.stdint cimport uint8_t, uint16_t, uintptr_t

from _kernels._types cimport pixel_t


cdef extern from "_stencil.h" nogil:
    void bilinear_row_u8(
        const uint8_t*, const uint8_t*, const uint8_t*, int, float, Py_ssize_t, float*,
        float*, float*, float*, float*, float*)
    void bilinear_row_u16(
        const uint16_t*, const uint16_t*, const uint16_t*, int, float, Py_ssize_t,
        float*, float*, float*, float*, float*, float*)
    void bilinear_row_f32(
        const float*, const float*, const float*, int, float, Py_ssize_t, float*,
        float*, float*, float*, float*, float*)
    void aop_row(const float*, const float*, Py_ssize_t, float*)
    void dolp_row(const float*, const float*, const float*, Py_ssize_t, float*)
    void mix_row(
        const float*, const float*, const float*, const float*, const float*,
        const float*, const float*, const float*, Py_ssize_t, Py_ssize_t, float*)
    void stokes_row(
        const float*, const float*, const float*, const float*, float, Py_ssize_t,
        float*, float*, float*)
    void polarization_row(
        const float*, const float*, const float*, const float*, float, Py_ssize_t,
        float*, float*, float*)


cdef inline int check_places(const Py_ssize_t[::1] places) except -1:
    cdef Py_ssize_t c, seen = 0
    if places.shape[0] == 4:
        for c in range(4):
            if 0 <= places[c] < 4:
                seen |= 1 << places[c]
    if seen != 15:
        raise ValueError("places must be a permutation of 0, 1, 2, 3")
    return 0


cdef inline Py_ssize_t row_stride(Py_ssize_t w) noexcept nogil:
    """Stride of scratch rows in floats: w + 4 or more, a multiple of cache lines."""
    return (w + 32) // 16 * 16


cdef inline float* scratch_row(
        float* scratch, Py_ssize_t row, Py_ssize_t w) noexcept nogil:
    """Row of a scratch of rows * row_stride(w) + 32 floats, aligned to a cache line.

    Two floats before it, and two after its w, belong to it too.
    """
    cdef uintptr_t first = (<uintptr_t>scratch + 127) // 64 * 64
    return <float*>first + row * row_stride(w)


cdef inline Py_ssize_t mirrored(Py_ssize_t i, Py_ssize_t n) noexcept nogil:
    """Index i of a row of n >= 2, mirrored at its ends without repeating them."""
    i = (i if i >= 0 else -i) % (2 * n - 2)
    return i if i < n else 2 * n - 2 - i


cdef inline void mirror_ends(float* row, Py_ssize_t w) noexcept nogil:
    (row - 2)[0] = row[mirrored(-2, w)]
    (row - 1)[0] = row[1]
    row[w] = row[w - 2]
    row[w + 1] = row[mirrored(w + 1, w)]


cdef inline void plane_of_place(
        const Py_ssize_t[::1] places, Py_ssize_t* plane) noexcept nogil:
    cdef Py_ssize_t c
    for c in range(4):
        plane[places[c]] = c


cdef inline void bilinear_row(
        const pixel_t* mosaic, Py_ssize_t y, Py_ssize_t h, Py_ssize_t w, float slope,
        float* own, float* other, float** to) noexcept nogil:
    """Row y of the planes; to[p] receives the channel at place p of the cell.

    Beyond a border a channel continues at this share of the slope between its last two
    samples.
    """
    cdef Py_ssize_t up = y - 1, down = y + 1, p = 2 * (y & 1), q = 2 - p
    cdef int edge = up < 0 or down == h
    if up < 0:
        up = 1
        down = 3 if h > 3 else 1
    elif down == h:
        up = h - 2
        down = h - 4 if h > 3 else h - 2
    if pixel_t is uint8_t:
        bilinear_row_u8(mosaic + y * w, mosaic + up * w, mosaic + down * w, edge,
                        slope, w, own, other, to[p], to[p + 1], to[q], to[q + 1])
    elif pixel_t is uint16_t:
        bilinear_row_u16(mosaic + y * w, mosaic + up * w, mosaic + down * w, edge,
                         slope, w, own, other, to[p], to[p + 1], to[q], to[q + 1])
    else:
        bilinear_row_f32(mosaic + y * w, mosaic + up * w, mosaic + down * w, edge,
                         slope, w, own, other, to[p], to[p + 1], to[q], to[q + 1])
