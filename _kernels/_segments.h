/* Log intensity at two times of each of many segments at once: see _segments.pxd.

   A segment is a piece of a frame's exposure between two events of a pixel, in which the
   part of a threshold crossed is quadratic in time.  Every quantity has a row of its
   own, as in _measure.h.  Results have the same bits as `add_step` in _exposure.pxd. */
#ifndef PDAVIS_CV_SEGMENTS_H
#define PDAVIS_CV_SEGMENTS_H

#include "_clones.h"
#include "_math.h"
#include "_measure.h"

enum {
    SEGMENTS = 128,             /* segments of one segments_t */
    NODES = 2,                  /* of two-point Gauss quadrature */
    PIXELS = TOGETHER,          /* pixels of one sums_t */
};

typedef struct {
    double still_us, hz, hz_per_intensity, refractory_us;
    ptrdiff_t n;                /* number of segments */
    int32_t row[SEGMENTS];      /* of sums_t, that a segment is added to */
    /* The nodes are middle - node and middle + node; half of the length.  half is 0
       where log intensity is asked for at the middle only. */
    double middle[SEGMENTS], node[SEGMENTS], half[SEGMENTS];
    /* The part is s (a + b s) of a threshold at the time last + s gap, times the
       probability that light moves, which depends on the time without an event; the
       part's polarity, 1 or 0; time from reset to the last event, where the light
       is taken to go on like that while the pixel is held in reset, else infinite.  All
       times are in us. */
    double last[SEGMENTS], gap[SEGMENTS], a[SEGMENTS], b[SEGMENTS];
    double without[SEGMENTS], on[SEGMENTS], sensitive_us[SEGMENTS];
    /* Counts at the last event; thresholds; log intensity that counts are relative to. */
    double n_on[SEGMENTS], n_off[SEGMENTS];
    double theta_on[SEGMENTS], theta_off[SEGMENTS], level[SEGMENTS];
    double moves[SEGMENTS];     /* probability that light moves */
    /* Results: integral of exp(y), and of it times each of the counts; where half is 0,
       y and the counts themselves. */
    double whole[NODES][SEGMENTS], by_on[NODES][SEGMENTS], by_off[NODES][SEGMENTS];
    /* Log intensity y relative to level, first without the lag; its slope, 1/s; the lag;
       intensity without the lag; 1 while the lag is being solved for. */
    double y[SEGMENTS], slope[SEGMENTS], lag[SEGMENTS];
    double light[SEGMENTS], step[SEGMENTS];
    float narrow[SEGMENTS];
} segments_t;

typedef struct {
    /* Rows up to PIXELS: integrals over a pixel's exposure of exp(y) and of it times
       each of the counts, span being the exposure's length (us); where span is 0, y and
       the counts at its middle, if no event came.  The rows after them: the part of a
       threshold at the middle, where events came. */
    double whole[2 * PIXELS], on[2 * PIXELS], off[2 * PIXELS];
    double span[PIXELS];
    int32_t slot[PIXELS];       /* which pixel of the group a row belongs to */
    ptrdiff_t n;                /* number of pixels */
    float narrow[PIXELS];
} sums_t;

/* Log intensity and counts at node k of each segment. */
PDAVIS_INLINE void cross(segments_t *restrict g, int k, ptrdiff_t n)
{
    const double side = k ? 1.0 : -1.0, refractory = g->refractory_us;
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double gap = g->gap[i], a = g->a[i], b = g->b[i], on = g->on[i];
        double since = g->middle[i] + side * g->node[i] - g->last[i], s = since / gap;
        double part = s * (a + s * b), rate = (a + 2.0 * s * b) * 1e6 / gap;
        double reset = since < refractory ? since : refractory;
        double n_on, n_off;
        part += reset / g->sensitive_us[i];
        rate += since < refractory ? 1e6 / g->sensitive_us[i] : 0.0;
        part *= g->moves[i];
        rate *= g->moves[i];
        n_on = g->n_on[i] + on * part;
        n_off = g->n_off[i] + (1.0 - on) * part;
        g->y[i] = g->theta_on[i] * n_on - g->theta_off[i] * n_off;
        g->slope[i] = (on > 0.0 ? g->theta_on[i] : -g->theta_off[i]) * rate;
        g->by_on[k][i] = n_on;
        g->by_off[k][i] = n_off;
    }
}

