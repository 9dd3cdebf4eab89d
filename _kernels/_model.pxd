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
    # 32 bytes: none lies across two cache lines.
    int64_t last            # stamp of the last event
    double n_off            # counted since the last sample, with what was lost
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
    double hot              # ln of the odds that it is hot, over the prior's
    double moves            # of a hot one: variance of ln intensity between samples
    int64_t sampled_us      # middle of the exposure of the last sample used
    int32_t samples         # used so far; 0: base and its variance mean nothing yet
    double seen_on          # all events up to sampled_us, with what was lost
    double seen_off
    double part             # at rest, in thresholds: see `part_at`

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
    double doubt
    double still_us
    double refractory_us
    double threshold_drift  # relative, a variance from frame to frame
    double holds_part       # 1: at rest a pixel keeps its part; 0: it has none

cdef packed struct sample_t:
    float log               # ln intensity
    float variance          # of read and shot noise; 0 or less: no usable sample
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
    # A frame as it measured one pixel: base + h_on theta_on + h_off theta_off at the
    # last event before its middle, up to noise (a variance; 0 or less: no sample).
    float level
    float h_on
    float h_off
    float noise
    float drift             # variance since the sample before
    double n_on             # all events up to the middle, with what was lost
    double n_off


cdef inline int check_given(parts) except -1:
    """Refuse None among arrays handed over together: a view of it has no memory."""
    for part in parts:
        if part is None:
            raise TypeError("parts of an argument must be arrays, got None")
    return 0
