"""The group of moving pixels that _ahead.h reads at once.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._estimate cimport LEAST_VARIANCE, holds, walk_to
from _kernels._hot cimport is_hot
from _kernels._lag cimport PER_TURN     # with the constants that _ahead.h shares
from _kernels._model cimport state_t, stored_t, track_t, tuning_t
from _kernels._tracks cimport at_rest, walk_t

cdef extern from "_ahead.h" nogil:
    enum:
        AT_ONCE
    ctypedef struct reader_t:
        double still_us
        double doubt
        double motion_variance
        double leak_per_s
        double noise_per_event
        double offset_dn
        double hz
        double hz_per_intensity
        double sigma
        double least_variance
        double valid_variance
    ctypedef struct ahead_t:
        double since[AT_ONCE]
        double before[AT_ONCE]
        double same[AT_ONCE]
        double up[AT_ONCE]
        double unseen[AT_ONCE]
        double elapsed[AT_ONCE]
        double n_on[AT_ONCE]
        double n_off[AT_ONCE]
        double held[AT_ONCE]
        double base[AT_ONCE]
        double theta_on[AT_ONCE]
        double theta_off[AT_ONCE]
        double var_base[AT_ONCE]
        double cov_base_on[AT_ONCE]
        double cov_base_off[AT_ONCE]
        double var_on[AT_ONCE]
        double cov_on_off[AT_ONCE]
        double var_off[AT_ONCE]
        double pull[AT_ONCE]
        double measured[AT_ONCE]
        float log[AT_ONCE]
        float variance[AT_ONCE]
        unsigned char valid[AT_ONCE]
    void show_ahead(ahead_t*, const reader_t*, Py_ssize_t)


cdef inline bint is_plain(const tuning_t* tuning) noexcept nogil:
    """Tell whether _ahead.h knows all that the tuning asks for."""
    return tuning.refractory_us <= 0.0 and tuning.still_us > 0.0


cdef inline reader_t reader_of(const tuning_t* tuning) noexcept nogil:
    cdef reader_t reader
    reader.still_us = tuning.still_us
    reader.doubt = tuning.doubt
    reader.motion_variance = tuning.motion_variance
    reader.leak_per_s = tuning.leak_per_s
    reader.noise_per_event = tuning.noise_per_event
    reader.offset_dn = tuning.offset_dn
    reader.hz = tuning.bandwidth_hz
    reader.hz_per_intensity = tuning.bandwidth_hz_per_intensity
    reader.sigma = tuning.bandwidth_sigma
    reader.least_variance = LEAST_VARIANCE
    reader.valid_variance = tuning.valid_variance
    return reader


cdef inline bint collect(int64_t t, const stored_t* store, const track_t* track,
                         const state_t* s, const tuning_t* tuning, ahead_t* group,
                         Py_ssize_t i) noexcept nogil:
    """Add a pixel to the group as its i-th; False for one that is hot or at rest."""
    cdef walk_t walk
    if is_hot(s):
        return False
    walk_to(&walk, t, store, track, tuning.refractory_us)
    if at_rest(walk.t, t):
        return False
    group.since[i] = <double>(t - walk.t)
    group.before[i] = <double>(walk.t - walk.t_prev)
    group.same[i] = walk.p == walk.p_prev
    group.up[i] = walk.p
    group.unseen[i] = walk.t > s.sampled_us
    group.elapsed[i] = <double>(t - s.sampled_us)
    group.n_on[i] = walk.n_on
    group.n_off[i] = walk.n_off
    group.held[i] = s.part if holds(s, &walk, tuning) else 0.0
    group.base[i] = s.base
    group.theta_on[i] = s.theta_on
    group.theta_off[i] = s.theta_off
    group.var_base[i] = s.var_base
    group.cov_base_on[i] = s.cov_base_on
    group.cov_base_off[i] = s.cov_base_off
    group.var_on[i] = s.var_on
    group.cov_on_off[i] = s.cov_on_off
    group.var_off[i] = s.var_off
    group.pull[i] = s.pull
    group.measured[i] = s.samples > 0
    return True