/* The lag of pixels whose corner frequency follows their light: see lead in _lag.pxd. */
PDAVIS_INLINE void solve_lag(segments_t *restrict g, ptrdiff_t n)
{
    const double hz = g->hz, per_light = g->hz_per_intensity;
    double moving = 0.0;
    ptrdiff_t i;
    int turn;
    for (i = 0; i < n; i++)
        g->narrow[i] = pd_exp((float)(g->level[i] + g->y[i]));
    for (i = 0; i < n; i++) {
        double light = g->narrow[i], f = hz + per_light * light;
        double u = g->slope[i] * PER_TURN / f;
        int linear = (u < LINEAR) & (u > -LINEAR);
        g->light[i] = light;
        g->lag[i] = linear ? u * (1.0 - u * per_light * light / f) : 0.0;
        g->step[i] = linear ? 0.0 : 1.0;
    }
    for (i = 0; i < n; i++)
        moving += g->step[i];
    for (turn = 0; turn < NEWTON_STEPS && moving > 0.0; turn++) {
        moving = 0.0;
        for (i = 0; i < n; i++)
            g->narrow[i] = pd_exp((float)g->lag[i]);
        for (i = 0; i < n; i++) {
            double u = g->lag[i], e = per_light * g->light[i] * g->narrow[i];
            double f = hz + e * (1.0 + u), least = DERIVATIVE_LEAST * (hz + e);
            double by = u * (hz + e) - g->slope[i] * PER_TURN;
            by /= f < least ? least : f;
            u -= by;
            u = u > LAG_MOST ? LAG_MOST : u < LAG_LEAST ? LAG_LEAST : u;
            g->lag[i] = g->step[i] > 0.0 ? u : g->lag[i];
            g->step[i] = (by < CONVERGED) & (by > -CONVERGED) ? 0.0 : g->step[i];
        }
        for (i = 0; i < n; i++)
            moving += g->step[i];
    }
}

/* Integrals over the segments. */
PDAVIS_CLONES PDAVIS_UNUSED static void integrate_segments(segments_t *restrict g)
{
    const double hz = g->hz;
    const ptrdiff_t n = g->n;
    ptrdiff_t i;
    int k;
    for (i = 0; i < n; i++) {       /* p_rest in _tracks.pxd */
        double without = g->without[i] / g->still_us;
        without *= without;
        without *= without;
        g->moves[i] = g->still_us > 0.0 ? 1.0 - without / (1.0 + without) : 1.0;
    }
    for (k = 0; k < NODES; k++) {
        double first = k ? 0.0 : 1.0;
        cross(g, k, n);
        if (g->hz_per_intensity > 0.0) {
            solve_lag(g, n);
        } else {
            for (i = 0; i < n; i++) {
                double u = hz > 0.0 ? g->slope[i] * PER_TURN / hz : 0.0;
                u = u > LINEAR_LAG_MOST ? LINEAR_LAG_MOST : u;
                g->lag[i] = u < -LINEAR_LAG_MOST ? -LINEAR_LAG_MOST : u;
            }
        }
        for (i = 0; i < n; i++) {
            g->y[i] += g->lag[i];
            g->narrow[i] = (float)g->y[i];
        }
        for (i = 0; i < n; i++)
            g->narrow[i] = pd_exp(g->narrow[i]);
        for (i = 0; i < n; i++) {
            double half = g->half[i], light = half * g->narrow[i];
            int all = half > 0.0;
            g->whole[k][i] = all ? light : first * g->y[i];
            g->by_on[k][i] *= all ? light : first;
            g->by_off[k][i] *= all ? light : first;
        }
    }
}

/* Log of the mean over each exposure, and the means of the counts, weighted by light. */
PDAVIS_CLONES PDAVIS_UNUSED static void de_blur(sums_t *restrict g)
{
    const ptrdiff_t n = g->n;
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double span = g->span[i];
        g->narrow[i] = (float)(span > 0.0 ? g->whole[i] / span : 1.0);
    }
    for (i = 0; i < n; i++)
        g->narrow[i] = pd_log(g->narrow[i]);
    for (i = 0; i < n; i++) {
        int all = g->span[i] > 0.0;
        double whole = all ? g->whole[i] : 1.0;
        g->on[i] /= whole;
        g->off[i] /= whole;
        g->whole[i] = all ? g->narrow[i] : g->whole[i];
    }
}

#endif
