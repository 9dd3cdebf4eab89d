/* What some moving pixels show now, their last events being all that is known.

   A row per quantity, as in _measure.h, so that a processor takes several pixels in one
   instruction.  The bits are those of read_pixel in _estimate.pxd, where the reasons
   are: here without a lamp and without a refractory period. */
#ifndef PDAVIS_CV_AHEAD_H
#define PDAVIS_CV_AHEAD_H

#include "_clones.h"
#include "_extrapolation.h"
#include "_math.h"

enum { AT_ONCE = 64 };          /* pixels per call of show_ahead */

typedef struct {
    double still_us, doubt, motion_variance, leak_per_s, noise_per_event, offset_dn;
    double hz, hz_per_intensity, sigma;         /* bandwidth, and its relative error */
    double least_variance, valid_variance;
} reader_t;

typedef struct {
    double since[AT_ONCE];      /* us since the last event, and of the gap before it */
    double before[AT_ONCE];
    double same[AT_ONCE];       /* 1 where the last two events are of one sign */
    double up[AT_ONCE];         /* 1 where the last one is ON */
    double unseen[AT_ONCE];     /* 1 where no sample has come since */
    double elapsed[AT_ONCE];    /* us since the last sample */
    double n_on[AT_ONCE], n_off[AT_ONCE];       /* events since then */
    double held[AT_ONCE];       /* part that samples since the last event had */
    /* The state; measured: 1, or 0 before the first sample. */
    double base[AT_ONCE], theta_on[AT_ONCE], theta_off[AT_ONCE];
    double var_base[AT_ONCE], cov_base_on[AT_ONCE], cov_base_off[AT_ONCE];
    double var_on[AT_ONCE], cov_on_off[AT_ONCE], var_off[AT_ONCE];
    double pull[AT_ONCE], measured[AT_ONCE];
    /* Results. */
    float log[AT_ONCE], variance[AT_ONCE];
    unsigned char valid[AT_ONCE];
    /* Place in the table. */
    double gap[AT_ONCE], w[AT_ONCE], over[AT_ONCE];
    int32_t node[AT_ONCE];
    /* Part of a threshold, its slope; variances of the part, then of log intensity, and
       of the slope, then of the lag; probability that light still moves. */
    double part[AT_ONCE], rate[AT_ONCE], v[AT_ONCE], rate_var[AT_ONCE], moves[AT_ONCE];
    /* Slope of log intensity and how fast it last fell, per s; what the pixel shows,
       the intensity of that, and by how much it lags; 1 where that is not found yet. */
    double slope[AT_ONCE], fall[AT_ONCE];
    double level[AT_ONCE], light[AT_ONCE], lag[AT_ONCE], step[AT_ONCE];
    float narrow[AT_ONCE];
} ahead_t;

/* Probability that a pixel without an event for a gap is at rest: see _tracks.pxd. */
PDAVIS_INLINE double silence_of(double gap, double still_us)
{
    gap /= still_us;
    gap *= gap;
    gap *= gap;
    return gap / (1.0 + gap);
}

/* Part of a threshold, its slope and the variances of both, from the table. */
PDAVIS_INLINE void look_up(ahead_t *restrict g, ptrdiff_t n)
{
    const double knee = AHEAD_KNEE * AHEAD_FINE, most = AHEAD_NODES - 1 - AHEAD_KNEE;
    const double *restrict table = AHEAD[0];
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double before = g->before[i];
        double gap = before > AHEAD_LEAST_US ? before : AHEAD_LEAST_US;
        double u = g->since[i] / gap, fine = u / AHEAD_FINE;
        double coarse = u / AHEAD_COARSE - knee / AHEAD_COARSE;
        double near = u < knee ? 1.0 : 0.0, w, node;
        coarse = coarse < most ? coarse : most;
        w = near * fine + (1.0 - near) * coarse;
        node = (double)(int32_t)w;
        g->w[i] = w - node;
        g->gap[i] = gap;
        node += (1.0 - near) * AHEAD_KNEE;
        /* At the last node the pixel is at rest, and there is none after it. */
        g->over[i] = node < AHEAD_NODES - 1 ? 0.0 : 1.0;
        node -= g->over[i];
        node += AHEAD_NODES * (1.0 - g->same[i]);
        g->node[i] = (int32_t)(AHEAD_COLUMNS * node);
    }
    for (i = 0; i < n; i++) {
        int32_t at = g->node[i];
        double w = g->w[i];
        g->part[i] = table[at] + w * (table[at + 5] - table[at]);
        g->rate[i] = table[at + 1] + w * (table[at + 6] - table[at + 1]);
        g->v[i] = table[at + 2] + w * (table[at + 7] - table[at + 2]);
        g->rate_var[i] = table[at + 3] + w * (table[at + 8] - table[at + 3]);
        g->moves[i] = table[at + 4] + w * (table[at + 9] - table[at + 4]);
    }
}

