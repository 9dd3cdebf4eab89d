/* What a pixel's sums tell of the light behind a turning analyser, a row at a time. */
#ifndef PDAVIS_CV_TURNING_H
#define PDAVIS_CV_TURNING_H

#include "_clones.h"
#include "_math.h"
#include "_prefetch.h"

#define PDAVIS_LANES 16         /* pixels or events that are computed together */
#define PDAVIS_CHUNK 2048       /* pixels among which they are found */
#define TWO_PI 6.283185307179586
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
#define DARKEST 0.02f           /* of 1 + q: least intensity in a weight, relative */
#define FEW 0.8f                /* most that an event fades those before it: where fewer
                                   than some five come in a window, it is longer */
#define GUESS 0.0256f           /* weight of a row of the middle of a gap: its level is
                                   known to 0.25 thresholds, an event's to 0.04 */
#define OUTLIER 0.25f           /* residual that halves a row's weight, thresholds */
#define MOST_ROWS 1024.0f       /* of the lasting sums, which then stay */
#define RATIO 2                 /* of the time constants of `rest` and of q */

/* What an image needs: 64 bytes without gaps. */
typedef struct {
    double t;                   /* of the last event, us */
    float s1, s2;               /* fading sums of rows times their errors before they
                                   were added */
    float a11, a12, a22, b1, b2, yy, n;         /* fading sums */
    float scale;                /* error of ln threshold */
    float on, off;              /* exp of half the thresholds */
    float sign;                 /* of the last event; 0 before the first */
    float rest;                 /* ln of what changed and is no modulation; it fades */
} turning_cell_t;

/* The rest: as much. */
typedef struct {
    float c, s;                 /* cos 2a, sin 2a at the last event */
    float l11, l12, l22, m1, m2, zz;            /* sums that do not fade */
    float n1, g1, h1, y1;       /* of ON rows */
    float n0, g0, h0, y0;       /* of OFF rows */
} turning_lasting_t;

/* Events of as many pixels, and the fading sums of a cell. */
enum { S1, S2, A11, A12, A22, B1, B2, YY, SUMS, OWN = 4 };
typedef float turning_lanes_t[PDAVIS_LANES];
typedef struct {
    ptrdiff_t at[PDAVIS_LANES];         /* their pixels */
    double t[PDAVIS_LANES], rate[PDAVIS_LANES];         /* us; turns of a per us */
    turning_lanes_t c, s, sign;         /* cos 2a, sin 2a; +-1 */
} turning_rows_t;

PDAVIS_INLINE float larger(float a, float b)
{
    return a > b ? a : b;
}

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

/* Cosine and sine of so many turns, within 3e-7: cephes' cosf and sinf. */
PDAVIS_INLINE void turning_circle(double turns, float *cosine, float *sine)
{
    const double whole = 6755399441055744.0;    /* 1.5 2^52: adding it rounds */
    float x = 4.0f * (float)(turns - ((turns + whole) - whole));
    float quarters = x + 12582912.0f, r, z, c, s;
    int32_t turn = bits_of(quarters), odd = -(turn & 1);
    r = (x - (quarters - 12582912.0f)) * 1.57079633f;
    z = r * r;
    s = r + r * z * (-1.6666654611e-1f + z * (8.3321608736e-3f
                                              - z * 1.9515295891e-4f));
    c = 1.0f - 0.5f * z + z * z * (4.166664568298827e-2f + z * (
        -1.388731625493765e-3f + z * 2.443315711809948e-5f));
    z = pick(odd, c, s);
    c = pick(odd, s, c);
    *sine = turn & 2 ? -z : z;
    *cosine = (turn + 1) & 2 ? -c : c;
}

/* The intensity in units of S0/2. */
PDAVIS_INLINE float turning_light(float q1, float q2, float c, float s)
{
    return larger(1.0f + q1 * c + q2 * s, DARKEST);
}

