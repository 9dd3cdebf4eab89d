/* Common to the row functions in C: versions per instruction set, and bits of floats.

   gcc under glibc compiles a row function three times and picks one at load time.  The
   bits are the same in every version: no contraction, no libm, and sqrtf is exact by
   IEEE 754. */
#ifndef PDAVIS_CV_CLONES_H
#define PDAVIS_CV_CLONES_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__GLIBC__) && defined(__x86_64__) && defined(__GNUC__) \
    && !defined(__clang__) && __GNUC__ >= 12 && defined(__OPTIMIZE__) \
    && !defined(__SANITIZE_ADDRESS__)
#define PDAVIS_CLONES \
    __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define PDAVIS_CLONES
#endif

#if defined(__GNUC__)
#define PDAVIS_INLINE static inline __attribute__((always_inline))
#define PDAVIS_UNUSED __attribute__((unused))
#else
#define PDAVIS_INLINE static __inline
#define PDAVIS_UNUSED
#endif
#if defined(_MSC_VER)
#define restrict __restrict
#endif

#define PDAVIS_SIGN ((int32_t)0x80000000)

PDAVIS_INLINE int32_t bits_of(float value)
{
    int32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

PDAVIS_INLINE float float_of(int32_t bits)
{
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

PDAVIS_INLINE float pick(int32_t mask, float where_set, float where_not)
{
    return float_of((mask & bits_of(where_set)) | (~mask & bits_of(where_not)));
}

#endif