/* How far a pixel is at rest; log intensity as it shows it, and its variance. */
PDAVIS_INLINE void extrapolate(ahead_t *restrict g, const reader_t *restrict r,
                               ptrdiff_t n)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double before = g->before[i], since = g->since[i], gap = g->gap[i];
        int over = g->over[i] > 0.0, up = g->up[i] > 0.0;
        double part = over ? 0.0 : g->part[i], rate = over ? 0.0 : g->rate[i];
        double var = over ? REST_VARIANCE : g->v[i];
        double rate_var = over ? 0.0 : g->rate_var[i];
        double moves = over ? 0.0 : g->moves[i], rest, per_s = 1e6 / gap;
        rate *= per_s;
        rate_var *= PER_S2 / (gap * gap);
        per_s = over ? 0.0 : g->same[i] * per_s;
        g->fall[i] = g->theta_off[i] * (up ? 0.0 : per_s);
        rest = silence_of(before > since ? before : since, r->still_us);
        var = (1.0 - rest) * (var + rest * part * part);
        rate_var = (1.0 - rest) * (rate_var + rest * rate * rate);
        part *= 1.0 - rest;
        g->part[i] = part + (1.0 - (1.0 - rest) * moves) * g->held[i];
        g->rate[i] = rate * (1.0 - rest);
        g->v[i] = var;
        g->rate_var[i] = rate_var;
    }
    for (i = 0; i < n; i++) {
        int up = g->up[i] > 0.0;
        double on = g->n_on[i], off = g->n_off[i], part = g->part[i], var = g->v[i];
        double doubt = g->unseen[i] * (r->doubt * silence_of(g->before[i], r->still_us));
        double theta2 = 0.25 * (g->theta_on[i] + g->theta_off[i])
            * (g->theta_on[i] + g->theta_off[i]);
        double quiet = r->leak_per_s * 1e-6 * g->elapsed[i]
            + r->noise_per_event * (on + off);
        on = on - (up ? doubt : 0.0) + (up ? part : 0.0);
        off = off - (up ? 0.0 : doubt) + (up ? 0.0 : part);
        g->level[i] = g->base[i] + g->theta_on[i] * on - g->theta_off[i] * off;
        g->slope[i] = (up ? g->theta_on[i] : -g->theta_off[i]) * g->rate[i];
        g->rate_var[i] *= theta2;
        var += doubt * (1.0 - doubt) + g->unseen[i] * (2.0 * r->motion_variance);
        g->v[i] = theta2 * var
            + (g->var_base[i] + on * on * g->var_on[i] + off * off * g->var_off[i]
               + 2.0 * (on * g->cov_base_on[i] - off * g->cov_base_off[i]
                        - on * off * g->cov_on_off[i]))
            + theta2 * quiet;
    }
}

