/* Rows of values to rows of BGR pixels, through a table of colours.

   A block of values first becomes indices, without branches so that it fills vectors;
   then each pixel is one load and one store of four bytes, of which the next pixel
   overwrites the fourth.  The table has `size` colours and four more: of a value that is
   not finite and of one that is not valid, then both again.  These take turns along the
   diagonal, so that what has no value is hatched. */
#ifndef PDAVIS_CV_PICTURE_H
#define PDAVIS_CV_PICTURE_H

#include "_clones.h"

#define PDAVIS_PIXELS 256

/* Index of an angle outside the first turn, which is rare, or of NaN. */
static int32_t far_hue(double value, int32_t size)
{
    if (value - value != 0)
        return size;
    value -= size * floor(value / size);
    return value >= 0 && value < size ? (int32_t)value : 0; /* rounding; no turn left */
}

#define PDAVIS_HUE(VALUE)                                                            \
    double value = (double)(VALUE) * scale + 0.5;                                    \
    int32_t line = (int32_t)(value >= 0 && value < size ? value : -1.0);
#define PDAVIS_RAMP(VALUE)                                                           \
    double value = (double)(VALUE) * scale;                                          \
    double upon = value < 0 ? 0 : value > top ? top : value;                         \
    int32_t line = (int32_t)(value == value ? upon + 0.5 : size);
#define PDAVIS_TONE(VALUE)                                                           \
    double value = (double)(VALUE) * scale;                                          \
    double root = sqrt(value > 0 ? value : 0);                                       \
    int32_t line = (int32_t)(value == value ? (root > top ? top : root) + 0.5 : size);

/* valid may be NULL; what is not valid has the last colour if it is at least `least`. */
#define PDAVIS_PAINT(NAME, T, INDEX)                                                 \
    PDAVIS_CLONES PDAVIS_UNUSED static void NAME(                                    \
        const T *restrict row, const uint8_t *restrict valid, ptrdiff_t n,           \
        double scale, double least, const uint8_t *restrict table, int32_t size,     \
        int32_t y, uint8_t *restrict out)                                            \
    {                                                                                \
        int32_t lines[PDAVIS_PIXELS];                                                \
        const double top = size - 1;                                                 \
        const T bound = (T)least;                                                    \
        int32_t shift = 1;                                                           \
        while (n >> shift > 256) /* a picture seen whole, however large, shows them */ \
            shift++;                                                                 \
        (void)top;                                                                   \
        for (; n > 0; row += PDAVIS_PIXELS, n -= PDAVIS_PIXELS) {                    \
            ptrdiff_t i, m = n < PDAVIS_PIXELS ? n : PDAVIS_PIXELS;                  \
            int32_t far = 0;                                                         \
            for (i = 0; i < m; i++) {                                                \
                INDEX(row[i])                                                        \
                lines[i] = line;                                                     \
            }                                                                        \
            for (i = 0; i < m; i++)                                                  \
                far |= lines[i];                                                     \
            if (far < 0)                                                             \
                for (i = 0; i < m; i++)                                              \
                    if (lines[i] < 0)                                                \
                        lines[i] = far_hue((double)row[i] * scale + 0.5, size);      \
            if (valid) {                                                             \
                for (i = 0; i < m; i++)                                              \
                    lines[i] = valid[i] ? lines[i]                                   \
                        : size + (row[i] >= bound);                                  \
                valid += PDAVIS_PIXELS;                                              \
            }                                                                        \
            for (i = 0; i < m; i++)                                                  \
                lines[i] += (lines[i] >= size) * (((int32_t)i + y) >> shift & 1) * 2; \
            y += (int32_t)m;                                                         \
            for (i = 0; i < m - 1; i++)                                              \
                memcpy(out + 3 * i, table + 4 * (ptrdiff_t)lines[i], 4);             \
            memcpy(out + 3 * i, table + 4 * (ptrdiff_t)lines[i], 3);                 \
            out += 3 * m;                                                            \
        }                                                                            \
    }

PDAVIS_PAINT(hue_row_f32, float, PDAVIS_HUE)
PDAVIS_PAINT(hue_row_f64, double, PDAVIS_HUE)
PDAVIS_PAINT(ramp_row_f32, float, PDAVIS_RAMP)
PDAVIS_PAINT(ramp_row_f64, double, PDAVIS_RAMP)
PDAVIS_PAINT(tone_row_f32, float, PDAVIS_TONE)
PDAVIS_PAINT(tone_row_f64, double, PDAVIS_TONE)

/* Fade the colours of a row towards a grey: weight * scale, clamped to 0..1, in 256
   steps is the colour's share; NaN is 0.  valid may be NULL; where it is 0, out stays. */
PDAVIS_CLONES PDAVIS_UNUSED static void fade_row(
    const float *restrict weight, const uint8_t *restrict valid, ptrdiff_t n,
    float scale, int32_t ground, uint8_t *restrict out)
{
    int32_t share[PDAVIS_PIXELS];
    for (; n > 0; weight += PDAVIS_PIXELS, n -= PDAVIS_PIXELS) {
        ptrdiff_t i, m = n < PDAVIS_PIXELS ? n : PDAVIS_PIXELS;
        for (i = 0; i < m; i++) {
            float part = weight[i] * scale;
            part = part > 0 ? part < 1 ? part : 1 : 0;
            share[i] = (int32_t)(part * 256 + 0.5f);
        }
        if (valid) {
            for (i = 0; i < m; i++)
                share[i] = valid[i] ? share[i] : 256;
            valid += PDAVIS_PIXELS;
        }
        for (i = 0; i < 3 * m; i++)
            out[i] = (uint8_t)(
                ground + ((((int32_t)out[i] - ground) * share[i / 3] + 128) >> 8));
        out += 3 * m;
    }
}

#endif
