/* exp of a row, and rows of leaky integrators. */
#ifndef PDAVIS_CV_CURVES_H
#define PDAVIS_CV_CURVES_H

#include "_clones.h"
#include "_math.h"

/* Cells per block: a multiple of the floats in a vector. */
#define PDAVIS_LEAKS 32

PDAVIS_CLONES PDAVIS_UNUSED static void exp_row(
    const float *restrict x, ptrdiff_t n, float *restrict out)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        out[i] = pd_exp(x[i]);
}

/* Unpack m cells (cell_t in _leaky.pyx) of three 64-bit words: time, value, and in the
   lower half of the third the rate.  From loads of words the compiler makes shuffles,
   from loads of fields it does not. */
PDAVIS_INLINE void take_apart(
    const int64_t *restrict word, ptrdiff_t m, double *restrict t,
    double *restrict value, float *restrict rate)
{
    int64_t part[3][PDAVIS_LEAKS];
    int32_t low[PDAVIS_LEAKS];
    ptrdiff_t i;
    for (i = 0; i < m; i++) {
        part[0][i] = word[3 * i];
        part[1][i] = word[3 * i + 1];
        part[2][i] = word[3 * i + 2];
    }
    for (i = 0; i < m; i++)
        low[i] = (int32_t)part[2][i];
    memcpy(t, part[0], m * sizeof *t);
    memcpy(value, part[1], m * sizeof *value);
    memcpy(rate, low, m * sizeof *rate);
}

PDAVIS_INLINE void leak_block(
    const int64_t *restrict word, const float *restrict base, double now, ptrdiff_t m,
    float *restrict out)
{
    double t[PDAVIS_LEAKS], value[PDAVIS_LEAKS];
    float rate[PDAVIS_LEAKS], fall[PDAVIS_LEAKS];
    ptrdiff_t i;
    take_apart(word, m, t, value, rate);
    for (i = 0; i < m; i++)
        fall[i] = pd_expm1(-(rate[i] * (float)(now - t[i])));
    for (i = 0; i < m; i++)
        out[i] = (float)(base[i] + (value[i] + value[i] * fall[i]));
}

/* base + value decayed to now; the cells are not updated. */
PDAVIS_CLONES PDAVIS_UNUSED static void leak_row(
    const int64_t *restrict word, const float *restrict base, double now, ptrdiff_t n,
    float *restrict out)
{
    ptrdiff_t at;
    for (at = 0; at + PDAVIS_LEAKS <= n; at += PDAVIS_LEAKS)
        leak_block(word + 3 * at, base + at, now, PDAVIS_LEAKS, out + at);
    if (at < n)
        leak_block(word + 3 * at, base + at, now, n - at, out + at);
}

PDAVIS_CLONES PDAVIS_UNUSED static void add_row(
    const float *restrict of, ptrdiff_t n, float *restrict to)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        to[i] += of[i];
}

PDAVIS_CLONES PDAVIS_UNUSED static void divide_row(
    const float *restrict by, ptrdiff_t n, float *restrict to)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        to[i] /= by[i];
}

#endif
