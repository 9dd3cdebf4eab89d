"""AEDAT-4 payloads: event structs and vectors of tables."""
from libc.stdint cimport (
    int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t)
from libc.string cimport memcmp, memcpy, memset

from _kernels._check cimport BACKWARD, FILLED, LAST, STATE, far_us, put
from _kernels._types cimport event_t

cdef enum:
    STRIDE = 16     # int64 t, int16 x, int16 y, bool p, three bytes of padding
    BLOCK = 1024    # events that are decoded before they are judged


cdef extern from "_aedat4.h" nogil:
    bint plain_events(const uint8_t*, Py_ssize_t, uint64_t, bint, int64_t, uint8_t*)


cdef extern from "_lz4.h" nogil:
    Py_ssize_t lz4_frame(const uint8_t*, Py_ssize_t, uint8_t*, Py_ssize_t)


cdef void append(const uint8_t* source, Py_ssize_t n, int64_t first, int64_t last,
                 Py_ssize_t height, Py_ssize_t width, bint flip, int64_t* state,
                 event_t* out) noexcept nogil:
    """Append n events, without those whose time is not in first .. last."""
    cdef Py_ssize_t block, left
    cdef int64_t t
    cdef int16_t[2] place
    cdef event_t* to
    cdef uint64_t corner = <uint64_t>(width - 1 | height - 1 << 16)
    while n > 0:
        block = min(n - 1, BLOCK)       # the last event has none after it
        memcpy(&t, source, 8)
        to = out + state[FILLED]
        if block and first <= t and plain_events(
                source, block, corner, flip, state[LAST], <uint8_t*>to) and (
                to[block - 1].t <= last):
            state[FILLED] += block
            state[LAST] = to[block - 1].t
            source += block * STRIDE
            n -= block
            continue
        left = n - max(block, 1)
        while n > left:
            memcpy(&t, source, 8)
            memcpy(&place, source + 8, 4)
            if t < first or t > last:
                state[BACKWARD] += 1
            else:
                put(out, t, place[0], height - 1 - place[1] if flip else place[1],
                    source[12], height, width, state)
            source += STRIDE
            n -= 1


cdef int checked(Py_ssize_t height, Py_ssize_t width, const int64_t[::1] state
                 ) except -1:
    if state.shape[0] != STATE:
        raise ValueError("aedat4_events: state must hold 7 numbers")
    if not (0 < height <= 1 << 15 and 0 < width <= 1 << 15):
        raise ValueError("aedat4_events: a sensor has 1 to 32768 rows and columns")
    return 0


def aedat4_events(const uint8_t[::1] data not None, Py_ssize_t at, Py_ssize_t n,
                  Py_ssize_t height, Py_ssize_t width, bint flip, int64_t first,
                  int64_t last, int64_t[::1] state not None,
                  event_t[::1] out not None):
    """Append the n events of the vector at byte at to out.

    state is as in _check.pxd.  flip turns rows upside down.  Events whose time is not
    in first .. last are dropped.
    """
    checked(height, width, state)
    if n < 0 or at < 0 or at > data.shape[0] or n > (data.shape[0] - at) // STRIDE:
        raise ValueError("aedat4_events: events lie outside data")
    if state[FILLED] < 0 or state[FILLED] > out.shape[0] - n:
        raise ValueError("aedat4_events: out is too small")
    if n:
        with nogil:
            append(&data[at], n, first, last, height, width, flip, &state[0], &out[0])


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


cdef enum:
    ROOT = 4        # of a buffer that its size precedes


cdef (Py_ssize_t, Py_ssize_t) vector(const uint8_t* data, Py_ssize_t size, int field,
                                     Py_ssize_t item) noexcept nogil:
    cdef Py_ssize_t at = -1
    cdef uint32_t step, count = 0
    if size >= ROOT + 4 and field >= 0 and item > 0:
        at = field_at(data, size, ROOT, field, 4)
    if at <= 0:
        return at, 0
    memcpy(&step, data + at, 4)
    at += step
    if at > size - 4:
        return -1, 0
    memcpy(&count, data + at, 4)
    at += 4
    return at if count <= (size - at) // item else -1, count


def aedat4_vector(const uint8_t[::1] data not None, int field, Py_ssize_t item):
    """Return where the items of a vector in the root table lie, and their number.

    Where it has none both are 0; the place is -1 if they lie outside data.
    """
    return vector(&data[0] if data.shape[0] else NULL, data.shape[0], field, item)


def aedat4_packets(const uint8_t[::1] block not None, int64_t begin,
                   const int64_t[:, ::1] index not None, Py_ssize_t number,
                   Py_ssize_t stop, int stream, bint packed, Py_ssize_t height,
                   Py_ssize_t width, bint flip, uint8_t[::1] unpacked not None,
                   int64_t[::1] state not None, event_t[::1] out not None):
    """Append the events of packets of an index from a number on to out.

    Returns the first, of those before stop, that is not as the index says, or damaged,
    or too large.  index has place, size, number of events, first and last time of each
    packet of the stream; events beyond the times of its neighbours are dropped.  block
    holds the file from begin on.  Packets are unpacked as LZ4 if they are packed, one
    after the other into the same memory.  state and flip are as of aedat4_events.
    """
    cdef int32_t[2] head
    cdef uint32_t prefix
    cdef Py_ssize_t at, size, n, count
    cdef int64_t first, last
    cdef const uint8_t* data
    checked(height, width, state)
    if number < 0 or stop > index.shape[0] or index.shape[1] != 5 or (
            begin < 0 or state[FILLED] < 0):
        raise ValueError("aedat4_packets: index or state is wrong")
    with nogil:
        while number < stop:
            at, size = index[number, 0], index[number, 1]
            n = index[number, 2]
            if at - 8 < begin or not 0 < size <= block.shape[0] - (at - begin) or (
                    n >= unpacked.shape[0] // STRIDE):
                break
            data = &block[at - begin]
            memcpy(&head, data - 8, 8)
            if head[0] != stream or head[1] != size:
                break
            if packed:
                size = lz4_frame(data, size, &unpacked[0], unpacked.shape[0])
                data = &unpacked[0]
            if size < 12 or memcmp(data + 8, b"EVTS", 4):
                break
            memcpy(&prefix, data, 4)
            at, count = vector(data, size, 0, STRIDE)
            if prefix > size - 4 or at < 0 or n != count or (
                    n > out.shape[0] - state[FILLED]):
                break
            if n:
                first = index[number - 1, 4] if number else -far_us()
                last = index[number + 1, 3] if number + 1 < index.shape[0] else far_us()
                append(data + at, n, first, last, height, width, flip, &state[0],
                       &out[0])
            number += 1
    return number


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
