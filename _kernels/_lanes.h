/* Log intensity and variance of groups of moving pixels without a known next event.

   Until its next event or sample, a pixel's estimate depends on time and on constants
   that form its lane, a column of lanes_t.  Each quantity has a row of its own, as in
   _measure.h, so that a processor handles several pixels in one instruction.  The model
   is that of read_pixel in _estimate.pxd without a lamp, where the reasons are given,
   in float32 but for differences of times and of large counts: half of the memory. */
#ifndef PDAVIS_CV_LANES_H
#define PDAVIS_CV_LANES_H

#include "_clones.h"
#include "_extrapolation.h"
#include "_math.h"
#include "_prefetch.h"
#include "_sampled_part.h"

enum {
    LANES = 64,                 /* pixels of one lanes_t */
    PARTS = 8,                  /* in which the memory of one is asked for */
};

/* Longest time and gap, us: much longer than until a pixel counts as at rest, so that
   powers of it stay finite. */
#define SPAN_MOST 1e9
#define US_PER_S 1e6f           /* microseconds per second */

typedef struct {
    double t, known;            /* time to read; events are known up to then, us */
    double epoch;               /* reference time of the variances, us */
    float since_epoch;          /* time since then, s */
    float still_us, leak_per_s, refractory_us, least_gap_us;
    float noise_per_event, motion_variance, p_noise;
    float hz, hz_per_intensity, sigma;          /* bandwidth, relative standard error */
    float holds;                /* 1: the part that samples have measured is kept */
    float least_variance, valid_variance;
    int bare;                   /* 1: variance and validity are not written */
    int smooth;                 /* 1: samples after t are used */
} reader_t;

typedef struct {
    double last[LANES];         /* time of the last event, us */
    float before[LANES];        /* gap between the last two events, us */
    float same[LANES];          /* 1 if the last two events have the same polarity */
    /* Filter: polarity of the last event (1: ON); counts since the last sample. */
    float p[LANES], n_on[LANES], n_off[LANES];
    /* Above is what events change, below what samples change. */
    float held[LANES];          /* part of a threshold that samples have measured */
    float offset[LANES];        /* variance of the offset common to all frames */
    float measured[LANES];      /* 1, or 0 before the first sample */
    union {
        struct {                /* filter */
            /* State and covariance; time from the last sample to the epoch, us. */
            float base[LANES], theta_on[LANES], theta_off[LANES];
            float var_base[LANES], cov_base_on[LANES], cov_base_off[LANES];
            float var_on[LANES], cov_on_off[LANES], var_off[LANES], age[LANES];
        };
        struct {                /* smoother */
            /* Threshold of the last event, negative if it is OFF; square of the mean
               threshold; log intensity after the last event, at the epoch, and its
               variance: v0 + part (v1 + part v2); growth of level, v0 and v1 per s,
               and of v0 per squared s. */
            float theta[LANES], theta2[LANES], level[LANES];
            float v0[LANES], v1[LANES], v2[LANES];
            float slope[LANES], v0_1[LANES], v0_2[LANES], v1_1[LANES];
        };
    };
} lanes_t;

typedef struct {
    /* Results. */
    float log[LANES], variance[LANES];
    unsigned char valid[LANES];
    /* Time since the last event and last gap, us; place in the table of _tracks.pxd. */
    float since[LANES], gap[LANES], w[LANES], over[LANES];
    float after[LANES];         /* filter: 1 if the last event came after all samples */
    int32_t node[LANES];
    float found[LANES][AHEAD_PITCH];    /* the table's values there */
    float columns[AHEAD_PITCH][LANES];  /* the same, where a sample needs them */
    /* Probability of rest by silence alone; part crossed while in reset. */
    float rest[LANES], reset[LANES];
    /* Part of a threshold crossed since the last event, and its slope; v: variance of
       the part, later of log intensity; rate_var: variance of the slope, later of the
       lag. */
    float part[LANES], rate[LANES], v[LANES], rate_var[LANES];
    /* Slope of log intensity and its last rate of fall, per s (before the threshold is
       known: in thresholds per s); log intensity before the lag is removed, intensity,
       lag (ln), and 1 while the lag is being solved for. */
    float slope[LANES], fall[LANES];
    float level[LANES], light[LANES], lag[LANES], step[LANES];
} shown_t;

