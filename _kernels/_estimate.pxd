"""Log intensity of a pixel at one time from its state and events.  Inline only."""
from libc.math cimport sqrt
from libc.stdint cimport int64_t

from _kernels._hot cimport is_hot
from _kernels._lag cimport PER_TURN, corner, lead, lead_variance
from _kernels._lamp cimport lamp_t
from _kernels._model cimport state_t, stored_t, track_t, tuning_t
from _kernels._tracks cimport (
    REST_VARIANCE, ahead, ahead_of_sample, at_rest, between, drift, moving, never,
    part_t, quiet, p_rest, stamps_apart, start, step, still, walk_t)

cdef extern from *:
    """
    #define LEAST_VARIANCE 1e-8     /* ln^2: the resolution of float32 */
    /* Time constants of a pixel over which the slope of its output is a mean;
       lab/studies/lag_slope.py. */
    #define SLOPE_SPAN 1.0
    """
    const double LEAST_VARIANCE
    const double SLOPE_SPAN

cdef struct reading_t:
    walk_t walk             # position at the last event at or before the time
    part_t part             # part of a threshold crossed since then
    double n_on             # counts since the last sample, including the part
    double n_off
    double level            # log intensity behind the photoreceptor's lag
    double lag              # true log intensity minus level
    double p_noise          # probability that the last event is noise

cdef struct rest_t:
    # A pixel at rest: log intensity, its variance at an epoch (< 0: no sample was
    # used), growth of the variance per second, and what does not count for validity:
    # variance of the offset, and of the motion of a hot pixel's light.
    float level
    float variance
    float per_s
    float offset


cdef inline bint left_out(const state_t* s, const tuning_t* tuning) noexcept nogil:
    """Tell whether images leave a pixel out: 0, and not valid."""
    return s.samples == 0 and tuning.needs_sample > 0.0


cdef inline bint holds(const state_t* s, const walk_t* walk,
                       const tuning_t* tuning) noexcept nogil:
    """Tell whether s holds the part of samples that followed the last event."""
    return (s != NULL and tuning.holds_part > 0.0 and s.samples > 0
            and walk.t <= s.sampled_us and not never(walk.t))


cdef inline double theta_squared(const state_t* s) noexcept nogil:
    """Square of the mean threshold, the unit of the variance of a part."""
    return 0.25 * (s.theta_on + s.theta_off) * (s.theta_on + s.theta_off)


cdef inline part_t part_at(const walk_t* walk, const stored_t* store, int64_t known,
                           double on, double off, const lamp_t* lamp, double hz,
                           const tuning_t* tuning, const state_t* s,
                           double t) noexcept nogil:
    """Part crossed at t after walk's last event, up to its next event if known.

    It is the mean over motion and rest, weighted by the probability of rest (see
    `silence`).  At rest the part is the one that the state s holds since the samples
    after the last event, if it holds one (NULL: it does not), and where nothing is
    known after t, these samples tell of motion, too.
    """
    cdef part_t part
    cdef double gap, rest, moves
    cdef bint held = holds(s, walk, tuning)
    if walk.next >= 0 and store[walk.next].t <= known:
        part = between(walk, store[walk.next].t, store[walk.next].p, on, off, lamp,
                       hz, tuning.refractory_us, t)
        gap = <double>(store[walk.next].t - walk.t)
        held = False
    elif at_rest(walk.t, <int64_t>t):
        part = still(walk, lamp, hz, t)
        if held and lamp.blocks == 0:
            part.fraction = s.part
        return part
    else:
        gap = max(<double>(walk.t - walk.t_prev), <double>known - <double>walk.t)
        if <double>known > t:
            part = quiet(walk, <double>known, lamp, hz, tuning.refractory_us, t)
        elif held and lamp.blocks == 0:
            return ahead_of_sample(
                walk, p_rest(gap, tuning.still_us) if tuning.still_us > 0.0 else 0.0,
                s.part, s.var_base / theta_squared(s), s.sampled_us, tuning, t)
        else:
            part = ahead(walk, on, off, lamp, hz, tuning, t)
    if tuning.still_us <= 0.0 or lamp.blocks > 0:
        return part
    rest = p_rest(gap, tuning.still_us)
    part.var = (1.0 - rest) * (part.var + rest * part.fraction * part.fraction)
    part.rate_var = (1.0 - rest) * (part.rate_var + rest * part.rate * part.rate)
    part.fraction *= 1.0 - rest
    part.rate *= 1.0 - rest
    if held:
        moves = moving(walk, <double>known - <double>walk.t, tuning)
        part.fraction *= moves      # the table of `ahead` includes this factor
        part.rate *= moves
        part.fraction += (1.0 - (1.0 - rest) * moves) * s.part
    return part


cdef inline double noise_if_silent(const walk_t* walk, int64_t sampled,
                                   const tuning_t* tuning) noexcept nogil:
    """Probability that the last event passed is noise, given that silence follows."""
    if tuning.p_noise <= 0.0 or walk.t <= sampled:
        return 0.0
    return tuning.p_noise * p_rest(<double>(walk.t - walk.t_prev), tuning.still_us)


