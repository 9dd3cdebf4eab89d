/* Pixels at rest, a row at a time: see _estimate.pxd, show_rest, for one of them. */
#ifndef PDAVIS_CV_REST_H
#define PDAVIS_CV_REST_H

#include "_clones.h"

/* Variance and validity dt seconds after the epoch; at_epoch is the variance there, < 0
   for a pixel without a sample. */
PDAVIS_CLONES PDAVIS_UNUSED static void rest_row(
    const float *restrict at_epoch, const float *restrict per_s,
    const float *restrict offset, float dt, float least, float most, ptrdiff_t n,
    float *restrict variance, unsigned char *restrict valid)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float v = at_epoch[i] + per_s[i] * dt;
        float known = at_epoch[i] < 0 ? 0.0f : 1.0f;
        v = v > least ? v : least;
        variance[i] = known * (v + offset[i]);
        valid[i] = (unsigned char)((v <= most) & (at_epoch[i] >= 0));
    }
}

/* The same and log intensity for the smoother: see _smoothed.pxd, show_resting. */
PDAVIS_CLONES PDAVIS_UNUSED static void smooth_row(
    const float *restrict level, const float *restrict slope, const float *restrict v0,
    const float *restrict v1, const float *restrict v2, const float *restrict offset,
    float dt, float least, float most, ptrdiff_t n, float *restrict log,
    float *restrict variance, unsigned char *restrict valid)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float v = v0[i] + dt * (v1[i] + dt * v2[i]);
        float known = offset[i] < 0 ? 0.0f : 1.0f;
        v = v > least ? v : least;
        log[i] = level[i] + slope[i] * dt;
        variance[i] = known * (v + offset[i]);
        valid[i] = (unsigned char)((v <= most) & (offset[i] >= 0));
    }
}

#endif
