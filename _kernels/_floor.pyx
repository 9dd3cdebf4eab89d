"""What `python -m lab.bench` compares kernels with; never optimised."""
from libc.stdint cimport int64_t

from _kernels._types cimport event_t

cdef extern from "_team.h" nogil:
    ctypedef long long pd_count
    pd_count pd_now()
    pd_count load "PD_LOAD"(pd_count*)
    void store "PD_STORE"(pd_count*, pd_count)

cdef enum:
    WAYS = 100      # from thread to thread and back, of which the mean is taken


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


def pass_value(int64_t[::1] places not None, Py_ssize_t n, bint first):
    """Pass a value to and fro between two threads; return the ns that one way takes.

    Both threads call this on the same zeros, of shape (32,), one with `first` set.  One
    writes the first of them and the other the last, in different cache lines.  The time
    is the least mean of n parts, each of `WAYS` ways in both directions.
    """
    cdef pd_count* mine
    cdef pd_count* other
    cdef pd_count k, part, begun, least = 0
    if places.shape[0] != 32 or n < 1:
        raise ValueError("pass_value: places must be (32,), and n at least 1")
    mine, other = <pd_count*>&places[0], <pd_count*>&places[31]
    with nogil:
        if not first:
            for k in range(1, n * WAYS + 1):
                while load(mine) != k:
                    pass
                store(other, k)
        else:
            for part in range(n):
                begun = pd_now()
                for k in range(part * WAYS + 1, (part + 1) * WAYS + 1):
                    store(mine, k)
                    while load(other) != k:
                        pass
                begun = pd_now() - begun
                least = begun if part == 0 else min(least, begun)
    return least / (2.0 * WAYS)