cdef inline double noise_probability(const walk_t* walk, const stored_t* store,
                                     int64_t known, int64_t sampled,
                                     const tuning_t* tuning) noexcept nogil:
    """Probability that the last event passed is noise; 0 once a sample followed it.

    It is not 0 only for isolated events, without others shortly before and after.
    """
    cdef double p_noise = noise_if_silent(walk, sampled, tuning)
    if p_noise > 0.0 and walk.next >= 0 and store[walk.next].t <= known:
        p_noise *= p_rest(<double>(store[walk.next].t - walk.t), tuning.still_us)
    return p_noise


cdef inline double motion_noise(const walk_t* walk, const stored_t* store,
                                int64_t known, int64_t sampled,
                                const tuning_t* tuning) noexcept nogil:
    """Variance (theta^2) due to motion, as in the update by the next sample.

    One motion_variance for the sum of events if there were any since the last sample,
    and one for interpolation, also if the next event is known.
    """
    if walk.t > sampled:
        return 2.0 * tuning.motion_variance
    if walk.next >= 0 and store[walk.next].t <= known:
        return tuning.motion_variance
    return 0.0


cdef inline void walk_to(walk_t* walk, int64_t t, const stored_t* store,
                         const track_t* track, double refractory) noexcept nogil:
    """Advance to the last event up to t, inclusive; count from the last sample on."""
    start(walk, track)
    walk.n_on = track.n_on
    walk.n_off = track.n_off
    while walk.next >= 0 and store[walk.next].t <= t:
        step(walk, store, refractory)


cdef inline double output_slope(const walk_t* walk, const part_t* part,
                                const stored_t* store, int64_t known, double on,
                                double off, double level, const lamp_t* lamp,
                                const tuning_t* tuning, const state_t* s,
                                double t) noexcept nogil:
    """Slope of a pixel's output at t, 1/s, from which its lag is found.

    Between two known events it is the mean over a time constant around t, because time
    stamps of events jitter; over longer if they jitter by more than that.  It begins at
    the last event but one at the earliest, and with a refractory period at the last
    one: a walk does not know what was lost before.  Elsewhere it is the slope at t.
    """
    cdef walk_t later
    cdef part_t side
    cdef double half, begin, end, first = <double>walk.t, rise, apart
    cdef double slope = (on if part.p else -off) * part.rate + part.ripple_rate
    if lamp.blocks > 0 or never(walk.t) or walk.next < 0 or (
            store[walk.next].t > known):
        return slope
    half = corner(tuning, level)
    if half <= 0.0:
        return slope
    half = 1e6 * PER_TURN * SLOPE_SPAN / (2.0 * half)
    if tuning.jitter_us > 0.0:
        apart = stamps_apart(tuning)
        half = sqrt(half * half + apart * apart)
    if t - half >= first and t + half <= <double>store[walk.next].t:
        return slope        # the mean slope of a parabola is that in its middle
    if tuning.refractory_us <= 0.0 and not never(walk.t_prev):
        first = <double>walk.t_prev
    begin = t - half if t - half > first else first
    end = t + half if t + half < <double>known else <double>known
    if end <= begin:
        return slope
    later = walk[0]
    while later.next >= 0 and <double>store[later.next].t <= end:
        step(&later, store, tuning.refractory_us)
    side = part_at(&later, store, known, on, off, lamp, 0.0, tuning, s, end)
    rise = on * (later.n_on - walk.n_on) - off * (later.n_off - walk.n_off) + (
        on if side.p else -off) * side.fraction
    if begin < <double>walk.t:
        rise += (on if walk.p else -off) * (<double>walk.t - begin) / (
            <double>walk.t - first)
    else:
        side = part_at(walk, store, known, on, off, lamp, 0.0, tuning, s, begin)
        rise -= (on if side.p else -off) * side.fraction
    return 1e6 * rise / (end - begin)


cdef inline void read_level(reading_t* r, int64_t t, int64_t known,
                            const stored_t* store, const tuning_t* tuning,
                            const lamp_t* lamp, const state_t* s) noexcept nogil:
    """Set part, counts, level and lag at t; r.walk has been advanced to t."""
    cdef double hz = 0.0
    r.n_on = r.walk.n_on
    r.n_off = r.walk.n_off
    if lamp.blocks > 0:
        hz = corner(tuning, s.base + s.theta_on * r.n_on - s.theta_off * r.n_off)
    r.part = part_at(&r.walk, store, known, s.theta_on, s.theta_off, lamp, hz,
                     tuning, s, <double>t)
    r.p_noise = noise_probability(&r.walk, store, known, s.sampled_us, tuning)
    if r.walk.p:
        r.n_on -= r.p_noise
    else:
        r.n_off -= r.p_noise
    if r.part.p:
        r.n_on += r.part.fraction
    else:
        r.n_off += r.part.fraction
    r.level = s.base + s.theta_on * r.n_on - s.theta_off * r.n_off + r.part.ripple
    r.lag = lead(output_slope(&r.walk, &r.part, store, known, s.theta_on, s.theta_off,
                              r.level, lamp, tuning, s, <double>t), r.level, tuning)


