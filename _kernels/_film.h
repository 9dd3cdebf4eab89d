/* One step of the event pixels that a video frame leaves in peace, by rows of floats;
   the others are marked.  The mathematics is in _pixel.pxd. */
#ifndef PDAVIS_CV_FILM_H
#define PDAVIS_CV_FILM_H

#include "_clones.h"

typedef struct {
    float dark;             /* DN/ms */
    float faint;            /* the least light that has a log, DN/ms */
    float w0, w1;           /* end value of the filter for 1 and x */
    float soon;             /* end of the interval, us, rounded up */
    int32_t unfiltered;
    int32_t single;         /* whether a crossing may be found without `interval` */
    double t0, h, t1;       /* the interval, us */
    double phi;             /* its length in time constants */
} film_t;

enum {
    GROUP = 64,             /* pixels per call of film_solve */
    PEACE = 0, OFF = 1, ON = 2, MORE = 3
};

/* Pixels that are looked at. */
typedef struct {
    double ref[GROUP];      /* log light that the comparator remembers */
    double since[GROUP];    /* us, when that was; it falls by leak from then on */
    double release[GROUP];  /* us, end of the refractory period */
    double noise_t[GROUP];  /* us, next candidate of shot noise */
    double on[GROUP], off[GROUP], leak[GROUP];
    double level[GROUP], last[GROUP];   /* filtered log light at both ends */
    double v0[GROUP], v1[GROUP];        /* log light at both ends */
    double at[GROUP];       /* us, of the crossing */
    int64_t verdict[GROUP]; /* PEACE, one crossing (OFF or ON), or MORE to find out */
    float low[GROUP], high[GROUP], until[GROUP];
} film_group_t;

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

/* Write the places of n marks, each 0 or 1; return how many are 1.

   marks holds zeros up to the next multiple of eight. */
static PDAVIS_UNUSED ptrdiff_t film_places(
    const uint8_t *marks, ptrdiff_t n, int32_t *places)
{
    ptrdiff_t found = 0, i, k;
    for (i = 0; i < n; i += 8) {
        uint64_t eight;
        memcpy(&eight, marks + i, sizeof eight);
        if (!eight)
            continue;
        for (k = i; k < i + 8; k++) {
            places[found] = (int32_t)k;
            found += marks[k];
        }
    }
    return found;
}

#define PDAVIS_LESS(a, b) ((a) < (b) ? (a) : (b))
#define PDAVIS_MORE(a, b) ((a) > (b) ? (a) : (b))

/* Light, its log v and the filtered log (level) of n pixels at the frame's time.

   level and v are overwritten; old_level and old_v receive what they were.  A pixel is
   busy unless, until the interval's end, level certainly stays between low and high: both its ends lie
   there, and either it goes one way or the light it follows lies there too. */
PDAVIS_CLONES PDAVIS_UNUSED static void film_row(
    const film_t *film, ptrdiff_t n, const float *restrict i0,
    const float *restrict i45, const float *restrict i90, const float *restrict i135,
    const float *restrict half, const float *restrict along,
    const float *restrict across, const float *restrict low,
    const float *restrict high, const float *restrict until, float *restrict light,
    float *restrict level, float *restrict v, float *restrict old_level,
    float *restrict old_v, uint8_t *restrict busy)
{
    const float dark = film->dark, faint = film->faint, soon = film->soon;
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
        busy[i] = !((lowest > low[i]) & (highest < high[i]) & (until[i] >= soon)
                    & (((before - start) * (after - end) >= 0.0f)
                       | ((least > low[i]) & (most < high[i]))));
        old_level[i] = start;
        old_v[i] = before;
        level[i] = end;
        v[i] = after;
    }
}

