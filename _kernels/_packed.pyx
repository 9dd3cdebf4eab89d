"""Unpacking of 10- and 12-bit pixels, two or four to a group of bytes."""
from libc.stdint cimport uint8_t, uint16_t


def unpack_10p(const uint8_t[::1] data not None, uint16_t[::1] out not None):
    """Unpack contiguous 10-bit pixels, least significant bit first (Mono10p)."""
    cdef Py_ssize_t n = out.shape[0], i, byte
    cdef unsigned int pair
    if data.shape[0] < (10 * n + 7) // 8:
        raise ValueError("unpack_10p: data is too short")
    with nogil:
        for i in range(n):
            byte = 10 * i // 8
            pair = data[byte] | (<unsigned int> data[byte + 1] << 8)
            out[i] = (pair >> (2 * (i & 3))) & 1023


def unpack_12p(const uint8_t[::1] data not None, uint16_t[::1] out not None):
    """Unpack contiguous 12-bit pixels, least significant bit first (Mono12p)."""
    cdef Py_ssize_t n = out.shape[0], i, byte
    cdef unsigned int pair
    if data.shape[0] < (12 * n + 7) // 8:
        raise ValueError("unpack_12p: data is too short")
    with nogil:
        for i in range(n):
            byte = 12 * i // 8
            pair = data[byte] | (<unsigned int> data[byte + 1] << 8)
            out[i] = (pair >> (4 * (i & 1))) & 4095


def unpack_packed(const uint8_t[::1] data not None, int bits,
                  uint16_t[::1] out not None):
    """Unpack GigE Vision groups of two pixels in three bytes (Mono10/12Packed).

    The first and the third byte hold the upper eight bits of a pixel each, the
    second the lower ones: of the first pixel from bit 0, of the other from bit 4.
    """
    cdef Py_ssize_t n = out.shape[0], i
    cdef const uint8_t* group
    cdef int low
    if bits != 10 and bits != 12:
        raise ValueError("unpack_packed: bits must be 10 or 12")
    low = bits - 8
    if data.shape[0] < 3 * (n // 2) + 2 * (n & 1):
        raise ValueError("unpack_packed: data is too short")
    with nogil:
        for i in range(n):
            group = &data[3 * (i // 2)]
            out[i] = <uint16_t> (
                (group[2 * (i & 1)] << low)
                | ((group[1] >> (4 * (i & 1))) & ((1 << low) - 1)))
