"""The group of pixels that _measure.h updates at once.  Inline only."""
from _kernels._model cimport sample_t, state_t, tuning_t
from _kernels._update cimport JUMP_SIGMAS, THETA_LEAST, THETA_MOST

cdef extern from "_measure.h" nogil:
    enum:
        TOGETHER
        TERMS
    ctypedef struct policy_t:
        double frame_sigma
        double shot_share
        double read_variance
        double shot_variance
        double offset_dn
        double motion_variance
        double noise_per_event
        double jump_sigmas
        double theta_least
        double theta_most
    ctypedef struct group_t:
        double base[TOGETHER]
        double theta_on[TOGETHER]
        double theta_off[TOGETHER]
        double var_base[TOGETHER]
        double cov_base_on[TOGETHER]
        double cov_base_off[TOGETHER]
        double var_on[TOGETHER]
        double cov_on_off[TOGETHER]
        double var_off[TOGETHER]
        double prior_on[TOGETHER]
        double prior_off[TOGETHER]
        double pull[TOGETHER]
        double held[TOGETHER]
        double part[TOGETHER]
        double silent[TOGETHER]
        double motion[TOGETHER]
        double n_on[TOGETHER]
        double n_off[TOGETHER]
        double h_on[TOGETHER]
        double h_off[TOGETHER]
        double noise[TOGETHER]
        double innovation[TOGETHER]
        double sample_per_dn[TOGETHER]
        double learn[TOGETHER]
        double third[TOGETHER]
        double rests[TOGETHER]
        double unit[TOGETHER]
        double events[TOGETHER]
        double p_noise[TOGETHER]
        double event_step[TOGETHER]
        double included[TOGETHER]
        double jump[TOGETHER]
    void measure(group_t*, const policy_t*, Py_ssize_t, double* sums)


cdef inline policy_t policy_of(const tuning_t* tuning) noexcept nogil:
    cdef policy_t policy
    policy.frame_sigma = tuning.frame_sigma
    policy.shot_share = tuning.shot_share
    policy.read_variance = tuning.read_variance
    policy.shot_variance = tuning.shot_variance
    policy.offset_dn = tuning.offset_dn
    policy.motion_variance = tuning.motion_variance
    policy.noise_per_event = tuning.noise_per_event
    policy.jump_sigmas = JUMP_SIGMAS
    policy.theta_least = THETA_LEAST
    policy.theta_most = THETA_MOST
    return policy


cdef inline void hand_over(const state_t* s, const sample_t* sample, group_t* group,
                           Py_ssize_t i) noexcept nogil:
    """Copy to the group what `measure` updates, and by what."""
    group.base[i] = s.base
    group.theta_on[i] = s.theta_on
    group.theta_off[i] = s.theta_off
    group.var_base[i] = s.var_base
    group.cov_base_on[i] = s.cov_base_on
    group.cov_base_off[i] = s.cov_base_off
    group.var_on[i] = s.var_on
    group.cov_on_off[i] = s.cov_on_off
    group.var_off[i] = s.var_off
    group.prior_on[i] = s.prior_on
    group.prior_off[i] = s.prior_off
    group.pull[i] = s.pull
    group.held[i] = s.part
    group.sample_per_dn[i] = sample.per_dn
