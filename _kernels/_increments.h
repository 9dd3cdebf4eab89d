/* What the events of a pixel say of its light: docs/theory/kalman.md, equations (2)
   to (6).  Times are s, counts are signed numbers of thresholds, OFF first. */
#ifndef PDAVIS_CV_INCREMENTS_H
#define PDAVIS_CV_INCREMENTS_H

#include "_clones.h"
#include "_math.h"

#define GAP_CLASSES 5           /* hats in ln(gap), centred at 2, 8, 32, 128, 512 ms */
#define FIRST_GAP 2e-3          /* s: centre of the first one */
#define LN_CLASS 1.3862943611198906     /* ln 4, between the centres */
#define CONTEXTS 4
#define RATIOS 5                /* silence / gap before it: 1/4, 1/2, 1, 2, 4 */
#define FIRST_RATIO 0.25
#define LAGS 5
/* Gap before a turn of the light over that of the turn, a parabola that goes on by x
   thresholds: (sqrt(1 + x) - sqrt x)^2; at the most one, 3 - 2 sqrt 2. */
#define EARLIEST_TURN 0.17157287525380990
#define LEAST_LIVE 0.25         /* of the dead time, that a gap goes on after it */
#define LEAST_GAP 1e-5          /* s: bounds of a ratio; below all that occurs */
#define LEAST_SILENCE 1e-6
#define LEAST_LIGHT 1e-3        /* DN/ms: light that is less leads as much */
#define LEAD_LINEAR 0.02        /* lead up to which two terms err by some 1e-5 */
#define LEAD_LEAST -0.85        /* ln: near u = -1, where u e^u has its minimum, and far */
#define LEAD_MOST 2.0           /* beyond 1, y' does not determine the lead */
#define LEAD_STEPS 8            /* at most, of Newton's method; some four are needed */
#define LEAD_ERROR 1e-4         /* ln: the step with which they end */
#define RESTS 2.5               /* rest times after which light is still */
#define AT_REST (1.0 / (1.0 + RESTS * RESTS))
#define PER_TURN_2 0.15915494309189535  /* 1 / (2 pi) */

/* Constants of the filter: times, gates, hot pixels (docs/theory/kalman.md). */
#define PD_NEVER ((int64_t)1 << 62)
/* Of a pixel's planes: out of date; and those of a pixel whose events say nothing of
   the time since the frame before, which its samples alone decide. */
#define PD_CHANGED (-PD_NEVER)
#define PD_QUIET (PD_CHANGED - 1)
#define PD_GATE 16.0            /* squared sigmas beyond which a frame starts anew */
/* A frame contradicts events if their signs agree by this share, and it shows less than
   that of their change.  ln odds: one pixel in 1000 is hot; of those nine frames in ten
   contradict, of others one in a hundred (ln .9/.01 and ln .99/.1). */
#define PD_CLAIM 0.5
#define PD_SHOWN 0.25
#define PD_PRIOR_ODDS 6.91
#define PD_MORE 4.5
#define PD_LESS 2.29
#define PD_HOT_MEMORY 8.0       /* frames, of the motion that replaces its events */
#define PD_UNKNOWN 1e3          /* variance of a pixel without a sample */
#define PD_DOUBTFUL 9.0         /* squared sigmas: pixels contradict events */
/* s since an event, and growth, of the times between which a silence is linear. */
#define PD_SMOOTH_FROM 0.045
#define PD_KNOT 1.1

/* A camera as the kernels take it; the fields of `PixelModel.numbers`, all doubles. */
typedef struct {
    double rest;                /* s: a gap in which light is as likely still */
    double dead;                /* s: dead time after an event */
    double turn;                /* of a parabola after a gap of unknown pace */
    double hz, hz_per_light;    /* corner frequency: Hz, Hz per DN/ms */
    double black;               /* DN/ms that frames lack */
    double alpha, beta, gamma;  /* noise: per s, of a change, per threshold (ln^2) */
    double theta[2];            /* ln: OFF, ON */
    double theta_cov[3];        /* OFF OFF, OFF ON, ON ON */
    double spread2;             /* of the pixels' gains, squared */
    double by_class[2][GAP_CLASSES];
    double end[CONTEXTS][RATIOS], bow[CONTEXTS][RATIOS], open[CONTEXTS][RATIOS];
    double lag[LAGS];           /* s */
    double own[LAGS][2], cell[LAGS][2], near[LAGS][2];
    double own_now[2], cell_now[2], near_now[2];
} camera_t;

