/* What a pixel's sums tell of the light behind a turning analyser, a row at a time. */
#ifndef PDAVIS_CV_TURNING_H
#define PDAVIS_CV_TURNING_H

#include "_clones.h"
#include "_math.h"

#define PDAVIS_PIXELS 64        /* that are computed together */
#define LEAST_DET 1e-20f
#define ROW_FLOOR 0.02f         /* least error of an event's row, thresholds */
#define PRIOR_ROWS 1.0f         /* rows that say that the error is ROW_FLOOR */
#define WIDE 0.5f               /* of q where nothing is known of it */
#define SILENT 0.35f            /* of q after a period without events, thresholds: a
                                   swing, 2 q, of up to one */
#define LEAST_ROWS 1.0f         /* of a usable pixel, */
#define UNKNOWN 0.1f            /* and its most error of DoLP, */
#define UNSURE 0.2f             /* and of AoP */
#define MOST_ANGLE 0.9068997f   /* error of a random angle: pi / sqrt(12) */

/* 128 bytes without gaps; what an image needs are the first 64. */
typedef struct {
    double t;                   /* of the last event, us; -inf before the first */
    float s1, s2;               /* fading sums of rows times their errors before they
                                   were added */
    float on, off;              /* exp of half the thresholds */
    float sign;                 /* of the last event */
    float rest;                 /* ln of what changed and is no modulation; it fades */
    float a11, a12, a22, b1, b2, yy, n;         /* fading sums */
    float scale;                /* error of ln threshold */
    float c, s;                 /* cos 2a, sin 2a at the last event */
    float l11, l12, l22, m1, m2, zz;            /* lasting sums */
    float n1, g1, h1, y1;       /* of ON rows */
    float n0, g0, h0, y0;       /* of OFF rows */
} turning_cell_t;

/* A time, us; half a turn, us; rate of the slower decay per us; part of the drift of q
   that is its error; relative error that all thresholds have in common. */
typedef struct {
    double t;
    float half_us, decay, late, common;
} turning_read_t;

/* Solve for q, at most fully polarized; return 1 / determinant. */
PDAVIS_INLINE float turning_solve(float a11, float a12, float a22, float b1, float b2,
                                  float *q1, float *q2)
{
    float det = a11 * a22 - a12 * a12, length;
    det = 1.0f / (det > LEAST_DET ? det : LEAST_DET);
    *q1 = (a22 * b1 - a12 * b2) * det;
    *q2 = (a11 * b2 - a12 * b1) * det;
    length = *q1 * *q1 + *q2 * *q2;
    length = 1.0f / sqrtf(length > 1.0f ? length : 1.0f);
    *q1 *= length;
    *q2 *= length;
    return det;
}

PDAVIS_INLINE float larger(float a, float b)
{
    return a > b ? a : b;
}

/* Intensities of m <= PDAVIS_PIXELS pixels, and errors of AoP, DoLP and q across its
   direction; level is what ln S0 is relative to. */
