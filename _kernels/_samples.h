/* A row of a frame as samples of log intensity. */
#ifndef PDAVIS_CV_SAMPLES_H
#define PDAVIS_CV_SAMPLES_H

#include "_clones.h"
#include "_math.h"

/* Samples per block: a multiple of the floats in a vector. */
#define PDAVIS_SAMPLES 32

/* ln(max(dn, 1)) - exposure, and whether the sample is usable; a NaN becomes 1. */
PDAVIS_CLONES PDAVIS_UNUSED static void log_row(
    const float *restrict dn, const unsigned char *restrict usable,
    const float *restrict exposure, ptrdiff_t n, float *restrict out,
    unsigned char *restrict valid)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        out[i] = pd_log(dn[i] >= 1.0f ? dn[i] : 1.0f) - exposure[i];
    for (i = 0; i < n; i++)
        valid[i] = (unsigned char)((usable[i] != 0) & (dn[i] >= 1.0f));
}

PDAVIS_INLINE void sample_block(
    const float *restrict dn, const unsigned char *restrict usable,
    const float *restrict exposure, float read, float dn_per_shot, ptrdiff_t n,
    float *restrict out)
{
    float log[PDAVIS_SAMPLES], variance[PDAVIS_SAMPLES], per_dn[PDAVIS_SAMPLES];
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float v = dn[i] >= 1.0f ? dn[i] : 1.0f;
        float noise = (read + v / dn_per_shot) / (v * v);
        log[i] = pd_log(v) - exposure[i];
        variance[i] = (usable[i] != 0) & (dn[i] >= 1.0f) ? noise : 0.0f;
        per_dn[i] = 1.0f / v;
    }
    for (i = 0; i < n; i++) {
        out[3 * i] = log[i];
        out[3 * i + 1] = variance[i];
        out[3 * i + 2] = per_dn[i];
    }
}

/* Records (sample_t) of the same log, the variance of its noise, 0 where it is not
   usable, and 1 / dn. */
PDAVIS_CLONES PDAVIS_UNUSED static void sample_row(
    const float *restrict dn, const unsigned char *restrict usable,
    const float *restrict exposure, float read, float dn_per_shot, ptrdiff_t n,
    float *restrict out)
{
    ptrdiff_t at;
    for (at = 0; at + PDAVIS_SAMPLES <= n; at += PDAVIS_SAMPLES)
        sample_block(dn + at, usable + at, exposure + at, read, dn_per_shot,
                     PDAVIS_SAMPLES, out + 3 * at);
    sample_block(dn + at, usable + at, exposure + at, read, dn_per_shot, n - at,
                 out + 3 * at);
}

#endif
