"""Records that kernels of events and lamps share with Python.  Inline only.

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
    double n_off            # events since the last comparison
    double n_on
    uint32_t gap            # twice the us since the event before, plus its polarity
    int32_t first           # index of the first event after these, -1: none

cdef packed struct state_t:
    double base             # ln intensity at the last event counted, up to an offset
    double theta_on
    double theta_off
    double prior_on         # thresholds as stated
    double prior_off

cdef packed struct tuning_t:
    double bandwidth_hz
    double bandwidth_hz_per_intensity

cdef packed struct wave_t:
    int64_t start_us
    double turns_per_us     # 0: a steady lamp
    double cosine
    double sine
    double of_light

cdef inline int check_given(parts) except -1:
    """Refuse None among arrays handed over together: a view of it has no memory."""
    for part in parts:
        if part is None:
            raise TypeError("parts of an argument must be arrays, got None")
    return 0