/* Ask for the next part of the lanes that are shown later, between parts of the
   computation of others; return where the part after it begins.  All lines at once would
   be waited for: there are more of them than a processor fetches together. */
PDAVIS_INLINE const char *ask(const char *later)
{
    PDAVIS_PREFETCH_ALL(later, sizeof(lanes_t) / PARTS);
    return later + sizeof(lanes_t) / PARTS;
}

/* Probability that a pixel without an event for a gap is at rest: see _tracks.pxd. */
PDAVIS_INLINE float p_rest_of(float gap, float still_us)
{
    if (still_us <= 0.0f)
        return 0.0f;
    gap /= still_us;
    gap *= gap;
    gap *= gap;
    return gap / (1.0f + gap);
}

/* Part of a threshold, its slope and the variances of both, from the table. */
PDAVIS_INLINE void look_up(const lanes_t *restrict l, shown_t *restrict g,
                           float refractory, float least, ptrdiff_t from,
                           ptrdiff_t n)
{
    const float knee = AHEAD_KNEE * AHEAD_FINE, most = AHEAD_NODES - 1 - AHEAD_KNEE;
    const float shift = AHEAD_KNEE * AHEAD_FINE / AHEAD_COARSE;
    ptrdiff_t i, c;
    for (i = from; i < n; i++) {
        float gap = l->before[i] - refractory, active_us = g->since[i] - refractory;
        float u, fine, coarse, near, w, node;
        gap = gap > least ? gap : least;
        u = (active_us > 0.0f ? active_us : 0.0f) / gap;
        fine = u * (float)(1.0 / AHEAD_FINE);
        coarse = u * (float)(1.0 / AHEAD_COARSE) - shift;
        near = u < knee ? 1.0f : 0.0f;
        coarse = coarse < most ? coarse : most;
        w = near * fine + (1.0f - near) * coarse;
        node = (float)(int32_t)w;
        g->w[i] = w - node;
        g->gap[i] = gap;
        node += (1.0f - near) * AHEAD_KNEE;
        /* Beyond the last node the pixel is at rest, so nothing is interpolated. */
        g->over[i] = node < AHEAD_NODES - 1 ? 0.0f : 1.0f;
        node -= g->over[i];
        node += AHEAD_NODES * (1.0f - l->same[i]);
        g->node[i] = (int32_t)node;
    }
    /* Rows are read whole: single values, at places that differ, take longer. */
    for (i = from; i < n; i++) {
        const float *row = AHEAD[g->node[i]];
        float w = g->w[i];
        for (c = 0; c < AHEAD_PITCH; c++)
            g->found[i][c] = row[c] + w * (row[AHEAD_PITCH + c] - row[c]);
    }
}

/* Extrapolation from the last events, nothing being known after t, from the values that
   have been looked up: see ahead in _tracks.pxd. */
PDAVIS_INLINE void expect_ahead(const lanes_t *restrict l, shown_t *restrict g,
                                const reader_t *restrict r, ptrdiff_t from,
                                ptrdiff_t n)
{
    const float refractory = r->refractory_us;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        float before = l->before[i], since = g->since[i], gap = g->gap[i];
        float over = g->over[i], reset = since < refractory ? since : refractory;
        float moving = 1.0f - over, active = since < refractory ? 0.0f : 1.0f;
        float per_gap = 1.0f / gap, per_s = US_PER_S * per_gap;
        float first = AHEAD[0][1], rest;
        float part = moving * active * g->found[i][0];
        float rate = moving * active * g->found[i][1];
        float var = moving * g->found[i][2] + over * (float)REST_VARIANCE;
        float rate_var = moving * g->found[i][3];
        first += (1.0f - l->same[i]) * (AHEAD[AHEAD_NODES][1] - AHEAD[0][1]);
        first *= moving;
        rate = per_s * (rate + (1.0f - active) * first);
        part += first * reset * per_gap;
        rate_var *= per_s * per_s;
        g->fall[i] = moving * l->same[i] * per_s;
        rest = p_rest_of(before > since ? before : since, r->still_us);
        g->rest[i] = 1.0f - moving * (1.0f - rest);
        g->reset[i] = first * reset * per_gap;
        g->v[i] = (1.0f - rest) * (var + rest * part * part);
        g->rate_var[i] = (1.0f - rest) * (rate_var + rest * rate * rate);
        g->part[i] = (1.0f - rest) * part;
        g->rate[i] = (1.0f - rest) * rate;
    }
}

