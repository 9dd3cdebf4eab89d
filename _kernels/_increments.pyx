"""Filter of log intensity: events with learned increments, joined with frames.

One pixel's log intensity, with the black level, at t is

    J(t) = L + y(t) - y(frame) + gains (parts(t) - parts(frame)) + lead(t)

where L is the estimate at a frame, y sums the changes that events stand for, and parts
are those of OFF and of ON events.  docs/theory/kalman.md has the equations.
"""
from libc.stdint cimport int32_t, int64_t

from _kernels._increments cimport (
    CHANGED, NEVER, PRIOR_ODDS, QUIET, RESTS, anchor_t, before_it, camera_of, camera_t,
    context_of, pixel_t, step_of, stored_t, weight)
from _kernels._types cimport event_t


def increments_push(const event_t[::1] events not None, int64_t last, int64_t first,
                    Py_ssize_t at, stored_t[::1] store not None,
                    pixel_t[:, ::1] pixels not None, const double[::1] camera not None,
                    int64_t[:, ::1] due not None, int32_t[::1] awake not None,
                    Py_ssize_t woken):
    """Append events to store from index `at`; return how many were taken, and the
    length of the list `awake` of pixels that are not quiet, which was `woken`.

    Stops at the first event off the sensor or out of order.  first is the time of the
    first of all events, us: the gap before a pixel's first event begins there.  due is
    as in `increments_move`.
    """
    cdef Py_ssize_t i, n = events.shape[0], h = pixels.shape[0], w = pixels.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef pixel_t* p
    cdef stored_t* e
    cdef int32_t index
    if at < 0 or at + n > store.shape[0] or due.shape[0] != h or due.shape[1] != w:
        raise ValueError("increments_push: store must have room for the events")
    with nogil:
        for i in range(n):
            if (events[i].y >= h or events[i].x >= w or events[i].p > 1
                    or events[i].t < last):
                break
            last = events[i].t
            p = &pixels[events[i].y, events[i].x]
            e = &store[at + i]
            index = <int32_t>(at + i)
            e.t = last
            e.sign = 1 if events[i].p else -1
            e.pixel = <int32_t>(events[i].y * w + events[i].x)
            e.next = -1
            e.prev = p.newest_index
            add(e, &p.newest, first, c)
            if p.newest_index >= 0:
                store[p.newest_index].next = index
            if p.next < 0:
                p.next = index
            wake(&due[events[i].y, events[i].x], e.pixel, awake, &woken)
            p.newest = e[0]
            p.newest_index = index
        else:
            i = n
    return i, woken


cdef inline void add(stored_t* e, const stored_t* old, int64_t first,
                     const camera_t* c) noexcept nogil:
    """Fill in what follows from the event before: gap, context and sums."""
    cdef bint same = old.run > 0 and old.sign == e.sign
    e.run = min(old.run + 1, 3) if same else 1
    e.run_before = old.run
    e.before = <float>(1e-6 * <double>(e.t - (old.t if old.run > 0 else first)))
    e.before2 = old.before
    e.context = context_of(e.run, e.before, e.before2)
    sum_up(e, old.light, old.count, c)


cdef inline void sum_up(stored_t* e, const double* light, const double* count,
                        const camera_t* c) noexcept nogil:
    """Add an event to the sums at the one before."""
    cdef int on = e.sign > 0
    cdef double passed = e.sign * weight(e, c)
    e.light[0], e.light[1] = light[0], light[1]
    e.count[0], e.count[1] = count[0], count[1]
    e.light[on] += passed * step_of(e.before, on, c)
    e.count[on] += passed


cdef inline void wake(int64_t* due, int32_t index, int32_t[::1] awake,
                      Py_ssize_t* n) noexcept nogil:
    """Let the planes of a pixel be out of date, and append it to those not quiet."""
    if due[0] == QUIET and n[0] < awake.shape[0]:
        awake[n[0]] = index
        n[0] += 1
    due[0] = CHANGED


def increments_commit(const stored_t[::1] store not None, Py_ssize_t at,
                      Py_ssize_t stop, int64_t until, pixel_t[:, ::1] pixels not None,
                      int64_t[:, ::1] due not None, int32_t[::1] awake not None,
                      Py_ssize_t woken):
    """Let stored events from index `at` on with t <= until be their pixels' last ones.

    Returns the index of the first one left, and the length of the list `awake`.
    """
    cdef Py_ssize_t i = at
    cdef pixel_t* all_ = &pixels[0, 0]
    cdef pixel_t* p
    if (at < 0 or stop > store.shape[0] or due.shape[0] != pixels.shape[0]
            or due.shape[1] != pixels.shape[1]):
        raise ValueError("increments_commit: no such events")
    with nogil:
        while i < stop and store[i].t <= until:
            p = all_ + store[i].pixel
            p.at = store[i]
            p.at_index = <int32_t>i
            p.next = store[i].next
            wake(&due[0, 0] + store[i].pixel, store[i].pixel, awake, &woken)
            i += 1
    return i, woken


