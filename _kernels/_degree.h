/* The degree of polarization that lasts, and images whose own is weighed against it. */
#ifndef PDAVIS_CV_DEGREE_H
#define PDAVIS_CV_DEGREE_H

#include "_channels.h"

/* Macropixels that are computed together. */
#define PDAVIS_CELLS 64
/* Numbers of an analyser, and its parts at place k: solution, responses, null vector. */
#define PDAVIS_ANALYSER 24
#define PDAVIS_S(j) g->analyser[3 * k + (j)][i]
#define PDAVIS_A(j) g->analyser[12 + 2 * k + (j) - 1][i]
#define PDAVIS_NULL g->analyser[20 + k][i]
/* Squared difference of the two degrees, relative to its variance, at which the one that
   lasts has half of its weight: 3 sigma, the usual bound of an outlier. */
#define DOUBTFUL 9.0f
/* Bounds of the factors of the degree, and of an intensity: far beyond what a difference
   of 3 sigma asks for where the degree is ten sigma; they keep intensities positive. */
#define DEGREE_LEAST 0.5f
#define DEGREE_MOST 2.0f
#define LIGHT_LEAST 0.05f

/* Macropixels: light and the variance of its logarithm by place; degree that lasts, its variance,
   its share; analyser: by place S0, S1 and S2 per intensity, the responses
   to S1 and S2, and the null vector. */
typedef struct {
    float light[4][PDAVIS_CELLS], variance[4][PDAVIS_CELLS];
    float degree[PDAVIS_CELLS], spread[PDAVIS_CELLS], share[PDAVIS_CELLS];
    float analyser[PDAVIS_ANALYSER][PDAVIS_CELLS];
} cells_t;

/* Mark with 1 the n macropixels of two rows whose degree counts, and that are valid (1)
   at all four places. */
PDAVIS_CLONES PDAVIS_UNUSED static void mark_lasting(
    const float *restrict share, const unsigned char *restrict upper,
    const unsigned char *restrict lower, ptrdiff_t n, unsigned char *restrict marks)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        marks[i] = upper[2 * i] & upper[2 * i + 1] & lower[2 * i] & lower[2 * i + 1]
            & (share[i] > 0.0f);
}

/* Copy two rows of pixels to the places of n macropixels. */
PDAVIS_INLINE void to_places(
    const float *restrict upper, const float *restrict lower, ptrdiff_t n,
    float *restrict p0, float *restrict p1, float *restrict p2, float *restrict p3)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        p0[i] = upper[2 * i];
        p1[i] = upper[2 * i + 1];
        p2[i] = lower[2 * i];
        p3[i] = lower[2 * i + 1];
    }
}

/* The other way. */
PDAVIS_INLINE void from_places(
    const float *restrict p0, const float *restrict p1, const float *restrict p2,
    const float *restrict p3, ptrdiff_t n, float *restrict upper, float *restrict lower)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        upper[2 * i] = p0[i];
        upper[2 * i + 1] = p1[i];
        lower[2 * i] = p2[i];
        lower[2 * i + 1] = p3[i];
    }
}

/* Change the light of n macropixels, in proportion to S1 and S2, so that the
   degree of polarization becomes the mean of its own and the one that lasts, weighted by
   their inverse variances. */
PDAVIS_CLONES PDAVIS_UNUSED static void weigh_degree(cells_t *restrict g, ptrdiff_t n)
{
    float power[4][PDAVIS_CELLS], more[PDAVIS_CELLS];
    float s1_of[PDAVIS_CELLS], s2_of[PDAVIS_CELLS];
    ptrdiff_t i;
    int k;
    /* Three short loops: a long one waits for its own results. */
    for (k = 0; k < 4; k++)
        for (i = 0; i < n; i++) {
            float q = g->light[k][i];
            power[k][i] = g->variance[k][i] * q * q;
        }
    for (i = 0; i < n; i++) {
        float gap = 0.0f, total = NO_LIGHT, s0 = 0.0f, cross = 0.0f, variance = 0.0f;
        float length, per_length, per_s0, own, u1, u2, apart, per_sum, weight, factor;
        float s1 = 0.0f, s2 = 0.0f;
        for (k = 0; k < 4; k++) {
            gap += PDAVIS_NULL * g->light[k][i];
            total += PDAVIS_NULL * PDAVIS_NULL * power[k][i];
        }
        total = 1.0f / total;       /* divisions take most of the time */
        gap *= total;
        for (k = 0; k < 4; k++) {       /* as `reconcile` */
            float q = g->light[k][i] - power[k][i] * PDAVIS_NULL * gap;
            s0 += PDAVIS_S(0) * q;
            s1 += PDAVIS_S(1) * q;
            s2 += PDAVIS_S(2) * q;
        }
        s0 = s0 > NO_LIGHT ? s0 : NO_LIGHT;
        length = NO_LIGHT + sqrtf(s1 * s1 + s2 * s2);
        per_s0 = 1.0f / s0;
        per_length = 1.0f / length;
        own = length * per_s0;
        u1 = s1 * per_length;
        u2 = s2 * per_length;
        for (k = 0; k < 4; k++) {
            float slope = per_s0 * (
                u1 * PDAVIS_S(1) + u2 * PDAVIS_S(2) - own * PDAVIS_S(0));
            variance += slope * slope * power[k][i];
            cross += slope * PDAVIS_NULL * power[k][i];
        }
        variance -= cross * cross * total;
        variance = variance > 0.0f ? variance : 0.0f;
        apart = g->degree[i] - own;
        per_sum = 1.0f / (NO_LIGHT + variance + g->spread[i]);
        weight = apart * apart * per_sum * (1.0f / DOUBTFUL);
        weight = g->share[i] * variance * per_sum / (1.0f + weight * weight);
        factor = 1.0f + weight * apart * s0 * per_length;
        factor = factor > DEGREE_LEAST ? factor : DEGREE_LEAST;
        more[i] = (factor < DEGREE_MOST ? factor : DEGREE_MOST) - 1.0f;
        s1_of[i] = s1;
        s2_of[i] = s2;
    }
    for (k = 0; k < 4; k++)
        for (i = 0; i < n; i++) {
            float old = g->light[k][i], least = LIGHT_LEAST * old;
            float q = old + more[i] * (PDAVIS_A(1) * s1_of[i] + PDAVIS_A(2) * s2_of[i]);
            g->light[k][i] = q > least ? q : least;
        }
}

#endif