/* The events around a time t: the last one at or before it, and the next one. */
typedef struct {
    double since;               /* s from the last one to t */
    double gap;                 /* s from the last to the next one; 0: not known */
    double silent;              /* s from the last one to the end of what is known */
    double before;              /* s from the one before to the last one */
    double next_weight;         /* thresholds that the next one stands for */
    double drift;               /* ln: change of the lamp's ripple until then, negated */
    int sign, next_sign;        /* -1 OFF, 1 ON */
    int context;                /* 0, 1: the last three have one sign, gaps shorten or
                                   lengthen; 2: the last two have; 3: they differ */
    int flickers;               /* the lamp's ripple is known, and turns are its own */
} around_t;

/* Probability that light moved all through a gap; else it rests and then jumps.  (3) */
PDAVIS_INLINE double moves(double gap, const camera_t *c)
{
    double x = gap / c->rest;
    return 1.0 / (1.0 + x * x);
}

/* The same of a silence that goes on: less what is left at RESTS rest times, from which
   on the light counts as still. */
PDAVIS_INLINE double goes_on(double gap, const camera_t *c)
{
    double left = moves(gap, c) - AT_REST;
    return left > 0.0 ? left / (1.0 - AT_REST) : 0.0;
}

/* Lead u of the light over the photoreceptor: u (f0 + k I e^u) = y' / 2 pi.  (5) */
PDAVIS_INLINE double lead_of(double slope, double light, const camera_t *c)
{
    double right = slope * PER_TURN_2, u, x;
    double kl = c->hz_per_light * (light > LEAST_LIGHT ? light : LEAST_LIGHT);
    int k;
    if (c->hz + kl <= 0.0)
        return 0.0;
    u = right / (c->hz + kl);
    x = u * (1.0 - u * kl / (c->hz + kl));
    if (fabs(u) < LEAD_LINEAR)
        return x;
    for (k = 0; k < LEAD_STEPS; k++) {
        u = x > LEAD_MOST ? LEAD_MOST : x < LEAD_LEAST ? LEAD_LEAST : x;
        x = kl * pd_exp((float)u);
        x = u - (u * (c->hz + x) - right) / (c->hz + x * (1.0 + u));
        if (fabs(x - u) < LEAD_ERROR)
            return x;
    }
    return u;
}

/* The gap before a turn of the light, of which one of this pace is q, s. */
PDAVIS_INLINE double pace_of(double before, int known, double gap, const camera_t *c)
{
    double q = known ? before / gap : c->turn;
    return gap * (q < EARLIEST_TURN ? EARLIEST_TURN : q > 1.0 ? 1.0 : q);
}

/* What of a gap the pixel was not held in reset.  It is at least LEAST_LIVE of the dead
   time: noise would count without end. */
PDAVIS_INLINE double live_of(double gap, const camera_t *c)
{
    double live = gap - c->dead, least = LEAST_LIVE * c->dead;
    return live > least ? live : least;
}

/* Thresholds that an event stands for after a gap, and the gap before it, the last of
   `run_before` events of one sign: light went on in the dead time.  (4)
   An event of the same time has no such gap. */
PDAVIS_INLINE double weight_of(double gap, double before, int same, int run_before,
                               const camera_t *c)
{
    double live;
    if (c->dead <= 0.0 || run_before < 1 || gap <= 0.0)
        return 1.0;
    if (same)
        return 1.0 + c->dead / live_of(gap, c);
    before = pace_of(before, run_before > 1, gap, c);
    live = live_of(before, c);
    return gap * ((live + gap) / live_of(gap, c) - c->dead / live) / (before + gap);
}

