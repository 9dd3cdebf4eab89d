/* The measurement update of the Kalman method for some pixels at once: see _kalman.pyx.

   Every quantity has a row of its own, so that a processor handles several pixels in
   one instruction.  The results have the same bits as updating one pixel at a time. */
#ifndef PDAVIS_CV_MEASURE_H
#define PDAVIS_CV_MEASURE_H

#include "_clones.h"
#include "_math.h"

#define LINEAR_VARIANCE 0.04    /* ln^2: up to noise of 20 % the log is near linear */
#define THIRD_VARIANCE 20.0     /* 1 + 9 + 9 + 1: of a third difference, per sample's */
#define REST_MOST 3.0           /* ln: beyond a factor of 20 the light has changed */

enum {
    TOGETHER = 64,              /* pixels per call of measure */
    LANES = 8,                  /* number of partial sums, the same on every CPU */
    /* Rows of `terms`, the contributions of a sample to the sums over all samples:
       e^2 / v; ln v; 1; noise events that frames show, and the number expected; normal
       equations of e^2 for the noise of motion and per event, relative to v without
       both; of squared third differences of samples, without an event in between, for
       read and shot noise; of e for the relative changes of both thresholds since the
       sample before. */
    RATIO = 0, LOG, COUNT, NOISE_COUNT, NOISE_WEIGHT,
    MOTION, EVENTS, MOTION_MOTION, MOTION_EVENTS, EVENTS_EVENTS,
    READ, SHOT, READ_READ, READ_SHOT, SHOT_SHOT,
    ON, OFF, ON_ON, ON_OFF, OFF_OFF, TERMS
};

typedef struct {
    double frame_sigma, shot_share, read_variance, shot_variance;
    double offset_dn, motion_variance, noise_per_event;
    double jump_sigmas;         /* a larger innovation means that the base has jumped */
    double theta_least, theta_most;     /* bounds of the thresholds, by their priors */
} policy_t;

typedef struct {
    /* The state (see state_t), and its thresholds' priors. */
    double base[TOGETHER], theta_on[TOGETHER], theta_off[TOGETHER];
    double var_base[TOGETHER], cov_base_on[TOGETHER], cov_base_off[TOGETHER];
    double var_on[TOGETHER], cov_on_off[TOGETHER], var_off[TOGETHER];
    double prior_on[TOGETHER], prior_off[TOGETHER], pull[TOGETHER];
    /* state_t.part, and the part crossed at this sample; 1, or 0: an event came during
       the exposure; variance in noise that a pixel at rest does not have. */
    double held[TOGETHER], part[TOGETHER], silent[TOGETHER], motion[TOGETHER];
    double n_on[TOGETHER], n_off[TOGETHER];     /* events since the sample before */
    /* measured = base + h_on theta_on + h_off theta_off + noise; innovation; d(log) /
       d(DN), of the sample and where it is linearized.  noise is that of motion first. */
    double h_on[TOGETHER], h_off[TOGETHER], noise[TOGETHER], innovation[TOGETHER];
    double sample_per_dn[TOGETHER], per_dn[TOGETHER];
    double learn[TOGETHER];     /* 1, or 0: fixed thresholds (Schmidt-Kalman update) */
    /* Third difference of the last four samples; 1 if no event came between them. */
    double third[TOGETHER], rests[TOGETHER];
    double unit[TOGETHER];      /* derivative of v by motion_variance */
    double events[TOGETHER];    /* derivative of v by noise_per_event */
    double p_noise[TOGETHER];   /* probability that the last event is noise */
    double event_step[TOGETHER];        /* change of the base by that event */
    double included[TOGETHER];  /* 1, or 0: left out of the sums */
    /* Variance of the innovation; that of a jump of the base; see RATIO ... */
    double v[TOGETHER], jump[TOGETHER];
    double terms[TERMS][TOGETHER];
    double spread[TOGETHER], rest[TOGETHER];
    float narrow[TOGETHER];
} group_t;

/* Variance of a sample (ln^2) in light of 1 / per_dn DN. */
PDAVIS_INLINE double noise_at(double per_dn, const policy_t *p)
{
    return p->shot_share * per_dn * (p->read_variance * per_dn + p->shot_variance)
           + p->frame_sigma * p->frame_sigma;
}

