/* Row functions of the image kernels: one image row per call, over memory handed in.

   Plain C so that gcc under glibc can compile each three times and pick at load time
   (mosaic to AoP and DoLP: twice as fast at x86-64-v3, nearly three times at v4).  The
   bits are the same in every version: no contraction, no libm, and sqrtf is exact by
   IEEE 754. */
#ifndef PDAVIS_CV_STENCIL_H
#define PDAVIS_CV_STENCIL_H

#include "_clones.h"

/* Rows go by blocks that fill a vector; the last one overlaps its predecessor. */
#define PDAVIS_BLOCK 16
#define PDAVIS_BLOCKS_OF(size, n, DO)                                                \
    do {                                                                             \
        ptrdiff_t i, b, last = (n) - (size);                                         \
        if (last < 0)                                                                \
            for (i = 0; i < (n); i++) { DO; }                                        \
        else                                                                         \
            for (b = 0; b < (n); b += (size)) {                                      \
                ptrdiff_t from = b < last ? b : last;                                \
                for (i = from; i < from + (size); i++) { DO; }                       \
            }                                                                        \
    } while (0)
#define PDAVIS_BLOCKS(n, DO) PDAVIS_BLOCKS_OF(PDAVIS_BLOCK, n, DO)

/* ---- bilinear demosaicing ---------------------------------------------------- */

/* One row of the four planes.  `near` and `far` are the rows above and below, or,
   at the top and bottom (edge = 1), the nearest row of the other parity and the next
   one of that parity: the missing row is extrapolated as near + slope (near - far),
   columns likewise.  own and other point one float into scratch rows of w + 2.  The
   planes come by place in the cell: even and odd column of this row's parity, then of
   the other's. */
#define PDAVIS_BILINEAR(T, SUFFIX)                                                   \
    PDAVIS_CLONES PDAVIS_UNUSED static void bilinear_row_##SUFFIX(                   \
        const T *restrict row, const T *near_row, const T *far_row, int edge,        \
        float slope, ptrdiff_t w, float *restrict own, float *restrict other,        \
        float *restrict own0, float *restrict own1, float *restrict other0,          \
        float *restrict other1)                                                      \
    {                                                                                \
        const ptrdiff_t line = 64 / sizeof(T);                                       \
        const float more = 1.0f + slope;                                             \
        ptrdiff_t x;                                                                 \
        PDAVIS_BLOCKS_OF(line, w, own[i] = (float)row[i]);                           \
        if (edge)                                                                    \
            for (x = 0; x < w; x++) {                                                \
                float near_dn = (float)near_row[x];                                  \
                float beyond = more * near_dn - slope * (float)far_row[x];           \
                other[x] = 0.5f * (beyond + near_dn);                                \
            }                                                                        \
        else                                                                         \
            PDAVIS_BLOCKS_OF(                                                        \
                line, w, other[i] = 0.5f * ((float)near_row[i] + (float)far_row[i]));\
        spread_row(own, slope, w, own0, own1);                                       \
        spread_row(other, slope, w, other0, other1);                                 \
    }

/* Samples of two channels alternate in a row (one float of room at either end):
   give each its own value where it has one and else the mean of its neighbours. */
PDAVIS_INLINE void spread_row(
    float *restrict row, float slope, ptrdiff_t w, float *restrict even,
    float *restrict odd)
{
    ptrdiff_t x = 0, far_left = w > 3 ? 3 : 1, far_right = w > 3 ? w - 4 : w - 2;
    float more = 1.0f + slope;
    row[-1] = more * row[1] - slope * row[far_left];
    row[w] = more * row[w - 2] - slope * row[far_right];
    if (w >= PDAVIS_BLOCK) {
        /* the last block overlaps its predecessor and starts at an even column too */
        ptrdiff_t b, last = (w - PDAVIS_BLOCK) & ~(ptrdiff_t)1;
        for (b = 0; x < last + PDAVIS_BLOCK; b += PDAVIS_BLOCK) {
            ptrdiff_t from = b < last ? b : last;
            for (int32_t j = 0; j < PDAVIS_BLOCK; j++) {
                float sample = row[from + j];
                float mean = 0.5f * (row[from + j - 1] + row[from + j + 1]);
                even[from + j] = pick(-(j & 1), mean, sample);
                odd[from + j] = pick(-(j & 1), sample, mean);
            }
            x = from + PDAVIS_BLOCK;
        }
    }
    for (; x < w; x++) {
        float mean = 0.5f * (row[x - 1] + row[x + 1]);
        even[x] = x & 1 ? mean : row[x];
        odd[x] = x & 1 ? row[x] : mean;
    }
}

PDAVIS_BILINEAR(uint8_t, u8)
PDAVIS_BILINEAR(uint16_t, u16)
PDAVIS_BILINEAR(float, f32)

/* ---- Stokes parameters, angle and degree ------------------------------------- */

/* The smaller over the larger of two lengths, 0 if both are 0; NaN if one is. */
PDAVIS_INLINE float ratio(float s1, float s2, float *large)
{
    float a1 = float_of(bits_of(s1) & 0x7fffffff);
    float a2 = float_of(bits_of(s2) & 0x7fffffff);
    float small = a2 > a1 ? a1 : a2;
    *large = a2 > a1 ? a2 : a1;
    return small / (*large + 1e-37f); /* adds nothing to what is over 1e-29 */
}

