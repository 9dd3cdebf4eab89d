/* One step of the event pixels that a video frame leaves in peace, by rows of floats;
   the others are marked.  The mathematics is in _pixel.pxd. */
#ifndef PDAVIS_CV_FILM_H
#define PDAVIS_CV_FILM_H

#include "_clones.h"

typedef struct {
    float dark;             /* DN/ms */
    float faint;            /* the least light that has a log, DN/ms */
    float w0, w1;           /* end value of the filter for 1 and x */
    float t1;               /* us, rounded up */
    int32_t unfiltered;
} film_t;

/* Natural log of a positive, normal x, to 2e-7.

   The mantissa is taken to sqrt(1/2)..sqrt(2); then Cephes' polynomial (logf.c). */
PDAVIS_INLINE float log32(float x)
{
    int32_t bits = bits_of(x), k = (bits - 0x3f3504f3) >> 23;
    float m = float_of(bits - k * (1 << 23)) - 1.0f, z = m * m, e = (float)k;
    float y = 7.0376836292e-2f;
    y = y * m + -1.1514610310e-1f;
    y = y * m + 1.1676998740e-1f;
    y = y * m + -1.2420140846e-1f;
    y = y * m + 1.4249322787e-1f;
    y = y * m + -1.6668057665e-1f;
    y = y * m + 2.0000714765e-1f;
    y = y * m + -2.4999993993e-1f;
    y = y * m + 3.3333331174e-1f;
    y = y * m * z;
    y += e * -2.12194440e-4f;
    y -= 0.5f * z;
    return m + y + e * 0.693359375f;
}

#define PDAVIS_LESS(a, b) ((a) < (b) ? (a) : (b))
#define PDAVIS_MORE(a, b) ((a) > (b) ? (a) : (b))

/* Light, its log v and the filtered log (level) of n pixels at the frame's time.

   level and v are overwritten; old_level and old_v receive what they were.  A pixel is
   busy unless, until t1, level certainly stays between low and high: both its ends lie
   there, and either it goes one way or the light it follows lies there too. */
PDAVIS_CLONES PDAVIS_UNUSED static void film_row(
    const film_t *film, ptrdiff_t n, const float *restrict i0,
    const float *restrict i45, const float *restrict i90, const float *restrict i135,
    const float *restrict half, const float *restrict along,
    const float *restrict across, const float *restrict low,
    const float *restrict high, const float *restrict until, float *restrict light,
    float *restrict level, float *restrict v, float *restrict old_level,
    float *restrict old_v, int32_t *restrict busy)
{
    const float dark = film->dark, faint = film->faint, t1 = film->t1;
    const float w0 = film->w0, w1 = film->w1;
    const int32_t filtered = !film->unfiltered;
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        float seen = dark + half[i] * ((i0[i] + i90[i]) + (i45[i] + i135[i]))
            + (along[i] * (i0[i] - i90[i]) + across[i] * (i45[i] - i135[i]));
        light[i] = PDAVIS_MORE(seen, faint);
    }
    for (i = 0; i < n; i++) {
        float before = v[i], after = log32(light[i]), start = level[i];
        float end = start + w0 * (before - start) + w1 * (after - before);
        float lowest, highest, least, most;
        end = filtered ? end : after;
        lowest = PDAVIS_LESS(start, end);
        highest = PDAVIS_MORE(start, end);
        least = PDAVIS_LESS(before, after);
        most = PDAVIS_MORE(before, after);
        busy[i] = !((lowest > low[i]) & (highest < high[i]) & (until[i] >= t1)
                    & (((before - start) * (after - end) >= 0.0f)
                       | ((least > low[i]) & (most < high[i]))));
        old_level[i] = start;
        old_v[i] = before;
        level[i] = end;
        v[i] = after;
    }
}

#endif
