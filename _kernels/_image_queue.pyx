"""Channels, angle and degree of images with variances, by one thread or by two."""
from cpython.pythread cimport (
    PyThread_acquire_lock, PyThread_allocate_lock, PyThread_free_lock,
    PyThread_release_lock, PyThread_type_lock, WAIT_LOCK)

from _kernels._rows cimport polarization_row
from _kernels._weighted cimport check_weighted, weighted_row, weighted_t

cdef extern from "_curves.h" nogil:
    void exp_row(const float*, Py_ssize_t, float*)

cdef extern from "_team.h" nogil:
    ctypedef long long pd_count
    ctypedef struct team_t:
        PyThread_type_lock wake
        PyThread_type_lock left
    ctypedef struct share_t:
        pass
    ctypedef void (*pd_rows)(void*, Py_ssize_t, Py_ssize_t) noexcept nogil
    void share_begin(share_t*, pd_rows, void*, void*, Py_ssize_t, Py_ssize_t)
    bint share_step(share_t*, bint, int*)
    void team_share(team_t*, bint, pd_rows, void*, Py_ssize_t, Py_ssize_t)
    void team_help(team_t*)
    void team_post(team_t*)
    Py_ssize_t team_posted(team_t*)
    Py_ssize_t team_served(team_t*)
    void team_left(team_t*)
    void team_sleep(team_t*, Py_ssize_t)
    void team_join(team_t*)
    void team_leave(team_t*)
    bint team_alone(team_t*, pd_count)
    void team_acquire(PyThread_type_lock)
    void team_waited(team_t*, pd_count, pd_count)
    pd_count pd_now()

cdef enum:
    SLOTS = 16
    ROWS = 8        # that a thread takes at a time: about 10 us


cdef struct polarized_t:
    weighted_t image
    float gain
    float* quad     # (4, h, w)
    float* out      # (4, h, w), variances
    float* aop      # (h, w)
    float* dolp     # (h, w)


cdef int check_polarized(
        polarized_t* to, const float[:, ::1] mosaic, const float[:, ::1] variance,
        const Py_ssize_t[::1] places, const float[::1] spread,
        const float[:, :, ::1] null, float[::1] scratch, float[:, :, ::1] quad,
        float[:, :, ::1] out, float gain, float[:, ::1] aop,
        float[:, ::1] dolp) except -1:
    """Check the arguments of `ImageQueue.post` and write them to a struct."""
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1]
    check_weighted(&to.image, mosaic, variance, places, spread, null, scratch, 2)
    if (quad.shape[0] != 4 or quad.shape[1] != h or quad.shape[2] != w
            or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w):
        raise ValueError("post: quad and out must be (4, h, w)")
    if (aop.shape[0] != h or aop.shape[1] != w or dolp.shape[0] != h
            or dolp.shape[1] != w):
        raise ValueError("post: aop and dolp must be (h, w)")
    to.gain, to.aop, to.dolp = gain, &aop[0, 0], &dolp[0, 0]
    to.quad, to.out = &quad[0, 0, 0], &out[0, 0, 0]
    return 0


cdef void polarize_rows(
        void* args, Py_ssize_t first, Py_ssize_t last) noexcept nogil:
    cdef polarized_t* of = <polarized_t*>args
    cdef Py_ssize_t h = of.image.h, w = of.image.w, y, c
    cdef float* q[4]
    cdef float* v[4]
    for y in range(first, last):
        for c in range(4):
            q[c] = of.quad + (c * h + y) * w
            v[c] = of.out + (c * h + y) * w
        weighted_row(&of.image, y, q, v)
        polarization_row(q[0], q[1], q[2], q[3], of.gain, w, of.aop + y * w,
                         of.dolp + y * w)


cdef struct slot_t:
    polarized_t image
    polarized_t other       # the same, with the scratch of the thread in `serve`
    share_t rows
    bint last       # the thread ends here
    PyThread_type_lock done         # released when the image has been finished


cdef struct exp_t:
    const float* log
    float* mosaic
    Py_ssize_t w


cdef void exp_rows(void* args, Py_ssize_t first, Py_ssize_t last) noexcept nogil:
    cdef exp_t* of = <exp_t*>args
    cdef Py_ssize_t y
    for y in range(first, last):
        exp_row(of.log + y * of.w, of.w, of.mosaic + y * of.w)


cdef void finish(slot_t* slot, bint first_thread, team_t* team) noexcept nogil:
    """Process rows of an image until all are taken."""
    cdef int last
    while share_step(&slot.rows, first_thread, &last):
        if last:
            PyThread_release_lock(slot.done)
        if not first_thread:
            team_help(team)


