/* One interval of the event pixels in front of a video, by rows of floats.

   Pixels that certainly make no event in the interval are done here; the others are
   marked and solved for in groups, or left to `interval` in _pixel.pxd, whose
   mathematics this follows. */
#ifndef PDAVIS_CV_FILM_H
#define PDAVIS_CV_FILM_H

#include "_clones.h"

typedef struct {
    float dark;             /* DN/ms */
    float faint;            /* lower bound of the light, DN/ms; log 0 is undefined */
    float w0, w1;           /* the filter's end value for the inputs 1 and x */
    float soon;             /* end of the interval, us, rounded up */
    int32_t unfiltered;     /* 1: no low-pass */
    int32_t single;         /* 1: film_solve may find a crossing, without `interval` */
    double t0, h, t1;       /* beginning, length and end of the interval, us */
    double phi;             /* length of the interval in time constants */
} film_t;

enum {
    GROUP = 64,             /* pixels per call of film_solve */
    /* Outcome: no event, one event, or undecided, so that `interval` has to decide. */
    NO_EVENT = 0, OFF = 1, ON = 2, UNDECIDED = 3
};

/* Pixels that may make an event. */
typedef struct {
    double ref[GROUP];      /* log light memorised by the comparator */
    double since[GROUP];    /* its time, us; the memory falls by leak from then on */
    double release[GROUP];  /* end of the refractory period, us */
    double noise_t[GROUP];  /* next candidate of a noise event, us */
    double on[GROUP], off[GROUP], leak[GROUP];
    double level[GROUP], last[GROUP];   /* filtered log light at both ends */
    double v0[GROUP], v1[GROUP];        /* log light at both ends */
    double at[GROUP];       /* time of the crossing, us */
    int64_t outcome[GROUP]; /* NO_EVENT, OFF, ON or UNDECIDED */
    /* Up to this time (us) there is no event while the filtered log light stays between
       low and high. */
    float low[GROUP], high[GROUP], until[GROUP];
} film_group_t;

/* Natural log of a positive, normal x, to 2e-7.

   The mantissa is scaled to sqrt(1/2)..sqrt(2); the polynomial is Cephes' (logf.c). */
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

/* Write the indices of those of n marks (0 or 1) that are 1; return their number.

   marks must hold zeros from n up to the next multiple of eight. */
static PDAVIS_UNUSED ptrdiff_t film_indices(
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

   level and v are overwritten; old_level and old_v receive their former values.  busy
   receives 0 for pixels whose level certainly stays between low and high during the
   interval: it lies there at both ends and is either monotonic, or follows a light that
   lies there at both ends too. */
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
#define FILM_DRIFT 0.03         /* part of a threshold by which leak may lower ref */
#define FILM_MARGIN 4e-6        /* ln units; above the rounding of levels up to 32 */
#define FILM_ROUNDING 2e-7      /* relative error of a time rounded to float */

/* Levels (low, high) and time (until) within which a pixel that memorises ref at t1
   makes no event.  The margins exceed the rounding to floats. */
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

/* One step of Chebyshev's method for a e^(-phi s) + p + q s = aim, s in 0..1.

   Returns an estimate of the error that is left. */
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

/* Outcome of n pixels, time of the crossing where there is one, and their next bounds.

   If the log of the light is linear, the filtered one is a e^(-phi s) + p + q s.  It
   has no turning point in the interval if its slope has one sign at both ends. */
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
        /* Start from the root of the parabola through both ends with the slope sa. */
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
        /* NO_EVENT if calm, else OFF or ON if there is one crossing, else UNDECIDED. */
        k = (calm - 1) & (UNDECIDED + (-one & (OFF - UNDECIDED - up)));
        g->outcome[i] = k;
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
