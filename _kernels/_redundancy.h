/* Gains of groups of macropixels, from the moments of their weighted intensities.

   The gains are the eigenvector of the smallest eigenvalue of a symmetric 4x4 matrix,
   which Jacobi rotations make diagonal.  Each matrix element has a row of its own, as
   in _measure.h, so that a processor handles several macropixels in one instruction. */
#ifndef PDAVIS_CV_REDUNDANCY_H
#define PDAVIS_CV_REDUNDANCY_H

#include "_clones.h"
#include "_math.h"

#define CHANNEL_SHARE 0.25      /* of each channel in the mean of four */
#define GAIN_LEAST 0.02         /* least gain of a unit vector that counts as > 0 */
#define ROUNDED 1e-14           /* an off-diagonal element below this is 0 */
#define DEAD 1e-12              /* a pixel below this share of moments is dark */
#define SWEEPS 6                /* Jacobi sweeps, after which 4x4 has converged */
#define RATIO_LEAST 1e-6        /* lower bound of an eigenvalue, by rounding */

enum {
    CELLS = 16,                 /* macropixels of one cells_t */
    PRODUCTS = 10               /* elements of a symmetric 4x4 matrix */
};

typedef struct {
    /* Moments, upper triangle by rows; in the end scaled to gains of 1. */
    double product[PRODUCTS][CELLS];
    double weight[CELLS];       /* weight of the moments */
    /* Results: what makes the gains 1 if it is added to the log intensities. */
    double shift[4][CELLS];
    double ratio[CELLS];        /* ratio of the two smallest eigenvalues, 1: no gains */
    double smallest[CELLS];     /* smallest eigenvalue, a relative variance, 1: none */
    /* The matrix and its eigenvectors, by rows; cosine and sine of a rotation. */
    double a[16][CELLS], v[16][CELLS], c[CELLS], s[CELLS];
    double scale[4][CELLS], gain[4][CELLS];
    double found[CELLS];        /* 1 if there are gains, else 0 */
} cells_t;

/* Apply a Jacobi rotation to rows and columns p and q; return how many matrices turn.

   A matrix whose element is 0 already is rotated by an angle of 0, which changes no
   bit. */
PDAVIS_INLINE double rotate_cells(cells_t *restrict g, const int p, const int q)
{
    double turning = 0.0;
    ptrdiff_t i;
    int k;
    for (i = 0; i < CELLS; i++) {
        double off = g->a[4 * p + q][i], theta, t, c, turns;
        turns = fabs(off) < ROUNDED ? 0.0 : 1.0;
        theta = 0.5 * (g->a[5 * q][i] - g->a[5 * p][i]) / off;
        t = 1.0 / (fabs(theta) + sqrt(theta * theta + 1.0));
        t = theta >= 0.0 ? t : -t;
        c = 1.0 / sqrt(t * t + 1.0);
        g->c[i] = turns > 0.0 ? c : 1.0;
        g->s[i] = turns > 0.0 ? t * c : 0.0;
        turning += turns;
    }
    if (turning == 0.0)
        return 0.0;
    for (k = 0; k < 4; k++)
        for (i = 0; i < CELLS; i++) {
            double x = g->a[4 * k + p][i], y = g->a[4 * k + q][i];
            g->a[4 * k + p][i] = g->c[i] * x - g->s[i] * y;
            g->a[4 * k + q][i] = g->s[i] * x + g->c[i] * y;
        }
    for (k = 0; k < 4; k++)
        for (i = 0; i < CELLS; i++) {
            double x = g->a[4 * p + k][i], y = g->a[4 * q + k][i];
            g->a[4 * p + k][i] = g->c[i] * x - g->s[i] * y;
            g->a[4 * q + k][i] = g->s[i] * x + g->c[i] * y;
            x = g->v[4 * k + p][i];
            y = g->v[4 * k + q][i];
            g->v[4 * k + p][i] = g->c[i] * x - g->s[i] * y;
            g->v[4 * k + q][i] = g->s[i] * x + g->c[i] * y;
        }
    return turning;
}

