"""AEDAT-4 payloads: event structs and vectors of tables."""
from libc.stdint cimport int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t
from libc.string cimport memcpy, memset

from _kernels._check cimport (
    BACKWARD, FILLED, FIRST_BAD, JUMP, LAST, OFFSET, STATE, far, take)
from _kernels._types cimport event_t

cdef enum:
    STRIDE = 16     # int64 t, int16 x, int16 y, bool p, three bytes of padding


cdef inline Py_ssize_t plain(const uint8_t* source, Py_ssize_t n, int64_t height,
                             int64_t width, bint flip, int64_t least, int64_t most,
                             int64_t offset, event_t* out) noexcept nogil:
    """Decode events while they are inside, and in order from least on; return how many.

    It reads one event beyond the last that it decodes: source holds n + 1.
    """
    cdef Py_ssize_t i
    cdef int64_t t, following
    cdef uint32_t x, y, p
    cdef uint32_t right = <uint32_t>(width - 1), bottom = <uint32_t>(height - 1)
    memcpy(&t, source, 8)
    if t < least:
        return 0
    for i in range(n):
        memcpy(&following, source + 16, 8)
        # Unsigned: negative coordinates become large.
        x = <uint32_t>source[8] | <uint32_t>source[9] << 8
        y = <uint32_t>source[10] | <uint32_t>source[11] << 8
        p = source[12]
        if flip:
            y = bottom - y
        if (t > most) | (following < t) | (x > right) | (y > bottom) | (p > 1):
            return i
        out[i].t = t + offset
        out[i].x = <uint16_t>x
        out[i].y = <uint16_t>y
        out[i].p = <uint8_t>p
        t = following
        source += STRIDE
    return n


def aedat4_events(const uint8_t[::1] data not None, Py_ssize_t at, Py_ssize_t begin,
                  Py_ssize_t n, Py_ssize_t height, Py_ssize_t width, bint flip,
                  int64_t first, int64_t last, int64_t[::1] state not None,
                  event_t[::1] out not None):
    """Decode events begin .. n of the vector at byte at into out; return an index.

    Returns n, or the index of an event before which time jumped back by more than
    a second.  state is as in _check.pxd.  flip turns rows upside down.  Events
    whose time in the file is not in first .. last are dropped.
    """
    cdef Py_ssize_t i = begin, run
    cdef int64_t t, following, least, most
    cdef int16_t x, y
    cdef const uint8_t* source
    cdef int64_t* s
    cdef bint ordinary = 0 < height <= 1 << 15 and 0 < width <= 1 << 15
    if state.shape[0] != STATE:
        raise ValueError("aedat4_events: state must hold 7 numbers")
    if (begin < 0 or n < begin or at < 0 or at > data.shape[0]
            or n > (data.shape[0] - at) // STRIDE):
        raise ValueError("aedat4_events: events lie outside data")
    if state[FILLED] < 0 or state[FILLED] > out.shape[0] - (n - begin):
        raise ValueError("aedat4_events: out is too small")
    if n == begin:
        return n
    s = &state[0]
    s[FIRST_BAD] = -1
    source = &data[0] + at
    with nogil:
        while i < n:
            if ordinary and not far(s[OFFSET]) and not far(s[LAST]):
                least = s[LAST] - s[OFFSET]
                most = (<int64_t>1 << 61) - s[OFFSET]
                run = plain(
                    source + i * STRIDE, n - 1 - i, height, width, flip,
                    least if least > first else first, most if most < last else last,
                    s[OFFSET], &out[0] + s[FILLED])
                if run > 0:
                    i += run
                    s[FILLED] += run
                    s[LAST] = out[s[FILLED] - 1].t
            memcpy(&t, source + i * STRIDE, 8)
            memcpy(&x, source + i * STRIDE + 8, 2)
            memcpy(&y, source + i * STRIDE + 10, 2)
            if t < first or t > last:
                s[BACKWARD] += 1
                if s[FIRST_BAD] < 0:
                    s[FIRST_BAD] = i
                i += 1
                continue
            following = t
            if i + 1 < n:
                memcpy(&following, source + (i + 1) * STRIDE, 8)
            # Unsigned sums: a damaged time may be anything.
            if take(&out[0] + s[FILLED], i,
                    <int64_t>(<unsigned long long>t + <unsigned long long>s[OFFSET]),
                    <int64_t>(<unsigned long long>following
                              + <unsigned long long>s[OFFSET]),
                    x, height - 1 - y if flip else y, source[i * STRIDE + 12],
                    height, width, s) == JUMP:
                break
            i += 1
    return i


cdef inline Py_ssize_t field_at(const uint8_t* data, Py_ssize_t size,
                                Py_ssize_t place, int field, int width) noexcept nogil:
    """Return the byte index of a field in the table that place points to; 0 = default.

    place holds an offset relative to itself.  -1 if anything lies outside data.
    """
    cdef uint32_t step
    cdef int32_t back
    cdef uint16_t length, relative
    cdef Py_ssize_t table, vtable
    memcpy(&step, data + place, 4)
    table = place + step
    if table > size - 4:
        return -1
    memcpy(&back, data + table, 4)
    vtable = table - back
    if vtable < 0 or vtable > size - 4:
        return -1
    memcpy(&length, data + vtable, 2)
    if 4 + 2 * field + 2 > length:
        return 0
    if vtable + 4 + 2 * field + 2 > size:
        return -1
    memcpy(&relative, data + vtable + 4 + 2 * field, 2)
    if relative == 0:
        return 0
    if table + relative > size - width:
        return -1
    return table + relative


def aedat4_table_fields(const uint8_t[::1] data not None, Py_ssize_t at, int field,
                        uint8_t[:, :, ::1] out not None):
    """Read fields from field on of the tables whose offsets lie at byte at.

    out receives the bytes of each table's fields, 0 for one that is not there.  Returns
    the number of tables; stops at the first that lies outside data.
    """
    cdef Py_ssize_t i = 0, n = out.shape[0], size = data.shape[0], place = 0
    cdef Py_ssize_t j, columns = out.shape[1]
    cdef int width = <int>out.shape[2]
    if at < 0 or at > size or n > (size - at) // 4 or field < 0:
        raise ValueError("aedat4_table_fields: tables lie outside data")
    with nogil:
        while i < n:
            for j in range(columns):
                place = field_at(&data[0], size, at + 4 * i, field + <int>j, width)
                if place < 0:
                    break
                memset(&out[i, j, 0], 0, width)
                if place > 0:
                    memcpy(&out[i, j, 0], &data[place], width)
            if place < 0:
                break
            i += 1
    return i