/* e to the -x for x in 0..700, to 1e-11. */
PDAVIS_INLINE double fall64(double x)
{
    double k = x * -1.4426950408889634 + 6755399441055744.0, r, y, scale;
    uint64_t bits;
    memcpy(&bits, &k, sizeof bits);
    k -= 6755399441055744.0;
    r = (-x - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10;
    y = 1.0 / 362880;
    y = y * r + 1.0 / 40320;
    y = y * r + 1.0 / 5040;
    y = y * r + 1.0 / 720;
    y = y * r + 1.0 / 120;
    y = y * r + 1.0 / 24;
    y = y * r + 1.0 / 6;
    y = y * r + 0.5;
    y = y * r + 1.0;
    y = y * r + 1.0;
    bits = (bits + 1023) << 52;  /* the sum's last bits are k */
    memcpy(&scale, &bits, sizeof scale);
    return y * scale;
}

PDAVIS_INLINE double pick64(int64_t mask, double where_set, double where_not)
{
    int64_t a, b;
    memcpy(&a, &where_set, sizeof a);
    memcpy(&b, &where_not, sizeof b);
    a = (mask & a) | (~mask & b);
    memcpy(&where_set, &a, sizeof a);
    return where_set;
}

#define FILM_NEVER 3e38         /* us, beyond any time */
#define FILM_DRIFT 0.03         /* thresholds that leak may move before a look */
#define FILM_MARGIN 4e-6        /* ln units, for the rounding of levels up to 32 */
#define FILM_ROUNDING 2e-7      /* of a time to float, relative */

/* How long, and between which levels, a pixel needs no look from t1 on, when it
   remembers ref.  The margins are wider than the rounding to floats. */
PDAVIS_INLINE void film_rest(
    double ref, double on, double off, double leak, double release, double noise_t,
    double t1, float *low, float *high, float *until)
{
    double stop = t1 + FILM_DRIFT * on / leak, till;
    stop = PDAVIS_LESS(stop, noise_t);
    till = stop * (1 - FILM_ROUNDING);
    till = PDAVIS_LESS(till, FILM_NEVER);
    *low = (float)(ref - off + FILM_MARGIN);
    *high = (float)(ref + on - leak * (stop - t1) - FILM_MARGIN);
    *until = (release > t1) | (stop < t1) ? -1.0f : (float)till;
}

/* A step of Chebyshev's method for a e^(-phi s) + p + q s = aim, s in 0..1; return what
   it leaves. */
PDAVIS_INLINE double refine(
    double *at, double aim, double a, double p, double q, double phi)
{
    double s = *at > 0 ? *at : 0, y, slope, step, turn;  /* NaN becomes 0 */
    s = PDAVIS_LESS(s, 1);
    y = a * fall64(phi * s);
    slope = 1 / (q - phi * y);
    step = (aim - (y + p + q * s)) * slope;
    turn = 0.5 * step * (phi * phi * y) * slope;
    *at = s + step - step * turn;
    return step * (2 * turn * turn + step * step);
}

/* Decide about n pixels, find crossings of those with one, and what all may rest.

   The filtered log of light whose log is linear is a e^(-phi s) + p + q s; where its
   slope has the same sign at both ends, it has no turning point between them. */
PDAVIS_CLONES PDAVIS_UNUSED static void film_solve(
    const film_t *film, ptrdiff_t n, film_group_t *g)
{
    const double t0 = film->t0, h = film->h, t1 = film->t1, phi = film->phi;
    const double inverse = 1 / phi, tolerance = 0.001 / h;
    const int64_t filtered = !film->unfiltered, single = film->single;
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double on = g->on[i], off = g->off[i], leak = g->leak[i], drift = leak * h;
        double noise_t = g->noise_t[i], release = g->release[i], level = g->level[i];
        double ref = g->ref[i] - leak * (t0 - g->since[i]);
        double top = ref + on, bottom = ref - off;
        double last = g->last[i], end = last + drift, v0 = g->v0[i], v1 = g->v1[i];
        double sa = phi * (v0 - level) + drift, sb = phi * (v1 - last) + drift;
        double ra = sa < 0 ? -sa : sa, rb = sb < 0 ? -sb : sb;
        double reach = PDAVIS_LESS(ra, rb), low = bottom + reach;
        double high = top - (reach + drift), aim, way, bend, s, q, a, p, left;
        int64_t calm = (noise_t >= t1) & (release <= t0);
        int64_t inside = (end > bottom) & (end < top), one_way = sa * sb >= 0;
        int64_t turns = (last > low) & (last < high) & (level > low) & (level < high);
        int64_t up = -(int64_t)(end >= top), one, k;
        one = single & one_way & (level > bottom) & (level < top)
            & (end < top + on) & (end > bottom - off);
        /* From the root of the parabola with the values and the first slope. */
        aim = pick64(up, top, bottom);
        way = aim - level;
        bend = sa * sa + 4 * (end - level - sa) * way;
        bend = sqrt(PDAVIS_MORE(bend, 0));
        s = 2 * way / (sa + pick64(up, bend, -bend));
        q = v1 - v0;
        p = v0 - q * inverse;
        a = level - p;
        q += drift;
        left = refine(&s, aim, a, p, q, phi);
        left = refine(&s, aim, a, p, q, phi);
        left = left < 0 ? -left : left;
        one &= calm & (left < tolerance) & (s >= 0) & (s <= 1);
        calm &= inside & (one_way | turns | !filtered);
        /* PEACE = 0, OFF = 1, ON = 2, MORE = 3 */
        k = (calm - 1) & (MORE + (-one & (OFF - MORE - up)));
        g->verdict[i] = k;
        g->at[i] = t0 + s * h;
        one = -(one & (calm ^ 1));
        ref += pick64(one, pick64(up, on, -off), 0);
        ref -= drift;
        g->ref[i] = ref;
        film_rest(ref, on, off, leak, release, noise_t, t1, &g->low[i], &g->high[i],
                  &g->until[i]);
    }
}

#endif
