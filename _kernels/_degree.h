/* The degree of polarization that lasts, and images whose own is weighed against it. */
#ifndef PDAVIS_CV_DEGREE_H
#define PDAVIS_CV_DEGREE_H

#include "_channels.h"
#include "_math.h"

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

/* Macropixels: log intensity and its variance by place; degree that lasts, its variance,
   its share (0: not used); analyser: by place S0, S1 and S2 per intensity, the responses
   to S1 and S2, and the null vector. */
typedef struct {
    float log[4][PDAVIS_CELLS], variance[4][PDAVIS_CELLS];
    float degree[PDAVIS_CELLS], spread[PDAVIS_CELLS], share[PDAVIS_CELLS];
    float analyser[PDAVIS_ANALYSER][PDAVIS_CELLS];
} cells_t;

/* Degree of polarization of n macropixels, from log intensities; NaN without light. */
PDAVIS_CLONES PDAVIS_UNUSED static void find_degree(cells_t *restrict g, ptrdiff_t n)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, whole = 0.0f;
        int k;
        for (k = 0; k < 4; k++) {
            float q = pd_exp(g->log[k][i]);
            s0 += PDAVIS_S(0) * q;
            s1 += PDAVIS_S(1) * q;
            s2 += PDAVIS_S(2) * q;
            whole += g->log[k][i];
        }
        s1 = sqrtf(s1 * s1 + s2 * s2) / (s0 > NO_LIGHT ? s0 : NO_LIGHT);
        /* pd_exp takes NaN for a number. */
        g->degree[i] = s0 > NO_LIGHT && whole == whole ? s1 : NAN;
    }
}

/* Change the log intensities of n macropixels, in proportion to S1 and S2, so that the
   degree of polarization becomes the mean of its own and the one that lasts, weighted by
   their inverse variances. */
PDAVIS_CLONES PDAVIS_UNUSED static void weigh_degree(cells_t *restrict g, ptrdiff_t n)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float light[4], power[4], c[4], gap = 0.0f, total = NO_LIGHT;
        float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, cross = 0.0f, variance = 0.0f;
        float length, per_length, per_s0, own, u1, u2, apart, per_sum, weight, more;
        int k;
        for (k = 0; k < 4; k++) {
            light[k] = pd_exp(g->log[k][i]);
            power[k] = g->variance[k][i] * light[k] * light[k];
            c[k] = PDAVIS_NULL;
            gap += c[k] * light[k];
            total += c[k] * c[k] * power[k];
        }
        total = 1.0f / total;       /* divisions take most of the time */
        gap *= total;
        for (k = 0; k < 4; k++) {       /* as `reconcile` */
            float q = light[k] - power[k] * c[k] * gap;
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
            variance += slope * slope * power[k];
            cross += slope * c[k] * power[k];
        }
        variance -= cross * cross * total;
        variance = variance > 0.0f ? variance : 0.0f;
        apart = g->degree[i] - own;
        per_sum = 1.0f / (NO_LIGHT + variance + g->spread[i]);
        weight = apart * apart * per_sum * (1.0f / DOUBTFUL);
        weight = g->share[i] * variance * per_sum / (1.0f + weight * weight);
        more = 1.0f + weight * apart * s0 * per_length;
        more = more > DEGREE_LEAST ? more : DEGREE_LEAST;
        more = (more < DEGREE_MOST ? more : DEGREE_MOST) - 1.0f;
        for (k = 0; k < 4; k++) {
            float q = light[k] + more * (PDAVIS_A(1) * s1 + PDAVIS_A(2) * s2);
            float least = LIGHT_LEAST * light[k];
            g->log[k][i] = pd_log(q > least ? q : least);
        }
    }
}

#endif