/* The same where a sample came after the last event: see _sampled_part.h. */
PDAVIS_INLINE void expect_after_sample(const lanes_t *restrict l, shown_t *restrict g,
                                       const reader_t *restrict r, ptrdiff_t from,
                                       ptrdiff_t n)
{
    const float refractory = r->refractory_us, since_epoch = US_PER_S * r->since_epoch;
    ptrdiff_t i, c;
    for (i = from; i < n; i++)      /* rows with gaps would not be vectorised */
        for (c = 0; c < AHEAD_PITCH; c++)
            g->columns[c][i] = g->found[i][c];
    for (i = from; i < n; i++) {
        float since = g->since[i], per_gap = 1.0f / g->gap[i];
        float active = since > refractory ? since - refractory : 0.0f;
        float at = active - (l->age[i] + since_epoch), per_s = US_PER_S * per_gap;
        float mean = 0.5f * (l->theta_on[i] + l->theta_off[i]);
        float own = r->holds * l->measured[i] * (1.0f - g->after[i]);
        ahead_t row;
        sampled_t s;
        at = (at > 0.0f ? at : 0.0f) / (active > 1.0f ? active : 1.0f);
        row.part = g->columns[0][i];
        row.rate = g->columns[1][i];
        row.rate_var = g->columns[3][i];
        row.moving = g->columns[4][i];
        row.spread = g->columns[5][i];
        row.middle = g->columns[6][i];
        row.common = g->columns[7][i];
        s = part_of_sample(row, active * per_gap, at, g->rest[i], l->held[i],
                           l->var_base[i] / (mean * mean), g->reset[i]);
        g->part[i] = own > 0.0f ? s.part : g->part[i];
        g->v[i] = own > 0.0f ? s.var : g->v[i];
        g->rate[i] = own > 0.0f ? per_s * s.rate : g->rate[i];
        g->rate_var[i] = own > 0.0f ? per_s * per_s * s.rate_var : g->rate_var[i];
    }
}

/* Interpolation where no event follows up to `known`, which is later than t: see quiet
   in _tracks.pxd. */
PDAVIS_INLINE void expect_quiet(const lanes_t *restrict l, shown_t *restrict g,
                                const reader_t *restrict r, ptrdiff_t from,
                                ptrdiff_t n)
{
    const float refractory = r->refractory_us;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        double whole = r->known - l->last[i];
        float since = g->since[i], gap = (float)(whole < SPAN_MOST ? whole : SPAN_MOST);
        float s = since / gap, per_s = US_PER_S / gap;
        float first = l->before[i] - refractory;
        float reset = since < refractory ? since : refractory;
        float part = 2.0f * s * (1.0f - s), rate = (2.0f - 4.0f * s) * per_s, rest;
        float rate_var = (float)QUIET_RATE_VARIANCE * per_s * per_s;
        first = first > (float)GAP_LEAST_US ? first : (float)GAP_LEAST_US;
        part += reset / first;
        rate += since < refractory ? US_PER_S / first : 0.0f;
        rest = p_rest_of(l->before[i] > gap ? l->before[i] : gap, r->still_us);
        g->fall[i] = 0.0f;
        g->v[i] = (1.0f - rest) * ((float)QUIET_VARIANCE + rest * part * part);
        g->rate_var[i] = (1.0f - rest) * (rate_var + rest * rate * rate);
        g->part[i] = (1.0f - rest) * part;
        g->rate[i] = (1.0f - rest) * rate;
    }
}

/* Log intensity as a smoothed pixel shows it, its slope, and the variances of both. */
PDAVIS_INLINE void add_course(const lanes_t *restrict l, shown_t *restrict g,
                              const reader_t *restrict r, ptrdiff_t from, ptrdiff_t n)
{
    const float dt = r->since_epoch;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        float part = g->part[i], theta2 = l->theta2[i];
        g->level[i] = (l->level[i] + l->slope[i] * dt) + l->theta[i] * part;
        g->slope[i] = l->theta[i] * g->rate[i];
        g->fall[i] *= l->theta[i] < 0.0f ? -l->theta[i] : 0.0f;
        g->v[i] = theta2 * g->v[i]
            + (l->v0[i] + dt * (l->v0_1[i] + dt * l->v0_2[i]))
            + part * ((l->v1[i] + dt * l->v1_1[i]) + part * l->v2[i]);
        g->rate_var[i] *= theta2;
    }
}

