"""Store of recent events, linked by pixel (see _tracks.pxd)."""
from libc.stdint cimport int32_t, int64_t

from _kernels._tracks cimport track_t
from _kernels._types cimport event_t


def track_push(const event_t[::1] events not None, int64_t last, Py_ssize_t at,
               event_t[::1] store not None, int32_t[::1] link not None,
               track_t[:, ::1] tracks not None):
    """Append events to store from index at; return how many were taken.

    Stops at the first event outside tracks, or before its predecessor (the first:
    before last).
    """
    cdef Py_ssize_t n = events.shape[0], h = tracks.shape[0], w = tracks.shape[1]
    cdef Py_ssize_t i, k, y, x
    cdef track_t* track
    if at < 0 or at + n > store.shape[0] or link.shape[0] != store.shape[0]:
        raise ValueError("track_push: store and link must have room for the events")
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            if y >= h or x >= w or events[i].p > 1 or events[i].t < last:
                break
            last = events[i].t
            k = at + i
            store[k] = events[i]
            link[k] = -1
            track = &tracks[y, x]
            if track.tail >= 0 and track.tail < k:
                link[track.tail] = <int32_t>k
            if track.next < 0:
                track.next = <int32_t>k
            if track.first < 0:
                track.first = <int32_t>k
            track.tail = <int32_t>k
        else:
            i = n
    return i


def track_commit(const event_t[::1] store not None, const int32_t[::1] link not None,
                 Py_ssize_t at, Py_ssize_t stop, int64_t until,
                 track_t[:, ::1] tracks not None):
    """Commit stored events from index at on, t <= until; return the first one left."""
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    cdef track_t* track
    if at < 0 or stop > store.shape[0] or link.shape[0] != store.shape[0]:
        raise ValueError("track_commit: indices must lie in store and link")
    with nogil:
        i = at
        while i < stop and store[i].t <= until:
            y = store[i].y
            x = store[i].x
            if y >= h or x >= w:
                break
            track = &tracks[y, x]
            track.next = link[i]
            track.t_prev = track.t_last
            track.p_prev = track.p_last
            track.t_last = store[i].t
            track.p_last = store[i].p
            if store[i].p:
                track.n_on += 1
            else:
                track.n_off += 1
            i += 1
    return i


def track_drop(const event_t[::1] store not None, int32_t[::1] link not None,
               Py_ssize_t drop, Py_ssize_t stop, track_t[:, ::1] tracks not None):
    """Forget the first drop events; indices then count from the first one left.

    The caller moves the store's and link's items [drop, stop) to the front.
    """
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    cdef int32_t by = <int32_t>drop
    cdef track_t* track
    if drop < 0 or drop > stop or stop > store.shape[0]:
        raise ValueError("track_drop: indices must lie in store")
    if link.shape[0] != store.shape[0]:
        raise ValueError("track_drop: link must be as long as store")
    with nogil:
        for i in range(drop):
            y = store[i].y
            x = store[i].x
            if y < h and x < w:
                track = &tracks[y, x]
                track.first = link[i]
                track.t_old = store[i].t
                track.p_old = store[i].p
        for i in range(drop, stop):
            if link[i] >= 0:
                link[i] -= by
        for y in range(h):
            for x in range(w):
                track = &tracks[y, x]
                track.first = track.first - by if track.first >= by else -1
                track.next = track.next - by if track.next >= by else -1
                track.tail = track.tail - by if track.tail >= by else -1
