"""Events in foreign formats: Prophesee's EVT2 and EVT3, Event Stream, ROS, columns.

Facts: the formats as Prophesee documents them, the specification of Event Stream.
State of time and checks of events are as in _check.pxd.
"""
from libc.stdint cimport int32_t, int64_t, uint8_t, uint16_t, uint32_t
from libc.string cimport memcpy

from _kernels._check cimport FILLED, LAST, ORDERED, STATE, put
from _kernels._types cimport event_t

# Indices in the state of a stream of words.
cdef enum:
    HIGH = 0        # last word of the upper bits of time, -1 before the first
    TIME = 1        # in us, upper and lower bits
    LOOPS = 2       # added for overflows of the upper bits, us
    ROW = 3
    COLUMN = 4      # where the next vector of EVT3 begins
    POLARITY = 5
    UNTIMED = 6     # words skipped: no time came before, of no kind, or damaged
    TRIGGERS = 7    # external triggers found in this call
    WORD_STATE = 8

cdef enum:
    NEAR = 4096     # words that are searched for the next upper bits of time
    HIGHS = 3       # number of these that are compared: one may be damaged too
    FEW = 8         # events guessed right that save less than a wrong guess costs
    RARELY = 512    # most events until the next guess


ctypedef fused word_t:
    uint16_t
    uint32_t


cdef inline bint trigger(int64_t t, int64_t value, int64_t[:, ::1] out,
                         int64_t* stream) noexcept nogil:
    """Append an external trigger; return False if there is no room."""
    cdef int64_t n = stream[TRIGGERS]
    if n >= out.shape[0]:
        return False
    if stream[HIGH] >= 0:
        out[n, 0], out[n, 1] = t, value
        stream[TRIGGERS] = n + 1
    else:
        stream[UNTIMED] += 1
    return True


cdef inline Py_ssize_t after_wrong_time(const word_t* words, Py_ssize_t i, Py_ssize_t n,
                                        int64_t before) noexcept nogil:
    """Return the index of the next upper bits of time if those at i are damaged, or 0.

    They are if they fall, or rise by more than 1, and most of the next ones continue
    from those before.
    """
    cdef int shift = 12 if word_t is uint16_t else 28
    cdef word_t mask = (<word_t>1 << shift) - 1
    cdef int64_t high = words[i] & mask, following
    cdef Py_ssize_t k, first = 0
    cdef int seen = 0, going_on = 0
    if before < 0 or before <= high <= before + 1:
        return 0
    for k in range(i + 1, min(n, i + NEAR)):
        if words[k] >> shift == 8:
            following = words[k] & mask
            seen += 1
            if before <= following and (following < high or high < before):
                going_on += 1
                if not first:
                    first = k
            if seen == HIGHS:
                break
    return first if 2 * going_on > seen else 0


def evt2_words(const uint32_t[::1] words not None, Py_ssize_t begin,
               Py_ssize_t height, Py_ssize_t width, int64_t[::1] stream not None,
               int64_t[::1] state not None, int64_t[:, ::1] triggers not None,
               event_t[::1] out not None):
    """Decode EVT2 words from begin on while out has room; return how far.

    stream and state are kept from call to call.  External triggers are written to the
    first stream[7] rows of triggers: time, and twice the channel, plus 1 for a rising
    edge; decoding also ends where these are full.
    """
    cdef Py_ssize_t i = begin, n = words.shape[0], room = out.shape[0], after
    cdef uint32_t word, kind
    cdef int64_t high, t
    cdef int64_t* s
    if stream.shape[0] != WORD_STATE or state.shape[0] != STATE or (
            triggers.shape[0] < 1 or triggers.shape[1] != 2):
        raise ValueError("evt2_words: a state has the wrong length")
    if begin < 0 or begin > n or state[FILLED] < 0 or state[FILLED] > room:
        raise ValueError("evt2_words: begin or state lies outside an array")
    s = &state[0]
    stream[TRIGGERS] = 0
    with nogil:
        while i < n and s[FILLED] < room:
            word = words[i]
            kind = word >> 28
            if kind == 8:
                after = after_wrong_time(&words[0], i, n, stream[HIGH])
                if after:
                    stream[UNTIMED] += 1
                    for i in range(i + 1, after):
                        stream[UNTIMED] += words[i] >> 28 <= 1
                    i = after
                    continue
                high = word & 0xFFFFFFF
                if stream[HIGH] - high > 1 << 27:
                    stream[LOOPS] += <int64_t>1 << 34
                stream[HIGH] = high
            elif kind <= 1:
                if stream[HIGH] < 0:
                    stream[UNTIMED] += 1
                else:
                    t = stream[LOOPS] + (stream[HIGH] << 6 | (word >> 22 & 0x3F))
                    stream[TIME] = t
                    put(&out[0], t, word >> 11 & 0x7FF, word & 0x7FF, kind, height,
                        width, s)
            elif kind == 10:
                t = stream[LOOPS] + (max(stream[HIGH], 0) << 6 | (word >> 22 & 0x3F))
                if not trigger(t, word >> 7 & 0x3E | word & 1, triggers, &stream[0]):
                    break
            elif kind < 14:     # no kind at all
                stream[UNTIMED] += 1
            i += 1
    return i


