/* A line of four decimal numbers, as programs write it, without a branch per digit. */
#ifndef PDAVIS_CV_LINE_H
#define PDAVIS_CV_LINE_H

#include <stdint.h>
#include <string.h>

#define LINE 32           /* bytes in which such a line ends */
#define AHEAD (LINE + 8)  /* which reading it touches */

static const int64_t powers[] = {
    1, 10, 100, 1000, 10000, 100000, 1000000, 10000000, 100000000, 1000000000};

/* Zero bits below the lowest 1; there must be one. */
#if defined(__GNUC__)
#define zero_bits(word) __builtin_ctzll(word)
#else
static int zero_bits(uint64_t word) {
    int n = 0;
    for (; !(word & 1); word >>= 1) n++;
    return n;
}
#endif

/* A bit for each of LINE bytes, the first the lowest: 1 where there is no digit. */
#if defined(__SSE2__) && !PDAVIS_CV_DEBUG /* the debug flavour tests the other */
#include <emmintrin.h>
static inline uint32_t no_digits(const uint8_t *data) {
    const __m128i zero = _mm_set1_epi8('0'), nine = _mm_set1_epi8(9);
    __m128i a = _mm_sub_epi8(_mm_loadu_si128((const __m128i *)data), zero);
    __m128i b = _mm_sub_epi8(_mm_loadu_si128((const __m128i *)(data + 16)), zero);
    a = _mm_cmpeq_epi8(_mm_min_epu8(a, nine), a);
    b = _mm_cmpeq_epi8(_mm_min_epu8(b, nine), b);
    return ~((uint32_t)_mm_movemask_epi8(a) | (uint32_t)_mm_movemask_epi8(b) << 16);
}
#else
static inline uint32_t no_digits(const uint8_t *data) {
    uint32_t found = 0;
    for (int i = 0; i < LINE; i++)
        found |= (uint32_t)((uint8_t)(data[i] - '0') > 9) << i;
    return found;
}
#endif

/* The number that the first 1 to 8 bytes of a word, digits, stand for; the first byte
   is the lowest.  Neighbours add up: to 4 numbers of 2 digits, 2 of 4, one of 8. */
static inline int64_t value_of(uint64_t word, int count) {
    word = (word << (64 - 8 * count)) & 0x0F0F0F0F0F0F0F0F;
    word = (word * 2561 >> 8) & 0x00FF00FF00FF00FF;
    word = (word * 6553601 >> 16) & 0x0000FFFF0000FFFF;
    return (int64_t)(word * 42949672960001 >> 32);
}

/* The number that 1 to 16 digits stand for; 16 bytes can be read. */
static inline int64_t up_to_16(const uint8_t *data, int count) {
    uint64_t word, low;
    if (count <= 4) { /* of most coordinates */
        uint32_t half;
        memcpy(&half, data, 4);
        half = (half << (32 - 8 * count)) & 0x0F0F0F0F;
        half = (half * 2561 >> 8) & 0x00FF00FF;
        return half * 6553601 >> 16;
    }
    memcpy(&word, data, 8);
    if (count <= 8) return value_of(word, count);
    memcpy(&low, data + 8, 8);
    return value_of(word, 8) * powers[count - 8] + value_of(low, count - 8);
}

static inline int blank(uint8_t c) {
    return c == ' ' || c == ',' || c == ';' || c == '\t' || c == '\r' ||
           c == '"';
}

/* Read a line; return where it ends, or -1 for one that is not like this: four numbers
   of 1 to 16 digits, one separator between, of which the time, order 0, may have a
   fraction of up to 8, in 1e-9.  The places of all separators are found before any
   number is read: following one number to the next, each would wait for the one before.
 */
static inline int plain_line(const uint8_t *data, const int *order, int64_t *row,
                             int64_t *nano) {
    uint32_t marks = no_digits(data);
    int begin = 0, end = 0;
    *nano = 0;
#if defined(__GNUC__)
#pragma GCC unroll 4
#endif
    for (int k = 0; k < 4; k++) {
        int count;
        if (!marks) return -1;
        end = zero_bits(marks);
        marks &= marks - 1;
        count = end - begin;
        if (count < 1 || count > 16) return -1;
        row[order[k]] = up_to_16(data + begin, count);
        if (data[end] == '.' && order[k] == 0 && marks) {
            uint64_t word;
            begin = end + 1;
            end = zero_bits(marks);
            marks &= marks - 1;
            count = end - begin;
            if (count < 1 || count > 8) return -1;
            memcpy(&word, data + begin, 8);
            *nano = value_of(word, count) * powers[9 - count];
        }
        if (k < 3 && !blank(data[end])) return -1;
        begin = end + 1;
    }
    if (data[end] == '\r') end++;
    return data[end] == '\n' ? end : -1;
}

#endif
