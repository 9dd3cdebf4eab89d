"""Angle and degree of images weighted by variances, here or in another thread."""
from cpython.pythread cimport (
    PyThread_acquire_lock, PyThread_allocate_lock, PyThread_free_lock,
    PyThread_release_lock, PyThread_type_lock, WAIT_LOCK)

from _kernels._rows cimport polarization_row
from _kernels._weighted cimport check_weighted, weighted_row, weighted_t

cdef extern from "_curves.h" nogil:
    void exp_row(const float*, Py_ssize_t, float*)

cdef enum:
    SLOTS = 16


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
    """Check the arguments of `polarize_weighted` and write them to a struct."""
    cdef Py_ssize_t h = mosaic.shape[0], w = mosaic.shape[1]
    check_weighted(&to.image, mosaic, variance, places, spread, null, scratch, 2)
    if (quad.shape[0] != 4 or quad.shape[1] != h or quad.shape[2] != w
            or out.shape[0] != 4 or out.shape[1] != h or out.shape[2] != w):
        raise ValueError("polarize_weighted: quad and out must be (4, h, w)")
    if (aop.shape[0] != h or aop.shape[1] != w or dolp.shape[0] != h
            or dolp.shape[1] != w):
        raise ValueError("polarize_weighted: aop and dolp must be (h, w)")
    to.gain, to.aop, to.dolp = gain, &aop[0, 0], &dolp[0, 0]
    to.quad, to.out = &quad[0, 0, 0], &out[0, 0, 0]
    return 0


cdef void polarize_rows(
        polarized_t* of, Py_ssize_t first, Py_ssize_t last) noexcept nogil:
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


def polarize_weighted(const float[:, ::1] mosaic not None,
                      const float[:, ::1] variance not None,
                      const Py_ssize_t[::1] places not None,
                      const float[::1] spread not None,
                      const float[:, :, ::1] null not None, rows not None,
                      float[::1] scratch not None, float[:, :, ::1] quad not None,
                      float[:, :, ::1] out not None, float gain,
                      float[:, ::1] aop not None, float[:, ::1] dolp not None):
    """`bilinear_weighted`, and angle and degree (h, w) of its channels, in one pass.

    The same bits as `aop_dolp` of quad.  Only rows (first, last) are written.
    """
    cdef polarized_t image
    cdef Py_ssize_t first, last
    check_polarized(&image, mosaic, variance, places, spread, null, scratch, quad, out,
                    gain, aop, dolp)
    first, last = rows
    if first < 0 or last > image.image.h:
        raise ValueError("polarize_weighted: rows must lie in the mosaic")
    with nogil:
        polarize_rows(&image, first, last)


cdef struct slot_t:
    polarized_t image
    const float* log        # (h, w); NULL: the mosaic is filled already
    float* mosaic
    bint last       # the thread ends here
    PyThread_type_lock posted       # released when the slot has been filled,
    PyThread_type_lock done         # and when its image has been finished


cdef void finish(slot_t* slot) noexcept nogil:
    cdef Py_ssize_t h = slot.image.image.h, w = slot.image.image.w, y
    if slot.log != NULL:
        for y in range(h):
            exp_row(slot.log + y * w, w, slot.mosaic + y * w)
    polarize_rows(&slot.image, 0, h)


cdef class ImageQueue:
    """Images that one thread posts and waits for, and another, in `serve`, finishes.

    They are finished in the order of their numbers, 0, 1, ...  At most SLOTS - 1 are
    posted and not waited for.  The thread in `serve` never needs Python's lock.
    """

    cdef slot_t slots[SLOTS]
    cdef list held      # the arrays of each slot, as the thread knows addresses only
    cdef Py_ssize_t posted, waited
    cdef bint ended

    def __cinit__(self):
        cdef Py_ssize_t k
        self.held = [None] * SLOTS
        for k in range(SLOTS):
            self.slots[k].posted = self.slots[k].done = NULL
        for k in range(SLOTS):
            self.slots[k].posted = PyThread_allocate_lock()
            self.slots[k].done = PyThread_allocate_lock()
            if self.slots[k].posted == NULL or self.slots[k].done == NULL:
                raise MemoryError
            PyThread_acquire_lock(self.slots[k].posted, WAIT_LOCK)
            PyThread_acquire_lock(self.slots[k].done, WAIT_LOCK)

    def __dealloc__(self):
        cdef Py_ssize_t k
        for k in range(SLOTS):
            if self.slots[k].posted != NULL:
                PyThread_free_lock(self.slots[k].posted)
            if self.slots[k].done != NULL:
                PyThread_free_lock(self.slots[k].done)

    def post(self, const float[:, ::1] log, float[:, ::1] mosaic not None,
             const float[:, ::1] variance not None,
             const Py_ssize_t[::1] places not None,
             const float[::1] spread not None, const float[:, :, ::1] null not None,
             float[::1] scratch not None, float[:, :, ::1] quad not None,
             float[:, :, ::1] out not None, float gain, float[:, ::1] aop not None,
             float[:, ::1] dolp not None):
        """Post an image and return its number.

        The arguments are those of `polarize_weighted`, for all rows.  The mosaic is
        first filled with the exponential of log, if that is given.  Nobody may use the
        arrays before `wait`.
        """
        cdef slot_t* slot = &self.slots[self.posted % SLOTS]
        if self.ended or self.posted - self.waited >= SLOTS - 1:
            raise ValueError("post: the queue must be neither full nor ended")
        check_polarized(
            &slot.image, mosaic, variance, places, spread, null, scratch, quad, out,
            gain, aop, dolp)
        if log is not None and (
                log.shape[0] != mosaic.shape[0] or log.shape[1] != mosaic.shape[1]):
            raise ValueError("post: log must have the mosaic's shape")
        slot.log = NULL if log is None else &log[0, 0]
        slot.mosaic = &mosaic[0, 0]
        slot.last = False
        self.held[self.posted % SLOTS] = (
            log, mosaic, variance, null, scratch, quad, out, aop, dolp)
        self.posted += 1
        PyThread_release_lock(slot.posted)
        return self.posted - 1

    def wait(self, Py_ssize_t number):
        """Return when the image of a number, and all before, have been finished."""
        cdef slot_t* slot
        if number >= self.posted:
            raise ValueError("wait: number must be of an image that was posted")
        while self.waited <= number:
            slot = &self.slots[self.waited % SLOTS]
            with nogil:
                PyThread_acquire_lock(slot.done, WAIT_LOCK)
            self.held[self.waited % SLOTS] = None
            self.waited += 1

    def serve(self):
        """Finish the images posted, until `end`; not for the thread that posts."""
        cdef Py_ssize_t k = 0
        cdef slot_t* slot
        with nogil:
            while True:
                slot = &self.slots[k % SLOTS]
                PyThread_acquire_lock(slot.posted, WAIT_LOCK)
                if slot.last:
                    break
                finish(slot)
                PyThread_release_lock(slot.done)
                k += 1

    def end(self):
        """Let `serve` return when all images posted have been finished."""
        cdef slot_t* slot = &self.slots[self.posted % SLOTS]
        if not self.ended:
            self.ended = True
            slot.last = True
            PyThread_release_lock(slot.posted)

    def finish_here(self):
        """Finish all images posted in this thread, as a forked child has no other."""
        cdef slot_t* slot
        while self.waited < self.posted:
            slot = &self.slots[self.waited % SLOTS]
            finish(slot)
            self.held[self.waited % SLOTS] = None
            self.waited += 1
        self.ended = True