/* atan2(y, x) / 2 in [0, pi); neither is -0.  With r = min / max in [0, 1],
   h = atan(r) / 2 = r / 2 + r^3 p(r^2); p is a minimax fit, error 2.5e-8 rad.  The
   angle is k pi/4 + h or - h, folded at pi/4, pi/2 and pi by the bits of the signs;
   pi/4 is split so that k times its upper part is exact. */
PDAVIS_INLINE float half_atan2(float y, float x, float r)
{
    int32_t sx = bits_of(x), sy = bits_of(y);
    int32_t steep = float_of(sy & 0x7fffffff) > float_of(sx & 0x7fffffff) ? -1 : 0;
    float t = r * r, h, k, angle;
    float p = -2.177702496e-03f;
    p = p * t + 1.152006630e-02f;
    p = p * t - 2.888679318e-02f;
    p = p * t + 4.897117242e-02f;
    p = p * t - 6.988290697e-02f;
    p = p * t + 9.981352091e-02f;
    p = p * t - 1.666582972e-01f;
    h = 0.5f * r + r * t * p;
    k = float_of(steep & bits_of(1.0f));
    k = float_of((sx >> 31) & bits_of(2.0f))
        + float_of(bits_of(k) ^ (sx & PDAVIS_SIGN));
    k = float_of((sy >> 31) & bits_of(4.0f))
        + float_of(bits_of(k) ^ (sy & PDAVIS_SIGN));
    h = float_of(bits_of(h) ^ ((steep ^ sx ^ sy) & PDAVIS_SIGN));
    angle = k * 7.85397530e-01f + (k * 6.33794e-07f + h);
    return angle >= 3.141592741e+00f ? 0.0f : angle;
}

/* Scaled by the larger of the two, so that no square over- or underflows. */
PDAVIS_INLINE float degree(float s0, float large, float r)
{
    float value = large * sqrtf(1.0f + r * r) / s0;
    return s0 > 0.0f ? value : 0.0f;
}

PDAVIS_CLONES PDAVIS_UNUSED static void aop_row(
    const float *restrict s1, const float *restrict s2, ptrdiff_t n,
    float *restrict aop)
{
    PDAVIS_BLOCKS(n, {
        float x = s1[i] + 0.0f; /* -0 becomes 0 */
        float y = s2[i] + 0.0f;
        float large;
        float r = ratio(x, y, &large);
        aop[i] = half_atan2(y, x, r);
    });
}

PDAVIS_CLONES PDAVIS_UNUSED static void dolp_row(
    const float *restrict s0, const float *restrict s1, const float *restrict s2,
    ptrdiff_t n, float *restrict dolp)
{
    PDAVIS_BLOCKS(n, {
        float large;
        float r = ratio(s1[i], s2[i], &large);
        dolp[i] = degree(s0[i], large, r);
    });
}

/* gain multiplies s1 and s2: what the polarizers' leakage took from them. */
PDAVIS_CLONES PDAVIS_UNUSED static void stokes_row(
    const float *restrict i0, const float *restrict i45, const float *restrict i90,
    const float *restrict i135, float gain, ptrdiff_t n, float *restrict s0,
    float *restrict s1, float *restrict s2)
{
    for (ptrdiff_t i = 0; i < n; i++) {
        s0[i] = 0.5f * ((i0[i] + i90[i]) + (i45[i] + i135[i]));
        s1[i] = gain * (i0[i] - i90[i]);
        s2[i] = gain * (i45[i] - i135[i]);
    }
}

/* A weighted sum of the four; step is 0 when the weights are one for all. */
PDAVIS_CLONES PDAVIS_UNUSED static void mix_row(
    const float *restrict i0, const float *restrict i45, const float *restrict i90,
    const float *restrict i135, const float *restrict w0, const float *restrict w45,
    const float *restrict w90, const float *restrict w135, ptrdiff_t step, ptrdiff_t n,
    float *restrict out)
{
    if (step)
        for (ptrdiff_t i = 0; i < n; i++)
            out[i] = (w0[i] * i0[i] + w90[i] * i90[i])
                     + (w45[i] * i45[i] + w135[i] * i135[i]);
    else
        for (ptrdiff_t i = 0; i < n; i++)
            out[i] = (w0[0] * i0[i] + w90[0] * i90[i])
                     + (w45[0] * i45[i] + w135[0] * i135[i]);
}

PDAVIS_CLONES PDAVIS_UNUSED static void polarization_row(
    const float *restrict i0, const float *restrict i45, const float *restrict i90,
    const float *restrict i135, float gain, ptrdiff_t n, float *restrict s0,
    float *restrict aop, float *restrict dolp)
{
    PDAVIS_BLOCKS(n, {
        float light = 0.5f * ((i0[i] + i90[i]) + (i45[i] + i135[i]));
        float x = gain * (i0[i] - i90[i]) + 0.0f;
        float y = gain * (i45[i] - i135[i]) + 0.0f;
        float large;
        float r = ratio(x, y, &large);
        s0[i] = light;
        aop[i] = half_atan2(y, x, r);
        dolp[i] = degree(light, large, r);
    });
}

#endif
