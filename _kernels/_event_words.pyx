"""Words of event cameras' own streams: Prophesee's EVT2 and EVT3, and lines of text.

Facts: the formats as Prophesee documents them.  State of time and checks of events are
as in _check.pxd.
"""
from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t
from libc.string cimport memchr

from _kernels._check cimport (
    FILLED, FIRST_BAD, JUMP as FALLS, STATE, take)
from _kernels._types cimport event_t

# Places in the state of a stream of words.
cdef enum:
    HIGH = 0        # last word of the upper bits of time, -1 before the first
    TIME = 1        # in us, upper and lower bits
    LOOPS = 2       # added because the upper bits began anew
    ROW = 3
    COLUMN = 4      # where the next vector of EVT3 begins
    POLARITY = 5
    UNTIMED = 6     # events skipped because no time came before them
    WORD_STATE = 7

cdef enum:
    FULL = 0        # the words, or the room for events, are at their end
    JUMP = 1        # time falls by more than a second before this word


def evt2_words(const uint32_t[::1] words not None, Py_ssize_t begin,
               Py_ssize_t height, Py_ssize_t width, int64_t[::1] stream not None,
               int64_t[::1] state not None, event_t[::1] out not None):
    """Decode EVT2 words from begin on while out has room; return (how far, why).

    Why is 1 before a word whose time, stream[1], lies more than a second before the
    last.  stream and state go on from call to call.
    """
    cdef Py_ssize_t i = begin, n = words.shape[0], room = out.shape[0]
    cdef uint32_t word, kind
    cdef int64_t high, t
    cdef int why = FULL, took
    cdef int64_t* s
    if stream.shape[0] != WORD_STATE or state.shape[0] != STATE:
        raise ValueError("evt2_words: a state has the wrong length")
    if begin < 0 or begin > n or state[FILLED] < 0 or state[FILLED] > room:
        raise ValueError("evt2_words: begin or state lies outside an array")
    s = &state[0]
    s[FIRST_BAD] = -1
    with nogil:
        while i < n and s[FILLED] < room:
            word = words[i]
            kind = word >> 28
            if kind == 8:
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
                    t += s[2]
                    took = take(&out[s[FILLED]], i, t, t, word >> 11 & 0x7FF,
                                word & 0x7FF, kind, height, width, s)
                    if took == FALLS:
                        why = JUMP
                        break
            i += 1
    return i, why


cdef inline int put(event_t[::1] out, Py_ssize_t i, int64_t x, int64_t p,
                    int64_t* stream, Py_ssize_t height, Py_ssize_t width,
                    int64_t* s) noexcept nogil:
    """Take one event of the row and time that the stream is at."""
    cdef int64_t t = stream[TIME] + s[2]
    return take(&out[s[FILLED]], i, t, t, x, stream[ROW], p, height, width, s)


def evt3_words(const uint16_t[::1] words not None, Py_ssize_t begin,
               Py_ssize_t height, Py_ssize_t width, int64_t[::1] stream not None,
               int64_t[::1] state not None, event_t[::1] out not None):
    """Decode EVT3 words from begin on while out has room for 12; return (how far, why).

    As `evt2_words`.
    """
    cdef Py_ssize_t i = begin, n = words.shape[0], room = out.shape[0] - 12
    cdef uint32_t word, kind, bits
    cdef int64_t high, low, x, p
    cdef int why = FULL, count
    cdef int64_t* s
    cdef int64_t* at
    if stream.shape[0] != WORD_STATE or state.shape[0] != STATE:
        raise ValueError("evt3_words: a state has the wrong length")
    if begin < 0 or begin > n or state[FILLED] < 0:
        raise ValueError("evt3_words: begin or state lies outside an array")
    s, at = &state[0], &stream[0]
    s[FIRST_BAD] = -1
    with nogil:
        while i < n and s[FILLED] <= room:
            word = words[i]
            kind = word >> 12
            if kind == 0:
                at[ROW] = word & 0x7FF
            elif kind == 6:
                low = word & 0xFFF
                if at[HIGH] >= 0:
                    at[TIME] = at[LOOPS] + (at[HIGH] << 12 | low)
            elif kind == 8:
                high = word & 0xFFF
                if at[HIGH] - high > 1 << 11:
                    at[LOOPS] += 1 << 24
                if high != at[HIGH]:
                    at[HIGH] = high
                    at[TIME] = at[LOOPS] + (high << 12)
            elif kind == 2 or kind == 4 or kind == 5:
                if kind == 2:
                    bits, count, x, p = 1, 0, word & 0x7FF, word >> 11 & 1
                else:
                    bits = word & (0xFFF if kind == 4 else 0xFF)
                    count, x, p = (12 if kind == 4 else 8), at[COLUMN], at[POLARITY]
                if at[HIGH] < 0:
                    at[UNTIMED] += 1
                    bits = 0
                while bits:
                    if bits & 1 and put(
                            out, i, x, p, at, height, width, s) == FALLS:
                        why = JUMP     # before the first event of this word
                        break
                    bits >>= 1
                    x += 1
                if why == JUMP:
                    break
                at[COLUMN] += count
            elif kind == 3:
                at[COLUMN] = word & 0x7FF
                at[POLARITY] = word >> 11 & 1
            i += 1
    return i, why


