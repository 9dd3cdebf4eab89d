/* Unpack LZ4 frames without checksums, written from the format's specification. */
#ifndef PDAVIS_CV_LZ4_H
#define PDAVIS_CV_LZ4_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define STEP 16 /* bytes that are copied at once, far from all ends */

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

/* Unpack a frame; return its size, or -1 if it has checksums or a dictionary, does not
   fit, or is damaged. */
static ptrdiff_t lz4_frame(const uint8_t *source, ptrdiff_t size, uint8_t *out,
                           ptrdiff_t room)
{
    const uint8_t *end = source + size;
    uint8_t *to = out, *last = out + room;
    uint32_t block;
    /* Version 1, blocks that are independent or not, maybe the size of all. */
    if (size < 15 || memcmp(source, "\x04\x22\x4d\x18", 4) ||
        (source[4] & 0xd7) != 0x40)
        return -1;
    source += source[4] & 8 ? 15 : 7;
    while (to && end - source >= 4) {
        memcpy(&block, source, 4);
        source += 4;
        if (!block)
            return to - out;
        size = block & 0x7fffffff;
        if (size > end - source)
            return -1;
        if (!(block >> 31)) {
            to = lz4_block(source, size, out, to, last);
        } else {
            if (size > last - to)
                return -1;
            memcpy(to, source, (size_t)size);
            to += size;
        }
        source += size;
    }
    return -1;
}

#undef STEP
#endif
