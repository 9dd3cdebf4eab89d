"""Pictures for people: values through a table of colours to 8-bit BGR."""
from libc.stdint cimport int32_t, uint8_t

ctypedef fused plane_t:
    float
    double

cdef extern from "_picture.h" nogil:
    void hue_row_f32(const float*, const uint8_t*, Py_ssize_t, double, double,
                     const uint8_t*, int32_t, uint8_t*)
    void hue_row_f64(const double*, const uint8_t*, Py_ssize_t, double, double,
                     const uint8_t*, int32_t, uint8_t*)
    void ramp_row_f32(const float*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, uint8_t*)
    void ramp_row_f64(const double*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, uint8_t*)
    void tone_row_f32(const float*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, uint8_t*)
    void tone_row_f64(const double*, const uint8_t*, Py_ssize_t, double, double,
                      const uint8_t*, int32_t, uint8_t*)


cdef int check(Py_ssize_t h, Py_ssize_t w, const uint8_t[:, ::1] valid,
               const uint8_t[:, ::1] table, uint8_t[:, :, :] out) except -1:
    if valid.shape[0] * valid.shape[1] != 0 and (
            valid.shape[0] != h or valid.shape[1] != w):
        raise ValueError("picture: valid must be empty or have the size of plane")
    if not 2 < table.shape[0] < 1 << 30 or table.shape[1] != 4:
        raise ValueError("picture: table must be (n + 2, 4), n > 0")
    if (out.shape[0] != h or out.shape[1] != w or out.shape[2] != 3
            or out.strides[2] != 1 or w > 1 and out.strides[1] != 3):
        raise ValueError("picture: out must be (h, w, 3), its rows contiguous")
    return 0


cdef inline const uint8_t* row_of(const uint8_t[:, ::1] valid,
                                  Py_ssize_t y) noexcept nogil:
    return &valid[y, 0] if valid.shape[0] * valid.shape[1] != 0 else NULL


def hue_bgr(const plane_t[:, ::1] plane not None,
            const uint8_t[:, ::1] valid not None, double scale, double least,
            const uint8_t[:, ::1] table not None,
            uint8_t[:, :, :] out not None):
    """Write table[round(plane * scale) modulo n] to out (h, w, 3), rows contiguous.

    table is (n + 2, 4): B, G, R and a byte that is not used.  A value that is not
    finite gets table[n]; one from least on gets table[n + 1] where valid (if not empty)
    is 0.
    """
    cdef Py_ssize_t h = plane.shape[0], w = plane.shape[1], y
    check(h, w, valid, table, out)
    if w == 0:
        return
    with nogil:
        for y in range(h):
            if plane_t is float:
                hue_row_f32(&plane[y, 0], row_of(valid, y), w, scale, least,
                            &table[0, 0], table.shape[0] - 2, &out[y, 0, 0])
            else:
                hue_row_f64(&plane[y, 0], row_of(valid, y), w, scale, least,
                            &table[0, 0], table.shape[0] - 2, &out[y, 0, 0])


def ramp_bgr(const plane_t[:, ::1] plane not None,
             const uint8_t[:, ::1] valid not None, double scale, double least,
             const uint8_t[:, ::1] table not None, uint8_t[:, :, :] out not None):
    """As hue_bgr, but clamped to the ends of the n colours; NaN gets table[n]."""
    cdef Py_ssize_t h = plane.shape[0], w = plane.shape[1], y
    check(h, w, valid, table, out)
    if w == 0:
        return
    with nogil:
        for y in range(h):
            if plane_t is float:
                ramp_row_f32(&plane[y, 0], row_of(valid, y), w, scale, least,
                             &table[0, 0], table.shape[0] - 2, &out[y, 0, 0])
            else:
                ramp_row_f64(&plane[y, 0], row_of(valid, y), w, scale, least,
                             &table[0, 0], table.shape[0] - 2, &out[y, 0, 0])


def tone_bgr(const plane_t[:, ::1] plane not None,
             const uint8_t[:, ::1] valid not None, double scale, double least,
             const uint8_t[:, ::1] table not None, uint8_t[:, :, :] out not None):
    """As ramp_bgr, but of sqrt(plane * scale): fine steps where the light is dim."""
    cdef Py_ssize_t h = plane.shape[0], w = plane.shape[1], y
    check(h, w, valid, table, out)
    if w == 0:
        return
    with nogil:
        for y in range(h):
            if plane_t is float:
                tone_row_f32(&plane[y, 0], row_of(valid, y), w, scale, least,
                             &table[0, 0], table.shape[0] - 2, &out[y, 0, 0])
            else:
                tone_row_f64(&plane[y, 0], row_of(valid, y), w, scale, least,
                             &table[0, 0], table.shape[0] - 2, &out[y, 0, 0])
