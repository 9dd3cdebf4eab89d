/* Row functions of guided demosaicing (see _guided.pyx): one image row per call.

   Rows of samples and of terms have room for two more floats at either end.  There they
   are mirrored without repeating the end itself, so that columns keep their channel. */
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
   rows, between diagonals.  sum and difference are as above; down is 1 in even and -1 in
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

/* Inverse error variances of the three differences, up to a common factor.

   The error of a difference is taken as the change of intensity along its axis, plus
   the part `across` of the change along the other axis; floor is the lower bound of the
   variance relative to the squared mean.  trust is 1 if all nine samples are usable,
   otherwise so small that it matters only if no sample of the window is. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_weights(
    const float *restrict up2, const float *restrict up1, const float *restrict own,
    const float *restrict down1, const float *restrict down2,
    const float *restrict mean, const float *restrict trust, float floor, float across,
    ptrdiff_t w, float *restrict weight_x, float *restrict weight_y,
    float *restrict weight_d)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        float change_x = 0.0625f * ((square(own[x] - own[x - 2])
                                     + square(own[x + 2] - own[x]))
                                    + 2.0f * square(own[x + 1] - own[x - 1]));
        float change_y = 0.0625f * ((square(own[x] - up2[x])
                                     + square(down2[x] - own[x]))
                                    + 2.0f * square(down1[x] - up1[x]));
        float dn = mean[x] > 0.0f ? mean[x] : 0.0f;
        float least = floor * (dn * dn) + 1e-30f;
        float wx = trust[x] / ((change_x + across * change_y) + least);
        float wy = trust[x] / ((change_y + across * change_x) + least);
        weight_x[x] = wx;
        weight_y[x] = wy;
        weight_d[x] = wx > wy ? wx : wy;
    }
}

/* The terms of the weighted fit of a difference in proportion to the mean: weight times
   difference times mean, and weight times squared mean. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_terms(
    const float *restrict difference, const float *restrict mean,
    const float *restrict weight, ptrdiff_t w, float *restrict product,
    float *restrict power)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        float dn = mean[x] > 0.0f ? mean[x] : 0.0f, weighted = weight[x] * dn;
        product[x] = weighted * difference[x];
        power[x] = weighted * dn;
    }
}

/* The terms of the fit of the first fit's residual, and its weighted square.

   The variance of the residual by noise is added to the square: variance is that of the
   samples relative to their squares, and 9/64 = 0.140625 is the sum of the squared
   weights of a 3x3 difference. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_residual(
    const float *restrict difference, const float *restrict mean,
    const float *restrict weight, const float *restrict part,
    const float *restrict variance, ptrdiff_t w, float *restrict product,
    float *restrict energy)
{
    for (ptrdiff_t x = 0; x < w; x++) {
        float dn = mean[x] > 0.0f ? mean[x] : 0.0f, weighted = weight[x] * dn;
        float left = difference[x] - part[x] * mean[x];
        product[x] = weighted * left;
        energy[x] = (weight[x] * left) * left
                    + (weighted * dn) * (0.140625f * variance[x]);
    }
}

/* The window (1, 5, 8, 5, 1), not normalized. */
#define PDAVIS_WINDOW(a, b, c, d, e) (((a) + (e)) + 5.0f * ((b) + (d)) + 8.0f * (c))

/* Apply the window along a row. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_window(
    const float *restrict in, ptrdiff_t w, float *restrict out)
{
    for (ptrdiff_t x = 0; x < w; x++)
        out[x] = PDAVIS_WINDOW(in[x - 2], in[x - 1], in[x], in[x + 1], in[x + 2]);
}

/* Apply the window down five rows.  inverse: 1 / sum of w G^2; part: the first fit a,
   the ratio of a difference to the mean (a_1 in docs/theory/demosaicing.md). */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_fit(
    const float *const *product, const float *const *power, ptrdiff_t w,
    float *restrict inverse, float *restrict part)
{
    const float *restrict p0 = product[0], *restrict p1 = product[1];
    const float *restrict p2 = product[2], *restrict p3 = product[3];
    const float *restrict p4 = product[4];
    const float *restrict w0 = power[0], *restrict w1 = power[1];
    const float *restrict w2 = power[2], *restrict w3 = power[3];
    const float *restrict w4 = power[4];
    for (ptrdiff_t x = 0; x < w; x++) {
        inverse[x] = 1.0f / (PDAVIS_WINDOW(w0[x], w1[x], w2[x], w3[x], w4[x]) + 1e-30f);
        part[x] = PDAVIS_WINDOW(p0[x], p1[x], p2[x], p3[x], p4[x]) * inverse[x];
    }
}

