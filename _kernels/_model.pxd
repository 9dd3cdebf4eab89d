"""Records that kernels of the Kalman method share with Python.  Inline only.

The dtypes of the same fields, with their units, are in the library's
reconstruct/model.py; a stamp is an event's time times two, plus its polarity.
"""
from libc.stdint cimport int32_t, int64_t, uint8_t, uint16_t, uint32_t

cdef packed struct stored_t:
    int64_t t
    uint16_t x
    uint16_t y
    uint8_t p
    int32_t next            # index of the pixel's next event, -1: none

cdef packed struct track_t:
    # 32 bytes, so that no record lies across two cache lines.
    int64_t last            # stamp of the last event
    double n_off            # since the last sample, with the change lost in resets
    double n_on
    uint32_t gap            # twice the us since the event before, plus its polarity
    int32_t first           # index of the first event after these, -1: none

cdef packed struct state_t:
    double base             # ln intensity at the last event before the last sample
    double theta_on
    double theta_off
    double var_base
    double cov_base_on
    double cov_base_off
    double var_on
    double cov_on_off
    double var_off
    double prior_on
    double prior_off
    double pull             # d(base) / d(offset of all frames), ln per DN
    double frame_log        # ln intensity of the last sample, not de-blurred
    double hot              # ln of the odds that it is hot, relative to the prior odds
    double moves            # hot pixel: mean square change between samples, ln^2
    int64_t sampled_us      # middle of the exposure of the last sample used
    int32_t samples         # number of samples used; 0: base is undefined
    double seen_on          # all events up to sampled_us, with what resets lost
    double seen_off
    double part             # part of a threshold crossed, at rest: see `part_at`
    float unlit_log         # ln intensity of the last sample, without the lamp's ripple
    float first_difference  # of unlit_log from the sample before
    float second_difference
    float quiet             # samples in sequence without an event since the one before

cdef packed struct tuning_t:
    double leak_per_s
    double noise_per_event
    double bandwidth_hz
    double bandwidth_hz_per_intensity
    double bandwidth_sigma
    double frame_sigma
    double shot_share
    double read_variance    # DN^2
    double shot_variance    # DN^2 per DN
    double offset_dn
    double valid_variance
    double motion_variance
    double p_noise
    double still_us
    double refractory_us
    double threshold_drift  # variance of the relative change from frame to frame
    double holds_part       # 1: a pixel at rest keeps its part; 0: it does not
    double needs_sample     # 1: images leave out pixels without a sample; 0: none
    double jitter_us        # standard deviation of events' time stamps, us

cdef packed struct sample_t:
    float log               # ln intensity
    float variance          # of read and shot noise; 0 or less: not usable
    float per_dn            # d(log) / d(DN)

cdef packed struct exposure_t:
    int64_t begin
    int64_t middle
    int64_t end

cdef packed struct wave_t:
    int64_t start_us
    double turns_per_us     # 0: a steady lamp
    double cosine
    double sine
    double of_light

cdef packed struct node_t:
    # A frame's measurement of one pixel: level = base + h_on theta_on + h_off theta_off
    # + noise, with the base at the last event before the frame's middle.
    float level
    float h_on
    float h_off
    float noise             # variance; 0 or less: no sample
    float drift             # process noise since the sample before, ln^2
    double n_on             # all events up to the middle, and the change lost in resets
    double n_off


cdef inline int check_given(parts) except -1:
    """Refuse None among arrays handed over together: a view of it has no memory."""
    for part in parts:
        if part is None:
            raise TypeError("parts of an argument must be arrays, got None")
    return 0