/* From what each event or pixel has of n things to n things of all of them, or back. */
#define TURN(to, from, n) \
    for (i = 0; i < PDAVIS_LANES; i++) \
        for (j = 0; j < (n); j++) \
            to = from

/* Add m events: the row of each that has a predecessor, and one of the middle of the
   gap.  per_tau: rate of the slower decay per us. */
PDAVIS_CLONES PDAVIS_UNUSED static void turning_rows(
    const turning_rows_t *restrict e, int m, float per_tau, float share,
    turning_cell_t *restrict cells, turning_lasting_t *restrict lasting)
{
    double halves[PDAVIS_LANES];        /* half of what 2a moved since then, turns */
    turning_lanes_t gap, cosine, sine, roots, last, count, rest, room;
    turning_lanes_t sums[SUMS], stays[SUMS], own[OWN];
    float of[PDAVIS_LANES][SUMS], stay[PDAVIS_LANES][SUMS], mine[PDAVIS_LANES][OWN];
    int i, j;
    for (i = 0; i < PDAVIS_LANES; i++) {
        const turning_cell_t *cell = &cells[e->at[i]];
        const turning_lasting_t *old = &lasting[e->at[i]];
        memcpy(of[i], &cell->s1, sizeof of[i]);
        gap[i] = (float)(e->t[i] - cell->t);
        halves[i] = (e->t[i] - cell->t) * e->rate[i];
        cosine[i] = old->c;
        sine[i] = old->s;
        roots[i] = (&cell->on)[e->sign[i] < 0.0f];
        last[i] = cell->sign;
        count[i] = cell->n;
        rest[i] = cell->rest;
        room[i] = MOST_ROWS - (old->n1 + old->n0);
    }
    TURN(sums[j][i], of[i][j], SUMS);
    for (i = 0; i < PDAVIS_LANES; i++) {
        float slow = pd_exp(gap[i] * per_tau), fast = slow * slow;
        float fade = larger(fast, FEW), c0 = cosine[i], s0 = sine[i];
        float had = last[i] != 0.0f ? 1.0f : 0.0f;      /* a predecessor */
        float root = roots[i], inverse = 1.0f / root, step = root - inverse;
        float y = e->sign[i] * step, ridge = step * (ROW_FLOOR / WIDE);
        float q1, q2, here, before, cm, sm, gm, hm, g, h, half, w;
        float wg, wh, error, most, k;
        ridge *= ridge;
        for (j = 0; j < SUMS; j++)
            sums[j][i] *= fade;
        turning_solve(sums[A11][i] + ridge, sums[A12][i], sums[A22][i] + ridge,
                      sums[B1][i], sums[B2][i], &q1, &q2);
        here = turning_light(q1, q2, e->c[i], e->s[i]);
        before = turning_light(q1, q2, c0, s0);
        /* The middle of the gap: half the step, none where the polarity reversed. */
        turning_circle(halves[i], &cm, &sm);
        gm = c0 * cm - s0 * sm;
        hm = s0 * cm + c0 * sm;
        w = had * GUESS * share / (before * turning_light(q1, q2, gm, hm));
        half = e->sign[i] == last[i] ? 0.25f * y : 0.0f;    /* of ln I to each side */
        gm = gm - c0 - half * (gm + c0);
        hm = hm - s0 - half * (hm + s0);
        half *= 2.0f;
        wg = w * gm;
        wh = w * hm;
        /* The event itself, as exp(-ln step / 2) I - exp(ln step / 2) I before. */
        k = had / sqrtf(here * before);
        most = e->sign[i] > 0.0f ? root : inverse;
        inverse = e->sign[i] > 0.0f ? inverse : root;
        g = (e->c[i] * inverse - c0 * most) * k;
        h = (e->s[i] * inverse - s0 * most) * k;
        most = OUTLIER * y;
        y *= k;
        error = y - g * q1 - h * q2;
        sums[A11][i] += wg * gm + g * g;
        sums[A12][i] += wg * hm + g * h;
        sums[A22][i] += wh * hm + h * h;
        sums[B1][i] += wg * half + g * y;
        sums[B2][i] += wh * half + h * y;
        sums[YY][i] += w * half * half + y * y;
        sums[S1][i] += g * error;
        sums[S2][i] += h * error;
        count[i] = count[i] * fade + had;
        /* In the lasting sums an event that was noise has less weight. */
        k = most * most;
        k = room[i] > 0.0f ? had * k / (k + error * error) : 0.0f;
        most = 2.0f * step;
        w = error < most ? error : most;
        rest[i] = rest[i] * slow + (w > -most ? w : -most);
        wg = k * g;
        wh = k * h;
        stays[0][i] = e->c[i] - c0;
        stays[1][i] = e->s[i] - s0;
        stays[2][i] = wg * g;
        stays[3][i] = wg * h;
        stays[4][i] = wh * h;
        stays[5][i] = wg * y;
        stays[6][i] = wh * y;
        stays[7][i] = k * y * y;
        own[0][i] = k;
        own[1][i] = wg;
        own[2][i] = wh;
        own[3][i] = k * y;
    }
    TURN(of[i][j], sums[j][i], SUMS);
    TURN(stay[i][j], stays[j][i], SUMS);
    TURN(mine[i][j], own[j][i], OWN);
    for (i = 0; i < m; i++) {
        turning_cell_t *cell = &cells[e->at[i]];
        turning_lasting_t *old = &lasting[e->at[i]];
        float *polarity = &old->n1 + OWN * (e->sign[i] < 0.0f);
        memcpy(&cell->s1, of[i], sizeof of[i]);
        cell->t = e->t[i];
        cell->n = count[i];
        cell->rest = rest[i];
        cell->sign = e->sign[i];
        for (j = 0; j < SUMS; j++)
            stay[i][j] += (&old->c)[j];
        for (j = 0; j < OWN; j++)
            mine[i][j] += polarity[j];
        memcpy(&old->c, stay[i], sizeof stay[i]);
        memcpy(polarity, mine[i], sizeof mine[i]);
    }
}