/* Class of the gap before an event, and the share of the next class. */
PDAVIS_INLINE int class_of(double gap, double *share)
{
    double x = gap > FIRST_GAP ? pd_log((float)gap / (float)FIRST_GAP) / LN_CLASS : 0.0;
    int i = x < GAP_CLASSES - 2 ? (int)x : GAP_CLASSES - 2;
    *share = x - i < 1.0 ? x - i : 1.0;
    return i;
}

/* Change of light by an event after a gap, by its class. */
PDAVIS_INLINE double step_of(double before, int on, const camera_t *c)
{
    double part;
    int i = class_of(before, &part);
    return c->theta[on] + (1.0 - part) * c->by_class[on][i]
           + part * c->by_class[on][i + 1];
}

PDAVIS_INLINE int context_of(int run, double before, double before2)
{
    return run < 2 ? 3 : run < 3 ? 2 : before < before2 ? 0 : 1;
}

/* Node of a ratio of silence to the gap before, and the share of the next node. */
PDAVIS_INLINE int node_of(double ratio, double *share)
{
    double low = FIRST_RATIO;
    int node = 0;
    while (node < RATIOS - 2 && ratio > 2.0 * low) {
        node++;
        low *= 2.0;
    }
    *share = (ratio - low) / low;
    *share = *share < 1.0 ? *share : 1.0;
    return node;
}

/* A silence whose end is not known: the part of a threshold passed at a time x since
   the last event (s) is x (rise + x bend), its variance `open` times a shape.  (2c) */
typedef struct {
    double rise, bend, open, length;
} silence_t;

PDAVIS_INLINE silence_t silence_of(const around_t *a, const camera_t *c)
{
    double length = a->silent > LEAST_SILENCE ? a->silent : LEAST_SILENCE;
    double before = a->before > LEAST_GAP ? a->before : LEAST_GAP, share, end, bow, z;
    double ratio = length / before, on = goes_on(length > before ? length : before, c);
    int node = node_of(ratio, &share);
    const double *e = &c->end[a->context][node], *b = &c->bow[a->context][node];
    const double *o = &c->open[a->context][node];
    silence_t out;
    end = e[0] + share * (e[1] - e[0]);
    bow = 4.0 * (b[0] + share * (b[1] - b[0]));
    out.open = o[0] + share * (o[1] - o[0]);
    if (ratio < FIRST_RATIO) {
        end = c->end[a->context][0] * ratio / FIRST_RATIO;
        out.open = c->open[a->context][0];
    }
    z = a->sign * on / length;
    out.rise = z * (end + bow);
    out.bend = -z * bow / length;
    out.open *= on;
    out.length = length;
    return out;
}

/* Variance of the part of a silence at a time x, thresholds^2. */
PDAVIS_INLINE double silent_variance(const silence_t *of, double x)
{
    double s = x / of->length;
    return of->open * (s > 0.5 ? s : 2.0 * s * (1.0 - s));
}

/* Parts of a threshold, OFF and ON, passed at a time x since the last event, s:
   x (rise + x bend).  (2a) to (2c) */
PDAVIS_INLINE void course_of(const around_t *a, const camera_t *c, double rise[2],
                             double bend[2])
{
    int on = a->sign > 0;
    rise[0] = rise[1] = bend[0] = bend[1] = 0.0;
    if (a->gap > 0.0) {
        double p = moves(a->gap, c);
        rise[a->next_sign > 0] = a->next_sign * p * a->next_weight / a->gap;
        if (a->next_sign != a->sign && !a->flickers) {
            double before = pace_of(a->before, a->context < 3, a->gap, c);
            bend[on] = -a->sign * p * (1.0 / live_of(a->gap, c) + 1.0 / live_of(before, c))
                       / (before + a->gap);
            rise[on] = -bend[on] * a->gap;
        }
    } else if (!a->flickers) {
        silence_t open = silence_of(a, c);
        rise[on] = open.rise;
        bend[on] = open.bend;
    }
}

/* Parts of a threshold passed since the last event, OFF and ON, and their rates per s.
   */