/* Linearize at the posterior estimate of the light; noise becomes R there.

   Noise adds to DN, not to their logarithm.  Linearized at the sample itself, a sample
   that noise has made brighter would get too much weight, and a darker one would lie
   too far off.  So innovation and per_dn are those of an iterated Kalman filter, unless
   the light has jumped. */
PDAVIS_INLINE void linearize(group_t *restrict g, const policy_t *restrict p,
                             ptrdiff_t n)
{
    double most = p->jump_sigmas * p->jump_sigmas;
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double on = g->h_on[i], off = g->h_off[i];
        double noise = g->noise[i] + noise_at(g->sample_per_dn[i], p);
        g->spread[i] = g->var_base[i] + (
            2.0 * (on * g->cov_base_on[i] + off * g->cov_base_off[i]
                   + on * off * g->cov_on_off[i])
            + on * on * g->var_on[i] + off * off * g->var_off[i]);
        g->rest[i] = g->innovation[i] * noise / (g->spread[i] + noise);
        g->narrow[i] = (float)g->rest[i];
    }
    for (i = 0; i < n; i++)
        g->narrow[i] = pd_exp(g->narrow[i]);
    for (i = 0; i < n; i++) {
        double per_dn = g->sample_per_dn[i], rest = g->rest[i], factor = g->narrow[i];
        double here = g->noise[i] + noise_at(per_dn, p);
        double there = g->noise[i] + noise_at(per_dn * factor, p);
        double e = g->innovation[i] - rest + factor - 1.0;
        int stays = (rest < -REST_MOST) | (rest > REST_MOST)
                    | (e * e > most * (g->spread[i] + there));
        g->innovation[i] = stays ? g->innovation[i] : e;
        g->per_dn[i] = stays ? per_dn : per_dn * factor;
        g->noise[i] = stays ? here : there;
    }
}

/* Set the samples' contributions to the sums that the noise is estimated from. */
PDAVIS_INLINE void set_terms(group_t *restrict g, const policy_t *restrict p,
                             ptrdiff_t n)
{
    double most = p->jump_sigmas * p->jump_sigmas;
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        g->narrow[i] = pd_log(g->narrow[i]);
    for (i = 0; i < n; i++) {
        double ratio = g->terms[RATIO][i], v = g->v[i], offset = g->spread[i];
        /* The weights exclude both noises: otherwise the first samples, before the
           noises are known, would outweigh all later ones. */
        double plain_v = v - g->unit[i] * p->motion_variance
                         - g->events[i] * p->noise_per_event + offset * offset;
        double unit = g->unit[i] / plain_v, events = g->events[i] / plain_v;
        double excess = ratio * v / plain_v - 1.0;
        double noise = g->p_noise[i] - g->innovation[i] / g->event_step[i];
        int noisy = g->p_noise[i] > 0.0;
        noise = noise > 0.0 ? noise : 0.0;
        noise = g->p_noise[i] * (noise < 1.0 ? noise : 1.0);
        int included = g->included[i] > 0.0;
        g->terms[LOG][i] = included ? g->narrow[i] : 0.0;
        g->terms[COUNT][i] = g->included[i];
        g->terms[MOTION][i] = unit * excess;
        g->terms[EVENTS][i] = events * excess;
        g->terms[MOTION_MOTION][i] = unit * unit;
        g->terms[MOTION_EVENTS][i] = unit * events;
        g->terms[EVENTS_EVENTS][i] = events * events;
        g->terms[NOISE_COUNT][i] = noisy ? noise : 0.0;
        g->terms[NOISE_WEIGHT][i] = noisy ? g->p_noise[i] : 0.0;
    }
    for (i = 0; i < n; i++) {
        /* The variance of a sample relative to R, by what samples differ from a
           parabola, and the derivatives of R by read and shot noise, relative to R. */
        double third = g->third[i], ratio = third * third / (
            THIRD_VARIANCE * g->noise[i]);
        double shot = p->shot_share * g->per_dn[i] / g->noise[i];
        double read = shot * g->per_dn[i];
        double excess = (ratio > most ? most : ratio) - 1.0 + read * p->read_variance
                        + shot * p->shot_variance;
        int usable = (g->rests[i] > 0.0) & (g->noise[i] > 0.0)
                     & (g->noise[i] <= LINEAR_VARIANCE);
        read = usable ? read : 0.0;
        shot = usable ? shot : 0.0;
        excess = usable ? excess : 0.0;
        g->terms[READ][i] = read * excess;
        g->terms[SHOT][i] = shot * excess;
        g->terms[READ_READ][i] = read * read;
        g->terms[READ_SHOT][i] = read * shot;
        g->terms[SHOT_SHOT][i] = shot * shot;
    }
    for (i = 0; i < n; i++)
        g->terms[RATIO][i] = g->included[i] > 0.0 ? g->terms[RATIO][i] : 0.0;
}