/* Add the fit of the residual to the first fit, multiplied by gain and by the fraction
   of the residual's energy that it explains; this factor is at most `most`.

   least receives the minimum of its value and of the energy that both fits leave,
   relative to the squared mean: that of the difference least disturbed by edges. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_refine(
    const float *const *product, const float *const *energy,
    const float *restrict inverse, const float *restrict first, float gain, float most,
    ptrdiff_t w, float *restrict part, float *restrict least)
{
    const float *restrict p0 = product[0], *restrict p1 = product[1];
    const float *restrict p2 = product[2], *restrict p3 = product[3];
    const float *restrict p4 = product[4];
    const float *restrict e0 = energy[0], *restrict e1 = energy[1];
    const float *restrict e2 = energy[2], *restrict e3 = energy[3];
    const float *restrict e4 = energy[4];
    for (ptrdiff_t x = 0; x < w; x++) {
        float summed = PDAVIS_WINDOW(p0[x], p1[x], p2[x], p3[x], p4[x]);
        float left = PDAVIS_WINDOW(e0[x], e1[x], e2[x], e3[x], e4[x]) + 1e-30f;
        float step = summed * inverse[x], explained = summed * step;
        float taken = gain * (explained / left);
        float rest = (left - explained) * inverse[x];
        part[x] = first[x] + (taken < most ? taken : most) * step;
        least[x] = rest < least[x] ? rest : least[x];
    }
}

/* Mean of the channels at a pixel from its own sample, less the 3x3 mean (detail), and
   trust times the square of that.  additive is the weight of the model that differences
   equal their 3x3 values, against the model that they are proportional to the mean at
   the pixel; down as above. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_detail(
    const float *restrict own, const float *restrict mean, const float *restrict part_x,
    const float *restrict part_y, const float *restrict part_d, float down,
    float additive, const float *restrict trust, ptrdiff_t w, float *restrict detail,
    float *restrict power)
{
    for (int32_t x = 0; x < (int32_t)w; x++) {
        float right = x & 1 ? -1.0f : 1.0f;
        float change = (right * part_x[x] + down * part_y[x])
                       + right * (down * part_d[x]);
        float share = 1.0f + change;
        float shifted = own[x] - change * mean[x];
        float dn = (share * own[x] + additive * shifted) / (share * share + additive);
        detail[x] = dn - mean[x];
        power[x] = trust[x] * (detail[x] * detail[x]);
    }
}

/* Binomial sum (1, 2, 1) along a row, of values that are step apart. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_beside(
    const float *restrict in, ptrdiff_t step, ptrdiff_t w, float *restrict out)
{
    for (ptrdiff_t x = 0; x < w; x++)
        out[x] = (in[x - step] + in[x + step]) + 2.0f * in[x];
}

/* What 3x3 means have more than the mean of nine of them, two pixels apart, from three
   rows of sums along rows; and its square. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_coarse(
    const float *restrict mean, const float *const *sums, ptrdiff_t w,
    float *restrict coarse, float *restrict power)
{
    const float *restrict a = sums[0], *restrict b = sums[1], *restrict c = sums[2];
    for (ptrdiff_t x = 0; x < w; x++) {
        coarse[x] = mean[x] - 0.0625f * ((a[x] + c[x]) + 2.0f * b[x]);
        power[x] = coarse[x] * coarse[x];
    }
}

/* Multiply what means have more by 1 - N / D, as guided_row does with detail. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_smooth(
    const float *restrict coarse, const float *const *power,
    const float *restrict least, float noise, ptrdiff_t w, float *restrict mean)
{
    const float *restrict a = power[0], *restrict b = power[1], *restrict c = power[2];
    for (ptrdiff_t x = 0; x < w; x++) {
        float square_mean = 0.0625f * ((a[x] + c[x]) + 2.0f * b[x]);
        float left = noise * (least[x] * (mean[x] * mean[x])) / (square_mean + 1e-30f);
        mean[x] -= (left < 1.0f ? left : 1.0f) * coarse[x];
    }
}

/* Four channels of a row, by place in the cell, from its 3x3 means, the detail of the
   mean, and the ratios of the differences to it.  The detail is multiplied by
   1 - N / D, at least 0 (a Wiener filter): D is its mean square over 3x3 pixels (power
   over trust, each summed along three rows), N the variance of noise in it, taken as
   noise times the relative variance that the fits left of the differences. */
PDAVIS_CLONES PDAVIS_UNUSED static void guided_row(
    const float *restrict mean, const float *restrict detail, const float *const *power,
    const float *const *trust, const float *restrict least, float noise,
    const float *restrict part_x, const float *restrict part_y,
    const float *restrict part_d, ptrdiff_t w, float *restrict to0, float *restrict to1,
    float *restrict to2, float *restrict to3)
{
    const float *restrict d0 = power[0], *restrict d1 = power[1], *restrict d2 = power[2];
    const float *restrict t0 = trust[0], *restrict t1 = trust[1], *restrict t2 = trust[2];
    for (ptrdiff_t x = 0; x < w; x++) {
        float ax = part_x[x], ay = part_y[x], ad = part_d[x];
        float square_sum = (d0[x] + d2[x]) + 2.0f * d1[x];
        float trusted = (t0[x] + t2[x]) + 2.0f * t1[x];
        float noisy = trusted * (noise * (least[x] * (mean[x] * mean[x])));
        float taken = 1.0f - noisy / (square_sum + 1e-30f * trusted);
        float dn = mean[x] + (taken > 0.0f ? taken : 0.0f) * detail[x];
        float plus = ay + ad, minus = ay - ad;
        to0[x] = dn * ((1.0f + ax) + plus);
        to1[x] = dn * ((1.0f - ax) + minus);
        to2[x] = dn * ((1.0f + ax) - plus);
        to3[x] = dn * ((1.0f - ax) - minus);
    }
}

#endif
