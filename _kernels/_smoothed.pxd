"""Smoothed log intensity of a pixel from frames on both sides.  Inline only.

Until the next event or frame, the estimate is a polynomial of time, apart from the part
of a threshold crossed since the last event: see `course_of`.
"""
from libc.stdint cimport int64_t

from _kernels._estimate cimport (
    LEAST_VARIANCE, output_slope, part_at, part_variance, theta_squared, walk_to)
from _kernels._hot cimport is_hot
from _kernels._lag cimport corner, lead, lead_variance
from _kernels._lamp cimport lamp_t
from _kernels._lanes cimport gap_before, lanes_t
from _kernels._model cimport state_t, stored_t, track_t, tuning_t
from _kernels._tracks cimport REST_VARIANCE, TINY, at_rest, drift, part_t, walk_t

cdef packed struct past_t:
    # Estimate of the base from the samples on one side; var < 0: there is none.
    double base
    double var
    int64_t t
    double n_on             # all events up to t, and the change lost in resets
    double n_off

cdef packed struct gap_t:
    # Estimates from the samples on both sides of a time.
    past_t before
    past_t after            # base after the next sample
    double drift            # process noise between both

cdef struct course_t:
    # A pixel between two events, dt seconds after the epoch.  Log intensity is level
    # + slope dt, its variance v0 + dt (v1 + dt v2).  A part crossed of the next ON
    # threshold adds part (up0 + up1 dt) to the variance, one of OFF uses down0, down1.
    bint measured           # whether there is any sample
    double level
    double slope
    double v0
    double v1
    double v2
    double up0
    double up1
    double down0
    double down1

cdef struct resting_t:
    # A pixel at rest, as in course_t; offset: variance of the offset, < 0: no sample.
    float level
    float slope
    float v0
    float v1
    float v2
    float offset


cdef inline course_t course_of(const gap_t* gap, const walk_t* walk, const state_t* s,
                               int64_t epoch, const tuning_t* tuning) noexcept nogil:
    """Return the course of a pixel between two events; walk has passed the first.

    The weights of both sides depend on the process noise since the sample before, which
    is linear in time, and on its sum with that until the sample after, which is
    constant.  So the weights are linear in time.
    """
    cdef course_t c
    cdef double on = s.theta_on, off = s.theta_off, theta2 = theta_squared(s)
    cdef double per_s = theta2 * tuning.leak_per_s, m_on = 0.0, m_off = 0.0
    cdef double to_on = gap.after.n_on - walk.n_on
    cdef double to_off = gap.after.n_off - walk.n_off
    cdef double a, a1, v, u, share, share1, whole, sum_, on1 = 0.0, off1 = 0.0
    c.measured = gap.before.var >= 0 or gap.after.var >= 0
    c.slope = 0.0
    c.v1 = 0.0
    c.v2 = 0.0
    if gap.before.var >= 0:
        m_on = walk.n_on - gap.before.n_on
        m_off = walk.n_off - gap.before.n_off
        c.level = gap.before.base + on * m_on - off * m_off
        v = theta2 * drift(epoch - gap.before.t, m_on + m_off, tuning)
        if gap.after.var >= 0:
            # A jump between two samples may lie anywhere between them.
            whole = theta2 * drift(
                gap.after.t - gap.before.t, m_on + to_on + m_off + to_off, tuning)
            share = v / whole if whole > 0 else 0.5
            share1 = per_s / whole if whole > 0 else 0.0
            a = gap.before.var + share * gap.drift
            a1 = share1 * gap.drift
            sum_ = gap.before.var + gap.drift + gap.after.var + TINY
            share = a / sum_
            share1 = a1 / sum_
            u = gap.after.base - (on * to_on - off * to_off) - c.level
            c.level += share * u
            c.slope = share1 * u
            c.v0 = (1.0 - share) * a
            c.v1 = (1.0 - share) * a1 - share1 * a
            c.v2 = -share1 * a1
            on1 = -share1 * (m_on + to_on)
            off1 = -share1 * (m_off + to_off)
            m_on -= share * (m_on + to_on)
            m_off -= share * (m_off + to_off)
        else:
            c.v0 = gap.before.var + v
            c.v1 = per_s
    elif gap.after.var >= 0:
        c.level = gap.after.base - (on * to_on - off * to_off)
        c.v0 = gap.after.var + theta2 * drift(gap.after.t - epoch, to_on + to_off,
                                              tuning)
        c.v1 = -per_s
        m_on = -to_on
        m_off = -to_off
    else:
        c.level = on * walk.n_on - off * walk.n_off
        c.v0 = 0.0
    c.up0 = 2.0 * (m_on * s.var_on - m_off * s.cov_on_off)
    c.up1 = 2.0 * (on1 * s.var_on - off1 * s.cov_on_off)
    c.down0 = 2.0 * (m_off * s.var_off - m_on * s.cov_on_off)
    c.down1 = 2.0 * (off1 * s.var_off - on1 * s.cov_on_off)
    c.v0 += 0.5 * (m_on * c.up0 + m_off * c.down0)
    c.v1 += m_on * c.up1 + m_off * c.down1
    c.v2 += 0.5 * (on1 * c.up1 + off1 * c.down1)
    if gap.before.var >= 0 and walk.t > gap.before.t:
        c.v0 += theta2 * tuning.motion_variance
    return c


