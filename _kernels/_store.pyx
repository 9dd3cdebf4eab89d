"""Store of recent events, and the summary of past ones of each pixel (`track_t`)."""
from libc.stdint cimport int32_t, int64_t, uint8_t

from _kernels._listing cimport CHANGED, LEFT_OUT, LISTED, NEW_STATE
from _kernels._model cimport stored_t, track_t
from _kernels._tracks cimport before, gap_since, loss_t, lost
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


cdef inline Py_ssize_t list_pixel(Py_ssize_t y, Py_ssize_t x, Py_ssize_t n,
                                  int32_t[::1] pixels,
                                  uint8_t[:, ::1] listed) noexcept nogil:
    """Append a pixel to a list of n, unless it is in it; return the list's length.

    A pixel that the reader leaves out is not appended.
    """
    cdef uint8_t flag = listed[y, x]
    if flag & LEFT_OUT:
        return n
    if not flag & LISTED and n < pixels.shape[0]:
        pixels[n] = <int32_t>(y * listed.shape[1] + x)
        n += 1
        flag = NEW_STATE
    listed[y, x] = LISTED | CHANGED | flag & NEW_STATE
    return n


def store_push(const event_t[::1] events not None, int64_t last, Py_ssize_t at,
               stored_t[::1] store not None, int32_t[::1] pixels not None,
               Py_ssize_t listed_before, uint8_t[:, ::1] listed not None):
    """Copy events to store from index at; return their number and the list's length.

    Stops at the first event that lies outside the image, or is earlier than the event
    before it (the first event: earlier than last).  The pixels of copied events are
    marked as changed, and are appended to pixels (row * width + column), which holds
    `listed_before` entries, unless their flag in listed says that they are in it (see
    _listing.pxd).
    """
    cdef Py_ssize_t n = events.shape[0], h = listed.shape[0], w = listed.shape[1]
    cdef Py_ssize_t i, m = listed_before, y, x
    if at < 0 or at + n > store.shape[0]:
        raise ValueError("store_push: store must have room for the events")
    if pixels.shape[0] != h * w or m < 0:
        raise ValueError("store_push: pixels must have room for the image")
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            if y >= h or x >= w or events[i].p > 1 or events[i].t < last:
                break
            last = events[i].t
            store[at + i].t = last
            store[at + i].x = events[i].x
            store[at + i].y = events[i].y
            store[at + i].p = events[i].p
            store[at + i].next = -1
            m = list_pixel(y, x, m, pixels, listed)
        else:
            i = n
    return i, m


def store_commit(const stored_t[::1] store not None, Py_ssize_t at, Py_ssize_t stop,
                 int64_t until, double refractory, track_t[:, ::1] tracks not None):
    """Count stored events from index at on with t <= until; return the first one left.

    The change of light during a refractory period (us), which no event shows, is added
    to the counts (`lost` in _tracks.pxd).
    """
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], i, y, x
    cdef track_t* track
    cdef loss_t loss
    cdef double on
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
            if refractory > 0.0:
                loss = lost(before(track), track.last >> 1, store[i].t, refractory)
                on = loss.before * (track.last & 1) + loss.after * store[i].p
                track.n_on += on
                track.n_off += loss.before + loss.after - on
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


def store_mark(const stored_t[::1] store not None, Py_ssize_t start, Py_ssize_t stop,
               int32_t[::1] pixels not None, Py_ssize_t listed_before,
               uint8_t[:, ::1] listed not None):
    """List the pixels of stored events [start, stop) as `store_push` does.

    Returns the list's length.
    """
    cdef Py_ssize_t h = listed.shape[0], w = listed.shape[1], i, y, x
    cdef Py_ssize_t m = listed_before
    if start < 0 or stop > store.shape[0]:
        raise ValueError("store_mark: indices must lie in store")
    if pixels.shape[0] != h * w or m < 0:
        raise ValueError("store_mark: pixels must have room for the image")
    with nogil:
        for i in range(start, stop):
            y = store[i].y
            x = store[i].x
            if y < h and x < w:
                m = list_pixel(y, x, m, pixels, listed)
    return m
