"""Planes of values as 8-bit BGR pictures, by tables of colours."""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, uint8_t

from _kernels._rows cimport aop_row, dolp_row, row_stride, scratch_row, stokes_row

ctypedef fused plane_t:
    float
    double

ctypedef void (*row_f32_t)(const float*, const uint8_t*, Py_ssize_t, double, double,
                           const uint8_t*, int32_t, int32_t, uint8_t*) noexcept nogil
ctypedef void (*row_f64_t)(const double*, const uint8_t*, Py_ssize_t, double, double,
                           const uint8_t*, int32_t, int32_t, uint8_t*) noexcept nogil

cdef extern from "_picture.h" nogil:
    void hue_row_f32(const float*, const uint8_t*, Py_ssize_t, double, double,
                     const uint8_t*, int32_t, int32_t, uint8_t*)
    void hue_row_f64(const double*, const uint8_t*, Py_ssize_t, double, double,
                     const uint8_t*, int32_t, int32_t, uint8_t*)
    void ramp_row_f32(const float*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, int32_t, uint8_t*)
    void ramp_row_f64(const double*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, int32_t, uint8_t*)
    void tone_row_f32(const float*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, int32_t, uint8_t*)
    void tone_row_f64(const double*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, int32_t, uint8_t*)
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


cdef int check_canvas(Py_ssize_t h, Py_ssize_t w, const uint8_t[:, ::1] table,
                      uint8_t[:, :, :] out) except -1:
    cdef const uint8_t[:, ::1] everything = table[:0]
    return 0 if out.shape[0] == 0 else check(h, w, everything, table, out)


def polar_bgr(const float[:, :, ::1] quad not None,
              const uint8_t[:, ::1] valid not None, float gain,
              float[::1] scratch not None, double s0_scale, double least,
              const uint8_t[:, ::1] s0_table not None, double aop_scale,
              const uint8_t[:, ::1] aop_table not None, double dolp_scale,
              const uint8_t[:, ::1] dolp_table not None, uint8_t[:, :, :] s0 not None,
              uint8_t[:, :, :] aop not None, uint8_t[:, :, :] dolp not None):
    """Draw S0, angle and degree of quad (4, h, w) row by row; skip empty outputs.

    The same bits as `stokes`, `aop`, `dolp` and then ramp_bgr, hue_bgr, ramp_bgr, valid
    where S0 > 0 and valid (if not empty) is 1; `least` applies to S0.  scratch is
    6 * (w + 32) + 32 floats.
    """
    cdef Py_ssize_t h = quad.shape[1], w = quad.shape[2], c, x, y
    cdef bint masked = valid.shape[0] * valid.shape[1] != 0
    cdef float* row[5]
    cdef uint8_t* good
    if quad.shape[0] != 4 or scratch.shape[0] < 6 * row_stride(w) + 32:
        raise ValueError("polar_bgr: quad must be (4, h, w), scratch 6 * (w + 32) + 32")
    if masked and (valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("polar_bgr: valid must be empty or (h, w)")
    check_canvas(h, w, s0_table, s0)
    check_canvas(h, w, aop_table, aop)
    check_canvas(h, w, dolp_table, dolp)
    if w == 0:
        return
    for c in range(5):
        row[c] = scratch_row(&scratch[0], c, w)
    good = <uint8_t*>scratch_row(&scratch[0], 5, w)
    with nogil:
        for y in range(h):
            stokes_row(&quad[0, y, 0], &quad[1, y, 0], &quad[2, y, 0], &quad[3, y, 0],
                       gain, w, row[0], row[1], row[2])
            for x in range(w):
                good[x] = row[0][x] > 0
            if masked:
                for x in range(w):
                    good[x] &= valid[y, x] != 0
            if s0.shape[0]:
                ramp_row_f32(row[0], good, w, s0_scale, least, &s0_table[0, 0],
                             s0_table.shape[0] - 4, <int32_t>y, &s0[y, 0, 0])
            if aop.shape[0]:
                aop_row(row[1], row[2], w, row[3])
                hue_row_f32(row[3], good, w, aop_scale, -INFINITY, &aop_table[0, 0],
                            aop_table.shape[0] - 4, <int32_t>y, &aop[y, 0, 0])
            if dolp.shape[0]:
                dolp_row(row[0], row[1], row[2], w, row[4])
                ramp_row_f32(row[4], good, w, dolp_scale, -INFINITY, &dolp_table[0, 0],
                             dolp_table.shape[0] - 4, <int32_t>y, &dolp[y, 0, 0])
