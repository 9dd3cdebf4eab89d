/* Variance by mismatch, and reconciliation, of the four channels, row by row. */
#ifndef PDAVIS_CV_CHANNELS_H
#define PDAVIS_CV_CHANNELS_H

#include "_clones.h"

/* Lower bound of a squared intensity, relative to the macropixel's squared sum. */
#define DIM_SHARE 1e-4f
/* Upper bound of the relative variance by errors of angle, contrast and offset. */
#define MISMATCH_MOST 1.0f
#define NO_LIGHT 1e-30f         /* keeps 0 / 0 from being NaN */

/* Add to the variances of ln I those by mismatch.  gain, angle (rad^2), contrast and
   offset (of I) are variances, the third divided by 4. */
PDAVIS_CLONES PDAVIS_UNUSED static void mismatch_row(
    const float *restrict q0, const float *restrict q1, const float *restrict q2,
    const float *restrict q3, float gain, float angle, float contrast, float offset,
    ptrdiff_t n, float *restrict v0, float *restrict v1, float *restrict v2,
    float *restrict v3)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float a = q0[i], b = q1[i], c = q2[i], d = q3[i];
        float least = NO_LIGHT + a + b + c + d, bd = b - d, ac = a - c, v;
        float even, odd;
        least *= least * DIM_SHARE;
        even = offset + angle * bd * bd + contrast * ac * ac;
        odd = offset + angle * ac * ac + contrast * bd * bd;
#define PDAVIS_ADD(q, moved, to)                                                     \
        v = q * q;                                                                   \
        v = v > least ? v : least;                                                   \
        v = moved / v;                                                               \
        to[i] += gain + (v < MISMATCH_MOST ? v : MISMATCH_MOST);
        PDAVIS_ADD(a, even, v0)
        PDAVIS_ADD(b, odd, v1)
        PDAVIS_ADD(c, even, v2)
        PDAVIS_ADD(d, odd, v3)
#undef PDAVIS_ADD
    }
}

/* Project four channels onto null . q = 0, weighted by their inverse variances; step is
   the stride of the null vectors, 0 if all pixels have one. */
PDAVIS_INLINE void reconcile_each(
    float *restrict q0, float *restrict q1, float *restrict q2, float *restrict q3,
    const float *restrict v0, const float *restrict v1, const float *restrict v2,
    const float *restrict v3, const float *restrict n0, const float *restrict n1,
    const float *restrict n2, const float *restrict n3, ptrdiff_t step, ptrdiff_t n)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        ptrdiff_t k = i * step;
        float s0 = q0[i] * q0[i] * v0[i] * n0[k], s1 = q1[i] * q1[i] * v1[i] * n1[k];
        float s2 = q2[i] * q2[i] * v2[i] * n2[k], s3 = q3[i] * q3[i] * v3[i] * n3[k];
        float gap = n0[k] * q0[i] + n1[k] * q1[i] + n2[k] * q2[i] + n3[k] * q3[i];
        float total = NO_LIGHT + n0[k] * s0 + n1[k] * s1 + n2[k] * s2 + n3[k] * s3;
        float part = gap / total;
        q0[i] -= s0 * part;
        q1[i] -= s1 * part;
        q2[i] -= s2 * part;
        q3[i] -= s3 * part;
    }
}

PDAVIS_CLONES PDAVIS_UNUSED static void reconcile_row(
    float *restrict q0, float *restrict q1, float *restrict q2, float *restrict q3,
    const float *restrict v0, const float *restrict v1, const float *restrict v2,
    const float *restrict v3, const float *restrict n0, const float *restrict n1,
    const float *restrict n2, const float *restrict n3, int one, ptrdiff_t n)
{
    if (one)
        reconcile_each(q0, q1, q2, q3, v0, v1, v2, v3, n0, n1, n2, n3, 0, n);
    else
        reconcile_each(q0, q1, q2, q3, v0, v1, v2, v3, n0, n1, n2, n3, 1, n);
}

#endif
