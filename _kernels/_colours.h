/* Row functions of the means of colours (see _colours.pyx): one row per call. */
#ifndef PDAVIS_CV_COLOURS_H
#define PDAVIS_CV_COLOURS_H

#include "_clones.h"

/* Add a row's products with its guide, and the guide's squares, times its tap. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_products(
    const float *restrict image, const float *restrict guide, float tap, ptrdiff_t w,
    float *restrict above, float *restrict below)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        above[x] += tap * (image[x] * guide[x]);
        below[x] += tap * (guide[x] * guide[x]);
    }
}

/* Sum the four kinds of rows where their pixels have the colour. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_masked(
    const float *restrict mask, const float *restrict part, ptrdiff_t stride,
    ptrdiff_t w, float *restrict to)
{
    for (ptrdiff_t x = 0; x < w; x++)
        to[x] = ((mask[x] * part[x] + mask[stride + x] * part[2 * stride + x])
                 + mask[2 * stride + x] * part[4 * stride + x])
                + mask[3 * stride + x] * part[6 * stride + x];
}

/* The ratio of two windowed rows, n taps step pixels apart; 0 where there is none. */
PDAVIS_INLINE void ratio_of(
    const float *restrict above, const float *restrict below,
    const float *restrict taps, ptrdiff_t n, ptrdiff_t step, ptrdiff_t w,
    float *restrict out)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        float a = 0.0f, b = 0.0f;
        for (ptrdiff_t k = 0; k < n; k++) {
            a += taps[k] * above[x + k * step];
            b += taps[k] * below[x + k * step];
        }
        out[x] = b > 0.0f ? a / b : 0.0f;
    }
}

/* With a number of taps that it knows, the compiler sums up many pixels at once. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_ratio(
    const float *restrict above, const float *restrict below,
    const float *restrict taps, ptrdiff_t n, ptrdiff_t step, ptrdiff_t w,
    float *restrict out)
{
    switch (n) {
    case 3: ratio_of(above, below, taps, 3, step, w, out); break;
    case 5: ratio_of(above, below, taps, 5, step, w, out); break;
    case 9: ratio_of(above, below, taps, 9, step, w, out); break;
    case 13: ratio_of(above, below, taps, 13, step, w, out); break;
    default: ratio_of(above, below, taps, n, step, w, out);
    }
}

#endif