/* The same of a filtered pixel: base + theta_on on - theta_off off, where the last
   event counts less by the probability that it is noise. */
PDAVIS_INLINE void add_counts(const lanes_t *restrict l, shown_t *restrict g,
                              const reader_t *restrict r, ptrdiff_t from, ptrdiff_t n)
{
    const float leak_per_us = r->leak_per_s / US_PER_S;
    const float since_epoch_us = US_PER_S * r->since_epoch;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        float rises = l->p[i], falls = 1.0f - rises, after = g->after[i];
        float theta_on = l->theta_on[i], theta_off = l->theta_off[i];
        float mean = 0.5f * (theta_on + theta_off), theta2 = mean * mean;
        float noise = after * r->p_noise * p_rest_of(l->before[i], r->still_us);
        float more = g->part[i] - noise;
        float on = l->n_on[i] + rises * more, off = l->n_off[i] + falls * more;
        float v = noise * (1.0f - noise)
            + r->noise_per_event * (l->n_on[i] + l->n_off[i])
            + 2.0f * r->motion_variance * after
            + leak_per_us * (l->age[i] + since_epoch_us);
        g->level[i] = l->base[i] + (theta_on * on - theta_off * off);
        g->slope[i] = (rises * theta_on - falls * theta_off) * g->rate[i];
        g->fall[i] *= falls * theta_off;
        g->v[i] = theta2 * (g->v[i] + v)
            + (l->var_base[i] + on * (on * l->var_on[i] + 2.0f * l->cov_base_on[i])
               + off * (off * l->var_off[i] - 2.0f * (l->cov_base_off[i]
                                                      + on * l->cov_on_off[i])));
        g->rate_var[i] *= theta2;
    }
}

/* Lag of pixels whose corner frequency follows their light: see lead in _lag.pxd. */
PDAVIS_INLINE void follow(shown_t *restrict g, const reader_t *restrict r,
                          ptrdiff_t from, ptrdiff_t n)
{
    const float hz = r->hz, k = r->hz_per_intensity;
    float moving = 0.0f;
    ptrdiff_t i;
    int turn;
    for (i = from; i < n; i++) {
        float light = pd_exp(g->level[i]), f = hz + k * light;
        float u = g->slope[i] * (float)PER_TURN / f;
        int linear = (u < (float)LINEAR) & (u > -(float)LINEAR);
        g->light[i] = light;
        g->lag[i] = linear ? u * (1.0f - u * k * light / f) : 0.0f;
        g->step[i] = linear ? 0.0f : 1.0f;
    }
    for (i = from; i < n; i++)
        moving += g->step[i];
    for (turn = 0; turn < NEWTON_STEPS && moving > 0.0f; turn++) {
        moving = 0.0f;
        for (i = from; i < n; i++) {
            float u = g->lag[i], e = k * g->light[i] * pd_exp(u);
            float f = hz + e * (1.0f + u), least = (float)DERIVATIVE_LEAST * (hz + e);
            float by = u * (hz + e) - g->slope[i] * (float)PER_TURN;
            f = f < least ? least : f;
            by /= f;
            u -= by;
            u = u > (float)LAG_MOST ? (float)LAG_MOST
                : u < (float)LAG_LEAST ? (float)LAG_LEAST : u;
            g->lag[i] = g->step[i] > 0.0f ? u : g->lag[i];
            g->step[i] = (by < (float)CONVERGED) & (by > -(float)CONVERGED)
                ? 0.0f : g->step[i];
        }
        for (i = from; i < n; i++)
            moving += g->step[i];
    }
}

/* Variance of the lag of pixels whose corner frequency follows their light: see
   lead_variance in _lag.pxd. */