cdef inline void enter_smoothed(lanes_t* lanes, Py_ssize_t i, const walk_t* walk,
                                const gap_t* gap, const state_t* s, int64_t epoch,
                                const tuning_t* tuning) noexcept nogil:
    """Write a pixel's lane; walk has passed its last event."""
    cdef course_t c = course_of(gap, walk, s, epoch, tuning)
    cdef double u = tuning.offset_dn * s.pull
    lanes.last[i] = <double>walk.t
    lanes.before[i] = gap_before(walk)
    lanes.same[i] = walk.p == walk.p_prev
    lanes.level[i] = <float>c.level
    lanes.theta[i] = <float>(s.theta_on if walk.p else -s.theta_off)
    lanes.theta2[i] = <float>theta_squared(s)
    lanes.held[i] = 0.0
    lanes.v0[i] = <float>c.v0
    lanes.v1[i] = <float>(c.up0 if walk.p else c.down0)
    lanes.v2[i] = <float>(s.var_on if walk.p else s.var_off)
    lanes.offset[i] = <float>(u * u)
    lanes.measured[i] = c.measured
    lanes.slope[i] = <float>c.slope
    lanes.v0_1[i] = <float>c.v1
    lanes.v0_2[i] = <float>c.v2
    lanes.v1_1[i] = <float>(c.up1 if walk.p else c.down1)


cdef inline resting_t resting_of(const gap_t* gap, const walk_t* walk,
                                 const state_t* s, int64_t epoch,
                                 const tuning_t* tuning) noexcept nogil:
    """Return the estimate of a pixel at rest that is not hot."""
    cdef resting_t rest
    cdef course_t c = course_of(gap, walk, s, epoch, tuning)
    cdef double u = tuning.offset_dn * s.pull
    if gap.before.var >= 0:
        c.v0 += part_variance(s, gap.before.t, walk.t)
    else:
        c.v0 += theta_squared(s) * REST_VARIANCE
    rest.level = <float>c.level
    rest.slope = <float>c.slope
    rest.v0 = <float>c.v0
    rest.v1 = <float>c.v1
    rest.v2 = <float>c.v2
    rest.offset = <float>(u * u) if c.measured else -1.0
    return rest


cdef inline void show_resting(const resting_t* rest, float dt, float most, float* out,
                              float* variance, unsigned char* valid) noexcept nogil:
    """Write a pixel at rest, dt seconds after the epoch (as smooth_row in _rest.h)."""
    cdef float least = LEAST_VARIANCE, v = rest.v0 + dt * (rest.v1 + dt * rest.v2)
    v = v if v > least else least
    out[0] = rest.level + rest.slope * dt
    variance[0] = 0.0
    valid[0] = 0
    if rest.offset >= 0:
        variance[0] = v + rest.offset
        valid[0] = v <= most


cdef inline void read_hot(int64_t t, const tuning_t* tuning, const gap_t* gap,
                          const state_t* s, float* out, float* variance,
                          unsigned char* valid) noexcept nogil:
    """Write log intensity of a hot pixel, from its samples alone.

    The motion of the light between both samples is split in proportion to time.
    """
    cdef double a = gap.before.var, b = gap.after.var, share, u = tuning.offset_dn
    u *= s.pull
    variance[0] = 0.0
    valid[0] = 0
    if a < 0 and b < 0:
        out[0] = 0.0
        return
    valid[0] = max(a, b) <= tuning.valid_variance
    if a < 0 or b < 0:
        out[0] = <float>(gap.before.base if b < 0 else gap.after.base)
        variance[0] = <float>(max(a, b) + s.moves + u * u)
        return
    share = <double>(t - gap.before.t) / <double>max(gap.after.t - gap.before.t, 1)
    a += share * s.moves
    b += (1.0 - share) * s.moves
    share = a / (a + b + TINY)
    out[0] = <float>(gap.before.base + share * (gap.after.base - gap.before.base))
    variance[0] = <float>((1.0 - share) * a + u * u)