cdef inline Py_ssize_t single_events(
        const uint16_t* words, Py_ssize_t i, Py_ssize_t n, int64_t height,
        int64_t width, int64_t* at, int64_t* s, Py_ssize_t* wait, Py_ssize_t room,
        event_t* out) noexcept nogil:
    """Decode what usually is there: a time or none, a row or none, and an event.

    Returns the index of the first word that is not, below n, such as a row outside.
    Where events are dense, which of them there are cannot be predicted, so they are
    selected by masks, without branches; both are told from the same two words, as
    others would have to be waited for.  Where events are sparse, all are there, which
    is guessed again `wait` events after it was wrong.
    """
    cdef int64_t high = at[LOOPS] + (at[HIGH] << 12), time = at[TIME], row = at[ROW]
    cdef int64_t x, timed, rowed, last = s[LAST]
    cdef bint fall = False
    cdef Py_ssize_t k = s[FILLED], guess = k + wait[0]
    while i + 3 < n and k <= room:
        if k >= guess and (words[i] >> 12 == 6) & ((words[i + 1] & 0xF7FF) < height):
            time, row = high + (words[i] & 0xFFF), words[i + 1] & 0x7FF
            i += 2
        else:
            if k >= guess:
                wait[0] = 1 if k - guess >= FEW else min(2 * wait[0], RARELY)
                guess = k + wait[0]
            timed = words[i] >> 12 == 6
            rowed = ((words[i] & 0xF7FF) < height) | (
                (words[i + 1] & 0xF7FF) < height) & timed
            time += (high + (words[i] & 0xFFF) - time) & -timed
            row += ((words[i + timed] & 0x7FF) - row) & -rowed
            i += timed + rowed
        x = words[i] & 0x7FF
        if (words[i] >> 12 != 2) | (x >= width) | (row >= height):
            break
        fall |= time < last
        out[k].t = last = time
        out[k].x = <uint16_t>x
        out[k].y = <uint16_t>row
        out[k].p = words[i] >> 11 & 1
        k += 1
        i += 1
    at[TIME], at[ROW], s[LAST], s[FILLED] = time, row, last, k
    if fall:
        s[ORDERED] = -1
    return i


cdef inline bint is_in(uint16_t word, int kinds) noexcept nogil:
    """Return whether the kind of a word of EVT3 is one of those, a bit each."""
    return kinds >> (word >> 12) & 1


