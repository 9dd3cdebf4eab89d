/* Cosines of phases in turns, the same bits on every CPU. */
#ifndef PDAVIS_CV_LAMP_H
#define PDAVIS_CV_LAMP_H

#include "_clones.h"

#define QUARTER_TURN 0.25       /* from a cosine to a sine, in turns */
#define TWO_PI 6.283185307179586        /* rad per turn */
#define TWO_PI_PER_US 6283185.307179586   /* one turn per us, in rad per s */
/* Taylor series of the sine about 0: the factorials 3!, 5!, ... 13!. */
#define FACTORIAL_3 6.0         /* Taylor series, as above */
#define FACTORIAL_5 120.0       /* Taylor series, as above */
#define FACTORIAL_7 5040.0      /* Taylor series, as above */
#define FACTORIAL_9 362880.0    /* Taylor series, as above */
#define FACTORIAL_11 39916800.0         /* Taylor series, as above */
#define FACTORIAL_13 6227020800.0       /* Taylor series, as above */

/* cos(2 pi u) to 1e-9 for |u| <= 1/2. */
PDAVIS_INLINE double pd_cos_turn(double u)
{
    double x = TWO_PI * (QUARTER_TURN - (u < 0 ? -u : u)), x2 = x * x;
    return x * (1 + x2 * (-1 / FACTORIAL_3 + x2 * (1 / FACTORIAL_5
           + x2 * (-1 / FACTORIAL_7 + x2 * (1 / FACTORIAL_9
           + x2 * (-1 / FACTORIAL_11 + x2 * (1 / FACTORIAL_13)))))));
}

/* The same for |u| below 2^62. */
PDAVIS_INLINE double pd_cos_turns(double u)
{
    return pd_cos_turn(u - (double)(int64_t)(u + (u >= 0 ? 0.5 : -0.5)));
}

/* The same of several phases below 2^31; there, numbers of 32 bits do, which every
   instruction set can convert. */
PDAVIS_CLONES PDAVIS_UNUSED static void cos_each(const double *restrict u, ptrdiff_t n,
                                                 double *restrict out)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        out[i] = pd_cos_turn(u[i] - (double)(int32_t)(u[i] + (u[i] >= 0 ? 0.5 : -0.5)));
}

#endif
