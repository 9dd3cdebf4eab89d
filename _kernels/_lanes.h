/* Log intensity and variance of groups of moving pixels without a known next event.

   Until its next event or sample, a pixel's estimate depends on time and on constants
   that form its lane, a column of lanes_t.  Each quantity has a row of its own, as in
   _measure.h, so that a processor handles several pixels in one instruction.  The model
   is that of read_pixel in _estimate.pxd without a lamp, where the reasons are given. */
#ifndef PDAVIS_CV_LANES_H
#define PDAVIS_CV_LANES_H

#include "_clones.h"
#include "_extrapolation.h"
#include "_math.h"

enum {
    LANES = 64,                 /* pixels of one lanes_t */
};

typedef struct {
    double still_us, leak_per_s, refractory_us;
    double hz, hz_per_intensity, sigma;         /* bandwidth, relative standard error */
    double least_variance, valid_variance;
    double t, known;            /* time to read; events are known up to then, us */
    double since_epoch;         /* time since the variances' reference time, s */
    int bare;                   /* 1: variance and validity are not written */
    int smooth;                 /* 1: samples after t are used */
} reader_t;

typedef struct {
    double last[LANES];         /* time of the last event, us */
    double before[LANES];       /* gap between the last two events, us */
    double same[LANES];         /* 1 if the last two events have the same polarity */
    double level[LANES];        /* log intensity after the last event */
    double theta[LANES];        /* threshold of the last event; negative if it is OFF */
    double theta2[LANES];       /* square of the mean threshold */
    double held[LANES];         /* state_t.part, or 0 if the pixel keeps none */
    double v0[LANES];           /* variance at the epoch: v0 + part (v1 + part v2) */
    double v1[LANES], v2[LANES];
    double offset[LANES];       /* variance of the offset common to all frames */
    double measured[LANES];     /* 1, or 0 before the first sample */
    /* Smoother only: growth of level, v0 and v1 per s, and of v0 per squared s. */
    double slope[LANES], v0_1[LANES], v0_2[LANES], v1_1[LANES];
} lanes_t;

typedef struct {
    /* Results. */
    float log[LANES], variance[LANES];
    unsigned char valid[LANES];
    /* Time since the last event and last gap, us; place in the table of _tracks.pxd. */
    double since[LANES], gap[LANES], w[LANES], over[LANES];
    int32_t node[LANES];
    /* Part of a threshold crossed since the last event, and its slope; v: variance of
       the part, later of log intensity; rate_var: variance of the slope, later of the
       lag; probability that the light still moves. */
    double part[LANES], rate[LANES], v[LANES], rate_var[LANES], moves[LANES];
    /* Slope of log intensity and its last rate of fall, per s; log intensity before the
       lag is removed, intensity, lag (ln), and 1 while the lag is being solved for. */
    double slope[LANES], fall[LANES];
    double level[LANES], light[LANES], lag[LANES], step[LANES];
    float narrow[LANES];
} shown_t;

/* Probability that a pixel without an event for a gap is at rest: see _tracks.pxd. */
PDAVIS_INLINE double p_rest_of(double gap, double still_us)
{
    if (still_us <= 0.0)
        return 0.0;
    gap /= still_us;
    gap *= gap;
    gap *= gap;
    return gap / (1.0 + gap);
}

/* Part of a threshold, its slope and the variances of both, from the table. */
PDAVIS_INLINE void look_up(const lanes_t *restrict l, shown_t *restrict g,
                           double refractory, ptrdiff_t from, ptrdiff_t n)
{
    const double knee = AHEAD_KNEE * AHEAD_FINE, most = AHEAD_NODES - 1 - AHEAD_KNEE;
    const double *restrict table = AHEAD[0];
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        double gap = l->before[i] - refractory, active_us = g->since[i] - refractory;
        double u, fine, coarse, near, w, node;
        gap = gap > AHEAD_LEAST_US ? gap : AHEAD_LEAST_US;
        u = (active_us > 0.0 ? active_us : 0.0) / gap;
        fine = u / AHEAD_FINE;
        coarse = u / AHEAD_COARSE - knee / AHEAD_COARSE;
        near = u < knee ? 1.0 : 0.0;
        coarse = coarse < most ? coarse : most;
        w = near * fine + (1.0 - near) * coarse;
        node = (double)(int32_t)w;
        g->w[i] = w - node;
        g->gap[i] = gap;
        node += (1.0 - near) * AHEAD_KNEE;
        /* Beyond the last node the pixel is at rest, so nothing is interpolated. */
        g->over[i] = node < AHEAD_NODES - 1 ? 0.0 : 1.0;
        node -= g->over[i];
        node += AHEAD_NODES * (1.0 - l->same[i]);
        g->node[i] = (int32_t)(AHEAD_COLUMNS * node);
    }
    for (i = from; i < n; i++) {
        int32_t at = g->node[i];
        double w = g->w[i];
        g->part[i] = table[at] + w * (table[at + 5] - table[at]);
        g->rate[i] = table[at + 1] + w * (table[at + 6] - table[at + 1]);
        g->v[i] = table[at + 2] + w * (table[at + 7] - table[at + 2]);
        g->rate_var[i] = table[at + 3] + w * (table[at + 8] - table[at + 3]);
        g->moves[i] = table[at + 4] + w * (table[at + 9] - table[at + 4]);
    }
}

