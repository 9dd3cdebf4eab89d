/* Light of some pixels at the nodes of intervals, and its log, by rows of doubles. */
#ifndef PDAVIS_CV_NODES_H
#define PDAVIS_CV_NODES_H

#include "_clones.h"

enum {
    NODES = 33,             /* most nodes of a block of intervals */
    BESIDE = 16             /* pixels at once, so that nodes_t fits a cache */
};

/* The nodes of a pixel are BESIDE elements apart. */
typedef struct {
    double light[NODES * BESIDE];   /* DN/ms, with the dark current */
    double slope[NODES * BESIDE];   /* per interval */
    double log[NODES * BESIDE];
    double rise[NODES * BESIDE];    /* slope of the log, per interval */
    /* For the interval that ends there, if cutoff and leak are constant: */
    double level[NODES * BESIDE];   /* filtered log at its end */
    double monotonic[NODES * BESIDE];   /* 1: filtered log plus leak is monotonic */
    double drift[BESIDE];           /* change by the leak per interval */
    double flat[BESIDE];            /* 1: the light is constant in some interval */
} nodes_t;

/* The photoreceptor's low-pass: fields as in config_t of _pixel.pxd. */
typedef struct {
    double phi, e, w0, w1, w2, w3;
} nodes_filter_t;

#define NODES_ROUND 6755399441055744.0

/* Natural log of a positive, normal, finite x: as log64 in _double.pxd. */
PDAVIS_INLINE double nodes_log(double x)
{
    int64_t bits, k;
    double f, s, z, r, half, m, dk, base = NODES_ROUND;
    memcpy(&bits, &x, sizeof bits);
    k = (int64_t)(((uint64_t)bits + 0x00095f6400000000ULL) >> 52) - 1023;
    bits -= (int64_t)((uint64_t)k << 52);
    memcpy(&m, &bits, sizeof m);
    memcpy(&bits, &base, sizeof bits);
    bits += k;                      /* the last bits of 1.5 * 2^52 are units */
    memcpy(&dk, &bits, sizeof dk);
    dk -= base;
    f = m - 1.0;
    s = f / (2.0 + f);
    z = s * s;
    r = z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 + z * (
        2.857142874366239149e-01 + z * (2.222219843214978396e-01 + z * (
            1.818357216161805012e-01 + z * (1.531383769920937332e-01
                                            + z * 1.479819860511658591e-01))))));
    half = 0.5 * f * f;
    return dk * 6.93147180369123816490e-01 - (
        (half - (s * (half + r) + dk * 1.90821492927058770002e-10)) - f);
}

/* Light of n pixels at one node.  Light below `faint` becomes `faint`, with slope 0. */
PDAVIS_CLONES PDAVIS_UNUSED static void nodes_row(
    ptrdiff_t n, double dark, double faint, const double *restrict seen,
    const double *restrict change, double *restrict light, double *restrict slope,
    double *restrict log, double *restrict rise)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double now = dark + seen[i], d = now < faint ? 0.0 : change[i];
        now = now < faint ? faint : now;
        light[i] = now;
        slope[i] = d;
        log[i] = nodes_log(now);
        rise[i] = d / now;
    }
}

/* Filtered log light of n pixels at the end of the interval between two nodes.

   The operations are those of begin, end_level and no_crossing in _pixel.pxd. */
PDAVIS_CLONES PDAVIS_UNUSED static void nodes_level_row(
    ptrdiff_t n, const nodes_filter_t *filter, const double *restrict drift,
    const double *restrict light, const double *restrict slope,
    const double *restrict log, const double *restrict rise,
    const double *restrict level0, double *restrict level1, double *restrict monotonic,
    double *restrict flat)
{
    const double *next_light = light + BESIDE, *next_slope = slope + BESIDE;
    const double *next_log = log + BESIDE, *next_rise = rise + BESIDE;
    const double phi = filter->phi;
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double v0 = log[i], m0 = rise[i], m1 = next_rise[i], dv = next_log[i] - v0;
        double b = 3 * dv - 2 * m0 - m1, e = m0 + m1 - 2 * dv, level = level0[i];
        double last = filter->e * level + filter->w0 * v0 + filter->w1 * m0
            + (filter->w2 * b + filter->w3 * e);
        double by = drift[i], end = (last + by) - by;
        double first = (v0 - level) * phi, second = (v0 + m0 + b + e - end) * phi;
        int rests = (light[i] == next_light[i]) & (slope[i] == 0)
            & (next_slope[i] == 0);
        level1[i] = last;
        monotonic[i] = (first + by) * (second + by) > 0 ? 1.0 : 0.0;
        flat[i] = rests ? 1.0 : flat[i];
    }
}

#endif
