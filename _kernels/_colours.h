/* Row functions of mosaics of colours (see _colours.pyx): one row per call.

   Rows of pixels and of blocks have room for two more floats at either end.  Of a row of
   a Bayer mosaic, n is its colour beside green, and o the third. */
#ifndef PDAVIS_CV_COLOURS_H
#define PDAVIS_CV_COLOURS_H

#include "_clones.h"

PDAVIS_INLINE float at_least(float least, float value)
{
    return value > least ? value : least;
}

/* The three colours of a row of pixels; filters cover two, green ones lie at odd
   (x + shift) / 2.  beside is the mean of the rows of the same polarizers above and
   below. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_bilinear(
    const float *restrict own, const float *restrict beside, int shift, ptrdiff_t w,
    float *restrict n, float *restrict green, float *restrict o)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        int32_t here = -((((int32_t)x + shift) >> 1) & 1);
        float along = 0.5f * (own[x - 2] + own[x + 2]);
        n[x] = pick(here, along, own[x]);
        green[x] = pick(here, own[x], 0.5f * (along + beside[x]));
        o[x] = pick(here, beside[x], 0.5f * (beside[x - 2] + beside[x + 2]));
    }
}

PDAVIS_INLINE float part_of(float difference, float sum)
{
    return at_least(-1.0f, -at_least(-1.0f, -difference / sum));
}

/* The sum of each block of 2x2 pixels, and its three differences in parts of it: of
   columns, of rows, of diagonals.  A part of what is positive is at most 1. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_blocks(
    const float *restrict upper, const float *restrict lower, ptrdiff_t w,
    float *restrict light, float *restrict part_x, float *restrict part_y,
    float *restrict part_d)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        float a = upper[2 * x], b = upper[2 * x + 1], c = lower[2 * x];
        float d = lower[2 * x + 1], sum = (a + b) + (c + d);
        light[x] = sum = at_least(1e-20f, sum);
        part_x[x] = part_of((a + c) - (b + d), sum);
        part_y[x] = part_of((a + b) - (c + d), sum);
        part_d[x] = part_of((a + d) - (b + c), sum);
    }
}

/* Means (1, 2, 3, 2, 1) down the columns, of rows of this kind and of the other.  What
   parts owe to the slope of their colour, as blocks two away tell it, is taken off. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_columns(
    const float *const *rows, ptrdiff_t w, float *restrict same, float *restrict other,
    float *restrict part_x, float *restrict part_y)
{
    const float *restrict a = rows[0], *restrict b = rows[1], *restrict c = rows[2];
    const float *restrict d = rows[3], *restrict e = rows[4];
    for (ptrdiff_t x = -2; x < w + 2; x++) {
        same[x] = 0.2f * ((a[x] + e[x]) + 3.0f * c[x]);
        other[x] = 0.5f * (b[x] + d[x]);
    }
    for (ptrdiff_t x = 0; x < w; x++) {
        float before = c[x - 2], behind = c[x + 2], twice = 2.0f * c[x];
        part_x[x] += 0.25f * (behind - before) / ((behind + before) + twice);
        part_y[x] += 0.25f * (e[x] - a[x]) / ((e[x] + a[x]) + twice);
    }
}

/* Means of the three colours from the same along the row, and the block's own light in
   proportion to that of its colour.  Green blocks lie at odd x + shift. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_means(
    const float *restrict same, const float *restrict other,
    const float *restrict light, int shift, ptrdiff_t w, float *restrict n,
    float *restrict green, float *restrict o, float *restrict grey)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        int32_t here = -(((int32_t)x + shift) & 1);
        float a = 0.2f * ((same[x - 2] + same[x + 2]) + 3.0f * same[x]);
        float b = 0.5f * (same[x - 1] + same[x + 1]);
        float c = 0.2f * ((other[x - 2] + other[x + 2]) + 3.0f * other[x]);
        float d = 0.5f * (other[x - 1] + other[x + 1]);
        /* 25 and 16 are the sums of the weights of the two kinds of green. */
        float own = pick(here, (25.0f * a + 16.0f * d) / 41.0f, a);
        n[x] = pick(here, b, a);
        green[x] = pick(here, own, 0.5f * (b + c));
        o[x] = pick(here, c, d);
        grey[x] = light[x] / own;
    }
}

