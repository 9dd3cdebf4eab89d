"""Store of recent events, and what each pixel remembers of them (see _tracks.pxd)."""
from libc.stdint cimport int32_t, int64_t

from _kernels._tracks cimport track_t
from _kernels._types cimport event_t


def store_push(const event_t[::1] events not None, int64_t last, Py_ssize_t h,
               Py_ssize_t w, Py_ssize_t at, event_t[::1] store not None):
    """Copy events to store from index at; return how many were taken.

    Stops at the first event outside h x w, or before its predecessor (the first:
    before last).
    """
    cdef Py_ssize_t n = events.shape[0], i
    if at < 0 or at + n > store.shape[0]:
        raise ValueError("store_push: store must have room for the events")
    with nogil:
        for i in range(n):
            if (events[i].y >= h or events[i].x >= w or events[i].p > 1
                    or events[i].t < last):
                break
            last = events[i].t
            store[at + i] = events[i]
        else:
            i = n
    return i


def store_commit(const event_t[::1] store not None, Py_ssize_t at, Py_ssize_t stop,
                 int64_t until, track_t[:, ::1] tracks not None):
    """Count stored events from index at on, t <= until; return the first one left."""
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    cdef track_t* track
    if at < 0 or stop > store.shape[0]:
        raise ValueError("store_commit: indices must lie in store")
    with nogil:
        i = at
        while i < stop and store[i].t <= until:
            y = store[i].y
            x = store[i].x
            if y >= h or x >= w:
                break
            track = &tracks[y, x]
            track.prev = track.last
            track.last = 2 * store[i].t + store[i].p
            # No branch on the polarity: it cannot be predicted.
            track.n_on += store[i].p
            track.n_off += 1 - store[i].p
            i += 1
    return i


def store_pass(const event_t[::1] store not None, Py_ssize_t at, Py_ssize_t stop,
               int64_t until, int64_t[:, :, ::1] stamps not None):
    """Note each pixel's last two stamps of stored events from index at on, t <= until.

    Returns the first one left.
    """
    cdef Py_ssize_t h = stamps.shape[0], w = stamps.shape[1], i, y, x
    if at < 0 or stop > store.shape[0]:
        raise ValueError("store_pass: indices must lie in store")
    if stamps.shape[2] != 2:
        raise ValueError("store_pass: stamps must be (h, w, 2)")
    with nogil:
        i = at
        while i < stop and store[i].t <= until:
            y = store[i].y
            x = store[i].x
            if y >= h or x >= w:
                break
            stamps[y, x, 0] = stamps[y, x, 1]
            stamps[y, x, 1] = 2 * store[i].t + store[i].p
            i += 1
    return i


def store_link(const event_t[::1] store not None, Py_ssize_t start, Py_ssize_t stop,
               int32_t[::1] link not None, int32_t[:, ::1] first not None):
    """Chain stored events [start, stop) by pixel.

    first is each pixel's first one, link[i] the next one after i; -1 for none.
    """
    cdef Py_ssize_t h = first.shape[0], w = first.shape[1], i, y, x
    if start < 0 or stop > store.shape[0] or link.shape[0] != store.shape[0]:
        raise ValueError("store_link: indices must lie in store and link")
    with nogil:
        for y in range(h):
            for x in range(w):
                first[y, x] = -1
        i = stop - 1
        while i >= start:
            y = store[i].y
            x = store[i].x
            if y < h and x < w:
                link[i] = first[y, x]
                first[y, x] = <int32_t>i
            i -= 1
