/* Events of AEDAT-4, copied and checked in one pass without a branch. */
#ifndef PDAVIS_CV_AEDAT4_H
#define PDAVIS_CV_AEDAT4_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define STRIDE 16 /* int64 t, int16 x, int16 y, bool p, three bytes of padding */
#define EVENT 13

#if defined(__GNUC__)
#define FEW_AT_A_TIME _Pragma("GCC unroll 4") /* else it depends on how it is aligned */
#else
#define FEW_AT_A_TIME
#endif

/* Copy n events; return whether all are inside and time does not fall, from before on.

   Each is written with its padding, in place of which the next one is written.  corner
   is the largest x and, 16 bits above, the largest y.  Both coordinates are compared at
   once, and neither is negative: each difference keeps the bit above it, unless it
   falls below 0. */
static int plain_events(const uint8_t *source, ptrdiff_t n, uint64_t corner, int flip,
                        int64_t before, uint8_t *out)
{
    const uint64_t above = 0x80008000;
    uint64_t any = 0, inside = above, place;
    int fall = 0;
    int64_t t;
    FEW_AT_A_TIME
    for (ptrdiff_t i = 0; i < n; i++) {
        memcpy(&t, source + STRIDE * i, 8);
        memcpy(&place, source + STRIDE * i + 8, 8);
        memcpy(out + EVENT * i, source + STRIDE * i, STRIDE);
        if (flip) {
            uint16_t y = (uint16_t)((corner >> 16) - (place >> 16));
            memcpy(out + EVENT * i + 10, &y, 2);
        }
        fall |= t < before;
        before = t;
        any |= place;
        inside &= (corner | above) - place;
    }
    return !fall && (uint8_t)(any >> 32) <= 1 && (inside & ~any & above) == above;
}

#undef STRIDE
#undef EVENT
#undef FEW_AT_A_TIME
#endif
