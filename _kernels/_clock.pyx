"""Put the samples of one stream in time order, on the evidence of those around."""
from libc.stdint cimport int64_t, uint8_t
from libc.string cimport memcpy

from _kernels._check cimport (
    BACKWARD, BEFORE, LAST, OFFSET, ORDERED, SEGMENT_US, STATE, far_us)
from _kernels._types cimport event_t

cdef enum:
    REACH = 8           # samples that decide, on each side
    EQUAL = 64          # events that may share one damaged word of time
    LONE = 3            # samples ahead of all others that are dropped at a segment

cdef int64_t LONELY_US = 3600000000


cdef inline int64_t moved(int64_t t, int64_t offset) noexcept nogil:
    """Return a time of the file plus the offset; a damaged one may be anything."""
    return min(max(t, -far_us()), far_us()) + offset


cdef inline Py_ssize_t ahead(const event_t* s, Py_ssize_t w, Py_ssize_t i,
                             Py_ssize_t m, int64_t behind, int64_t offset,
                             int64_t floor) noexcept nogil:
    """Return how many of the w samples before a fall at i are ahead of all others.

    Whatever is dropped, the fewest values are: those at the end of the w, or `behind`
    of the m from i on.  Of a pair that is interchanged, it is the first.
    """
    cdef int64_t best = behind, cost, values = 0, before
    cdef Py_ssize_t k = w, j, most = 0
    while k > 0 and values < REACH and w - k < EQUAL:
        before = s[k - 1].t
        while k > 0 and w - k < EQUAL and s[k - 1].t == before:
            k -= 1
        values += 1
        before = s[k - 1].t if k else floor
        cost = values
        for j in range(m):
            cost += moved(s[i + j].t, offset) < before
        if cost < best or cost == best == 1:
            best, most = cost, w - k
    return most


cdef inline bint segment(const event_t* s, Py_ssize_t i, Py_ssize_t m, int64_t behind,
                         int64_t last, int64_t offset) noexcept nogil:
    """Tell whether a segment begins at i: most that follow are behind, as far as it."""
    cdef int64_t[REACH] t
    cdef int64_t one, n = 0
    cdef Py_ssize_t j, k
    if behind < 2 or 2 * behind <= m or last - moved(s[i].t, offset) <= SEGMENT_US:
        return False
    for j in range(m):
        one = moved(s[i + j].t, offset)
        if one < last:
            k = n
            while k > 0 and t[k - 1] > one:
                t[k] = t[k - 1]
                k -= 1
            t[k] = one
            n += 1
    one = moved(s[i].t, offset) - t[n // 2]
    one = (one if one > 0 else -one) - SEGMENT_US
    # At most four times the spread, which may not fit 64 bits.
    return one <= 0 or (one + 3) // 4 <= t[3 * n // 4] - t[n // 4]


def settle(event_t[::1] samples not None, Py_ssize_t accepted, Py_ssize_t n, int reach,
           int held, bint final, object move, int64_t[::1] state not None):
    """Accept samples in time order; return how many are accepted, left and certain.

    The first of samples are accepted, the next up to n have times of the file.  Those
    that are accepted are moved by the offset in state and follow one another; of those
    that are left, the last `reach` (1 to 8) wait for what follows, unless final.  A
    sample is dropped if fewer agree with it than with its neighbours.  move(fall) is
    called for a new segment, where time falls by more than a second and most of the
    next samples agree; it returns what is added to their times.  With None they are
    dropped.  Of those that are accepted all but the last `held` are certain.
    """
    cdef Py_ssize_t w = accepted, i = accepted, until = n if final else n - reach
    cdef Py_ssize_t m, j, gone
    cdef int64_t offset, last, behind, floor, t, added
    cdef int64_t most = far_us(), earliest = -(<int64_t>1 << 55)
    cdef Py_ssize_t ordered = n if state[ORDERED] < 0 else state[ORDERED]
    cdef bint jumps = move is not None
    cdef event_t* s
    if state.shape[0] != STATE or accepted < 0 or n < accepted or (
            n > samples.shape[0] or not 1 <= reach <= REACH):
        raise ValueError("settle: samples or state is wrong")
    if not n:
        return 0, 0, 0
    s, floor, offset = &samples[0], state[BEFORE], state[OFFSET]
    last = s[w - 1].t if w else floor
    with nogil:
        while i < until:
            if w == i:
                while i < until and earliest <= s[i].t <= most - offset and (
                        last <= s[i].t + offset):
                    if i == ordered and not offset and s[n - 1].t <= most:
                        i = until       # as the kernel that decoded them has seen
                        last = s[i - 1].t
                        break
                    s[i].t += offset
                    last = s[i].t
                    i += 1
                w = i
                if i == until:
                    break
            t = moved(s[i].t, offset)
            if not (earliest <= s[i].t <= most and earliest <= t <= most):
                state[BACKWARD] += 1
                i += 1
                continue
            if t >= last:
                s[w] = s[i]
                s[w].t = last = t
                w += 1
                i += 1
                continue
            m = min(reach, n - i)
            behind = 0
            for j in range(m):
                behind += moved(s[i + j].t, offset) < last
            gone = ahead(s, w, i, m, behind, offset, floor)
            if not gone and jumps and segment(s, i, m, behind, last, offset):
                for j in range(min(LONE, w - 1)):
                    if s[w - 1 - j].t - s[w - 2 - j].t > LONELY_US:
                        gone = j + 1
                w -= gone
                last = s[w - 1].t if w else floor
                with gil:
                    added = move(last - t)
                added = min(offset + added, 2 * far_us())
                if added == offset and not gone:    # no further
                    gone += 1
                    i += 1
                offset = added
            elif not gone:
                gone = 1
                i += 1
            else:
                w -= gone
                last = s[w - 1].t if w else floor
            state[BACKWARD] += gone
        if final and w > LONE and s[w - 1].t - s[w - 2].t > LONELY_US:
            state[BACKWARD] += 1
            w -= 1
        if w < i:
            for j in range(n - i):
                s[w + j] = s[i + j]
    state[OFFSET], state[LAST] = offset, s[w - 1].t if w else floor
    m = w if final else max(w - held, 0)
    if m and floor == -far_us() and w > LONE and s[1].t - s[0].t > LONELY_US:
        state[BACKWARD] += 1        # the first is alone before all others
        state[BEFORE] = s[0].t
        w, m = w - 1, m - 1
        for j in range(w + n - i):
            s[j] = s[j + 1]
    if m:
        state[BEFORE] = s[m - 1].t
    return w, w + n - i, m


def cells(const uint8_t[::1] samples not None, Py_ssize_t size, int64_t width):
    """Return where in samples each interval of time begins, and their first times.

    Each of the samples, in time order, takes `size` bytes and begins with its time.
    Intervals begin at multiples of `width`.
    """
    cdef Py_ssize_t n, low = 0, high, middle
    cdef int64_t t, end
    if size < 8 or samples.shape[0] % size or width < 1:
        raise ValueError("cells: samples do not hold whole records")
    n = samples.shape[0] // size
    starts, times = [], []
    while low < n:
        memcpy(&t, &samples[low * size], 8)
        starts.append(low)
        times.append(t)
        end = t     # of a time that is damaged: alone
        if -far_us() <= t <= far_us():
            end += width - (t % width + width) % width
        low, high = low + 1, n
        while low < high:
            middle = low + (high - low) // 2
            memcpy(&t, &samples[middle * size], 8)
            if t < end:
                low = middle + 1
            else:
                high = middle
    return starts, times
