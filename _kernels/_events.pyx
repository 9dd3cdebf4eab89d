"""Events to images."""
from libc.stdint cimport int32_t, int64_t

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
