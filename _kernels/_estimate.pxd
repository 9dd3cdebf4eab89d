"""Log intensity of a pixel at one time, by its state and its events.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._lag cimport corner, lead, lead_variance
from _kernels._lamp cimport lamp_t
from _kernels._model cimport state_t, stored_t, track_t, tuning_t
from _kernels._tracks cimport (
    REST_VARIANCE, ahead, at_rest, between, drift, part_t, quiet,
    start, step, still, walk_t)

cdef extern from *:
    """
    #define LEAST_VARIANCE 1e-8     /* ln^2: float32 has no more to tell */
    """
    const double LEAST_VARIANCE

cdef struct reading_t:
    walk_t walk             # up to the last event at or before the time
    part_t part             # crossed since
    double n_on             # counts since the last sample, the part included
    double n_off
    double level            # log intensity as the pixel shows it
    double lag              # log intensity less level

cdef struct rest_t:
    # A pixel at rest: log intensity, its variance at an epoch (< 0: no sample was
    # used), what is added to that per second, and the variance of the offset.
    float level
    float variance
    float per_s
    float offset


cdef inline part_t part_at(const walk_t* walk, const stored_t* store, int64_t known,
                           double on, double off, const lamp_t* lamp, double hz,
                           double t) noexcept nogil:
    """Part crossed at t, between walk and its next event, if that is known."""
    if walk.next >= 0 and store[walk.next].t <= known:
        return between(walk, store[walk.next].t, store[walk.next].p, on, off, lamp,
                       hz, t)
    if at_rest(walk.t, <int64_t>t):
        return still(walk, lamp, hz, t)
    if <double>known > t:
        return quiet(walk.t, walk.p, <double>known, lamp, hz, t)
    return ahead(walk, on, off, lamp, hz, t)


cdef inline void walk_to(walk_t* walk, int64_t t, const stored_t* store,
                         const track_t* track) noexcept nogil:
    """Pass the events up to t, inclusive; count all since the last sample."""
    start(walk, track)
    walk.n_on = track.n_on
    walk.n_off = track.n_off
    while walk.next >= 0 and store[walk.next].t <= t:
        step(walk, store)


cdef inline void read_level(reading_t* r, int64_t t, int64_t known,
                            const stored_t* store, const tuning_t* tuning,
                            const lamp_t* lamp, const state_t* s) noexcept nogil:
    """Log intensity at t; r.walk is there already."""
    cdef double theta, hz = 0.0
    r.n_on = r.walk.n_on
    r.n_off = r.walk.n_off
    if lamp.blocks > 0:
        hz = corner(tuning, s.base + s.theta_on * r.n_on - s.theta_off * r.n_off)
    r.part = part_at(&r.walk, store, known, s.theta_on, s.theta_off, lamp, hz,
                     <double>t)
    if r.part.p:
        r.n_on += r.part.fraction
        theta = s.theta_on
    else:
        r.n_off += r.part.fraction
        theta = -s.theta_off
    r.level = s.base + s.theta_on * r.n_on - s.theta_off * r.n_off + r.part.ripple
    r.lag = lead(theta * r.part.rate + r.part.ripple_rate, r.level, tuning)


cdef inline double counted(const state_t* s, double n_on,
                           double n_off) noexcept nogil:
    """Variance of base + theta_on n_on - theta_off n_off."""
    return (s.var_base + n_on * n_on * s.var_on + n_off * n_off * s.var_off
            + 2.0 * (n_on * s.cov_base_on - n_off * s.cov_base_off
                     - n_on * n_off * s.cov_on_off))


cdef inline double theta_squared(const state_t* s) noexcept nogil:
    """Square of the mean threshold: the unit of parts' variances."""
    return 0.25 * (s.theta_on + s.theta_off) * (s.theta_on + s.theta_off)


cdef inline double part_variance(const state_t* s, int64_t sampled, int64_t last,
                                 const tuning_t* tuning) noexcept nogil:
    """Variance of the part of a pixel at rest; last is the time of its last event.

    A sample after it has measured the part, but for what all samples of a pixel have
    in common (the pixel's difference from nominal), which no averaging reduces.
    """
    if sampled >= last:
        return tuning.frame_sigma * tuning.frame_sigma
    return theta_squared(s) * REST_VARIANCE


cdef inline rest_t rest_of(const state_t* s, double n_on, double n_off, int64_t last,
                           int64_t epoch, const tuning_t* tuning) noexcept nogil:
    """Return what a pixel at rest shows; last is the time of its last event."""
    cdef rest_t rest
    cdef double theta2 = theta_squared(s), v
    rest.level = <float>(s.base + s.theta_on * n_on - s.theta_off * n_off)
    rest.variance = -1.0
    rest.per_s = 0.0
    rest.offset = 0.0
    if s.samples > 0:
        v = counted(s, n_on, n_off) + theta2 * drift(
            epoch - s.sampled_us, n_on + n_off, tuning)
        v += part_variance(s, s.sampled_us, last, tuning)
        rest.variance = <float>(v if v > 0.0 else 0.0)
        rest.per_s = <float>(theta2 * tuning.leak_per_s)
        v = tuning.offset_dn * s.pull
        rest.offset = <float>(v * v)
    return rest


cdef inline void show_rest(const rest_t* rest, float dt, float most, float* out,
                           float* variance, unsigned char* valid) noexcept nogil:
    """Write a pixel at rest, dt seconds after the epoch (as rest_row in _rest.h)."""
    cdef float v = rest.variance + rest.per_s * dt, least = LEAST_VARIANCE
    v = v if v > least else least
    out[0] = rest.level
    if rest.variance < 0:
        variance[0] = 0.0
        valid[0] = 0
        return
    variance[0] = v + rest.offset
    valid[0] = v <= most


cdef inline void read_pixel(int64_t t, int64_t known, int64_t epoch,
                            const stored_t* store, const tuning_t* tuning,
                            const lamp_t* lamp, const track_t* track,
                            const state_t* s, float* out, float* variance,
                            unsigned char* valid) noexcept nogil:
    """Log intensity and its variance at t, events up to known >= t being there."""
    cdef reading_t r
    cdef rest_t rest
    cdef double v, u, theta2
    walk_to(&r.walk, t, store, track)
    if lamp.blocks == 0 and at_rest(r.walk.t, t) and (
            r.walk.next < 0 or store[r.walk.next].t > known):
        rest = rest_of(s, r.walk.n_on, r.walk.n_off, r.walk.t, epoch, tuning)
        show_rest(&rest, <float>(1e-6 * <double>(t - epoch)),
                  <float>tuning.valid_variance, out, variance, valid)
        return
    read_level(&r, t, known, store, tuning, lamp, s)
    out[0] = <float>(r.level + r.lag)
    if s.samples == 0:
        variance[0] = 0.0
        valid[0] = 0
        return
    theta2 = theta_squared(s)
    v = (theta2 * r.part.var + counted(s, r.n_on, r.n_off)
         + theta2 * drift(t - s.sampled_us, r.walk.n_on + r.walk.n_off, tuning))
    v = v if v > LEAST_VARIANCE else LEAST_VARIANCE
    valid[0] = v <= tuning.valid_variance
    u = tuning.offset_dn * s.pull
    variance[0] = <float>(v + u * u + lead_variance(
        r.lag, theta2 * r.part.rate_var, s.theta_off * r.part.fall, r.level, tuning))