/* The share of a row of blocks in cells: of red or blue, and of two that are green. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_cells(
    const float *restrict part, ptrdiff_t odd, ptrdiff_t n, float *restrict own,
    float *restrict green)
{
    for (ptrdiff_t j = 0; j < n; j++) {
        own[j] = part[2 * j + odd];
        green[j] = 0.5f * part[2 * j + 1 - odd] + (odd ? green[j] : 0.0f);
    }
}

/* The window (-2, 3, 6, 7, 6, 3, -2), which keeps what bends evenly, down rows, and
   along them with three ends more. */
#define PDAVIS_SEVEN(a, b, c, d, e, f, g)                                            \
    ((3.0f * ((b) + (f)) - 2.0f * ((a) + (g))) + (6.0f * ((c) + (e)) + 7.0f * (d)))
PDAVIS_CLONES PDAVIS_UNUSED static void colour_window(
    const float *const *rows, ptrdiff_t n, float *restrict spare, float *restrict out)
{
    const float *restrict a = rows[0], *restrict b = rows[1], *restrict c = rows[2];
    const float *restrict d = rows[3], *restrict e = rows[4], *restrict f = rows[5];
    const float *restrict g = rows[6];
    for (ptrdiff_t x = 0; x < n; x++)
        spare[x] = PDAVIS_SEVEN(a[x], b[x], c[x], d[x], e[x], f[x], g[x]);
    for (ptrdiff_t x = 0; x < 3; x++) {
        spare[-1 - x] = spare[0];
        spare[n + x] = spare[n - 1];
    }
    for (ptrdiff_t x = 0; x < n; x++)
        out[x] = PDAVIS_SEVEN(spare[x - 3], spare[x - 2], spare[x - 1], spare[x],
                              spare[x + 1], spare[x + 2], spare[x + 3]) / 441.0f;
}

/* The least of a part of grey: below is noise. */
PDAVIS_INLINE float above_noise(float part) { return at_least(0.02f, part); }