PDAVIS_INLINE double limited(double theta, double prior, const policy_t *p)
{
    double least = p->theta_least * prior, most = p->theta_most * prior;
    theta = theta < least ? least : theta;
    return theta > most ? most : theta;
}

/* Add the terms of n pixels to the sums over all. */
PDAVIS_INLINE void add_up(const group_t *restrict g, ptrdiff_t n,
                          double *restrict sums)
{
    ptrdiff_t i, j, k;
    for (k = 0; k < TERMS; k++) {
        double lane[LANES] = {0.0};
        for (i = 0; i + LANES <= n; i += LANES)
            for (j = 0; j < LANES; j++)
                lane[j] += g->terms[k][i + j];
        for (; i < n; i++)
            lane[0] += g->terms[k][i];
        for (j = 0; j < LANES; j++)
            sums[k] += lane[j];
    }
}

/* Update n <= TOGETHER states by a sample each; add the innovation terms to sums. */
PDAVIS_CLONES PDAVIS_UNUSED static void measure(
    group_t *restrict g, const policy_t *restrict p, ptrdiff_t n, double *restrict sums)
{
    double most = p->jump_sigmas * p->jump_sigmas;
    ptrdiff_t i;
    linearize(g, p, n);
    for (i = 0; i < n; i++) {
        double on = g->h_on[i], off = g->h_off[i], e = g->innovation[i];
        double g0 = g->var_base[i] + on * g->cov_base_on[i] + off * g->cov_base_off[i];
        double g1 = g->cov_base_on[i] + on * g->var_on[i] + off * g->cov_on_off[i];
        double g2 = g->cov_base_off[i] + on * g->cov_on_off[i] + off * g->var_off[i];
        double v = g0 + on * g1 + off * g2 + g->noise[i], ratio = e * e / v, jump;
        double k0, k1, k2, rest, learn = g->learn[i], weight;
        double by_on = g->theta_on[i] * (g->n_on[i] + on);
        double by_off = g->theta_off[i] * (off - g->n_off[i]);
        /* Lost events or a wrong sample make the base jump, but not the thresholds. */
        jump = ratio > most ? e * e : 0.0;
        weight = ratio > most ? 0.0 : learn / v;
        g->terms[ON][i] = weight * by_on * e;
        g->terms[OFF][i] = weight * by_off * e;
        g->terms[ON_ON][i] = weight * by_on * by_on;
        g->terms[ON_OFF][i] = weight * by_on * by_off;
        g->terms[OFF_OFF][i] = weight * by_off * by_off;
        g->v[i] = v;
        g->narrow[i] = (float)v;
        g->jump[i] = jump;
        g->terms[RATIO][i] = ratio > most ? most : ratio;
        g->spread[i] = p->offset_dn * (g->sample_per_dn[i] - g->pull[i]);
        g0 += jump;
        v += jump;
        k0 = g0 / v;
        k1 = learn * (g1 / v);
        k2 = learn * (g2 / v);
        g->base[i] += k0 * e;
        g->pull[i] += k0 * (g->sample_per_dn[i] - g->pull[i]);
        /* At rest the sample measures the part, too: its noise is that of the frame. */
        rest = 1.0 - (g->noise[i] - g->motion[i]) / v;
        rest = g->silent[i] > 0.0 ? rest : k0;
        g->held[i] += rest * (g->part[i] - g->held[i])
                      + (rest - k0) * e / g->event_step[i];
        g->var_base[i] = g->var_base[i] + jump - k0 * g0;
        g->cov_base_on[i] -= k0 * g1;
        g->cov_base_off[i] -= k0 * g2;
        g->theta_on[i] = limited(g->theta_on[i] + k1 * e, g->prior_on[i], p);
        g->theta_off[i] = limited(g->theta_off[i] + k2 * e, g->prior_off[i], p);
        g->var_on[i] -= k1 * g1;
        g->cov_on_off[i] -= k1 * g2;
        g->var_off[i] -= k2 * g2;
    }
    set_terms(g, p, n);
    add_up(g, n, sums);
}

#endif