PDAVIS_INLINE void turning_block(
    const turning_read_t *restrict now, const turning_cell_t *restrict cell,
    const float *restrict level, ptrdiff_t m, float *restrict i0, float *restrict i45,
    float *restrict i90, float *restrict i135, float *restrict aop,
    float *restrict dolp, float *restrict across, unsigned char *restrict valid)
{
    enum { S1, S2, ON, OFF, SIGN, REST, A11, A12, A22, B1, B2, YY, N, SCALE, FIELDS };
    float f[FIELDS][PDAVIS_PIXELS], age[PDAVIS_PIXELS];
    ptrdiff_t i;
    int k;
    for (i = 0; i < m; i++) {
        const float *restrict word = &cell[i].s1;
        age[i] = larger((float)(now->t - cell[i].t), 0.0f);
        for (k = 0; k < FIELDS; k++)
            f[k][i] = word[k];
    }
    for (i = 0; i < m; i++) {
        float slow = pd_exp(age[i] * now->decay), gone = slow * slow;
        float theta = 0.5f * (f[ON][i] - 1.0f / f[ON][i] + f[OFF][i] - 1.0f / f[OFF][i]);
        float floor = ROW_FLOOR * ROW_FLOOR * theta * theta;
        float a11 = f[A11][i] * gone, a12 = f[A12][i] * gone, a22 = f[A22][i] * gone;
        float b1 = f[B1][i] * gone, b2 = f[B2][i] * gone, n = f[N][i] * gone;
        float ridge = floor / (WIDE * WIDE), q1, q2, det, left, ratio, variance;
        float degree, per, c, s, d1, d2, both, along, square, half, angle;
        /* No event in a whole period: a swing below one threshold. */
        ridge += age[i] > now->half_us && f[SIGN][i] != 0.0f
            ? ROW_FLOOR * ROW_FLOOR / (SILENT * SILENT) : 0.0f;
        turning_solve(a11 + ridge, a12, a22 + ridge, b1, b2, &q1, &q2);
        left = f[YY][i] * gone - 2.0f * (q1 * b1 + q2 * b2) + q1 * q1 * a11
            + 2.0f * q1 * q2 * a12 + q2 * q2 * a22;
        ratio = larger(n, 1.0f);
        ratio /= 2.0f * ratio - 1.0f;
        variance = (larger(left, 0.0f) + PRIOR_ROWS * floor)
            / (larger(n - 2.0f * ratio, 0.0f) + PRIOR_ROWS);
        ridge *= variance / floor;
        a11 += ridge;
        a22 += ridge;
        det = turning_solve(a11, a12, a22, b1, b2, &q1, &q2);
        variance *= ratio * det;
        degree = sqrtf(q1 * q1 + q2 * q2);
        per = 1.0f / larger(degree, 1e-9f);
        c = degree > 0.0f ? q1 * per : 1.0f;
        s = q2 * per;
        /* What q lacked, on average, when its rows came. */
        det *= gone * now->late;
        d1 = (a22 * f[S1][i] - a12 * f[S2][i]) * det;
        d2 = (a11 * f[S2][i] - a12 * f[S1][i]) * det;
        both = 2.0f * a12 * c * s;
        along = d1 * c + d2 * s;
        along = larger(variance * (a22 * c * c + a11 * s * s - both), along * along);
        valid[i] = (n > LEAST_ROWS) & (along < UNKNOWN * UNKNOWN);
        square = d2 * c - d1 * s;
        square = sqrtf(larger(variance * (a22 * s * s + a11 * c * c + both),
                              square * square));
        across[i] = square;
        angle = 0.5f * square * per;
        aop[i] = angle < MOST_ANGLE ? angle : MOST_ANGLE;
        valid[i] &= angle < UNSURE;
        /* A common factor of the thresholds multiplies atanh of the degree: its series,
           the last term for all that follow. */
        square = degree < 1.0f ? degree * degree : 1.0f;
        square = degree * (1.0f - square) * (1.0f + square * (
            1.0f / 3.0f + square * (0.2f + square * 0.35f)));
        dolp[i] = sqrtf(along + square * square * (
            f[SCALE][i] * f[SCALE][i] + now->common * now->common));
        half = 0.5f * pd_exp(level[i] + f[REST][i] * slow);
        i0[i] = half * (1.0f + q1);
        i45[i] = half * (1.0f + q2);
        i90[i] = half * (1.0f - q1);
        i135[i] = half * (1.0f - q2);
    }
}

PDAVIS_CLONES PDAVIS_UNUSED static void turning_row(
    const turning_read_t *restrict now, const turning_cell_t *restrict cell,
    const float *restrict level, ptrdiff_t n, float *restrict i0, float *restrict i45,
    float *restrict i90, float *restrict i135, float *restrict aop,
    float *restrict dolp, float *restrict across, unsigned char *restrict valid)
{
    ptrdiff_t at, m;
    for (at = 0; at < n; at += m) {
        m = n - at < PDAVIS_PIXELS ? n - at : PDAVIS_PIXELS;
        turning_block(now, cell + at, level + at, m, i0 + at, i45 + at, i90 + at,
                      i135 + at, aop + at, dolp + at, across + at, valid + at);
    }
}

#endif
