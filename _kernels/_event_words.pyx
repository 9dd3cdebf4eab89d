"""Words of event cameras' own streams: Prophesee's EVT2 and EVT3, and lines of text.

Facts: the formats as Prophesee documents them.  State of time and checks of events are
as in _check.pxd.
"""
from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memchr, memcpy

from _kernels._check cimport (
    FILLED, FIRST_BAD, JUMP as FALLS, OFFSET, STATE, far, take)
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


# ---- lines of text ---------------------------------------------------------------

# What the whole numbers of times are.
cdef enum:
    MICROSECONDS = 0
    SECONDS = 1
    NANOSECONDS = 2

cdef extern from *:
    """
    static const int64_t powers[] = {
        1, 10, 100, 1000, 10000, 100000, 1000000, 10000000, 100000000, 1000000000};
    #if defined(__GNUC__)
    #define zero_bytes(word) ((word) ? __builtin_ctzll(word) >> 3 : 8)
    #else
    static int zero_bytes(uint64_t word) {
        int n = 0;
        for (; n < 8 && !(word & 0xFF); word >>= 8) n++;
        return n;
    }
    #endif
    """
    const int64_t[10] powers
    int zero_bytes(uint64_t word) nogil      # below the lowest other one

cdef enum:
    FAR_S = 2305843009214       # beyond 1 << 61 us


cdef inline int eight_digits(const uint8_t* data, Py_ssize_t i, Py_ssize_t n,
                             int64_t* value) noexcept nogil:
    """Read up to 8 digits at once; return how many there are.

    Digit by digit, the end of each number is a branch that no CPU foresees.  The first
    byte is the lowest of the word.
    """
    cdef uint64_t word = 0, other
    cdef int count
    if i + 8 <= n:
        memcpy(&word, data + i, 8)
    else:
        memcpy(&word, data + i, n - i)
    word ^= <uint64_t>0x3030303030303030
    # The high bit of each byte that is no digit; a carry reaches later bytes only.
    other = ((word + <uint64_t>0x7676767676767676) | word) & (
        <uint64_t>0x8080808080808080)
    count = zero_bytes(other)
    value[0] = 0
    if count:
        word <<= 64 - 8 * count
        # Neighbours add up: to 4 numbers of 2 digits, 2 of 4, one of 8.
        word = word * 2561 >> 8 & <uint64_t>0x00FF00FF00FF00FF
        word = word * 6553601 >> 16 & <uint64_t>0x0000FFFF0000FFFF
        value[0] = <int64_t>(word * <uint64_t>42949672960001 >> 32)
    return count


cdef inline bint digit(uint8_t c) noexcept nogil:
    return c >= c'0' and c <= c'9'


cdef inline Py_ssize_t number(const uint8_t* data, Py_ssize_t i, Py_ssize_t n,
                              int64_t* whole, int64_t* nano) noexcept nogil:
    """Read a decimal number before a line's end; return the place after it, or -1.

    nano is the fraction in units of 1e-9, further digits are left out.
    """
    cdef bint negative = data[i] == c'-'
    cdef int64_t value, fraction = 0, part
    cdef Py_ssize_t begin, places
    cdef int count
    if digit(data[i]) and data[i + 1] != c'.' and not digit(data[i + 1]):
        whole[0], nano[0] = data[i] - c'0', 0   # most often a polarity
        return i + 1
    if negative or data[i] == c'+':
        i += 1
    begin = i
    count = eight_digits(data, i, n, &value)
    i += count
    if count == 8:
        count = eight_digits(data, i, n, &part)
        value = value * powers[count] + part
        i += count
        if count == 8:
            count = eight_digits(data, i, n, &part)
            if count > 3 or (count == 3 and data[begin] > c'8'):
                return -1   # 64 bits do not hold it
            value = value * powers[count] + part
            i += count
    places = i - begin
    if data[i] == c'.':
        i += 1
        begin = i
        count = eight_digits(data, i, n, &fraction)
        i += count
        if count == 8:
            count = eight_digits(data, i, n, &part)
            i += count
            if count:
                fraction = 10 * fraction + part // powers[count - 1]
            while count == 8:
                count = eight_digits(data, i, n, &part)
                i += count
        places += i - begin
        fraction *= powers[9 - min(i - begin, 9)]
    if places == 0:
        return -1
    whole[0] = -value if negative else value
    nano[0] = -fraction if negative else fraction
    return i


