"""Constants of moving pixels between two events (`lanes_t`).  Inline only.

Until its next event or sample, a pixel's estimate is a function of time and of
constants, which `enter_state` and `enter_events` write and _lanes.h evaluates for a
group of pixels at once.
"""
from libc.stdint cimport int64_t

from _kernels._estimate cimport LEAST_VARIANCE
from _kernels._lag cimport PER_TURN     # with the constants that _lanes.h shares
from _kernels._model cimport state_t, tuning_t
from _kernels._tracks cimport least_gap, walk_t

cdef extern from "_lanes.h" nogil:
    enum:
        LANES
    const double SPAN_MOST
    ctypedef struct reader_t:
        double t
        double known
        double epoch
        float since_epoch
        float still_us
        float leak_per_s
        float refractory_us
        float least_gap_us
        float noise_per_event
        float motion_variance
        float p_noise
        float hz
        float hz_per_intensity
        float sigma
        float holds
        float least_variance
        float valid_variance
        bint bare
        bint smooth
    ctypedef struct lanes_t:
        double last[LANES]
        float before[LANES]
        float same[LANES]
        float p[LANES]
        float n_on[LANES]
        float n_off[LANES]
        float held[LANES]
        float offset[LANES]
        float measured[LANES]
        # of the filter
        float base[LANES]
        float theta_on[LANES]
        float theta_off[LANES]
        float var_base[LANES]
        float cov_base_on[LANES]
        float cov_base_off[LANES]
        float var_on[LANES]
        float cov_on_off[LANES]
        float var_off[LANES]
        float age[LANES]
        # of the smoother
        float theta[LANES]
        float theta2[LANES]
        float level[LANES]
        float v0[LANES]
        float v1[LANES]
        float v2[LANES]
        float slope[LANES]
        float v0_1[LANES]
        float v0_2[LANES]
        float v1_1[LANES]
    ctypedef struct shown_t:
        float log[LANES]
        float variance[LANES]
        unsigned char valid[LANES]
        float since[LANES]
    void show_lanes(const lanes_t*, shown_t*, const reader_t*, const lanes_t*,
                    Py_ssize_t, Py_ssize_t)


cdef inline reader_t reader_of(const tuning_t* tuning, int64_t t, int64_t known,
                               int64_t epoch, bint bare,
                               bint smooth) noexcept nogil:
    cdef reader_t reader
    reader.t = <double>t
    reader.known = <double>known
    reader.epoch = <double>epoch
    reader.since_epoch = <float>(1e-6 * <double>(t - epoch))
    reader.still_us = <float>tuning.still_us
    reader.leak_per_s = <float>tuning.leak_per_s
    reader.refractory_us = <float>max(tuning.refractory_us, 0.0)
    reader.least_gap_us = <float>least_gap(tuning)
    reader.noise_per_event = <float>tuning.noise_per_event
    reader.motion_variance = <float>tuning.motion_variance
    reader.p_noise = <float>max(tuning.p_noise, 0.0)
    reader.hz = <float>tuning.bandwidth_hz
    reader.hz_per_intensity = <float>tuning.bandwidth_hz_per_intensity
    reader.sigma = <float>tuning.bandwidth_sigma
    reader.holds = <float>tuning.holds_part
    reader.least_variance = <float>LEAST_VARIANCE
    reader.valid_variance = <float>tuning.valid_variance
    reader.bare = bare
    reader.smooth = smooth
    return reader


cdef inline float gap_before(const walk_t* walk) noexcept nogil:
    """Return the gap between the last two events of walk, us, at most `SPAN_MOST`."""
    return <float>min(<double>(walk.t - walk.t_prev), SPAN_MOST)


cdef inline void enter_state(lanes_t* lanes, Py_ssize_t i, const state_t* s,
                             int64_t epoch, const tuning_t* tuning) noexcept nogil:
    """Write what a pixel's lane takes from its state, which changes with frames."""
    cdef double u = tuning.offset_dn * s.pull
    lanes.held[i] = <float>s.part
    lanes.offset[i] = <float>(u * u)
    lanes.measured[i] = s.samples > 0
    lanes.base[i] = <float>s.base
    lanes.theta_on[i] = <float>s.theta_on
    lanes.theta_off[i] = <float>s.theta_off
    lanes.var_base[i] = <float>s.var_base
    lanes.cov_base_on[i] = <float>s.cov_base_on
    lanes.cov_base_off[i] = <float>s.cov_base_off
    lanes.var_on[i] = <float>s.var_on
    lanes.cov_on_off[i] = <float>s.cov_on_off
    lanes.var_off[i] = <float>s.var_off
    lanes.age[i] = <float>(epoch - s.sampled_us)


cdef inline void enter_events(lanes_t* lanes, Py_ssize_t i,
                              const walk_t* walk) noexcept nogil:
    """Write what it takes from its events, after the last one of walk."""
    lanes.last[i] = <double>walk.t
    lanes.before[i] = gap_before(walk)
    # No branches on polarities: they cannot be predicted.
    lanes.same[i] = 1 - (walk.p ^ walk.p_prev)
    lanes.p[i] = walk.p
    lanes.n_on[i] = <float>walk.n_on
    lanes.n_off[i] = <float>walk.n_off
