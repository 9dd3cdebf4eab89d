/* Unpack LZ4 frames, written from the specifications of the format and of XXH32. */
#ifndef PDAVIS_CV_LZ4_H
#define PDAVIS_CV_LZ4_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define STEP 16 /* bytes that are copied at once, far from all ends */
#define TURN(x, n) ((x) << (n) | (x) >> (32 - (n)))

/* Add the bytes that continue a length of 15; return it, or -1 at the end. */
static ptrdiff_t lz4_length(ptrdiff_t length, const uint8_t **source, const uint8_t *end)
{
    uint8_t more = length < 15 ? 0 : 255;
    while (more == 255) {
        if (*source == end)
            return -1;
        length += more = *(*source)++;
    }
    return length;
}

/* Unpack a block to `to`, which lies in out, up to last, and may refer to what is before;
   return where it ends, or NULL if it is damaged or does not fit. */
static uint8_t *lz4_block(const uint8_t *source, ptrdiff_t size, const uint8_t *out,
                          uint8_t *to, uint8_t *last)
{
    const uint8_t *end = source + size, *far = end - (size < 2 * STEP ? size : 2 * STEP);
    const uint8_t *safe = last - (last - out < 4 * STEP ? last - out : 4 * STEP);
    while (source < end) {
        const unsigned token = *source++;
        ptrdiff_t length = token >> 4, back;
        uint8_t *stop;
        if (length < 15 && source < far && to < safe) {
            memcpy(to, source, STEP);
            source += length;
            to += length;
            back = source[0] | source[1] << 8;
            length = token & 15;
            if (length < 15 && back >= 8 && back <= to - out) { /* as usual */
                memcpy(to, to - back, 8);
                memcpy(to + 8, to + 8 - back, 8);
                memcpy(to + 16, to + 16 - back, 2);
                source += 2;
                to += length + 4;
                continue;
            }
        } else {
            length = lz4_length(length, &source, end);
            if (length < 0 || length > end - source || length > last - to)
                return NULL;
            memcpy(to, source, (size_t)length);
            source += length;
            to += length;
            if (source == end)
                return to;
            if (end - source < 2)
                return NULL;
        }
        back = source[0] | source[1] << 8;
        source += 2;
        length = lz4_length(token & 15, &source, end) + 4;
        if (length < 4 || !back || back > to - out || length > last - to)
            return NULL;
        stop = to + length;
        if (back >= STEP && last - stop >= STEP)
            for (; to < stop; to += STEP)
                memcpy(to, to - back, STEP);
        else
            for (; to < stop; to++)
                *to = to[-back];
        to = stop;
    }
    return NULL;
}

static uint32_t lz4_word(const uint8_t *data)
{
    uint32_t word;
    memcpy(&word, data, 4);
    return word;
}

/* Return the checksum of bytes, XXH32 with 0 as its seed. */
static uint32_t lz4_sum(const uint8_t *data, ptrdiff_t size)
{
    const uint32_t p[] = {2654435761u, 2246822519u, 3266489917u, 668265263u, 374761393u};
    uint32_t a[] = {p[0] + p[1], p[1], 0, -p[0]}, sum = p[4];
    ptrdiff_t i, k;
    for (i = 0; size - i >= 16; i += 16)
        for (k = 0; k < 4; k++)
            a[k] = TURN(a[k] + lz4_word(data + i + 4 * k) * p[1], 13) * p[0];
    if (i)
        sum = TURN(a[0], 1) + TURN(a[1], 7) + TURN(a[2], 12) + TURN(a[3], 18);
    for (sum += (uint32_t)size; size - i >= 4; i += 4)
        sum = TURN(sum + lz4_word(data + i) * p[2], 17) * p[3];
    for (; i < size; i++)
        sum = TURN(sum + data[i] * p[4], 11) * p[0];
    sum = (sum ^ sum >> 15) * p[1];
    sum = (sum ^ sum >> 13) * p[2];
    return sum ^ sum >> 16;
}

/* Unpack a frame; return its size, or -1 if only its blocks have checksums, it has a
   dictionary, does not fit, or is damaged. */
static ptrdiff_t lz4_frame(const uint8_t *source, ptrdiff_t size, uint8_t *out,
                           ptrdiff_t room)
{
    const uint8_t *end = source + size;
    uint8_t *to = out, *last = out + room;
    const int flags = size < 15 ? 0 : source[4], sums = flags & 0x10 ? 4 : 0;
    uint32_t block;
    /* Version 1, blocks that are independent or not, maybe the size of all; one checksum
       of all is enough. */
    if ((flags & 0xc3) != 0x40 || (flags & 0x14) == 0x10 ||
        memcmp(source, "\x04\x22\x4d\x18", 4))
        return -1;
    source += flags & 8 ? 15 : 7;
    while (to && end - source >= 4) {
        block = lz4_word(source);
        source += 4;
        if (!block && flags & 4)
            return end - source >= 4 && lz4_word(source) == lz4_sum(out, to - out) ?
                       to - out : -1;
        if (!block)
            return to - out;
        size = block & 0x7fffffff;
        if (size > end - source - sums)
            return -1;
        if (!(block >> 31)) {
            to = lz4_block(source, size, out, to, last);
        } else {
            if (size > last - to)
                return -1;
            memcpy(to, source, (size_t)size);
            to += size;
        }
        source += size + sums;
    }
    return -1;
}

#undef TURN
#undef STEP
#endif
