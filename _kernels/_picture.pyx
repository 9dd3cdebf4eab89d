"""Planes of values as 8-bit BGR pictures, by tables of colours."""
from libc.stdint cimport int32_t, uint8_t

ctypedef fused plane_t:
    float
    double

ctypedef void (*row_f32_t)(const float*, const uint8_t*, Py_ssize_t, double, double,
                           const uint8_t*, int32_t, int32_t, uint8_t*) noexcept nogil
ctypedef void (*row_f64_t)(const double*, const uint8_t*, Py_ssize_t, double, double,
                           const uint8_t*, int32_t, int32_t, uint8_t*) noexcept nogil

cdef extern from "_picture.h" nogil:
    row_f32_t hue_row_f32, ramp_row_f32, tone_row_f32
    row_f64_t hue_row_f64, ramp_row_f64, tone_row_f64
    void fade_row(const float*, const uint8_t*, Py_ssize_t, float, int32_t, uint8_t*)


cdef int check(Py_ssize_t h, Py_ssize_t w, const uint8_t[:, ::1] valid,
               const uint8_t[:, ::1] table, uint8_t[:, :, :] out) except -1:
    if valid.shape[0] * valid.shape[1] != 0 and (
            valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("picture: valid must be empty or have the size of plane")
    if not 4 < table.shape[0] < 1 << 30 or table.shape[1] != 4:
        raise ValueError("picture: table must be (n + 4, 4), n > 0")
    if (out.shape[0] != h or out.shape[1] != w or out.shape[2] != 3
            or out.strides[2] != 1 or w > 1 and out.strides[1] != 3):
        raise ValueError("picture: out must be (h, w, 3), its rows contiguous")
    return 0


cdef inline const uint8_t* row_of(const uint8_t[:, ::1] valid,
                                  Py_ssize_t y) noexcept nogil:
    return &valid[y, 0] if valid.shape[0] * valid.shape[1] != 0 else NULL


cdef int draw(const plane_t[:, ::1] plane, const uint8_t[:, ::1] valid, double scale,
              double least, const uint8_t[:, ::1] table, uint8_t[:, :, :] out,
              row_f32_t row_f32, row_f64_t row_f64) except -1:
    """Draw plane by rows, with the row function of its dtype."""
    cdef Py_ssize_t h = plane.shape[0], w = plane.shape[1], y
    check(h, w, valid, table, out)
    if w == 0:
        return 0
    with nogil:
        for y in range(h):
            if plane_t is float:
                row_f32(&plane[y, 0], row_of(valid, y), w, scale, least,
                        &table[0, 0], table.shape[0] - 4, <int32_t>y, &out[y, 0, 0])
            else:
                row_f64(&plane[y, 0], row_of(valid, y), w, scale, least,
                        &table[0, 0], table.shape[0] - 4, <int32_t>y, &out[y, 0, 0])
    return 0


def hue_bgr(const plane_t[:, ::1] plane not None,
            const uint8_t[:, ::1] valid not None, double scale, double least,
            const uint8_t[:, ::1] table not None,
            uint8_t[:, :, :] out not None):
    """Write table[round(plane * scale) modulo n] to out (h, w, 3), rows contiguous.

    table is (n + 4, 4): B, G, R and an unused byte.  A value that is not finite gets
    table[n]; where valid (if not empty) is 0, a value of at least `least` gets
    table[n + 1], any other table[n].  In every other diagonal stripe these are
    table[n + 2] and table[n + 3]; stripes are 2 pixels wide, in wide pictures more.
    """
    draw(plane, valid, scale, least, table, out, hue_row_f32, hue_row_f64)


def ramp_bgr(const plane_t[:, ::1] plane not None,
             const uint8_t[:, ::1] valid not None, double scale, double least,
             const uint8_t[:, ::1] table not None, uint8_t[:, :, :] out not None):
    """As hue_bgr, but clamped to the ends of the n colours; NaN gets table[n]."""
    draw(plane, valid, scale, least, table, out, ramp_row_f32, ramp_row_f64)


def tone_bgr(const plane_t[:, ::1] plane not None,
             const uint8_t[:, ::1] valid not None, double scale, double least,
             const uint8_t[:, ::1] table not None, uint8_t[:, :, :] out not None):
    """As ramp_bgr of sqrt(plane * scale), which resolves dim light better."""
    draw(plane, valid, scale, least, table, out, tone_row_f32, tone_row_f64)


def fade_bgr(const float[:, ::1] weight not None, const uint8_t[:, ::1] valid not None,
             float scale, uint8_t ground, uint8_t[:, :, :] out not None):
    """Fade out (h, w, 3) towards a grey: weight * scale in 0..1 is the colour's share.

    In 256 steps; NaN is 0.  Where valid (if not empty) is 0, out stays.
    """
    cdef Py_ssize_t h = weight.shape[0], w = weight.shape[1], y
    if valid.shape[0] * valid.shape[1] != 0 and (
            valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("fade_bgr: valid must be empty or have the size of weight")
    if (out.shape[0] != h or out.shape[1] != w or out.shape[2] != 3
            or out.strides[2] != 1 or w > 1 and out.strides[1] != 3):
        raise ValueError("fade_bgr: out must be (h, w, 3), its rows contiguous")
    if w == 0:
        return
    with nogil:
        for y in range(h):
            fade_row(&weight[y, 0], row_of(valid, y), w, scale, ground, &out[y, 0, 0])
