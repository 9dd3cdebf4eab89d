"""Leaky integrators: a value per pixel that decays between events.

Each pixel holds the time of its last update, a value that decays towards 0, and its
rate in 1/us.  For the complementary filter the value is L - L_F, for the printed
equation L (docs/theory/complementary-filter.md), for the events method the
high-passed log intensity (docs/theory/events.md).
"""
from libc.stdint cimport int64_t, uint8_t

from _kernels._math cimport expm1_f
from _kernels._check cimport far
from _kernels._types cimport event_t

cdef extern from "_curves.h" nogil:
    void leak_row(const int64_t*, const float*, double, Py_ssize_t, float*)
    void add_row(const float*, Py_ssize_t, float*)
    void divide_row(const float*, Py_ssize_t, float*)

cdef extern from "_prefetch.h" nogil:
    const Py_ssize_t AHEAD "PDAVIS_AHEAD"
    void prefetch "PDAVIS_PREFETCH"(const void*)

cdef packed struct cell_t:
    double t          # microseconds, exact to 2**53
    double value      # float32 would lose 1e-4 within some 10,000 events
    float rate
    float unused      # keeps the doubles aligned


cdef inline void ask(const event_t[::1] events, Py_ssize_t i,
                     cell_t[:, ::1] cells) noexcept nogil:
    """Prefetch the cell of event i, if there is one."""
    if (i < events.shape[0] and events[i].y < cells.shape[0]
            and events[i].x < cells.shape[1]):
        prefetch(&cells[events[i].y, events[i].x])


cdef inline void leak(cell_t* cell, double t) noexcept nogil:
    cell.value += cell.value * expm1_f(-(cell.rate * <float>(t - cell.t)))
    cell.t = t


def check_times(const event_t[::1] events not None):
    """Return the index of the first event whose time is too far from 0."""
    cdef Py_ssize_t n = events.shape[0], i
    with nogil:
        for i in range(n):
            if far(events[i].t):
                break
        else:
            i = n
    return i


def check_events(const event_t[::1] events not None, int64_t last, Py_ssize_t h,
                 Py_ssize_t w):
    """Return the index of the first event that leak_events would stop at."""
    cdef Py_ssize_t n = events.shape[0], i
    with nogil:
        for i in range(n):
            if (events[i].y >= h or events[i].x >= w or events[i].p > 1
                    or events[i].t < last):
                break
            last = events[i].t
        else:
            i = n
    return i


def leak_events(const event_t[::1] events not None,
                const float[:, :, :] step not None, int64_t last,
                cell_t[:, ::1] cells not None):
    """Decay and add step[y, x, p] at each event; return how many were taken.

    Stops at the first event outside cells, or before its predecessor (the first:
    before last).
    """
    cdef Py_ssize_t n = events.shape[0], h = cells.shape[0], w = cells.shape[1]
    cdef Py_ssize_t i, y, x, p
    cdef int64_t t
    if step.shape[0] != h or step.shape[1] != w or step.shape[2] != 2:
        raise ValueError("leak_events: step must be (h, w, 2)")
    with nogil:
        for i in range(n):
            t = events[i].t
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if y >= h or x >= w or p > 1 or t < last:
                break
            last = t
            ask(events, i + AHEAD, cells)
            leak(&cells[y, x], <double>t)
            cells[y, x].value += step[y, x, p]
        else:
            i = n
    return i


def leak_read(const cell_t[:, ::1] cells not None, const float[:, ::1] base not None,
              double t, float[:, ::1] out not None):
    """Write base + value decayed to t; the cells are not updated."""
    cdef Py_ssize_t h = out.shape[0], w = out.shape[1], y
    if (cells.shape[0] != h or base.shape[0] != h or cells.shape[1] != w
            or base.shape[1] != w):
        raise ValueError("leak_read: cells, base and out must have one shape")
    if w == 0:
        return
    with nogil:
        for y in range(h):
            leak_row(<const int64_t*>&cells[y, 0], &base[y, 0], t, w, &out[y, 0])


def leak_shown(const event_t[::1] events not None, const cell_t[:, ::1] cells not None,
               float[:, ::1] out not None, uint8_t[:, ::1] seen not None):
    """Write the values of cells after these events, and 1 where there was one.

    Stops at the first event outside.
    """
    cdef Py_ssize_t h = out.shape[0], w = out.shape[1], i, y, x
    if (cells.shape[0] != h or seen.shape[0] != h or cells.shape[1] != w
            or seen.shape[1] != w):
        raise ValueError("leak_shown: cells, out and seen must have one shape")
    with nogil:
        for i in range(events.shape[0]):
            y = events[i].y
            x = events[i].x
            if y >= h or x >= w:
                break
            out[y, x] = <float>cells[y, x].value
            seen[y, x] = 1


