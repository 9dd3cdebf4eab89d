/* Row functions of guided demosaicing (see _guided.pyx): one image row per call.

   Rows of samples and of terms have two floats of room at either end, in which they are
   mirrored without repeating the end itself, so that columns keep their channel. */
#ifndef PDAVIS_CV_GUIDED_H
#define PDAVIS_CV_GUIDED_H

#include "_clones.h"

PDAVIS_INLINE float square(float value) { return value * value; }

/* Binomial sum (1, 2, 1) and second difference (-1, 2, -1) down the columns. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_columns(
    const float *restrict up, const float *restrict mid, const float *restrict down,
    ptrdiff_t w, float *restrict sum, float *restrict difference)
{
    for (ptrdiff_t x = -2; x < w + 2; x++) {
        float beside = up[x] + down[x], twice = 2.0f * mid[x];
        sum[x] = beside + twice;
        difference[x] = twice - beside;
    }
}

/* A row's 3x3 means, and the three differences as 3x3 sums: between columns, between
   rows, between diagonals.  sum and difference are as above; down is 1 or -1 in even and
   odd rows. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_differences(
    const float *restrict sum, const float *restrict difference, float down,
    ptrdiff_t w, float *restrict mean, float *restrict along_x, float *restrict along_y,
    float *restrict along_d)
{
    for (int32_t x = 0; x < (int32_t)w; x++) {
        float right = x & 1 ? -0.0625f : 0.0625f;
        float sums = sum[x - 1] + sum[x + 1], twice_sum = 2.0f * sum[x];
        float ends = difference[x - 1] + difference[x + 1];
        float twice = 2.0f * difference[x];
        mean[x] = 0.0625f * (sums + twice_sum);
        along_x[x] = right * (twice_sum - sums);
        along_y[x] = down * (0.0625f * (ends + twice));
        along_d[x] = down * (right * (twice - ends));
    }
}

/* The terms of the weighted fit of each difference to the mean: it becomes its product
   with weight and mean, and weight_ receives weight times squared mean.

   A difference errs by what the intensity changes along its axis, so its weight is one
   over the square of that change: across is the part of the other axis' that counts
   too, floor the least relative variance.  trust is 1 where all nine samples are
   usable, else so small that it counts only where none is. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_terms(
    const float *restrict up2, const float *restrict up1, const float *restrict own,
    const float *restrict down1, const float *restrict down2,
    const float *restrict mean, const float *restrict trust, float floor, float across,
    ptrdiff_t w, float *restrict along_x, float *restrict along_y,
    float *restrict along_d, float *restrict weight_x, float *restrict weight_y,
    float *restrict weight_d)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        float change_x = 0.0625f * ((square(own[x] - own[x - 2])
                                     + square(own[x + 2] - own[x]))
                                    + 2.0f * square(own[x + 1] - own[x - 1]));
        float change_y = 0.0625f * ((square(own[x] - up2[x])
                                     + square(down2[x] - own[x]))
                                    + 2.0f * square(down1[x] - up1[x]));
        float dn = mean[x] > 0.0f ? mean[x] : 0.0f, scale = trust[x] * dn;
        float least = floor * (dn * dn) + 1e-30f;
        float wx = scale / ((change_x + across * change_y) + least);
        float wy = scale / ((change_y + across * change_x) + least);
        float wd = wx > wy ? wx : wy;
        along_x[x] *= wx;
        weight_x[x] = wx * dn;
        along_y[x] *= wy;
        weight_y[x] = wy * dn;
        along_d[x] *= wd;
        weight_d[x] = wd * dn;
    }
}

/* The window (1, 8, 14, 8, 1), not normalized. */
#define PDAVIS_WINDOW(a, b, c, d, e) (((a) + (e)) + 8.0f * ((b) + (d)) + 14.0f * (c))

/* Along a row. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_window(
    const float *restrict in, ptrdiff_t w, float *restrict out)
{
    for (ptrdiff_t x = 0; x < w; x++)
        out[x] = PDAVIS_WINDOW(in[x - 2], in[x - 1], in[x], in[x + 1], in[x + 2]);
}

/* Down five rows of a product and of its weight, and the quotient of the two. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_quotient(
    const float *const *product, const float *const *weight, ptrdiff_t w,
    float *restrict out)
{
    const float *restrict p0 = product[0], *restrict p1 = product[1];
    const float *restrict p2 = product[2], *restrict p3 = product[3];
    const float *restrict p4 = product[4];
    const float *restrict w0 = weight[0], *restrict w1 = weight[1];
    const float *restrict w2 = weight[2], *restrict w3 = weight[3];
    const float *restrict w4 = weight[4];
    for (ptrdiff_t x = 0; x < w; x++)
        out[x] = PDAVIS_WINDOW(p0[x], p1[x], p2[x], p3[x], p4[x])
                 / (PDAVIS_WINDOW(w0[x], w1[x], w2[x], w3[x], w4[x]) + 1e-30f);
}

/* Four channels of a row, by place in the cell, from its samples, its 3x3 means and the
   differences' parts of the mean; down as above.  additive is the weight of the law
   "difference as in the mean" against "difference in proportion to what is here". */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_row(
    const float *restrict own, const float *restrict mean, const float *restrict part_x,
    const float *restrict part_y, const float *restrict part_d, float down,
    float additive, ptrdiff_t w, float *restrict to0, float *restrict to1,
    float *restrict to2, float *restrict to3)
{
    for (int32_t x = 0; x < (int32_t)w; x++) {
        float right = x & 1 ? -1.0f : 1.0f;
        float ax = part_x[x], ay = part_y[x], ad = part_d[x];
        float change = (right * ax + down * ay) + right * (down * ad);
        float share = 1.0f + change;
        float shifted = own[x] - change * mean[x];
        float dn = (share * own[x] + additive * shifted) / (share * share + additive);
        float plus = ay + ad, minus = ay - ad;
        to0[x] = dn * ((1.0f + ax) + plus);
        to1[x] = dn * ((1.0f - ax) + minus);
        to2[x] = dn * ((1.0f + ax) - plus);
        to3[x] = dn * ((1.0f - ax) - minus);
    }
}

#endif