/* Lag of pixels whose corner frequency follows their light: see lead in _lag.pxd. */
PDAVIS_INLINE void follow(ahead_t *restrict g, const reader_t *restrict r, ptrdiff_t n)
{
    const double hz = r->hz, k = r->hz_per_intensity;
    double moving = 1.0;
    ptrdiff_t i;
    int turn;
    for (i = 0; i < n; i++)
        g->narrow[i] = pd_exp((float)g->level[i]);
    for (i = 0; i < n; i++) {
        double light = g->narrow[i], f = hz + k * light;
        double u = g->slope[i] * PER_TURN / f;
        int linear = (u < LINEAR) & (u > -LINEAR);
        g->light[i] = light;
        g->lag[i] = linear ? u * (1.0 - u * k * light / f) : 0.0;
        g->step[i] = linear ? 0.0 : 1.0;
    }
    for (turn = 0; turn < NEWTON_STEPS && moving > 0.0; turn++) {
        moving = 0.0;
        for (i = 0; i < n; i++)
            g->narrow[i] = pd_exp((float)g->lag[i]);
        for (i = 0; i < n; i++) {
            double u = g->lag[i], e = k * g->light[i] * g->narrow[i];
            double f = hz + e * (1.0 + u), least = STIFF * (hz + e);
            double by = u * (hz + e) - g->slope[i] * PER_TURN;
            f = f < least ? least : f;
            by /= f;
            u -= by;
            u = u > RISE_MOST ? RISE_MOST : u < FALL_MOST ? FALL_MOST : u;
            g->lag[i] = g->step[i] > 0.0 ? u : g->lag[i];
            g->step[i] = (by < CONVERGED) & (by > -CONVERGED) ? 0.0 : g->step[i];
        }
        for (i = 0; i < n; i++)
            moving += g->step[i];
    }
}

/* Variance of the lag: see lead_variance in _lag.pxd. */
PDAVIS_INLINE void add_lag(ahead_t *restrict g, const reader_t *restrict r, ptrdiff_t n)
{
    const double hz = r->hz, k = r->hz_per_intensity;
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        g->narrow[i] = pd_exp((float)(g->level[i] + g->lag[i]));
    for (i = 0; i < n; i++) {
        double u = g->lag[i], e = k * g->light[i], lost, d, least, v;
        lost = g->fall[i] * PER_TURN * e / ((hz + e) * (hz + e));
        lost = lost > LOST_FROM ? LOST_SLOPE * (lost - LOST_FROM) : 0.0;
        e = k * g->narrow[i];
        d = hz + e * (1.0 + u);
        least = STIFF * (hz + e);
        d = d < least ? least : d;
        v = r->sigma * u * (hz + e);
        v = (PER_TURN * PER_TURN * g->rate_var[i] + v * v) / (d * d) + lost * lost;
        g->rate_var[i] = v < LAG_VARIANCE_MOST ? v : LAG_VARIANCE_MOST;
    }
}

/* Log intensity, its variance and validity of n <= AT_ONCE pixels. */
PDAVIS_CLONES PDAVIS_UNUSED static void show_ahead(
    ahead_t *restrict g, const reader_t *restrict r, ptrdiff_t n)
{
    ptrdiff_t i;
    look_up(g, n);
    extrapolate(g, r, n);
    if (r->hz_per_intensity > 0.0) {
        follow(g, r, n);
        add_lag(g, r, n);
    } else {
        for (i = 0; i < n; i++) {
            double u = r->hz > 0.0 ? g->slope[i] * PER_TURN / r->hz : 0.0;
            u = u > STRAIGHT_MOST ? STRAIGHT_MOST : u;
            g->lag[i] = u < -STRAIGHT_MOST ? -STRAIGHT_MOST : u;
            g->light[i] = 0.0;
        }
        if (r->hz > 0.0)
            add_lag(g, r, n);
        else
            memset(g->rate_var, 0, sizeof g->rate_var);
    }
    for (i = 0; i < n; i++) {
        double v = g->v[i], u = r->offset_dn * g->pull[i];
        double measured = g->measured[i];
        v = v > r->least_variance ? v : r->least_variance;
        g->log[i] = (float)(g->level[i] + g->lag[i]);
        g->variance[i] = (float)(measured * (v + u * u + g->rate_var[i]));
        g->valid[i] = (unsigned char)((v <= r->valid_variance) & (measured > 0.0));
    }
}

#endif