cdef inline double counts_variance(const state_t* s, double n_on,
                                   double n_off) noexcept nogil:
    """Variance of base + theta_on n_on - theta_off n_off."""
    return (s.var_base + n_on * n_on * s.var_on + n_off * n_off * s.var_off
            + 2.0 * (n_on * s.cov_base_on - n_off * s.cov_base_off
                     - n_on * n_off * s.cov_on_off))


cdef inline double part_variance(const state_t* s, int64_t sampled,
                                 int64_t last) noexcept nogil:
    """Variance (ln^2) of the part of a pixel at rest; last: time of its last event.

    It is 0 after a sample that followed the event, which has measured the part.
    """
    return 0.0 if sampled >= last else theta_squared(s) * REST_VARIANCE


cdef inline rest_t rest_of(const state_t* s, const walk_t* walk, int64_t epoch,
                           const tuning_t* tuning) noexcept nogil:
    """Return the estimate of a pixel at rest, or hot; walk has passed its last event.
    """
    cdef rest_t rest
    cdef double theta2 = theta_squared(s), v, n_on = walk.n_on, n_off = walk.n_off
    cdef double p_noise = noise_if_silent(walk, s.sampled_us, tuning)
    cdef double u = tuning.offset_dn * s.pull
    rest.per_s = <float>(theta2 * tuning.leak_per_s)
    if is_hot(s):   # as in `show_hot`
        rest.level = <float>s.base
        rest.variance = <float>(
            s.var_base + theta2 * drift(epoch - s.sampled_us, 0.0, tuning))
        rest.offset = <float>(s.moves + u * u)
        return rest
    if walk.p:
        n_on -= p_noise
    else:
        n_off -= p_noise
    if holds(s, walk, tuning):
        if walk.p:
            n_on += s.part
        else:
            n_off += s.part
    rest.level = <float>(s.base + s.theta_on * n_on - s.theta_off * n_off)
    rest.variance = -1.0
    rest.offset = 0.0
    if s.samples == 0:
        rest.per_s = 0.0
        return rest
    v = counts_variance(s, n_on, n_off) + theta2 * drift(
        epoch - s.sampled_us, walk.n_on + walk.n_off, tuning)
    v += part_variance(s, s.sampled_us, walk.t)
    if walk.t > s.sampled_us:
        v += theta2 * (p_noise * (1.0 - p_noise) + 2.0 * tuning.motion_variance)
    rest.variance = <float>(v if v > 0.0 else 0.0)
    rest.offset = <float>(u * u)
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


cdef inline void show_hot(int64_t t, const state_t* s, const tuning_t* tuning,
                          float* out, float* variance,
                          unsigned char* valid) noexcept nogil:
    """Write a hot pixel: its events are ignored, and it holds the filtered frames.

    Its validity depends on the frames' variance alone; the variance also includes the
    motion of the light since the last frame.
    """
    cdef double v = s.var_base + theta_squared(s) * drift(t - s.sampled_us, 0.0, tuning)
    cdef double u = tuning.offset_dn * s.pull
    out[0] = <float>s.base
    valid[0] = v <= tuning.valid_variance
    variance[0] = <float>(v + s.moves + u * u)


cdef inline void read_pixel(int64_t t, int64_t known, int64_t epoch,
                            const stored_t* store, const tuning_t* tuning,
                            const lamp_t* lamp, const track_t* track,
                            const state_t* s, float* out, float* variance,
                            unsigned char* valid) noexcept nogil:
    """Write log intensity and variance at t, using the events up to known >= t."""
    cdef reading_t r
    cdef rest_t rest
    cdef double v, u, theta2
    if left_out(s, tuning):
        out[0] = 0.0
        variance[0] = 0.0
        valid[0] = 0
        return
    walk_to(&r.walk, t, store, track, tuning.refractory_us)
    if is_hot(s):
        show_hot(t, s, tuning, out, variance, valid)
        return
    if lamp.blocks == 0 and at_rest(r.walk.t, t) and (
            r.walk.next < 0 or store[r.walk.next].t > known):
        rest = rest_of(s, &r.walk, epoch, tuning)
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
    r.part.var += r.p_noise * (1.0 - r.p_noise) + motion_noise(
        &r.walk, store, known, s.sampled_us, tuning)
    v = (theta2 * r.part.var + counts_variance(s, r.n_on, r.n_off)
         + theta2 * drift(t - s.sampled_us, r.walk.n_on + r.walk.n_off, tuning))
    v = v if v > LEAST_VARIANCE else LEAST_VARIANCE
    valid[0] = v <= tuning.valid_variance
    u = tuning.offset_dn * s.pull
    variance[0] = <float>(v + u * u + lead_variance(
        r.lag, theta2 * r.part.rate_var, s.theta_off * r.part.fall, r.level, tuning))
