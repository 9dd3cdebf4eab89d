"""Events as the words and structs of the AEDAT formats."""
from libc.stdint cimport int64_t, uint8_t, uint32_t
from libc.string cimport memcpy, memset

from _kernels._types cimport event_t

cdef enum:
    STRIDE = 16     # int64 t, int16 x, int16 y, bool p, three bytes of padding


def pack_aedat4_events(const event_t[::1] events not None, Py_ssize_t at,
                       uint8_t[::1] out not None):
    """Write events as AEDAT-4 structs from byte at of out on."""
    cdef Py_ssize_t i, n = events.shape[0]
    cdef uint8_t* target
    if at < 0 or at > out.shape[0] or n > (out.shape[0] - at) // STRIDE:
        raise ValueError("pack_aedat4_events: out is too small")
    if n == 0:
        return
    target = &out[0] + at
    with nogil:
        for i in range(n):
            memcpy(target, &events[i].t, 8)
            memcpy(target + 8, &events[i].x, 2)
            memcpy(target + 10, &events[i].y, 2)
            memset(target + 12, 0, 4)
            target[12] = events[i].p != 0
            target += STRIDE


cdef inline void big_endian(uint8_t* at, uint32_t value) noexcept nogil:
    at[0] = <uint8_t>(value >> 24)
    at[1] = <uint8_t>(value >> 16)
    at[2] = <uint8_t>(value >> 8)
    at[3] = <uint8_t>value


def pack_aedat2_events(const event_t[::1] events not None, int64_t origin,
                       Py_ssize_t height, Py_ssize_t width,
                       uint8_t[:, ::1] out not None):
    """Write events as big-endian AEDAT-2.0 words: x mirrored, row 0 at the bottom.

    origin is subtracted from times, of which the low 32 bits are kept.
    """
    cdef Py_ssize_t i, n = events.shape[0], x, y
    cdef uint32_t address
    if out.shape[0] != n or out.shape[1] != 8:
        raise ValueError("pack_aedat2_events: out must be (n, 8)")
    if width > 1024 or height > 512:
        raise ValueError("pack_aedat2_events: addresses hold 1024x512 pixels")
    with nogil:
        for i in range(n):
            x = width - 1 - events[i].x
            y = height - 1 - events[i].y
            address = (<uint32_t>(y & 511) << 22 | <uint32_t>(x & 1023) << 12
                       | <uint32_t>(events[i].p != 0) << 11)
            big_endian(&out[i, 0], address)
            big_endian(&out[i, 4], <uint32_t>(<unsigned long long>events[i].t
                                              - <unsigned long long>origin))