cdef inline void read_smoothed(int64_t t, int64_t known, const stored_t* store,
                               const tuning_t* tuning, const lamp_t* lamp,
                               const track_t* track, const gap_t* gap,
                               const state_t* s, float* out, float* variance,
                               unsigned char* valid) noexcept nogil:
    """Write log intensity and variance at t, using the events up to known > t."""
    cdef walk_t walk
    cdef part_t part
    cdef double on = s.theta_on, off = s.theta_off, theta2 = theta_squared(s)
    cdef double m_on = 0.0, m_off = 0.0, theta, level = 0.0, v, u, spread
    cdef double a = 0.0, b = 0.0, left, whole, share, hz = 0.0
    cdef bint resting
    if is_hot(s):
        read_hot(t, tuning, gap, s, out, variance, valid)
        return
    walk_to(&walk, t, store, track, tuning.refractory_us)
    # Thresholds crossed since the sample before, and until the one after.
    if gap.before.var >= 0:
        m_on = walk.n_on - gap.before.n_on
        m_off = walk.n_off - gap.before.n_off
        level = gap.before.base + on * m_on - off * m_off
        v = theta2 * drift(t - gap.before.t, m_on + m_off, tuning)
        a = gap.before.var + v
        if gap.after.var >= 0:
            # A jump between two samples may lie anywhere between them.
            whole = theta2 * drift(
                gap.after.t - gap.before.t, gap.after.n_on - gap.before.n_on
                + gap.after.n_off - gap.before.n_off, tuning)
            share = v / whole if whole > 0 else 0.5
            a = gap.before.var + share * gap.drift
            left = (1.0 - share) * gap.drift
    elif gap.after.var >= 0:
        left = theta2 * drift(
            gap.after.t - t, gap.after.n_on - walk.n_on + gap.after.n_off
            - walk.n_off, tuning)
    if gap.after.var >= 0:
        b = gap.after.var + left
        u = gap.after.base - (on * (gap.after.n_on - walk.n_on)
                              - off * (gap.after.n_off - walk.n_off))
        share = a / (a + b + TINY) if gap.before.var >= 0 else 1.0
        m_on = (1.0 - share) * m_on - share * (gap.after.n_on - walk.n_on)
        m_off = (1.0 - share) * m_off - share * (gap.after.n_off - walk.n_off)
        level += share * (u - level)
        v = (1.0 - share) * a if gap.before.var >= 0 else b
    elif gap.before.var >= 0:
        v = a
    else:
        level = on * walk.n_on - off * walk.n_off
        v = -1.0
    # The part crossed of the next threshold, and the lag of the photoreceptor.
    if lamp.blocks > 0:
        hz = corner(tuning, level)
    part = part_at(&walk, store, known, on, off, lamp, hz,
                   tuning, NULL, <double>t)
    resting = lamp.blocks == 0 and at_rest(walk.t, t) and (
        walk.next < 0 or store[walk.next].t > known)
    spread = theta2 * part.var
    if resting and gap.before.var >= 0:
        spread = part_variance(s, gap.before.t, walk.t)
    if (walk.next >= 0 and store[walk.next].t <= known) or (
            gap.before.var >= 0 and walk.t > gap.before.t):
        spread += theta2 * tuning.motion_variance
    theta = on if part.p else -off
    level += theta * part.fraction + part.ripple
    # Constant light has no lag.
    u = 0.0 if resting else lead(
        output_slope(&walk, &part, store, known, on, off, level, lamp, tuning, NULL,
                     <double>t), level, tuning)
    out[0] = <float>(level + u)
    if v < 0:
        variance[0] = 0.0
        valid[0] = 0
        return
    if part.p:
        m_on += part.fraction
    else:
        m_off += part.fraction
    v += (spread + m_on * m_on * s.var_on + m_off * m_off * s.var_off
          - 2.0 * m_on * m_off * s.cov_on_off)
    v = v if v > LEAST_VARIANCE else LEAST_VARIANCE
    valid[0] = v <= tuning.valid_variance
    a = tuning.offset_dn * s.pull
    v += a * a
    if not resting:
        v += lead_variance(
            u, theta2 * part.rate_var, off * part.fall, level, tuning)
    variance[0] = <float>v
