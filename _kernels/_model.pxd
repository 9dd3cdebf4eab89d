"""Records that kernels share with Python.  Inline only."""
from libc.stdint cimport int64_t

cdef packed struct wave_t:      # WAVE_DTYPE of reconstruct/lamp.py
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