/* Extrapolation from the last events, nothing being known after t: see ahead in
   _tracks.pxd. */
PDAVIS_INLINE void expect_ahead(const lanes_t *restrict l, shown_t *restrict g,
                                const reader_t *restrict r, ptrdiff_t from,
                               ptrdiff_t n)
{
    const double refractory = r->refractory_us;
    ptrdiff_t i;
    look_up(l, g, refractory, from, n);
    for (i = from; i < n; i++) {
        double before = l->before[i], since = g->since[i], gap = g->gap[i];
        double over = g->over[i], reset = since < refractory ? since : refractory;
        double moving = 1.0 - over, active = since < refractory ? 0.0 : 1.0;
        double first = AHEAD[0][1], per_s = 1e6 / gap, rest;
        double part = moving * active * g->part[i], rate = moving * active * g->rate[i];
        double var = moving * g->v[i] + over * REST_VARIANCE;
        double rate_var = moving * g->rate_var[i];
        first += (1.0 - l->same[i]) * (AHEAD[AHEAD_NODES][1] - AHEAD[0][1]);
        first *= moving;
        rate = per_s * (rate + (1.0 - active) * first);
        part += first * reset / gap;
        rate_var *= PER_S2 / (gap * gap);
        g->fall[i] = (l->theta[i] < 0.0 ? -l->theta[i] : 0.0)
            * (moving * l->same[i] * per_s);
        rest = p_rest_of(before > since ? before : since, r->still_us);
        g->v[i] = (1.0 - rest) * (var + rest * part * part);
        g->rate_var[i] = (1.0 - rest) * (rate_var + rest * rate * rate);
        g->part[i] = (1.0 - rest) * part
            + (1.0 - (1.0 - rest) * (moving * g->moves[i])) * l->held[i];
        g->rate[i] = (1.0 - rest) * rate;
    }
}

/* Interpolation where no event follows up to `known`, which is later than t: see quiet
   in _tracks.pxd. */
PDAVIS_INLINE void expect_quiet(const lanes_t *restrict l, shown_t *restrict g,
                                const reader_t *restrict r, ptrdiff_t from,
                               ptrdiff_t n)
{
    const double refractory = r->refractory_us;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        double since = g->since[i], gap = r->known - l->last[i], s = since / gap;
        double first = l->before[i] - refractory, per_s = 1e6 / gap;
        double reset = since < refractory ? since : refractory;
        double part = 2.0 * s * (1.0 - s), rate = (2.0 - 4.0 * s) * per_s, rest;
        double rate_var = QUIET_RATE_VARIANCE * PER_S2 / (gap * gap);
        first = first > GAP_LEAST_US ? first : GAP_LEAST_US;
        part += reset / first;
        rate += since < refractory ? 1e6 / first : 0.0;
        rest = p_rest_of(l->before[i] > gap ? l->before[i] : gap, r->still_us);
        g->fall[i] = 0.0;
        g->v[i] = (1.0 - rest) * (QUIET_VARIANCE + rest * part * part);
        g->rate_var[i] = (1.0 - rest) * (rate_var + rest * rate * rate);
        g->part[i] = (1.0 - rest) * part;
        g->rate[i] = (1.0 - rest) * rate;
    }
}

/* Log intensity as a pixel shows it, its slope, and the variances of both. */
PDAVIS_INLINE void add_up(const lanes_t *restrict l, shown_t *restrict g,
                          const reader_t *restrict r, ptrdiff_t from,
                               ptrdiff_t n)
{
    const double dt = r->since_epoch, leak = r->leak_per_s * dt;
    ptrdiff_t i;
    if (r->smooth) {
        for (i = from; i < n; i++) {
            double part = g->part[i], theta2 = l->theta2[i];
            g->level[i] = (l->level[i] + l->slope[i] * dt) + l->theta[i] * part;
            g->slope[i] = l->theta[i] * g->rate[i];
            g->v[i] = theta2 * g->v[i]
                + (l->v0[i] + dt * (l->v0_1[i] + dt * l->v0_2[i]))
                + part * ((l->v1[i] + dt * l->v1_1[i]) + part * l->v2[i]);
            g->rate_var[i] *= theta2;
        }
        return;
    }
    for (i = from; i < n; i++) {
        double part = g->part[i], theta2 = l->theta2[i];
        g->level[i] = l->level[i] + l->theta[i] * part;
        g->slope[i] = l->theta[i] * g->rate[i];
        g->v[i] = theta2 * (g->v[i] + leak)
            + (l->v0[i] + part * (l->v1[i] + part * l->v2[i]));
        g->rate_var[i] *= theta2;
    }
}

