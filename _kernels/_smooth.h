/* Samples on both sides of a time, some pixels of a row at once: see _smooth.pyx. */
#ifndef PDAVIS_CV_SMOOTH_H
#define PDAVIS_CV_SMOOTH_H

#include "_clones.h"

enum {
    SIDE = 64,                  /* pixels per call of take_in */
};

typedef struct {                /* samples of one frame: a row per quantity of node_t */
    double level[SIDE], h_on[SIDE], h_off[SIDE], noise[SIDE], drift[SIDE];
    double n_on[SIDE], n_off[SIDE];
    int64_t t[SIDE];
} nodes_t;

typedef struct {                /* estimate by the samples on one side, as past_t */
    double base[SIDE], var[SIDE], n_on[SIDE], n_off[SIDE];
    int64_t t[SIDE];
    double drift[SIDE];         /* process noise before the last sample taken in */
} side_t;

typedef struct {
    double on[SIDE], off[SIDE]; /* thresholds */
} pair_t;

/* Update the filter of one side by its next sample in its direction of time; gap is
   the process noise between this and the samples taken in before. */
PDAVIS_INLINE void take_in(side_t *restrict s, const nodes_t *restrict f,
                           const pair_t *restrict theta, const double *restrict gap,
                           ptrdiff_t n)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double on = theta->on[i], off = theta->off[i], noise = f->noise[i];
        double z = f->level[i] - f->h_on[i] * on - f->h_off[i] * off;
        double base = s->base[i], var = s->var[i] + gap[i], k = var / (var + noise);
        int first = s->var[i] < 0.0, usable = noise > 0.0;
        base += on * (f->n_on[i] - s->n_on[i]) - off * (f->n_off[i] - s->n_off[i]);
        base += k * (z - base);
        var *= 1.0 - k;
        base = first ? z : base;
        var = first ? noise : var;
        s->base[i] = usable ? base : s->base[i];
        s->var[i] = usable ? var : s->var[i];
        s->n_on[i] = usable ? f->n_on[i] : s->n_on[i];
        s->n_off[i] = usable ? f->n_off[i] : s->n_off[i];
        s->t[i] = usable ? f->t[i] : s->t[i];
        s->drift[i] = usable ? f->drift[i] : s->drift[i];
    }
}

PDAVIS_CLONES PDAVIS_UNUSED static void advance_side(
    side_t *restrict s, const nodes_t *restrict f, const pair_t *restrict theta,
    ptrdiff_t n)
{
    take_in(s, f, theta, f->drift, n);
}

PDAVIS_CLONES PDAVIS_UNUSED static void retreat_side(
    side_t *restrict s, const nodes_t *restrict f, const pair_t *restrict theta,
    ptrdiff_t n)
{
    double gap[SIDE];
    memcpy(gap, s->drift, sizeof gap);
    take_in(s, f, theta, gap, n);
}

#endif
