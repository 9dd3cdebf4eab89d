"""Checks of each event that a reader decodes.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._types cimport event_t

# Indices in the state that a reader keeps between calls.
cdef enum:
    FILLED = 0      # events taken into the output so far
    LAST = 1        # time of the last event taken
    OFFSET = 2      # added to each time of the file
    OUTSIDE = 3     # events dropped because they lie outside the sensor
    BACKWARD = 4    # events dropped because their time runs backward
    FIRST_BAD = 5   # index of the first event dropped in this call, or -1
    BEFORE = 6      # time of the last event before the first of the output
    STATE = 7

cdef enum:
    TAKEN = 0
    DROPPED = 1
    JUMP = 2        # time falls by more than a second: the caller decides

cdef enum:
    SEGMENT_US = 1000000

# Times beyond this are damage; sums and differences of two stay in range.
cdef inline bint far(int64_t t) noexcept nogil:
    return t < -(<int64_t>1 << 61) or t > (<int64_t>1 << 61)


cdef inline int take(event_t* out, Py_ssize_t i, int64_t t, int64_t following,
                     int64_t x, int64_t y, int64_t p, int64_t height, int64_t width,
                     int64_t* state) noexcept nogil:
    """Append one event, drop it, or report that time jumped back before it.

    following is the time of the next event.  An event later than both its neighbours is
    damaged and is dropped; otherwise all later events would seem to run backward.  So
    is one earlier than both: time jumps back only if the next event agrees.
    """
    cdef int64_t last = state[LAST]
    if (x < 0 or x >= width or y < 0 or y >= height or p < 0 or p > 1 or far(t)):
        state[OUTSIDE] += 1
        if state[FIRST_BAD] < 0:
            state[FIRST_BAD] = i
        return DROPPED
    if t < last:
        if last - t > SEGMENT_US and following < last:
            return JUMP
        state[BACKWARD] += 1
        if state[FIRST_BAD] < 0:
            state[FIRST_BAD] = i
        return DROPPED
    if t > following and following >= last:
        state[BACKWARD] += 1
        if state[FIRST_BAD] < 0:
            state[FIRST_BAD] = i
        return DROPPED
    out[0].t = t
    out[0].x = <unsigned short>x
    out[0].y = <unsigned short>y
    out[0].p = <unsigned char>p
    state[LAST] = t
    state[FILLED] += 1
    return TAKEN


cdef inline int add(event_t* out, Py_ssize_t i, int64_t t, int64_t x, int64_t y,
                    int64_t p, int64_t height, int64_t width, Py_ssize_t group,
                    int64_t* state) noexcept nogil:
    """Append one event behind those in out, drop it, or report a jump before it.

    As take, for formats in which it is expensive to read the next event first: if this
    one is earlier than the last, but not than the one before, the last was damaged and
    is removed, with up to `group` events that share its damaged word of time.
    """
    cdef Py_ssize_t n = state[FILLED], k = n
    cdef int64_t last = state[LAST], before
    if t < last and not far(t) and 0 <= x < width and 0 <= y < height and 0 <= p <= 1:
        while k > 0 and n - k < group and out[k - 1].t == last:
            k -= 1
        before = out[k - 1].t if k else state[BEFORE]
        if k < n and before <= t:
            state[BACKWARD] += n - k
            if state[FIRST_BAD] < 0:
                state[FIRST_BAD] = i
            state[FILLED], state[LAST] = k, before
    return take(out + state[FILLED], i, t, t, x, y, p, height, width, state)