enum { I0, I45, I90, I135, AOP, DOLP, ACROSS, PLANES };

/* Write I0 to I135 and errors of AoP, DoLP and q across its direction of up to
   PDAVIS_LANES of the m pixels at.  half_us: half a turn; decay: rate of the slower
   decay per us; late: part of the drift of q that is its error; common: relative error
   that all thresholds have in common; level: what ln S0 is relative to. */
PDAVIS_INLINE void turning_block(
    double t, float half_us, float decay, float late, float common,
    const turning_cell_t *restrict cells, const float *restrict level, ptrdiff_t n,
    const int32_t *restrict at, int m, float *restrict planes,
    unsigned char *restrict valid)
{
    enum { N = SUMS, SCALE, ON, OFF, SIGN, REST, WORDS = 16 };
    float of[PDAVIS_LANES][WORDS], words[WORDS][PDAVIS_LANES];
    float (*f)[PDAVIS_LANES] = words + 2, out[PLANES][PDAVIS_LANES];   /* after t */
    turning_lanes_t age, zero;
    int known[PDAVIS_LANES], i, j, k;
    for (i = 0; i < PDAVIS_LANES; i++) {
        /* Behind the last there are others, or pixel 0. */
        const turning_cell_t *cell = &cells[at[i]];
        PDAVIS_PREFETCH(&cells[at[i + PDAVIS_LANES]]);
        age[i] = larger((float)(t - cell->t), 0.0f);
        zero[i] = level[at[i]];
        memcpy(of[i], cell, sizeof of[i]);
    }
    TURN(words[j][i], of[i][j], WORDS);
    for (i = 0; i < PDAVIS_LANES; i++) {
        float slow = pd_exp(age[i] * decay), gone = slow * slow;
        float theta = 0.5f * (f[ON][i] - 1.0f / f[ON][i] + f[OFF][i] - 1.0f / f[OFF][i]);
        float floor = ROW_FLOOR * ROW_FLOOR * theta * theta;
        float a11 = f[A11][i] * gone, a12 = f[A12][i] * gone, a22 = f[A22][i] * gone;
        float b1 = f[B1][i] * gone, b2 = f[B2][i] * gone, n = f[N][i] * gone;
        float ridge = floor / (WIDE * WIDE), q1, q2, det, left, ratio, variance;
        float degree, per, c, s, d1, d2, both, along, square, half, angle;
        /* No event in a whole period: a swing below one threshold. */
        ridge += age[i] > half_us ? ROW_FLOOR * ROW_FLOOR / (SILENT * SILENT) : 0.0f;
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
        det *= gone * late;
        d1 = (a22 * f[S1][i] - a12 * f[S2][i]) * det;
        d2 = (a11 * f[S2][i] - a12 * f[S1][i]) * det;
        both = 2.0f * a12 * c * s;
        along = d1 * c + d2 * s;
        along = larger(variance * (a22 * c * c + a11 * s * s - both), along * along);
        square = d2 * c - d1 * s;
        square = sqrtf(larger(variance * (a22 * s * s + a11 * c * c + both),
                              square * square));
        out[ACROSS][i] = square;
        angle = 0.5f * square * per;
        out[AOP][i] = angle < MOST_ANGLE ? angle : MOST_ANGLE;
        known[i] = (n > LEAST_ROWS) & (along < UNKNOWN * UNKNOWN) & (angle < UNSURE);
        /* A common factor of the thresholds multiplies atanh of the degree: its series,
           the last term for all that follow. */
        square = degree < 1.0f ? degree * degree : 1.0f;
        square = degree * (1.0f - square) * (1.0f + square * (
            1.0f / 3.0f + square * (0.2f + square * 0.35f)));
        out[DOLP][i] = sqrtf(along + square * square * (
            f[SCALE][i] * f[SCALE][i] + common * common));
        half = 0.5f * pd_exp(zero[i] + f[REST][i] * slow);
        out[I0][i] = half * (1.0f + q1);
        out[I45][i] = half * (1.0f + q2);
        out[I90][i] = half * (1.0f - q1);
        out[I135][i] = half * (1.0f - q2);
    }
    for (i = 0; i < m && i < PDAVIS_LANES; i++) {
        valid[at[i]] = known[i];
        for (k = 0; k < PLANES; k++)
            planes[k * n + at[i]] = out[k][i];
    }
}

