"""Rows shared with a thread that is at work on something else.  Inline only."""

cdef extern from "_team.h" nogil:
    ctypedef struct team_t:
        pass
    ctypedef void (*pd_rows)(void*, Py_ssize_t, Py_ssize_t) noexcept nogil
    void team_share(team_t*, bint, pd_rows, void*, Py_ssize_t, Py_ssize_t)