def evt3_words(const uint16_t[::1] words not None, Py_ssize_t begin,
               Py_ssize_t height, Py_ssize_t width, int64_t[::1] stream not None,
               int64_t[::1] state not None, int64_t[:, ::1] triggers not None,
               event_t[::1] out not None):
    """Decode EVT3 words while out has room for 12 events; return how far.

    As `evt2_words`.
    """
    cdef Py_ssize_t i = begin, n = words.shape[0], room = out.shape[0] - 12, after
    cdef Py_ssize_t wait = 1
    cdef uint32_t word, kind, bits
    cdef int64_t high, x, p
    cdef int count, k
    cdef int64_t[STATE] s
    cdef int64_t[WORD_STATE] at
    if stream.shape[0] != WORD_STATE or state.shape[0] != STATE or (
            triggers.shape[0] < 1 or triggers.shape[1] != 2):
        raise ValueError("evt3_words: a state has the wrong length")
    if begin < 0 or begin > n or state[FILLED] < 0:
        raise ValueError("evt3_words: begin or state lies outside an array")
    for k in range(STATE):     # local, so that writing events cannot change them
        s[k] = state[k]
    for k in range(WORD_STATE):
        at[k] = stream[k]
    at[TRIGGERS] = 0
    height = min(height, 0x800)     # rows are below
    with nogil:
        while i < n and s[FILLED] <= room:
            if at[HIGH] >= 0:
                i = single_events(
                    &words[0], i, n, height, width, at, s, &wait, room, &out[0])
                if s[FILLED] > room:
                    break
            word = words[i]
            kind = word >> 12
            if kind == 2 or kind == 4 or kind == 5:
                if kind == 2:
                    bits, count, x, p = 1, 0, word & 0x7FF, word >> 11 & 1
                else:
                    bits = word & (0xFFF if kind == 4 else 0xFF)
                    count, x, p = (12 if kind == 4 else 8), at[COLUMN], at[POLARITY]
                if at[HIGH] < 0:
                    at[UNTIMED] += 1
                    bits = 0
                while bits:
                    if bits & 1:
                        put(&out[0], at[TIME], x, at[ROW], p, height, width, s)
                    bits >>= 1
                    x += 1
                at[COLUMN] += count
            elif kind == 6:
                if at[HIGH] >= 0:
                    at[TIME] = at[LOOPS] + (at[HIGH] << 12 | (word & 0xFFF))
            elif kind == 0:
                at[ROW] = word & 0x7FF
                if at[ROW] >= height:   # without an event, which would say it
                    at[UNTIMED] += i + 1 < n and is_in(words[i + 1], 0b10101000001)
            elif kind == 8:
                after = after_wrong_time(&words[0], i, n, at[HIGH])
                if after:
                    at[UNTIMED] += 1
                    for i in range(i + 1, after):
                        kind = words[i] >> 12
                        at[UNTIMED] += kind == 2 or kind == 4 or kind == 5
                    i = after
                    continue
                high = word & 0xFFF
                if at[HIGH] - high > 1 << 11:
                    at[LOOPS] += 1 << 24
                if high != at[HIGH]:
                    at[HIGH] = high
                    at[TIME] = at[LOOPS] + (high << 12)
            elif kind == 3:
                at[COLUMN] = word & 0x7FF
                at[POLARITY] = word >> 11 & 1
                # A base that no vector follows, which would change nothing.
                at[UNTIMED] += i + 1 < n and is_in(words[i + 1], 0b1001101)
            elif kind == 10:
                if not trigger(at[TIME], word >> 7 & 0x1E | word & 1, triggers, at):
                    break
            elif kind == 7 or kind == 15:   # continue others, not events
                at[UNTIMED] += i > 0 and is_in(words[i - 1], 0b1111101)
            elif kind < 14:     # no kind at all
                at[UNTIMED] += 1
            i += 1
    for k in range(STATE):
        state[k] = s[k]
    for k in range(WORD_STATE):
        stream[k] = at[k]
    return i


def stream_events(const uint8_t[::1] data not None, bint atis, Py_ssize_t height,
                  Py_ssize_t width, int64_t[::1] time not None,
                  int64_t[::1] state not None, event_t[::1] out not None):
    """Decode whole events of an Event Stream while out has room; return how far.

    An event is 5 bytes: time since the last one and polarity, x, y from the bottom.
    Bytes before it prolong this time.  time, of length 1, is kept from call to call.
    Events of ATIS that measure exposure are skipped.
    """
    cdef Py_ssize_t i = 0, n = data.shape[0], room = out.shape[0]
    cdef int64_t t
    cdef int head, x, y
    if time.shape[0] != 1 or state.shape[0] != STATE or (
            state[FILLED] < 0 or state[FILLED] > room):
        raise ValueError("stream_events: time or state is wrong")
    t = time[0]
    with nogil:
        while i < n and state[FILLED] < room:
            head = data[i]
            if atis and head >= 0xFC:
                t += 63 * (head & 3)
                i += 1
            elif not atis and head >= 0xFE:
                t += 127 * (head & 1)       # 0xFE marks a reset
                i += 1
            elif i + 5 > n:
                break
            else:
                t += head >> (2 if atis else 1)
                if not (atis and head & 1):
                    x = data[i + 1] | data[i + 2] << 8
                    y = data[i + 3] | data[i + 4] << 8
                    put(&out[0], t, x, height - 1 - y, head >> atis & 1, height, width,
                        &state[0])
                i += 5
    time[0] = t
    return i


