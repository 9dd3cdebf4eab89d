"""Store of recent events, and the summary of past ones of each pixel (`track_t`)."""
from libc.stdint cimport int32_t, int64_t

from _kernels._model cimport stored_t, track_t
from _kernels._tracks cimport gap_since
from _kernels._types cimport event_t

cdef extern from "_prefetch.h" nogil:
    const Py_ssize_t AHEAD "PDAVIS_AHEAD"
    void prefetch "PDAVIS_PREFETCH"(const void*)


cdef inline void prefetch_track(const stored_t[::1] store, Py_ssize_t i,
                                track_t[:, ::1] tracks) noexcept nogil:
    """Prefetch the track of stored event i, if there is one."""
    if (0 <= i < store.shape[0] and store[i].y < tracks.shape[0]
            and store[i].x < tracks.shape[1]):
        prefetch(&tracks[store[i].y, store[i].x])


def store_push(const event_t[::1] events not None, int64_t last, Py_ssize_t at,
               stored_t[::1] store not None, Py_ssize_t h, Py_ssize_t w):
    """Copy events of an h x w sensor to store from index at on; return their number.

    Stops at the first event that lies outside the sensor, or is earlier than the event
    before it (the first event: earlier than last).
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
            store[at + i].t = last
            store[at + i].x = events[i].x
            store[at + i].y = events[i].y
            store[at + i].p = events[i].p
            store[at + i].next = -1
        else:
            i = n
    return i


def store_commit(const stored_t[::1] store not None, Py_ssize_t at, Py_ssize_t stop,
                 int64_t until, track_t[:, ::1] tracks not None):
    """Count stored events from index at with t <= until; return the first one left."""
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    cdef track_t* track
    if at < 0 or stop > store.shape[0]:
        raise ValueError("store_commit: indices must lie in store")
    with nogil:
        i = at
        while i < stop and store[i].t <= until:
            prefetch_track(store, i + AHEAD, tracks)
            y = store[i].y
            x = store[i].x
            if y >= h or x >= w:
                break
            track = &tracks[y, x]
            track.gap = gap_since(track.last, store[i].t)
            track.last = 2 * store[i].t + store[i].p
            # No branch on the polarity: it cannot be predicted.
            track.n_on += store[i].p
            track.n_off += 1 - store[i].p
            i += 1
    return i


def store_link(stored_t[::1] store not None, Py_ssize_t start, Py_ssize_t stop,
               track_t[:, ::1] tracks not None):
    """Link each pixel's stored events [start, stop), starting from `first` in tracks.

    Links that were made before must have been removed by `store_unlink`.
    """
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    if start < 0 or stop > store.shape[0]:
        raise ValueError("store_link: indices must lie in store")
    with nogil:
        i = stop - 1
        while i >= start:
            prefetch_track(store, i - AHEAD, tracks)
            y = store[i].y
            x = store[i].x
            if y < h and x < w:
                store[i].next = tracks[y, x].first
                tracks[y, x].first = <int32_t>i
            i -= 1


def store_unlink(const stored_t[::1] store not None, Py_ssize_t start, Py_ssize_t stop,
                 track_t[:, ::1] tracks not None):
    """Remove the links from tracks to stored events [start, stop)."""
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    if start < 0 or stop > store.shape[0]:
        raise ValueError("store_unlink: indices must lie in store")
    with nogil:
        for i in range(start, stop):
            prefetch_track(store, i + AHEAD, tracks)
            y = store[i].y
            x = store[i].x
            if y < h and x < w:
                tracks[y, x].first = -1