cdef inline bint blank(uint8_t c) noexcept nogil:
    return c == c' ' or c == c',' or c == c';' or c == c'\t' or c == c'\r'


cdef inline int64_t floored(int64_t a, int64_t b) noexcept nogil:
    """Divide by a positive number, downward, whatever cdivision says."""
    return a // b - (a % b < 0)


cdef inline int64_t in_us(int64_t whole, int64_t nano, int unit) noexcept nogil:
    """Return a time in us, rounded where it is in seconds."""
    if unit == SECONDS:
        whole = min(max(whole, -<int64_t>FAR_S), <int64_t>FAR_S)
        return whole * 1000000 + floored(nano + 500, 1000)
    return floored(whole, 1000) if unit == NANOSECONDS else whole


def text_events(const uint8_t[::1] data not None, Py_ssize_t begin,
                const int64_t[::1] order not None, int unit, Py_ssize_t height,
                Py_ssize_t width, int64_t[::1] state not None,
                event_t[::1] out not None):
    """Read lines of four numbers from begin on; return (how far, bad lines, why, t).

    Whole lines only, while out has room.  order says which of t, x, y, p the first
    number of a line is, the second, and so on; unit that of whole times: 0 us, 1 s,
    2 ns.  A line that is not four numbers is bad, unless it is empty or begins with #
    or a letter; a negative p is OFF.  Why is 1 before a line whose time, t in us, lies
    more than a second before the last.
    """
    cdef Py_ssize_t i = begin, n = data.shape[0], bad = 0, at, after, k
    cdef Py_ssize_t room = out.shape[0]
    cdef const uint8_t* source
    cdef int64_t whole = 0, fraction = 0, nano = 0, t = 0
    cdef int64_t[4] row
    cdef int64_t* s
    cdef int why = FULL
    if order.shape[0] != 4 or state.shape[0] != STATE or begin < 0 or begin > n:
        raise ValueError("text_events: an array has the wrong shape")
    for k in range(4):
        if order[k] < 0 or order[k] > 3:
            raise ValueError("text_events: order must be of 0 .. 3")
    if unit < MICROSECONDS or unit > NANOSECONDS:
        raise ValueError("text_events: unit must be 0, 1 or 2")
    if state[FILLED] < 0 or state[FILLED] > room:
        raise ValueError("text_events: state lies outside an array")
    # A line's end is no digit and no blank, so that nothing is read beyond the last.
    while n > begin and data[n - 1] != c'\n':
        n -= 1
    if begin == n:
        return n, 0, FULL, 0
    source, s = &data[0], &state[0]
    s[FIRST_BAD] = -1
    with nogil:
        while i < n and s[FILLED] < room:
            at = i
            while blank(source[at]):
                at += 1
            if source[at] == c'#' or source[at] >= c'A':
                at = <const uint8_t*>memchr(source + at, c'\n', n - at) - source
            elif source[at] != c'\n':
                for k in range(4):
                    after = number(source, at, n, &whole, &fraction)
                    # A fraction of a pixel is no event.
                    if after < 0 or (fraction != 0 and order[k] != 0):
                        at = -1
                        break
                    row[order[k]] = whole
                    if order[k] == 0:
                        nano = fraction
                    at = after
                    while blank(source[at]):
                        at += 1
                    if at == after and k < 3:
                        at = -1
                        break
                if at < 0 or source[at] != c'\n':
                    bad += 1
                    at = <const uint8_t*>memchr(source + i, c'\n', n - i) - source
                else:
                    t = in_us(row[0], nano, unit)
                    whole = t if far(t) else t + s[OFFSET]
                    if take(&out[s[FILLED]], i, whole, whole, row[1], row[2],
                            max(row[3], 0), height, width, s) == FALLS:
                        why = JUMP
                        break
            i = at + 1
    return i, bad, why, t