# ---- numbers ---------------------------------------------------------------------


def event_columns(const int64_t[::1] t not None, const int32_t[::1] x not None,
                  const int32_t[::1] y not None, const int32_t[::1] p not None,
                  Py_ssize_t height, Py_ssize_t width, int64_t[::1] state not None,
                  event_t[::1] out not None):
    """Append the events of columns to out; t in us, a negative p is OFF."""
    cdef Py_ssize_t i, n = t.shape[0]
    if x.shape[0] != n or y.shape[0] != n or p.shape[0] != n or state.shape[0] != STATE:
        raise ValueError("event_columns: an array has the wrong shape")
    if state[FILLED] < 0 or state[FILLED] > out.shape[0] - n:
        raise ValueError("event_columns: out is too small")
    with nogil:
        for i in range(n):
            put(&out[0], t[i], x[i], y[i], max(p[i], 0), height, width, &state[0])


# Places of an event's numbers in a message of ROS, bytes from its first.
cdef enum:
    ROS_X, ROS_Y, ROS_S, ROS_NS, ROS_P, ROS_PLACES


cdef inline int64_t ros_time(const uint8_t* seconds_at, const uint8_t* nano_at
                             ) noexcept nogil:
    cdef int32_t seconds
    cdef uint32_t nano
    memcpy(&seconds, seconds_at, 4)
    memcpy(&nano, nano_at, 4)
    return <int64_t>seconds * 1000000 + nano // 1000


def ros_events(const uint8_t[::1] data not None, Py_ssize_t start, Py_ssize_t stride,
               Py_ssize_t count, const int64_t[::1] places not None, Py_ssize_t shift,
               Py_ssize_t height, Py_ssize_t width, int64_t[::1] state not None,
               event_t[::1] out not None):
    """Append the events of a message to out.

    The first of count events is at byte start, the next stride bytes on; places are
    those of x, y (uint16), seconds (int32), nanoseconds (uint32) and polarity (uint8).
    x and y of the first lie shift bytes further on: CDR aligns nothing but times.
    """
    cdef Py_ssize_t i, last = 0, further
    cdef const uint8_t* row
    cdef uint16_t x, y
    cdef int k
    if places.shape[0] != ROS_PLACES or state.shape[0] != STATE:
        raise ValueError("ros_events: places or state is wrong")
    for k in range(ROS_PLACES):
        if places[k] < 0 or places[k] > stride or shift < 0 or shift > stride:
            raise ValueError("ros_events: places must lie within an event")
        last = max(last, places[k] + (4 if k == ROS_S or k == ROS_NS else (
            1 if k == ROS_P else 2 + shift)))
    if stride < 1 or start < 0 or count < 0 or (
            count > 0 and ((count - 1) > (data.shape[0] - start) // stride
                           or start + (count - 1) * stride + last > data.shape[0])):
        raise ValueError("ros_events: events lie outside the data")
    if state[FILLED] < 0 or state[FILLED] > out.shape[0] - count:
        raise ValueError("ros_events: out is too small")
    with nogil:
        for i in range(count):
            row = &data[start + i * stride]
            further = shift if i == 0 else 0
            memcpy(&x, row + places[ROS_X] + further, 2)
            memcpy(&y, row + places[ROS_Y] + further, 2)
            put(&out[0], ros_time(row + places[ROS_S], row + places[ROS_NS]), x, y,
                row[places[ROS_P]], height, width, &state[0])
