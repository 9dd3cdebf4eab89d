"""Checks of each event that a reader decodes.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._types cimport event_t

# Indices in the state that a reader keeps between calls.
cdef enum:
    FILLED = 0      # events taken into the output so far
    LAST = 1        # time of the last event, of those in the output or accepted
    OFFSET = 2      # added to each time of the file
    OUTSIDE = 3     # events dropped because they lie outside the sensor
    BACKWARD = 4    # events dropped because their time runs backward
    ORDERED = 5     # index in the output from which on time does not fall, or -1
    BEFORE = 6      # time of the last event before those in the output
    STATE = 7

cdef enum:
    SEGMENT_US = 1000000

# Times beyond this are damage; sums and differences of two stay in range.
cdef inline int64_t far_us() noexcept nogil:
    return <int64_t>1 << 61


cdef inline bint far(int64_t t) noexcept nogil:
    return t < -far_us() or t > far_us()


cdef inline bint put(event_t* out, int64_t t, int64_t x, int64_t y, int64_t p,
                     int64_t height, int64_t width, int64_t* state) noexcept nogil:
    """Append an event to those in out, or count it if it lies outside the sensor."""
    if x < 0 or x >= width or y < 0 or y >= height or p < 0 or p > 1:
        state[OUTSIDE] += 1
        return False
    if t < state[LAST]:
        state[ORDERED] = -1
    state[LAST] = t
    out += state[FILLED]
    out[0].t = t
    out[0].x = <unsigned short>x
    out[0].y = <unsigned short>y
    out[0].p = <unsigned char>p
    state[FILLED] += 1
    return True
