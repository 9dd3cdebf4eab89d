"""Events as lines of text.  State of time and checks of events are as in _check.pxd."""
from libc.stdint cimport int64_t, uint8_t, uint64_t
from libc.string cimport memchr, memcpy

from _kernels._check cimport FILLED, STATE, put
from _kernels._types cimport event_t

# Units of the integer part of times.
cdef enum:
    MICROSECONDS = 0
    SECONDS = 1
    NANOSECONDS = 2
    MILLISECONDS = 3

cdef extern from "_line.h":
    const int64_t[10] powers
    int AHEAD
    int zero_bits(uint64_t word) nogil
    int64_t value_of(uint64_t word, int count) nogil
    bint blank(uint8_t c) nogil
    int plain_line(const uint8_t* data, const int* order, int64_t* row,
                   int64_t* nano) nogil

cdef enum:
    MOST_COLUMNS = 16
    FAR_S = 2305843009214       # beyond 1 << 61 us
    NO_EVENT = -1               # an empty line, a comment
    BAD = -2


cdef inline uint64_t others(uint64_t word) noexcept nogil:
    """Return the highest bit of each byte of a word that is no digit.

    The first byte is the lowest of the word.  No carry leaves a byte.
    """
    word ^= <uint64_t>0x3030303030303030
    return (((word & <uint64_t>0x7F7F7F7F7F7F7F7F) + <uint64_t>0x7676767676767676)
            | word) & <uint64_t>0x8080808080808080


cdef inline int eight_digits(const uint8_t* data, Py_ssize_t i, Py_ssize_t n,
                             int64_t* value) noexcept nogil:
    """Read up to 8 digits at once; return how many there are.

    Digit by digit, the end of each number is a branch that no CPU foresees.
    """
    cdef uint64_t word = 0, ends
    cdef int count
    memcpy(&word, data + i, min(8, n - i))
    ends = others(word)
    count = zero_bits(ends) >> 3 if ends else 8
    value[0] = value_of(word, count) if count else 0
    return count


cdef inline bint digit(uint8_t c) noexcept nogil:
    return c >= c'0' and c <= c'9'


cdef inline int64_t ten_to(int power) noexcept nogil:
    return powers[min(power, 9)] * powers[power - min(power, 9)]


