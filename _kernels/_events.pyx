"""Events to images: counts, voxel grids, time surfaces."""
from libc.stdint cimport int32_t, int64_t

from _kernels._math cimport exp_f
from _kernels._types cimport event_t


def count(const event_t[::1] events not None, int64_t start, int64_t stop,
          int32_t[:, :, ::1] out not None):
    """Add the events of [start, stop) to out (polarity, y, x); return how many it read.

    Stops at the first event outside out, so the caller can name it.
    """
    cdef Py_ssize_t n = events.shape[0], h = out.shape[1], w = out.shape[2]
    cdef Py_ssize_t i, y, x, p
    if out.shape[0] != 2:
        raise ValueError("count: out must be (2, h, w)")
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if y >= h or x >= w or p > 1:
                break
            out[p, y, x] += start <= events[i].t < stop
        else:
            i = n
    return i


def voxel(const event_t[::1] events not None, int64_t start, int64_t stop,
          float[:, :, ::1] out not None):
    """Divide +1 or -1 per event of [start, stop) between two bins of (bin, y, x)."""
    cdef Py_ssize_t n = events.shape[0], bins = out.shape[0], h = out.shape[1]
    cdef Py_ssize_t w = out.shape[2], i, y, x, p, k
    cdef double per_us, place
    cdef float sign, late
    if bins < 1 or stop <= start:
        raise ValueError("voxel: out must have a bin, and stop lie after start")
    per_us = (bins - 1) / <double>(stop - start)
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if y >= h or x >= w or p > 1:
                break
            if events[i].t < start or events[i].t >= stop:
                continue
            place = <double>(events[i].t - start) * per_us
            k = <Py_ssize_t>place
            if k >= bins:                 # only if the division rounds up
                k = bins - 1
            late = <float>(place - k)
            sign = 2 * p - 1
            out[k, y, x] += sign - sign * late
            if k + 1 < bins:
                out[k + 1, y, x] += sign * late
        else:
            i = n
    return i


def surface(const event_t[::1] events not None, int64_t t, float rate,
            float[:, :, ::1] out not None):
    """Set out (polarity, y, x), all 0, to exp(rate (t_event - t)) of the last events.

    Goes backward, so that only the last event of a pixel costs an exp.
    """
    cdef Py_ssize_t h = out.shape[1], w = out.shape[2], i, y, x, p
    if out.shape[0] != 2:
        raise ValueError("surface: out must be (2, h, w)")
    with nogil:
        for i in range(events.shape[0] - 1, -1, -1):
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if y >= h or x >= w or p > 1 or events[i].t > t:
                continue
            if out[p, y, x] == 0:
                out[p, y, x] = exp_f(-(rate * <float>(t - events[i].t)))