/* Set matrix (scaled to a diagonal of 1, and with the ridge) and eigenvectors. */
PDAVIS_INLINE void begin_cells(cells_t *restrict g, double pull)
{
    ptrdiff_t n;
    int i, j, k;
    for (n = 0; n < CELLS; n++)
        g->found[n] = 1.0;
    for (i = k = 0; i < 4; k += 4 - i, i++)
        for (n = 0; n < CELLS; n++) {
            double own = g->product[k][n];
            int dark = own <= DEAD * g->weight[n];
            g->scale[i][n] = dark ? 0.0 : 1.0 / sqrt(own);
            g->found[n] = dark ? 0.0 : g->found[n];
        }
    for (i = k = 0; i < 4; i++)
        for (j = i; j < 4; j++, k++)
            for (n = 0; n < CELLS; n++) {
                double one = g->product[k][n] * g->scale[i][n] * g->scale[j][n]
                    - CHANNEL_SHARE * pull;
                g->a[4 * i + j][n] = g->a[4 * j + i][n] = i == j ? one + pull : one;
                g->v[4 * i + j][n] = g->v[4 * j + i][n] = i == j ? 1.0 : 0.0;
            }
}

/* Set the gains and the two smallest eigenvalues from the diagonal matrix. */
PDAVIS_INLINE void choose_cells(cells_t *restrict g, double pull)
{
    ptrdiff_t n;
    int i, k;
    for (n = 0; n < CELLS; n++) {
        double low = g->a[0][n], other = g->a[5][n], sign = 0.0, gain[4];
        for (k = 0; k < 4; k++)
            gain[k] = g->v[4 * k][n];
        for (i = 1; i < 4; i++) {
            double one = g->a[5 * i][n];
            int less = one < low;
            /* The second smallest: the former smallest, or this one. */
            double next = less ? low : one;
            other = i == 1 || next < other ? next : other;
            low = less ? one : low;
            for (k = 0; k < 4; k++)
                gain[k] = less ? g->v[4 * k + i][n] : gain[k];
        }
        for (k = 0; k < 4; k++)
            sign += gain[k];
        for (k = 0; k < 4; k++) {
            double one = sign > 0.0 ? gain[k] : -gain[k];
            g->found[n] = one < GAIN_LEAST ? 0.0 : g->found[n];
            g->gain[k][n] = one * g->scale[k][n];
        }
        low = low > RATIO_LEAST ? low : RATIO_LEAST;
        other -= pull;              /* without the ridge */
        g->smallest[n] = g->found[n] > 0.0 ? low : 1.0;
        g->ratio[n] = g->found[n] > 0.0 && other > low ? low / other : 1.0;
    }
}

/* Find the gains of CELLS macropixels, and scale their moments to gains of 1. */
PDAVIS_CLONES PDAVIS_UNUSED static void solve_cells(cells_t *restrict g, double pull)
{
    double turning = 1.0;
    ptrdiff_t n;
    int i, j, k;
    begin_cells(g, pull);
    for (k = 0; k < SWEEPS && turning > 0.0; k++) {
        turning = rotate_cells(g, 0, 1);
        turning += rotate_cells(g, 0, 2);
        turning += rotate_cells(g, 0, 3);
        turning += rotate_cells(g, 1, 2);
        turning += rotate_cells(g, 1, 3);
        turning += rotate_cells(g, 2, 3);
    }
    choose_cells(g, pull);
    for (n = 0; n < CELLS; n++) {
        double mean = 0.0;
        for (i = 0; i < 4; i++) {
            g->shift[i][n] = pd_log((float)(g->found[n] > 0.0 ? g->gain[i][n] : 1.0));
            mean += CHANNEL_SHARE * g->shift[i][n];
        }
        for (i = 0; i < 4; i++) {
            g->shift[i][n] -= mean;
            g->gain[i][n] = pd_exp((float)g->shift[i][n]);
        }
    }
    for (i = k = 0; i < 4; i++)
        for (j = i; j < 4; j++, k++)
            for (n = 0; n < CELLS; n++)
                g->product[k][n] *= g->gain[i][n] * g->gain[j][n];
}

#endif
