/* Part of a threshold crossed, live, where a sample has measured it since the last
   event: see part_at in _estimate.pxd.  docs/theory/kalman.md derives it. */
#ifndef PDAVIS_CV_SAMPLED_PART_H
#define PDAVIS_CV_SAMPLED_PART_H

#include "_clones.h"
#include "_math.h"

#define LEAST_NOISE 1e-6f       /* thresholds^2; numerical */
#define LEAST_SHARE 1e-6f       /* least probability of motion; numerical */
#define LEAST_TIME 0.0625f      /* gaps; the resolution of the table */
#define ODDS_MOST 50.0f         /* ln; numerical */
#define AT_REST_VARIANCE (1 / 3.0f)     /* thresholds^2: anywhere in the dead band */

/* A row of the table; a copy of it, as a pointer keeps gcc from vectorising. */
typedef struct {
    float part, rate, rate_var, moving, spread, middle, common;
} ahead_t;

typedef struct {
    float part, rate, var, rate_var;    /* thresholds; per gap before the last event */
} sampled_t;

/* Combine the table's row with a sample.

   u: time since the last event over the gap before it; at: part of that time after
   which the sample was taken; rest: probability of rest by silence alone; held: the part
   that the sample has measured, with the variance noise; reset: part that the light has
   crossed while the pixel was held in reset. */
PDAVIS_INLINE sampled_t part_of_sample(ahead_t row, float u, float at, float rest,
                                       float held, float noise, float reset)
{
    /* Reciprocals, as divisions take most of the time. */
    float per_share = 1.0f / (row.moving > LEAST_SHARE ? row.moving : LEAST_SHARE);
    float moving = (1.0f - rest) * row.moving, still, odds, per_v, gain, far, per_still;
    float mean = row.part * per_share, rate = row.rate * per_share;
    float spread2 = row.spread * row.spread;
    float early = 1.0f - at, expected, common, part, error;
    sampled_t s;
    noise = noise > LEAST_NOISE ? noise : LEAST_NOISE;
    u = u > LEAST_TIME ? u : LEAST_TIME;
    expected = at * (mean + 4.0f * early * (row.middle - 0.5f * mean));
    common = 1.0f - 4.0f * (1.0f - row.common) * early * early;
    common = at * spread2 * (common > 0.0f ? common : 0.0f);
    per_v = 1.0f / (at * at * spread2 + noise);
    gain = common * per_v;
    far = held - reset - expected;
    part = mean + reset + gain * far;
    /* Bayes' rule: light at rest lies anywhere in the dead band. */
    per_still = 1.0f / (AT_REST_VARIANCE + noise);
    odds = 0.5f * (held * held * per_still - far * far * per_v);
    odds = odds < ODDS_MOST ? odds : ODDS_MOST;
    odds = odds > -ODDS_MOST ? odds : -ODDS_MOST;
    /* sqrt(per_v / per_still), so that both parts of the quotient stay finite. */
    odds = moving * pd_exp(odds) * sqrtf(per_v);
    still = (1.0f - moving) * sqrtf(per_still);
    moving = odds / (odds + still);
    still = 1.0f - moving;
    error = part - held;
    s.part = held + moving * error;
    s.var = moving * (spread2 - gain * common + still * error * error);
    s.rate_var = (row.rate_var + row.rate * row.rate) * per_share - rate * rate;
    s.rate_var = s.rate_var > 0.0f ? s.rate_var : 0.0f;
    rate += gain * far / u;
    s.rate = moving * rate;
    s.rate_var = moving * (s.rate_var + still * rate * rate);
    return s;
}

#endif