cdef inline Py_ssize_t number(const uint8_t* data, Py_ssize_t i, int64_t* whole,
                              int64_t* nano) noexcept nogil:
    """Read a decimal number before a line's end; return the place after it, or -1.

    The newline is no digit, so no other bound is needed.  nano is the fraction in
    units of 1e-9, further digits are left out.
    """
    cdef bint negative = data[i] == c'-'
    cdef int64_t value = 0, fraction = 0
    cdef Py_ssize_t begin, digits, _
    if negative or data[i] == c'+':
        i += 1
    begin = i
    while <uint8_t>(data[i] - c'0') <= 9:
        value = 10 * value + <uint8_t>(data[i] - c'0')
        i += 1
        if i - begin > 19 or (i - begin == 19 and data[begin] > c'8'):
            return -1   # 64 bits do not hold it
    digits = i - begin
    if data[i] == c'.':
        i += 1
        begin = i
        while <uint8_t>(data[i] - c'0') <= 9:
            if i - begin < 9:
                fraction = 10 * fraction + <uint8_t>(data[i] - c'0')
            i += 1
        digits += i - begin
        for _ in range(i - begin, 9):
            fraction *= 10
    if digits == 0:
        return -1
    whole[0] = -value if negative else value
    nano[0] = -fraction if negative else fraction
    return i


cdef inline bint blank(uint8_t c) noexcept nogil:
    return c == c' ' or c == c',' or c == c';' or c == c'\t' or c == c'\r'


def text_events(const uint8_t[::1] data not None, Py_ssize_t begin,
                const int64_t[::1] order not None, int64_t[:, ::1] out not None):
    """Read lines of four numbers from begin on; return (how far, events, bad lines).

    Whole lines only.  order says which row of out, t, x, y, p, the first number of
    a line is, the second, and so on.  Times come as whole units in row 0 and
    nanounits in row 4.  A line that is not four numbers is bad, unless it is empty
    or begins with # or a letter.
    """
    cdef Py_ssize_t i = begin, end, n = data.shape[0], filled = 0, bad = 0, at, k
    cdef Py_ssize_t room = out.shape[1]
    cdef const uint8_t* source
    cdef const uint8_t* newline
    cdef int64_t whole = 0, fraction = 0, nano = 0
    cdef int64_t[4] row
    if order.shape[0] != 4 or out.shape[0] != 5 or begin < 0 or begin > n:
        raise ValueError("text_events: an array has the wrong shape")
    for k in range(4):
        if order[k] < 0 or order[k] > 3:
            raise ValueError("text_events: order must be of 0 .. 3")
    if begin == n:
        return n, 0, 0
    source = &data[0]
    with nogil:
        while i < n and filled < room:
            newline = <const uint8_t*>memchr(source + i, c'\n', n - i)
            if newline == NULL:
                break
            end = newline - source
            at = i
            while at < end and blank(source[at]):
                at += 1
            if at < end and not (source[at] == c'#' or source[at] >= c'A'):
                for k in range(4):
                    at = number(source, at, &whole, &fraction)
                    # A fraction of a pixel is no event.
                    if at < 0 or (fraction != 0 and order[k] != 0) or (
                            k < 3 and not blank(source[at])):
                        at = -1
                        break
                    row[order[k]] = whole
                    if order[k] == 0:
                        nano = fraction
                    while blank(source[at]):
                        at += 1
                if at != end:
                    bad += 1
                else:
                    for k in range(4):
                        out[k, filled] = row[k]
                    out[4, filled] = nano
                    filled += 1
            i = end + 1
    return i, filled, bad