PDAVIS_INLINE void part_of(const around_t *a, const camera_t *c, double part[2],
                           double rate[2])
{
    double rise[2], bend[2], x = a->since;
    int j;
    course_of(a, c, rise, bend);
    for (j = 0; j < 2; j++) {
        part[j] = x * (rise[j] + x * bend[j]);
        rate[j] = rise[j] + 2.0 * x * bend[j];
    }
}

/* What light passed since the last event because the lamp's ripple changed, and its
   rate per s: an event stands for the sum of both. */
PDAVIS_INLINE double drift_of(const around_t *a, const camera_t *c, double *rate)
{
    *rate = 0.0;
    if (a->gap <= 0.0 || a->drift == 0.0)
        return 0.0;
    *rate = a->drift * moves(a->gap, c) / a->gap;
    return *rate * a->since;
}

/* ln light at t (us) that is still, and its variance, from the frames before and after
   (at m0 and m1; a variance < 0: none) and what is common to both.  (13) */
PDAVIS_INLINE void at_rest(
    double t, float ahead, float p_ahead, float behind, float p_behind,
    double common, double extra, double m0, double m1, double alpha, double *log,
    double *variance)
{
    int before = p_ahead >= 0.0f, after = p_behind >= 0.0f, both = before && after;
    double v1 = p_ahead + alpha * fabs(1e-6 * (t - m0));
    double v2 = p_behind + alpha * fabs(1e-6 * (m1 - t));
    double all = v1 + v2 - 2.0 * common, u = (v1 - common) / all;
    u = u < 0.0 ? 0.0 : u > 1.0 ? 1.0 : u;
    *log = both ? ahead + u * (behind - ahead) : before ? ahead : after ? behind : 0.0;
    v1 = both ? v1 + u * (u * all - 2.0 * (v1 - common)) : before ? v1 : v2;
    *variance = before || after ? extra + v1 : PD_UNKNOWN;
}

/* Its planes (see `show_row`), times from an epoch: from the frame before to the one
   after, or a second on from either; frames are a ms apart at least. */
PDAVIS_INLINE void rest_planes(
    float ahead, float p_ahead, float behind, float p_behind, double common,
    double extra, double m0, double m1, double epoch, double alpha,
    float *restrict level, float *restrict slope, float *restrict variance,
    float *restrict grows, float *restrict bends)
{
    int before = p_ahead >= 0.0f, after = p_behind >= 0.0f;
    double t0 = before || !after ? m0 : m1 - 1e6, t1 = after ? m1 : t0 + 1e6;
    double j0, j1, v0, v1, seconds, since = 1e-6 * (epoch - t0), bend, rate;
    t1 = t1 > t0 + 1e3 ? t1 : t0 + 1e3;
    at_rest(t0, ahead, p_ahead, behind, p_behind, common, extra, m0, m1, alpha,
            &j0, &v0);
    at_rest(t1, ahead, p_ahead, behind, p_behind, common, extra, m0, m1, alpha,
            &j1, &v1);
    seconds = 1e-6 * (t1 - t0);
    rate = (j1 - j0) / seconds;
    *slope = (float)rate;
    *level = (float)(j0 + rate * since);
    /* v1 v2 / (v1 + v2) is a parabola, as v1 grows as fast as v2 falls. */
    bend = -alpha * alpha
           / (p_ahead + p_behind - 2.0 * common + alpha * 1e-6 * (m1 - m0));
    bend = before && after ? bend : 0.0;
    rate = (v1 - v0) / seconds - bend * seconds;
    *bends = (float)bend;
    *grows = (float)(rate + 2.0 * bend * since);
    *variance = (float)(v0 + since * (rate + since * bend));
}

/* The same of a row of pixels, whose planes hold ahead, behind and their variances. */
PDAVIS_CLONES PDAVIS_UNUSED static void rest_row(
    const double *restrict m0, const double *restrict m1, double epoch, double alpha,
    ptrdiff_t n, float *restrict level, float *restrict slope,
    float *restrict variance, float *restrict grows, float *restrict bends)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        rest_planes(level[i], variance[i], slope[i], grows[i], 0.0, 0.0, m0[i], m1[i],
                    epoch, alpha, level + i, slope + i, variance + i, grows + i,
                    bends + i);
}

