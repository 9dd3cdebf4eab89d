/* exp of a row, and a row of leaky pixels. */
#ifndef PDAVIS_CV_CURVES_H
#define PDAVIS_CV_CURVES_H

#include "_clones.h"
#include "_math.h"

/* Pixels that are taken apart at once: their exponentials fill whole vectors. */
#define PDAVIS_LEAKS 32

/* See cell_t in _leaky.pyx. */
typedef struct { double t, value; float rate, unused; } pd_leaky;

PDAVIS_CLONES PDAVIS_UNUSED static void exp_row(
    const float *restrict x, ptrdiff_t n, float *restrict out)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        out[i] = pd_exp(x[i]);
}

/* base + value decayed to t, of pixels that stay as they are. */
PDAVIS_CLONES PDAVIS_UNUSED static void leak_row(
    const pd_leaky *restrict cell, const float *restrict base, double t, ptrdiff_t n,
    float *restrict out)
{
    float fall[PDAVIS_LEAKS];
    ptrdiff_t from, i;
    for (from = 0; from < n; from += PDAVIS_LEAKS) {
        ptrdiff_t m = n - from < PDAVIS_LEAKS ? n - from : PDAVIS_LEAKS;
        for (i = 0; i < m; i++)
            fall[i] = -(cell[from + i].rate * (float)(t - cell[from + i].t));
        for (i = 0; i < m; i++)
            fall[i] = pd_expm1(fall[i]);
        for (i = 0; i < m; i++) {
            double v = cell[from + i].value;
            out[from + i] = (float)(base[from + i] + (v + v * fall[i]));
        }
    }
}

#endif
