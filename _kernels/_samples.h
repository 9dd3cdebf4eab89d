/* A row of a frame as samples of log intensity. */
#ifndef PDAVIS_CV_SAMPLES_H
#define PDAVIS_CV_SAMPLES_H

#include "_clones.h"
#include "_math.h"

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

#endif
