"""Constants of moving pixels between two events (`lanes_t`).  Inline only.

Until its next event or sample, a pixel's estimate is a function of time and of
constants, which `enter` computes and _lanes.h evaluates for a group of pixels at once.
"""
from libc.stdint cimport int64_t

from _kernels._estimate cimport (
    LEAST_VARIANCE, counts_variance, holds, noise_if_silent, theta_squared)
from _kernels._lag cimport PER_TURN     # with the constants that _lanes.h shares
from _kernels._model cimport state_t, tuning_t
from _kernels._tracks cimport drift, walk_t

cdef extern from "_lanes.h" nogil:
    enum:
        LANES
    ctypedef struct reader_t:
        double still_us
        double leak_per_s
        double refractory_us
        double hz
        double hz_per_intensity
        double sigma
        double least_variance
        double valid_variance
        double t
        double known
        double since_epoch
        bint bare
        bint smooth
    ctypedef struct lanes_t:
        double last[LANES]
        double before[LANES]
        double same[LANES]
        double level[LANES]
        double theta[LANES]
        double theta2[LANES]
        double held[LANES]
        double v0[LANES]
        double v1[LANES]
        double v2[LANES]
        double offset[LANES]
        double measured[LANES]
        double slope[LANES]
        double v0_1[LANES]
        double v0_2[LANES]
        double v1_1[LANES]
    ctypedef struct shown_t:
        float log[LANES]
        float variance[LANES]
        unsigned char valid[LANES]
        double since[LANES]
    void show_lanes(const lanes_t*, shown_t*, const reader_t*, Py_ssize_t,
                    Py_ssize_t)


cdef inline reader_t reader_of(const tuning_t* tuning, int64_t t, int64_t known,
                               int64_t epoch, bint bare,
                               bint smooth) noexcept nogil:
    cdef reader_t reader
    reader.still_us = tuning.still_us
    reader.leak_per_s = tuning.leak_per_s
    reader.refractory_us = max(tuning.refractory_us, 0.0)
    reader.hz = tuning.bandwidth_hz
    reader.hz_per_intensity = tuning.bandwidth_hz_per_intensity
    reader.sigma = tuning.bandwidth_sigma
    reader.least_variance = LEAST_VARIANCE
    reader.valid_variance = tuning.valid_variance
    reader.t = <double>t
    reader.known = <double>known
    reader.since_epoch = 1e-6 * <double>(t - epoch)
    reader.bare = bare
    reader.smooth = smooth
    return reader


cdef inline void enter(lanes_t* lanes, Py_ssize_t i, const walk_t* walk,
                       const state_t* s, int64_t epoch,
                       const tuning_t* tuning) noexcept nogil:
    """Write the constants of a pixel to its lane, after the last event of walk.

    Level and variance are quadratic in the part of a threshold crossed since that
    event: v0 + part (v1 + part v2), from the covariance of (base, theta_on, theta_off).
    """
    cdef double n_on = walk.n_on, n_off = walk.n_off, theta2 = theta_squared(s), u, v
    cdef double p_noise = noise_if_silent(walk, s.sampled_us, tuning)
    v = p_noise * (1.0 - p_noise) + drift(epoch - s.sampled_us, n_on + n_off, tuning)
    if walk.t > s.sampled_us:
        v += 2.0 * tuning.motion_variance
    if walk.p:
        n_on -= p_noise
        lanes.theta[i] = s.theta_on
        lanes.v1[i] = 2.0 * (n_on * s.var_on + s.cov_base_on - n_off * s.cov_on_off)
        lanes.v2[i] = s.var_on
    else:
        n_off -= p_noise
        lanes.theta[i] = -s.theta_off
        lanes.v1[i] = 2.0 * (n_off * s.var_off - s.cov_base_off - n_on * s.cov_on_off)
        lanes.v2[i] = s.var_off
    lanes.last[i] = <double>walk.t
    lanes.before[i] = <double>(walk.t - walk.t_prev)
    lanes.same[i] = walk.p == walk.p_prev
    lanes.level[i] = s.base + s.theta_on * n_on - s.theta_off * n_off
    lanes.theta2[i] = theta2
    lanes.held[i] = s.part if holds(s, walk, tuning) else 0.0
    lanes.v0[i] = theta2 * v + counts_variance(s, n_on, n_off)
    u = tuning.offset_dn * s.pull
    lanes.offset[i] = u * u
    lanes.measured[i] = s.samples > 0
