/* Part of a threshold crossed, live, where a sample has measured it since the last
   event: see part_at in _estimate.pxd.  docs/theory/kalman.md derives it. */
#ifndef PDAVIS_CV_SAMPLED_PART_H
#define PDAVIS_CV_SAMPLED_PART_H

#include <math.h>

#include "_clones.h"
#include "_extrapolation.h"
#include "_math.h"

#define LEAST_NOISE 1e-6f       /* thresholds^2; numerical */
#define LEAST_SHARE 1e-6f       /* least probability of motion; numerical */
#define LEAST_TIME 0.0625f      /* gaps; the resolution of the table */
#define ODDS_MOST 50.0f         /* ln; numerical */

typedef struct {
    float part, rate, var, rate_var;    /* thresholds; per gap before the last event */
} sampled_t;

/* Combine the table's row with a sample.

   u: time since the last event over the gap before it; at: part of that time after
   which the sample was taken; rest: probability of rest by silence alone; held: the part
   that the sample has measured, with the variance noise; reset: part that the light has
   crossed while the pixel was held in reset. */
PDAVIS_INLINE sampled_t part_of_sample(const float *row, float u, float at, float rest,
                                       float held, float noise, float reset)
{
    sampled_t s;
    float share = row[4] > LEAST_SHARE ? row[4] : LEAST_SHARE;
    float moving = (1.0f - rest) * row[4], still, odds, v, gain, far, still_v;
    float mean = row[0] / share, rate = row[1] / share, spread2 = row[5] * row[5];
    float early = 1.0f - at, expected, common, part, error;
    noise = noise > LEAST_NOISE ? noise : LEAST_NOISE;
    u = u > LEAST_TIME ? u : LEAST_TIME;
    expected = at * (mean + 4.0f * early * (row[6] - 0.5f * mean));
    common = 1.0f - 4.0f * (1.0f - row[7]) * early * early;
    common = at * spread2 * (common > 0.0f ? common : 0.0f);
    v = at * at * spread2 + noise;
    gain = common / v;
    far = held - reset - expected;
    part = mean + reset + gain * far;
    /* Bayes' rule: light at rest lies anywhere in the dead band. */
    still_v = (float)(1.0 / 3.0) + noise;
    odds = 0.5f * (held * held / still_v - far * far / v);
    odds = odds < ODDS_MOST ? odds : ODDS_MOST;
    odds = odds > -ODDS_MOST ? odds : -ODDS_MOST;
    odds = pd_exp(odds) * sqrtf(still_v / v);
    moving = moving * odds / (moving * odds + (1.0f - moving));
    still = 1.0f - moving;
    error = part - held;
    s.part = held + moving * error;
    s.var = moving * (spread2 - gain * common + still * error * error);
    s.rate_var = moving * ((row[3] + row[1] * row[1]) / share - rate * rate);
    rate += gain * far / u;
    s.rate = moving * rate;
    s.rate_var += moving * still * rate * rate;
    return s;
}

#endif
