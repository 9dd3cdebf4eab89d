"""Read-out of a sensor's events: order in time, and the bus."""
from libc.math cimport floor
from libc.stdint cimport int32_t, int64_t, uint8_t, uint16_t

from _kernels._types cimport event_t


def sort_events(const event_t[::1] events not None, int64_t start,
                int32_t[::1] counts not None, event_t[::1] out not None):
    """Stable counting sort by time; times lie in start .. start + len(counts) - 1.

    Returns the number of events sorted: it stops at the first time outside.
    """
    cdef Py_ssize_t n = events.shape[0], bins = counts.shape[0], i
    cdef int64_t t
    cdef int32_t at, here
    if out.shape[0] != n or n > 2147483647:
        raise ValueError("sort_events: out must have as many events")
    with nogil:
        for i in range(bins):
            counts[i] = 0
        for i in range(n):
            t = events[i].t - start
            if t < 0 or t >= bins:
                break
            counts[t] += 1
        else:
            at = 0
            for i in range(bins):
                here = counts[i]
                counts[i] = at
                at += here
            for i in range(n):
                t = events[i].t - start
                out[counts[t]] = events[i]
                counts[t] += 1
            i = n
    return i


def read_out(const event_t[::1] events not None, double until_us, double event_us,
             double row_us, double[::1] clock not None, int32_t[::1] waiting not None,
             uint16_t[:, ::1] queue not None, uint8_t[:, ::1] pending not None,
             event_t[::1] out not None):
    """Pass events through the arbiter: one row at a time, round robin.

    All n requests of a row get the time at which the row is served, and occupy the bus
    for row_us + n event_us.  An event of a pixel whose request is pending is lost.
    clock (3,): time at which the bus is free, row served last, requests waiting.
    waiting (H,), queue and pending (H, W): requests per row, their columns in the
    order of arrival, and 1 + polarity of each.  Returns (events read out, lost, events
    taken): it stops at the first event outside the sensor.
    """
    cdef Py_ssize_t n = events.shape[0], h = queue.shape[0], w = queue.shape[1]
    cdef Py_ssize_t i, k, _k, row, x, y, total, done = 0, lost = 0
    cdef double free, at
    if (waiting.shape[0] != h or pending.shape[0] != h or pending.shape[1] != w
            or clock.shape[0] != 3 or h < 1):
        raise ValueError("read_out: shapes do not fit")
    row = <Py_ssize_t>clock[1]
    total = <Py_ssize_t>clock[2]
    i = y = 0
    if not (0 <= row < h and 0 <= total <= h * w):
        raise ValueError("read_out: clock is not one of this bus")
    if out.shape[0] < n + total:
        raise ValueError("read_out: out must hold all requests")
    free = clock[0]
    with nogil:
        for i in range(n + 1):
            at = until_us
            if i < n:
                at = events[i].t
                x = events[i].x
                y = events[i].y
                if x >= w or y >= h or events[i].p > 1:
                    break
            while total > 0 and free < at:
                for _k in range(h):
                    row = row + 1 if row + 1 < h else 0
                    if waiting[row]:
                        break
                for k in range(waiting[row]):
                    x = queue[row, k]
                    out[done].t = <int64_t>floor(free + 0.5)
                    out[done].x = <uint16_t>x
                    out[done].y = <uint16_t>row
                    out[done].p = pending[row, x] - 1
                    pending[row, x] = 0
                    done += 1
                free += row_us + waiting[row] * event_us
                total -= waiting[row]
                waiting[row] = 0
            if i == n:
                break
            x = events[i].x
            if pending[y, x]:
                lost += 1
                continue
            if total == 0 and free < at:
                free = at
            pending[y, x] = 1 + events[i].p
            queue[y, waiting[y]] = <uint16_t>x
            waiting[y] += 1
            total += 1
    clock[0] = free
    clock[1] = row
    clock[2] = total
    return done, lost, i