def mean_around(const float[:, ::1] own not None, const float[:, ::1] count not None,
                const Py_ssize_t[:, ::1] offsets not None,
                float[:, ::1] out not None):
    """Write the mean of own over each pixel and those of its neighbours in the image.

    offsets, (n, 2), are rows and columns to the neighbours, in the order of addition;
    count is the number of pixels in each mean.
    """
    cdef Py_ssize_t h = out.shape[0], w = out.shape[1], y, x, k, dy, dx, n
    if (own.shape[0] != h or count.shape[0] != h or own.shape[1] != w
            or count.shape[1] != w):
        raise ValueError("mean_around: all images must have one shape")
    if offsets.shape[1] != 2:
        raise ValueError("mean_around: offsets must be (n, 2)")
    if w == 0:
        return
    with nogil:
        for y in range(h):
            for x in range(w):
                out[y, x] = own[y, x]
            for k in range(offsets.shape[0]):
                dy = y + offsets[k, 0]
                dx = offsets[k, 1]
                x = -dx if dx < 0 else 0
                n = w - x - dx if dx > 0 else w - x
                if 0 <= dy < h and n > 0:
                    add_row(&own[dy, x + dx], n, &out[y, x])
            divide_row(&count[y, 0], w, &out[y, 0])


cdef inline float gain_of(float log_v, float floor) noexcept nogil:
    """Adaptive gain m(v) of docs/theory/complementary-filter.md from ln v (8-bit)."""
    # 1 / ln 10, ln 255, 1 / ln(255 / 200): the paper's limits,
    # lab/studies/adaptive_gain.py
    cdef float per_ln_10 = 0.43429448, ln_255 = 5.5412635, per_top = 4.116138
    cdef float one = 1.0, low, high
    low = log_v * per_ln_10
    high = (ln_255 - log_v) * per_top
    low = low if low < high else high
    low = low if low < one else one
    low = low if low > 0 else 0
    return floor + (one - floor) * low


def cf_frame(const float[:, ::1] sample not None, const uint8_t[:, ::1] valid not None,
             const float[::1] log_8bit not None, const float[::1] age not None,
             double t, float rate, float floor, float[:, ::1] held not None,
             cell_t[:, ::1] cells not None):
    """Complementary filter: update by a frame at time t.

    sample is ln F; log_8bit[column] is added to give ln of the 8-bit value; age[column]
    is the time since the column's mid-exposure (us, may be negative); rate is 1/tau per
    us, floor the adaptive gain's lambda (1 = no adaptive gain).  held is L_F.
    """
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1]
    cdef Py_ssize_t y, x
    cdef float r, jump
    if (sample.shape[0] != h or valid.shape[0] != h or held.shape[0] != h
            or sample.shape[1] != w or valid.shape[1] != w or held.shape[1] != w
            or log_8bit.shape[0] != w or age.shape[0] != w):
        raise ValueError("cf_frame: all arrays must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                leak(&cells[y, x], t)
                r = gain_of(sample[y, x] + log_8bit[x], floor) if valid[y, x] else floor
                r *= rate
                # L_F changed when the column was exposed: the jump of L - L_F has
                # decayed since (if age < 0, it is extrapolated backward).
                jump = held[y, x] - sample[y, x]
                cells[y, x].value += jump + jump * expm1_f(-(r * age[x]))
                cells[y, x].rate = r
                held[y, x] = sample[y, x]


def cf_frame_authors(const float[:, ::1] sample not None,
                     const uint8_t[:, ::1] valid not None,
                     const float[::1] log_8bit not None, double t, float rate,
                     float floor, float[:, ::1] held not None,
                     cell_t[:, ::1] cells not None):
    """As cf_frame, but the sample and its gain weigh the time since the last update.

    L <- a L + (1 - a) ln F, a = exp(-m(F) (t - t_last) / tau), of all columns at t.
    """
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1]
    cdef Py_ssize_t y, x
    if (sample.shape[0] != h or valid.shape[0] != h or held.shape[0] != h
            or sample.shape[1] != w or valid.shape[1] != w or held.shape[1] != w
            or log_8bit.shape[0] != w):
        raise ValueError("cf_frame_authors: all arrays must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                cells[y, x].rate = rate * (
                    gain_of(sample[y, x] + log_8bit[x], floor) if valid[y, x]
                    else floor)
                cells[y, x].value += held[y, x] - sample[y, x]
                leak(&cells[y, x], t)
                held[y, x] = sample[y, x]


def cf_frame_printed(const float[:, ::1] sample not None,
                     const uint8_t[:, ::1] valid not None, double t, float rate,
                     float floor, float log_scale, cell_t[:, ::1] cells not None):
    """Printed equation: L <- a L + (1 - a) sample, sample in ln DN."""
    cdef Py_ssize_t h = cells.shape[0], w = cells.shape[1]
    cdef Py_ssize_t y, x
    cdef double old
    cdef float fall, r
    if (sample.shape[0] != h or valid.shape[0] != h or sample.shape[1] != w
            or valid.shape[1] != w):
        raise ValueError("cf_frame_printed: all arrays must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                old = cells[y, x].value
                fall = expm1_f(-(cells[y, x].rate * <float>(t - cells[y, x].t)))
                cells[y, x].value = old + (old - sample[y, x]) * fall
                cells[y, x].t = t
                r = gain_of(sample[y, x] + log_scale, floor) if valid[y, x] else floor
                cells[y, x].rate = r * rate