PDAVIS_INLINE void add_lag(shown_t *restrict g, const reader_t *restrict r,
                           ptrdiff_t from, ptrdiff_t n)
{
    const float hz = r->hz, k = r->hz_per_intensity, turn2 = PER_TURN * PER_TURN;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        float u = g->lag[i], e = k * g->light[i], lost, d, least, v;
        lost = g->fall[i] * (float)PER_TURN * e / ((hz + e) * (hz + e));
        lost = lost > (float)LOST_FROM
            ? (float)LOST_SLOPE * (lost - (float)LOST_FROM) : 0.0f;
        e = k * pd_exp(g->level[i] + u);
        d = hz + e * (1.0f + u);
        least = (float)DERIVATIVE_LEAST * (hz + e);
        d = d < least ? least : d;
        v = r->sigma * u * (hz + e);
        v = (turn2 * g->rate_var[i] + v * v) / (d * d) + lost * lost;
        g->rate_var[i] = v < (float)LAG_VARIANCE_MOST ? v : (float)LAG_VARIANCE_MOST;
    }
}

/* The same of pixels whose corner frequency is constant. */
PDAVIS_INLINE void add_constant_lag(shown_t *restrict g, const reader_t *restrict r,
                                    ptrdiff_t from, ptrdiff_t n)
{
    const float hz = r->hz, turn2 = PER_TURN * PER_TURN;
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        float v = r->sigma * g->lag[i] * hz;
        v = (turn2 * g->rate_var[i] + v * v) / (hz * hz);
        g->rate_var[i] = v < (float)LAG_VARIANCE_MOST ? v : (float)LAG_VARIANCE_MOST;
    }
}

/* Log intensity, its variance and validity of the pixels from <= i < n <= LANES.

   later: the lanes that are shown after the next ones, or any. */
PDAVIS_CLONES PDAVIS_UNUSED static void show_lanes(
    const lanes_t *restrict l, shown_t *restrict g, const reader_t *restrict r,
    const lanes_t *later, ptrdiff_t from, ptrdiff_t n)
{
    const char *at = ask((const char *)later);
    ptrdiff_t i;
    for (i = from; i < n; i++) {
        /* An unused lane may hold an old value later than t. */
        double since = r->t - l->last[i];
        since = since > 0.0 ? since : 0.0;
        g->since[i] = (float)(since < SPAN_MOST ? since : SPAN_MOST);
    }
    if (!r->smooth)
        for (i = from; i < n; i++)
            g->after[i] = r->epoch - l->last[i] < (double)l->age[i] ? 1.0f : 0.0f;
    at = ask(at);
    if (r->known > r->t) {
        expect_quiet(l, g, r, from, n);
    } else {
        look_up(l, g, r->refractory_us, r->least_gap_us, from, n);
        at = ask(at);
        expect_ahead(l, g, r, from, n);
    }
    at = ask(at);
    if (r->holds > 0.0f && !r->smooth)
        expect_after_sample(l, g, r, from, n);
    at = ask(at);
    if (r->smooth)
        add_course(l, g, r, from, n);
    else
        add_counts(l, g, r, from, n);
    at = ask(at);
    if (r->hz_per_intensity > 0.0f) {
        follow(g, r, from, n);
    } else {
        const float per_hz = r->hz > 0.0f ? (float)PER_TURN / r->hz : 0.0f;
        for (i = from; i < n; i++) {
            float u = g->slope[i] * per_hz, most = (float)LINEAR_LAG_MOST;
            u = u > most ? most : u;
            g->lag[i] = u < -most ? -most : u;
        }
    }
    for (i = from; i < n; i++)
        g->log[i] = g->level[i] + g->lag[i];
    at = ask(at);
    if (r->bare)
        return;
    if (r->hz_per_intensity > 0.0f)
        add_lag(g, r, from, n);
    else if (r->hz > 0.0f)
        add_constant_lag(g, r, from, n);
    else
        memset(g->rate_var, 0, sizeof g->rate_var);
    ask(at);
    for (i = from; i < n; i++) {
        float v = g->v[i], measured = l->measured[i];
        v = v > r->least_variance ? v : r->least_variance;
        g->variance[i] = measured * (v + l->offset[i] + g->rate_var[i]);
        g->valid[i] = (unsigned char)((v <= r->valid_variance) & (measured > 0.0f));
    }
}

#endif