cdef class ImageQueue:
    """Images that one thread posts and waits for, and another, in `serve`, finishes.

    They are finished in the order of their numbers, 0, 1, ...  At most SLOTS - 1 are
    posted that have not been waited for, or that `serve` has not come to.  The thread
    in `serve` never needs Python's lock.  While it works it also helps the kernels that
    are given the queue's `team`.
    """

    cdef team_t members
    cdef slot_t slots[SLOTS]
    cdef list held      # the arrays of each slot, as the thread knows addresses only
    cdef Py_ssize_t posted, waited
    cdef bint ended

    def __cinit__(self):
        cdef Py_ssize_t k
        self.held = [None] * SLOTS
        self.members.wake = PyThread_allocate_lock()
        self.members.left = PyThread_allocate_lock()
        if self.members.wake == NULL or self.members.left == NULL:
            raise MemoryError
        PyThread_acquire_lock(self.members.wake, WAIT_LOCK)
        PyThread_acquire_lock(self.members.left, WAIT_LOCK)
        for k in range(SLOTS):
            self.slots[k].done = PyThread_allocate_lock()
            if self.slots[k].done == NULL:
                raise MemoryError
            PyThread_acquire_lock(self.slots[k].done, WAIT_LOCK)

    def __dealloc__(self):
        cdef Py_ssize_t k
        if self.members.wake != NULL:
            PyThread_free_lock(self.members.wake)
        if self.members.left != NULL:
            PyThread_free_lock(self.members.left)
        for k in range(SLOTS):
            if self.slots[k].done != NULL:
                PyThread_free_lock(self.slots[k].done)

    @property
    def team(self):
        """Address of the struct with which a kernel shares its rows."""
        return <size_t>&self.members

    @property
    def late(self):
        """Whether the thread got no processor lately: nothing should wait for it."""
        return (team_alone(&self.members, pd_now())
                or self.posted - team_served(&self.members) >= SLOTS - 1)

    def post(self, const float[:, ::1] log, float[:, ::1] mosaic not None,
             const float[:, ::1] variance not None,
             const Py_ssize_t[::1] places not None,
             const float[::1] spread not None, const float[:, :, ::1] null not None,
             float[::1] scratch not None, float[:, :, ::1] quad not None,
             float[:, :, ::1] out not None, float gain, float[:, ::1] aop not None,
             float[:, ::1] dolp not None):
        """Post an image and return its number.

        The arguments are those of `bilinear_weighted`, for all rows and with twice the
        scratch, and of `aop_dolp`; aop and dolp are (h, w).  The mosaic is first filled
        with the exponential of log, if that is given.  Nobody may use the arrays before
        `wait`.
        """
        cdef slot_t* slot = &self.slots[self.posted % SLOTS]
        cdef exp_t exp
        if self.ended or self.posted - min(
                self.waited, team_served(&self.members)) >= SLOTS - 1:
            raise ValueError("post: the queue must be neither full nor ended")
        check_polarized(
            &slot.image, mosaic, variance, places, spread, null, scratch, quad, out,
            gain, aop, dolp)
        check_polarized(
            &slot.other, mosaic, variance, places, spread, null,
            scratch[scratch.shape[0] // 2:], quad, out, gain, aop, dolp)
        if log is not None and (
                log.shape[0] != mosaic.shape[0] or log.shape[1] != mosaic.shape[1]):
            raise ValueError("post: log must have the mosaic's shape")
        if log is not None:
            exp.log, exp.mosaic, exp.w = &log[0, 0], &mosaic[0, 0], log.shape[1]
            with nogil:
                team_share(&self.members, False, exp_rows, &exp, log.shape[0], ROWS)
        share_begin(&slot.rows, polarize_rows, &slot.image, &slot.other,
                    mosaic.shape[0], ROWS)
        slot.last = False
        self.held[self.posted % SLOTS] = (
            mosaic, variance, null, scratch, quad, out, aop, dolp)
        self.posted += 1
        team_post(&self.members)
        return self.posted - 1

    def wait(self, Py_ssize_t number):
        """Return when the image of a number, and all before, have been finished."""
        cdef slot_t* slot
        cdef pd_count began, ended
        if number >= self.posted:
            raise ValueError("wait: number must be of an image that was posted")
        while self.waited <= number:
            slot = &self.slots[self.waited % SLOTS]
            with nogil:
                began = pd_now()
                finish(slot, True, &self.members)
                ended = pd_now()
                team_acquire(slot.done)
                team_waited(&self.members, began, ended)
            self.held[self.waited % SLOTS] = None
            self.waited += 1

    def serve(self):
        """Finish the images posted, until `end`; not for the thread that posts."""
        cdef Py_ssize_t k = 0
        cdef slot_t* slot
        with nogil:
            team_join(&self.members)
            while True:
                team_help(&self.members)
                if team_posted(&self.members) == k:
                    team_sleep(&self.members, k)
                    continue
                slot = &self.slots[k % SLOTS]
                if slot.last:
                    break
                finish(slot, False, &self.members)
                team_left(&self.members)
                k += 1
            team_leave(&self.members)

    def end(self):
        """Let `serve` return when all images posted have been finished."""
        cdef slot_t* slot = &self.slots[self.posted % SLOTS]
        if not self.ended:
            self.ended = True
            slot.last = True
            team_post(&self.members)

    def finish_here(self):
        """Finish all images posted in this thread, as a forked child has no other."""
        cdef slot_t* slot
        while self.waited < self.posted:
            slot = &self.slots[self.waited % SLOTS]
            polarize_rows(&slot.image, 0, slot.image.image.h)
            self.held[self.waited % SLOTS] = None
            self.waited += 1
        self.ended = True