cdef Py_ssize_t with_exponent(const uint8_t* data, Py_ssize_t i, int64_t* whole,
                              int64_t* nano) noexcept nogil:
    """Read a number with an exponent, without sign; return the place after it, or -1.

    18 digits are used; nano is rounded.
    """
    cdef int64_t digits = 0
    cdef int shift = 0, used = 0, power = 0, places = 0
    cdef bint behind = False, negative
    while digit(data[i]) or (data[i] == c'.' and not behind):
        if data[i] == c'.':
            behind = True
        else:
            if used < 18:
                digits = 10 * digits + (data[i] - c'0')
                used += digits > 0
                shift -= behind
            else:
                shift += not behind
        i += 1
    i += 1      # the e
    negative = data[i] == c'-'
    if negative or data[i] == c'+':
        i += 1
    while digit(data[i]) and places < 3:
        power = 10 * power + (data[i] - c'0')
        places += 1
        i += 1
    if not places or digit(data[i]):
        return -1
    shift += -power if negative else power
    nano[0] = 0
    if digits == 0:
        whole[0] = 0
    elif shift >= 0:
        if shift > 18 or digits > (<int64_t>1 << 62) // ten_to(shift):
            return -1   # 64 bits do not hold it
        whole[0] = digits * ten_to(shift)
    else:
        whole[0] = digits // ten_to(-shift) if shift >= -18 else 0
        digits -= whole[0] * ten_to(-shift) if shift >= -18 else 0
        if shift >= -9:
            nano[0] = digits * ten_to(9 + shift)
        elif shift >= -27:
            nano[0] = min((digits + ten_to(-9 - shift) // 2) // ten_to(-9 - shift),
                          <int64_t>999999999)
    return i


cdef inline Py_ssize_t word_of_polarity(const uint8_t* data, Py_ssize_t i,
                                        int64_t* whole) noexcept nogil:
    """Read True or False; return the place after it, or -1."""
    cdef const char* rest = b"rue" if data[i] == c'T' or data[i] == c't' else b"alse"
    cdef Py_ssize_t k = 0
    if data[i] != c'T' and data[i] != c't' and data[i] != c'F' and data[i] != c'f':
        return -1
    whole[0] = rest[0] == c'r'
    while rest[k] != 0:
        if data[i + 1 + k] | 0x20 != rest[k]:
            return -1
        k += 1
    return i + 1 + k


cdef inline Py_ssize_t number(const uint8_t* data, Py_ssize_t i, Py_ssize_t n,
                              int64_t* whole, int64_t* nano) noexcept nogil:
    """Read a decimal number before a line's end; return the place after it, or -1.

    nano is the fraction in units of 1e-9, further digits are left out.  True is 1 and
    False 0.
    """
    cdef bint negative = data[i] == c'-'
    cdef int64_t value, fraction = 0, part
    cdef Py_ssize_t begin, places, first
    cdef int count
    if digit(data[i]) and data[i + 1] != c'.' and data[i + 1] | 0x20 != c'e' and (
            not digit(data[i + 1])):
        whole[0], nano[0] = data[i] - c'0', 0   # most often a polarity
        return i + 1
    if negative or data[i] == c'+':
        i += 1
    first = begin = i
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
        nano[0] = 0
        return word_of_polarity(data, i, whole)
    if data[i] | 0x20 == c'e':
        i = with_exponent(data, first, &value, &fraction)
    whole[0] = -value if negative else value
    nano[0] = -fraction if negative else fraction
    return i


cdef inline int64_t floored(int64_t a, int64_t b) noexcept nogil:
    """Divide by a positive number, downward, whatever cdivision says."""
    return a // b - (a % b < 0)


cdef inline int64_t in_us(int64_t whole, int64_t nano, int unit) noexcept nogil:
    """Return a time in us, rounded where it is in seconds."""
    if unit == SECONDS:
        whole = min(max(whole, -<int64_t>FAR_S), <int64_t>FAR_S)
        return whole * 1000000 + floored(nano + 500, 1000)
    if unit == MILLISECONDS:
        whole = min(max(whole, -1000 * <int64_t>FAR_S), 1000 * <int64_t>FAR_S)
        return whole * 1000 + floored(nano + 500000, 1000000)
    return floored(whole, 1000) if unit == NANOSECONDS else whole


cdef inline Py_ssize_t any_line(const uint8_t* source, Py_ssize_t at, Py_ssize_t n,
                                const int* order, int columns, bint more, int64_t* row,
                                int64_t* nano) noexcept nogil:
    """Read the line at a place before n; return where it ends, or NO_EVENT, or BAD."""
    cdef Py_ssize_t after
    cdef int64_t fraction = 0
    cdef int k
    while blank(source[at]):
        at += 1
    if source[at] == c'#' or source[at] == c'%' or source[at] == c'\n':
        return NO_EVENT
    for k in range(columns):
        if order[k] < 0:
            after = at
            while not blank(source[after]) and source[after] != c'\n':
                after += 1
            at = after
            while blank(source[at]):
                at += 1
            continue
        after = number(source, at, n, &row[order[k]], &fraction)
        # A fraction of a pixel is no event.
        if after < 0 or (fraction != 0 and order[k] != 0):
            return BAD
        if order[k] == 0:
            nano[0] = fraction
        at = after
        while blank(source[at]):
            at += 1
        if at == after and (k < columns - 1 or more) and source[at] != c'\n':
            return BAD
    while more and source[at] != c'\n':
        at += 1
    return at if source[at] == c'\n' else BAD


def text_events(const uint8_t[::1] data not None, Py_ssize_t begin,
                const int64_t[::1] order not None, bint more, int unit,
                Py_ssize_t height, Py_ssize_t width, int64_t[::1] state not None,
                event_t[::1] out not None):
    """Read lines of numbers from begin on; return (how far, bad lines).

    Whole lines only, while out has room.  order says which of t, x, y, p the first
    column of a line is, the second, and so on, -1 for none of these; more whether
    further columns may follow; unit that of times: 0 us, 1 s, 2 ns, 3 ms.  A line
    without the four numbers is bad, unless it is empty or begins with # or %; a
    negative p is OFF.
    """
    cdef Py_ssize_t i = begin, n = data.shape[0], bad = 0, at, k
    cdef Py_ssize_t room = out.shape[0]
    cdef const uint8_t* source
    cdef int64_t nano = 0
    cdef int64_t[4] row
    cdef int[MOST_COLUMNS] places
    cdef int64_t[STATE] s
    cdef int end, columns = <int>order.shape[0], found = 0
    cdef bint plain
    if columns < 4 or columns > MOST_COLUMNS or state.shape[0] != STATE or (
            begin < 0 or begin > n):
        raise ValueError("text_events: an array has the wrong shape")
    for k in range(columns):
        if order[k] < -1 or order[k] > 3:
            raise ValueError("text_events: order must be of -1 .. 3")
        places[k] = order[k]
        found |= 1 << order[k] if order[k] >= 0 else 0
    if found != 15:
        raise ValueError("text_events: order must have each of 0 .. 3")
    plain = columns == 4 and not more
    if unit < MICROSECONDS or unit > MILLISECONDS:
        raise ValueError("text_events: unit must be 0, 1, 2 or 3")
    if state[FILLED] < 0 or state[FILLED] > room:
        raise ValueError("text_events: state lies outside an array")
    # A line's end is no digit and no blank, so that nothing is read beyond the last.
    while n > begin and data[n - 1] != c'\n':
        n -= 1
    if begin == n:
        return n, 0
    source = &data[0]
    for k in range(STATE):     # local, so that writing events cannot change them
        s[k] = state[k]
    with nogil:
        while i < n and s[FILLED] < room:
            end = plain_line(source + i, places, row, &nano) if (
                plain and n - i >= AHEAD) else -1
            at = i + end if end >= 0 else any_line(
                source, i, n, places, columns, more, row, &nano)
            if at >= 0:
                put(&out[0], in_us(row[0], nano, unit), row[1], row[2], max(row[3], 0),
                    height, width, s)
            else:
                bad += at == BAD
                at = <const uint8_t*>memchr(source + i, c'\n', n - i) - source
            i = at + 1
    for k in range(STATE):
        state[k] = s[k]
    return i, bad