def increments_rest(stored_t[::1] store not None, int64_t known, int64_t oldest,
                    pixel_t[:, ::1] pixels not None,
                    const anchor_t[:, ::1] anchors not None,
                    const double[::1] camera not None, int64_t[:, ::1] due not None,
                    int32_t[::1] awake not None, Py_ssize_t woken,
                    int32_t[::1] rested not None):
    """Let sums begin anew at events that are their pixels' last ones up to `known`, and
    after which light was still at `oldest` (us).

    Without a later event, and unless it is hot, such a pixel is quiet, as is one
    without any event: its nodes count as 0, with the silence since quiet_t.  rested
    receives the pixels of either kind.  Returns how many, and the length of the list
    `awake`.  As it goes by `known`, sums do not depend on packets.
    """
    cdef Py_ssize_t i, n = 0, left = 0, size = pixels.shape[0] * pixels.shape[1]
    cdef const camera_t* c = camera_of(camera)
    cdef const stored_t* last
    cdef stored_t* e
    cdef pixel_t* p
    cdef int32_t at, k
    cdef bint anew, quiet
    if (rested.shape[0] < woken or awake.shape[0] < woken
            or due.shape[0] != pixels.shape[0] or due.shape[1] != pixels.shape[1]
            or anchors.shape[0] != pixels.shape[0]
            or anchors.shape[1] != pixels.shape[1]):
        raise ValueError("increments_rest: all images must have one shape")
    oldest -= <int64_t>(1e6 * RESTS * c.rest)
    with nogil:
        for i in range(woken):
            if not 0 <= awake[i] < size:
                continue
            p = &pixels[0, 0] + awake[i]
            last, at, k = &p.at, p.at_index, p.next
            while k >= 0 and store[k].t <= known:
                last, at, k = &store[k], k, store[k].next
            anew = last.run > 0 and last.t < oldest and last.t != p.quiet_t
            if anew:
                p.quiet_t = last.t
                begin_anew(<stored_t*>last)
                if at >= 0:
                    begin_anew(&store[at])
                if k < 0:
                    begin_anew(&p.newest)
                while k >= 0:
                    e = &store[k]
                    sum_up(e, last.light, last.count, c)
                    last, k = e, e.next
                    p.newest = e[0]
            quiet = p.next < 0 and (&anchors[0, 0] + awake[i]).hot <= PRIOR_ODDS and (
                p.at.run == 0 or p.at.t == p.quiet_t)
            if anew or quiet:
                rested[n] = awake[i]
                n += 1
            if quiet:
                (&due[0, 0] + awake[i])[0] = QUIET
            else:
                awake[left] = awake[i]
                left += 1
    return n, left


cdef inline void begin_anew(stored_t* e) noexcept nogil:
    e.light[0] = e.light[1] = e.count[0] = e.count[1] = 0.0


def increments_drop(stored_t[::1] store not None, Py_ssize_t stop, Py_ssize_t by,
                    pixel_t[:, ::1] pixels not None):
    """Subtract from all indices, of `stop` events, how many were dropped before them.
    """
    cdef Py_ssize_t i
    cdef int32_t n = <int32_t>by
    cdef pixel_t* p = &pixels[0, 0]
    with nogil:
        for i in range(stop):
            store[i].prev = max(store[i].prev - n, -1)
            store[i].next = max(store[i].next - n, -1)
        for i in range(pixels.shape[0] * pixels.shape[1]):
            p[i].at.prev = max(p[i].at.prev - n, -1)
            p[i].at_index = max(p[i].at_index - n, -1)
            p[i].newest_index = max(p[i].newest_index - n, -1)
            p[i].next = max(p[i].next - n, -1)


def increments_weigh(stored_t[::1] store not None, Py_ssize_t stop, int64_t first,
                     pixel_t[:, ::1] pixels not None,
                     const double[::1] camera not None):
    """Compute the sums of all stored events again, by another camera.

    A pixel's sums at its first stored event stay as they are.  None is quiet that has
    had an event.
    """
    cdef Py_ssize_t i
    cdef const camera_t* c = camera_of(camera)
    cdef pixel_t* p = &pixels[0, 0]
    cdef stored_t* e
    with nogil:
        for i in range(stop):
            e = &store[i]
            if e.prev >= 0:
                sum_up(e, store[e.prev].light, store[e.prev].count, c)
        for i in range(pixels.shape[0] * pixels.shape[1]):
            if p[i].at_index >= 0:
                p[i].at = store[p[i].at_index]
            elif p[i].at.run > 0 and p[i].next >= 0:
                before_it(&store[p[i].next], c, p[i].at.light, p[i].at.count)
            if p[i].newest_index >= 0:
                p[i].newest = store[p[i].newest_index]
            p[i].quiet_t = NEVER