/* Green of grey blocks of rows y - 2 to y + 2 at the others, from the two beside, more
   along the line on which light changes less, and three quarters of the curvature of
   their own colour; and what these have more than green. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_green(
    const float *const *rows, int shift, ptrdiff_t w, float *restrict green,
    float *restrict more)
{
    const float *restrict a = rows[0], *restrict b = rows[1], *restrict c = rows[2];
    const float *restrict d = rows[3], *restrict e = rows[4];
    for (ptrdiff_t x = 0; x < w; x++) {
        float bent_x = 2.0f * c[x] - (c[x - 2] + c[x + 2]);
        float bent_y = 2.0f * c[x] - (a[x] + e[x]);
        float change_x = fabsf(c[x + 1] - c[x - 1]) + fabsf(bent_x);
        float change_y = fabsf(d[x] - b[x]) + fabsf(bent_y);
        float least = 1e-3f * (c[x] * c[x]) + 1e-20f;
        float weight_x = change_y * change_y + least;
        float weight_y = change_x * change_x + least;
        float along = weight_x * (0.5f * (c[x - 1] + c[x + 1]) + 0.1875f * bent_x);
        float across = weight_y * (0.5f * (b[x] + d[x]) + 0.1875f * bent_y);
        green[x] = pick(-(((int32_t)x + shift) & 1), c[x],
                        (along + across) / (weight_x + weight_y));
        more[x] = c[x] - green[x];
    }
}

/* Means of colours around blocks become tints: the colours over the mean of all.  They
   are multiplied by grey blocks: green, and what rows y - 1 to y + 1 have more. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_tints(
    const float *restrict grey, const float *const *more, int shift, ptrdiff_t w,
    float *restrict n, float *restrict green, float *restrict o)
{
    const float *restrict a = more[0], *restrict b = more[1], *restrict c = more[2];
    for (ptrdiff_t x = 0; x < w; x++) {
        int32_t here = -(((int32_t)x + shift) & 1);
        float more_n = pick(here, 0.5f * (b[x - 1] + b[x + 1]), b[x]);
        float more_o = pick(here, 0.5f * (a[x] + c[x]),
                            0.25f * ((a[x - 1] + a[x + 1]) + (c[x - 1] + c[x + 1])));
        float p = at_least(0.0f, n[x] * (grey[x] + more_n));
        float q = at_least(0.0f, green[x] * grey[x]);
        float r = at_least(0.0f, o[x] * (grey[x] + more_o));
        float level = 1.0f / at_least(1e-20f, (p + (q + r)) / 3.0f);
        n[x] = above_noise(p * level);
        green[x] = above_noise(q * level);
        o[x] = above_noise(r * level);
    }
}

/* The first of two rows and a share of the second, with an end more on either side. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_between(
    const float *restrict a, const float *restrict b, float share, ptrdiff_t n,
    float *restrict out)
{
    for (ptrdiff_t x = 0; x < n; x++)
        out[x] = (1.0f - share) * a[x] + share * b[x];
    out[-1] = out[0];
    out[n] = out[n - 1];
}

/* A colour's 1 +- x +- y +- d at four places over that of grey, both at least a 50th.
   Parts of grey get a share of those on one side. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_over_grey(
    const float *restrict x, const float *restrict y, const float *restrict d,
    const float *restrict grey_x, const float *restrict grey_y,
    const float *restrict grey_d, ptrdiff_t side, float share, ptrdiff_t n,
    float *restrict to0, float *restrict to1, float *restrict to2, float *restrict to3)
{
    for (ptrdiff_t j = 0; j < n; j++) {
        float p = (1.0f - share) * grey_x[j] + share * grey_x[j + side];
        float q = (1.0f - share) * grey_y[j] + share * grey_y[j + side];
        float r = (1.0f - share) * grey_d[j] + share * grey_d[j + side];
#define PDAVIS_OF(x, y, d) above_noise((1.0f + (x)) + ((y) + (d)))
        to0[j] = PDAVIS_OF(x[j], y[j], d[j]) / PDAVIS_OF(p, q, r);
        to1[j] = PDAVIS_OF(-x[j], y[j], -d[j]) / PDAVIS_OF(-p, q, -r);
        to2[j] = PDAVIS_OF(x[j], -y[j], -d[j]) / PDAVIS_OF(p, -q, -r);
        to3[j] = PDAVIS_OF(-x[j], -y[j], d[j]) / PDAVIS_OF(-p, -q, r);
    }
}

/* A colour in parts of grey at one place of each block: its tint times what is of n
   cells, two blocks wide; share of the cell before belongs to even blocks, of that
   behind to odd ones. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_factors(
    const float *restrict tint, const float *restrict ratio, float before,
    float behind, ptrdiff_t n, float *restrict out)
{
    for (ptrdiff_t j = 0; j < n; j++) {
        float at = ratio[j];
        out[2 * j] = tint[2 * j] * (at + before * (ratio[j - 1] - at));
        out[2 * j + 1] = tint[2 * j + 1] * (at + behind * (ratio[j + 1] - at));
    }
}

/* Pixels between the n blocks of a row, two to a block. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_pixels(
    const float *restrict in, ptrdiff_t n, float *restrict out)
{
    out[0] = in[0];
    out[2 * n - 1] = in[n - 1];
    for (ptrdiff_t j = 0; j < n - 1; j++) {
        out[2 * j + 1] = 0.75f * in[j] + 0.25f * in[j + 1];
        out[2 * j + 2] = 0.75f * in[j + 1] + 0.25f * in[j];
    }
}

/* Divide a row of pixels by factors between two rows of blocks, each of four kinds: at
   the two pixels of even, then of odd blocks. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_divide(
    const float *const *here, const float *const *beside, ptrdiff_t w, float *own)
{
    const float *restrict a = here[0], *restrict b = here[1], *restrict c = here[2];
    const float *restrict d = here[3], *restrict p = beside[0], *restrict q = beside[1];
    const float *restrict r = beside[2], *restrict s = beside[3];
#pragma GCC ivdep
    for (ptrdiff_t x = 0; x < w; x++) {
        int32_t odd = -((int32_t)x & 1), second = -((int32_t)x >> 1 & 1);
        float near = pick(second, pick(odd, d[x], c[x]), pick(odd, b[x], a[x]));
        float far = pick(second, pick(odd, s[x], r[x]), pick(odd, q[x], p[x]));
        own[x] /= 0.75f * near + 0.25f * far;
    }
}

/* Multiply a row of pixels, which may be out, by factors between two rows of blocks. */
PDAVIS_CLONES PDAVIS_UNUSED static void colour_multiply(
    const float *restrict here, const float *restrict beside, const float *grey,
    ptrdiff_t w, float *out)
{
#pragma GCC ivdep
    for (ptrdiff_t x = 0; x < w; x++)
        out[x] = grey[x] * (0.75f * here[x] + 0.25f * beside[x]);
}

#endif