/* Lag of pixels whose corner frequency follows their light: see lead in _lag.pxd. */
PDAVIS_INLINE void follow(shown_t *restrict g, const reader_t *restrict r, ptrdiff_t from,
                               ptrdiff_t n)
{
    const double hz = r->hz, k = r->hz_per_intensity;
    double moving = 0.0;
    ptrdiff_t i;
    int turn;
    for (i = from; i < n; i++)
        g->narrow[i] = pd_exp((float)g->level[i]);
    for (i = from; i < n; i++) {
        double light = g->narrow[i], f = hz + k * light;
        double u = g->slope[i] * PER_TURN / f;
        int linear = (u < LINEAR) & (u > -LINEAR);
        g->light[i] = light;
        g->lag[i] = linear ? u * (1.0 - u * k * light / f) : 0.0;
        g->step[i] = linear ? 0.0 : 1.0;
    }
    for (i = from; i < n; i++)
        moving += g->step[i];
    for (turn = 0; turn < NEWTON_STEPS && moving > 0.0; turn++) {
        moving = 0.0;
        for (i = from; i < n; i++)
            g->narrow[i] = pd_exp((float)g->lag[i]);
        for (i = from; i < n; i++) {
            double u = g->lag[i], e = k * g->light[i] * g->narrow[i];
            double f = hz + e * (1.0 + u), least = DERIVATIVE_LEAST * (hz + e);
            double by = u * (hz + e) - g->slope[i] * PER_TURN;
            f = f < least ? least : f;
            by /= f;
            u -= by;
            u = u > LAG_MOST ? LAG_MOST : u < LAG_LEAST ? LAG_LEAST : u;
            g->lag[i] = g->step[i] > 0.0 ? u : g->lag[i];
            g->step[i] = (by < CONVERGED) & (by > -CONVERGED) ? 0.0 : g->step[i];
        }
        for (i = from; i < n; i++)
            moving += g->step[i];
    }
}

/* Variance of the lag: see lead_variance in _lag.pxd. */
PDAVIS_INLINE void add_lag(shown_t *restrict g, const reader_t *restrict r, ptrdiff_t from,
                               ptrdiff_t n)
{
    const double hz = r->hz, k = r->hz_per_intensity;
    ptrdiff_t i;
    if (k > 0.0)
        for (i = from; i < n; i++)
            g->narrow[i] = pd_exp((float)(g->level[i] + g->lag[i]));
    else
        memset(g->narrow, 0, sizeof g->narrow);
    for (i = from; i < n; i++) {
        double u = g->lag[i], e = k * g->light[i], lost, d, least, v;
        lost = g->fall[i] * PER_TURN * e / ((hz + e) * (hz + e));
        lost = lost > LOST_FROM ? LOST_SLOPE * (lost - LOST_FROM) : 0.0;
        e = k * g->narrow[i];
        d = hz + e * (1.0 + u);
        least = DERIVATIVE_LEAST * (hz + e);
        d = d < least ? least : d;
        v = r->sigma * u * (hz + e);
        v = (PER_TURN * PER_TURN * g->rate_var[i] + v * v) / (d * d) + lost * lost;
        g->rate_var[i] = v < LAG_VARIANCE_MOST ? v : LAG_VARIANCE_MOST;
    }
}

/* Log intensity, its variance and validity of the pixels from <= i < n <= LANES. */
PDAVIS_CLONES PDAVIS_UNUSED static void show_lanes(
    const lanes_t *restrict l, shown_t *restrict g, const reader_t *restrict r,
    ptrdiff_t from, ptrdiff_t n)
{
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        /* An unused lane may hold an old value later than t. */
        double since = r->t - l->last[i];
        g->since[i] = since > 0.0 ? since : 0.0;
    }
    if (r->known > r->t)
        expect_quiet(l, g, r, from, n);
    else
        expect_ahead(l, g, r, from, n);
    add_up(l, g, r, from, n);
    if (r->hz_per_intensity > 0.0) {
        follow(g, r, from, n);
    } else {
        for (i = from; i < n; i++) {
            double u = r->hz > 0.0 ? g->slope[i] * PER_TURN / r->hz : 0.0;
            u = u > LINEAR_LAG_MOST ? LINEAR_LAG_MOST : u;
            g->lag[i] = u < -LINEAR_LAG_MOST ? -LINEAR_LAG_MOST : u;
            g->light[i] = 0.0;
        }
    }
    for (i = from; i < n; i++)
        g->log[i] = (float)(g->level[i] + g->lag[i]);
    if (r->bare)
        return;
    if (r->hz_per_intensity > 0.0 || r->hz > 0.0)
        add_lag(g, r, from, n);
    else
        memset(g->rate_var, 0, sizeof g->rate_var);
    for (i = from; i < n; i++) {
        double v = g->v[i], measured = l->measured[i];
        v = v > r->least_variance ? v : r->least_variance;
        g->variance[i] = (float)(measured * (v + l->offset[i] + g->rate_var[i]));
        g->valid[i] = (unsigned char)((v <= r->valid_variance) & (measured > 0.0));
    }
}

#endif