/* Let a row of quiet pixels pass a frame (see `pass_one`): predict and update level and
   covariance (upper row), where there is a sample z (variance > 0); noise is (8). */
PDAVIS_CLONES PDAVIS_UNUSED static void pass_row(
    const float *restrict z, const float *restrict variance,
    const float *restrict said, const double *restrict noise, ptrdiff_t n,
    float *restrict log, float *restrict p0, float *restrict p1, float *restrict p2,
    float *restrict motion)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double r = variance[i], e = z[i] - log[i], k;
        float level = (float)(log[i] + (double)said[i]);
        float moved = (float)(motion[i] + (e * e - motion[i]) / PD_HOT_MEMORY);
        float p = (float)(p0[i] + noise[i]);
        int seen = r > 0.0;
        e = z[i] - level;
        p = seen && e * e > PD_GATE * (p + r) ? (float)(p + e * e) : p;
        k = p * (1.0 / (p + r));
        log[i] = seen ? (float)(level + k * e) : level;
        p0[i] = seen ? (float)(k * r) : p;
        p1[i] = seen ? (float)(p1[i] - k * p1[i]) : p1[i];
        p2[i] = seen ? (float)(p2[i] - k * p2[i]) : p2[i];
        motion[i] = seen ? moved : motion[i];
    }
}

/* Carry estimates b of quiet pixels, with their variances v (< 0: none), back from the
   frame after (see `back_one`), whose `said` and `noise` are given, and join samples. */
PDAVIS_CLONES PDAVIS_UNUSED static void back_row(
    const float *restrict z, const float *restrict variance,
    const float *restrict said, const double *restrict noise, ptrdiff_t n,
    double *restrict b, double *restrict v)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double r = variance[i], e, old = b[i], all = v[i];
        int had = all > 0.0, seen = r > 0.0, anew;
        old = had ? old - said[i] : old;
        all = had ? all + noise[i] : all;
        e = z[i] - old;
        anew = !had || e * e > PD_GATE * (all + r);
        b[i] = !seen ? old : anew ? z[i] : old + all / (all + r) * e;
        v[i] = !seen ? all : anew ? r : all * r / (all + r);
    }
}

/* A row of an image: planes (level at the epoch, its slope, variance, its slope and
   curvature per s) and the lamp's ripple, to ln light, which is what other pixels say
   before, its variance and validity. */
PDAVIS_CLONES PDAVIS_UNUSED static void show_row(
    const float *restrict level, const float *restrict slope,
    const float *restrict variance, const float *restrict grows,
    const float *restrict bends, float since, float ripple, float most, ptrdiff_t n, float *restrict log, float *restrict out,
    uint8_t *restrict valid)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        log[i] += level[i] + since * slope[i];
        out[i] = variance[i] + since * (grows[i] + since * bends[i]);
    }
    if (ripple != 0.0f)
        for (i = 0; i < n; i++)
            log[i] += ripple;
    for (i = 0; i < n; i++)
        valid[i] = out[i] <= most;
}

/* own + the mean over each macropixel + the mean of the four nearest alike. */
PDAVIS_CLONES PDAVIS_UNUSED static void mean_row(
    const float *restrict own, const float *restrict cell, const float *restrict other,
    const float *restrict near, const float *restrict up, const float *restrict down,
    ptrdiff_t n, float *restrict out)
{
    ptrdiff_t x;
    for (x = 0; x < n; x++)
        out[x] = own[x] + 0.25f * (up[x] + down[x]);
    for (x = 2; x + 2 < n; x++)
        out[x] += 0.25f * (near[x - 2] + near[x + 2]);
    for (x = 0; x < n; x += x == 1 && n > 4 ? n - 3 : 1)
        out[x] += 0.25f * (near[x < 2 ? 0 : x - 2] + near[x + 2 < n ? x + 2 : n - 1]);
    for (x = 0; x + 1 < n; x += 2) {
        float mean = 0.25f * (cell[x] + cell[x + 1] + other[x] + other[x + 1]);
        out[x] += mean;
        out[x + 1] += mean;
    }
    if (n & 1)
        out[n - 1] += cell[n - 1];
}

#endif