/* As turning_block of the pixels that have been seen; of the others n know nothing. */
PDAVIS_CLONES PDAVIS_UNUSED static void turning_pixels(
    double t, float half_us, float decay, float late, float common,
    const turning_cell_t *restrict cells, const unsigned char *restrict seen,
    const float *restrict level, ptrdiff_t n, float *restrict planes,
    unsigned char *restrict valid)
{
    static const float unknown[PLANES] = {0, 0, 0, 0, MOST_ANGLE, WIDE, WIDE};
    int32_t at[PDAVIS_CHUNK + PDAVIS_LANES] = {0};
    ptrdiff_t first, last, i;
    int m, k;
    for (first = 0; first < n; first = last) {
        last = n - first < PDAVIS_CHUNK ? n : first + PDAVIS_CHUNK;
        for (i = first; i < last; i++)
            planes[i] = 0.5f * pd_exp(level[i]);
        for (k = I45; k < PLANES; k++)
            for (i = first; i < last; i++)
                planes[k * n + i] = k < AOP ? planes[i] : unknown[k];
        for (i = first, m = 0; i < last; i++) {
            valid[i] = 0;
            at[m] = (int32_t)i;
            m += seen[i] != 0;
        }
        for (k = 0; k < m; k += PDAVIS_LANES)
            turning_block(t, half_us, decay, late, common, cells, level, n, at + k,
                          m - k, planes, valid);
    }
}

#endif
