"""What `python -m lab.bench` compares kernels with; never optimised."""
from _kernels._types cimport event_t


def floor_sum(const event_t[::1] events not None, const float[::1] step not None,
              float[:, ::1] out not None):
    """Add step[p] of each event to out[y, x]; return how many were taken."""
    cdef Py_ssize_t n = events.shape[0], h = out.shape[0], w = out.shape[1]
    cdef Py_ssize_t i, y, x, p
    if step.shape[0] != 2:
        raise ValueError("floor_sum: step must be (2,)")
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if y >= h or x >= w or p > 1:
                break
            out[y, x] += step[p]
        else:
            i = n
    return i
