"""Denoising of events: support by neighbours behind the same polarizer, hot pixels."""
from libc.stdint cimport int32_t, int64_t, uint8_t

from _kernels._types cimport event_t


cdef inline Py_ssize_t first_of(Py_ssize_t at) noexcept nogil:
    return at - 2 if at >= 2 else at


cdef inline Py_ssize_t last_of(Py_ssize_t at, Py_ssize_t side) noexcept nogil:
    return at + 2 if at + 2 < side else at


def denoise_events(const event_t[::1] events not None, Py_ssize_t start, int64_t last,
                   int64_t stop, int64_t window, Py_ssize_t needed,
                   const uint8_t[:, ::1] hot not None,
                   int64_t[:, :, ::1] times not None, int32_t[:, ::1] counts not None,
                   uint8_t[::1] keep not None):
    """Set keep for the events from index start on that lie before the time stop.

    An event is kept if at least `needed` of the eight pixels two rows or columns away
    had an event of its polarity at most window us before, and its pixel is not hot.
    times (row, column, polarity) holds the last events, counts their number by pixel.
    Returns the index of the first event that was not taken: not before stop, late, or
    off the sensor.
    """
    cdef Py_ssize_t n = events.shape[0], h = counts.shape[0], w = counts.shape[1]
    cdef Py_ssize_t i, y, x, p, a, b, seen
    cdef int64_t t
    if (hot.shape[0] != h or hot.shape[1] != w or times.shape[0] != h
            or times.shape[1] != w or times.shape[2] != 2 or keep.shape[0] != n):
        raise ValueError("denoise_events: an array has a wrong shape")
    if start < 0:
        raise ValueError("denoise_events: start must not be negative")
    with nogil:
        for i in range(start, n):
            t = events[i].t
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if y >= h or x >= w or p > 1 or t < last or t >= stop:
                break
            last = t
            counts[y, x] += 1
            keep[i] = 0
            if hot[y, x]:
                continue
            times[y, x, p] = t
            seen = 0
            for a in range(first_of(y), last_of(y, h) + 1, 2):
                for b in range(first_of(x), last_of(x, w) + 1, 2):
                    if (a != y or b != x) and times[a, b, p] >= t - window:
                        seen += 1
            keep[i] = seen >= needed
        else:
            i = n if n > start else start
    return i


def denoise_rates(int32_t[:, ::1] counts not None, float[:, ::1] rates not None,
                  uint8_t[:, ::1] hot not None, float share, float per_count,
                  float floor, float factor):
    """Update the mean rates by counts * per_count of weight share; mark hot pixels.

    A pixel is hot if its rate exceeds floor + factor times the median of the pixels two
    rows or columns away, and there are at least three of these.  counts become 0.
    """
    cdef Py_ssize_t h = counts.shape[0], w = counts.shape[1], y, x, a, b, n, k
    cdef float near[8]
    cdef float r, median
    if (rates.shape[0] != h or rates.shape[1] != w or hot.shape[0] != h
            or hot.shape[1] != w):
        raise ValueError("denoise_rates: all images must have one shape")
    with nogil:
        for y in range(h):
            for x in range(w):
                rates[y, x] += share * (per_count * <float>counts[y, x] - rates[y, x])
                counts[y, x] = 0
        for y in range(h):
            for x in range(w):
                hot[y, x] = 0
                if rates[y, x] <= floor:
                    continue
                n = 0
                for a in range(first_of(y), last_of(y, h) + 1, 2):
                    for b in range(first_of(x), last_of(x, w) + 1, 2):
                        if a == y and b == x:
                            continue
                        r = rates[a, b]
                        k = n
                        while k > 0 and near[k - 1] > r:
                            near[k] = near[k - 1]
                            k -= 1
                        near[k] = r
                        n += 1
                if n < 3:
                    continue
                median = <float>0.5 * (near[n // 2] + near[(n - 1) // 2])
                hot[y, x] = rates[y, x] > floor + factor * median
