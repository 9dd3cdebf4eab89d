"""Which pixels may be moving, and the planes of those at rest: see _reading.pyx."""
from libc.stdint cimport int32_t, int64_t, uint8_t

from _kernels._estimate cimport left_out
from _kernels._hot cimport is_hot
from _kernels._known cimport PLANES, SMOOTH_PLANES, known_t, show_planes
from _kernels._listing cimport CHANGED, LEFT_OUT, LISTED, NEW_STATE
from _kernels._model cimport check_given, state_t, track_t, tuning_t
from _kernels._smoothed cimport gap_t
from _kernels._tracks cimport at_rest

cdef struct listing_t:
    # What `kalman_rest` is given.
    known_t known
    int64_t now
    bint smooth
    Py_ssize_t size
    int32_t* pixels
    uint8_t* flags
    float* planes


cdef inline bint may_move(const listing_t* of, Py_ssize_t i) noexcept nogil:
    """Tell whether a pixel is to be listed; write its planes and flag if it is not."""
    cdef const known_t* k = &of.known
    cdef Py_ssize_t n = of.size
    if not of.smooth and left_out(&k.states[i], k.tuning):
        of.flags[i] = LEFT_OUT
        of.planes[i] = 0.0
        of.planes[n + i] = -1.0     # no sample
        of.planes[2 * n + i] = 0.0
        of.planes[3 * n + i] = 0.0
        return False
    if not of.smooth and is_hot(&k.states[i]):
        of.flags[i] = LEFT_OUT      # its events have no weight
        show_planes(k, i, of.planes, n)
        return False
    # The smoothed course of a hot pixel does not fit the planes' polynomial.
    if (k.tracks[i].first >= 0 or not at_rest(k.tracks[i].last >> 1, of.now)
            or of.smooth and is_hot(&k.states[i])):
        return True
    of.flags[i] = 0
    show_planes(k, i, of.planes, n)
    return False


cdef Py_ssize_t list_all(const listing_t* of) noexcept nogil:
    """List the pixels that may be moving; return how many."""
    cdef Py_ssize_t i, n = 0
    for i in range(of.size):
        if may_move(of, i):
            of.flags[i] = LISTED | CHANGED | NEW_STATE
            of.pixels[n] = <int32_t>i
            n += 1
    return n


cdef Py_ssize_t list_again(const listing_t* of) noexcept nogil:
    """List those of the listed pixels that may still be moving; return how many."""
    cdef Py_ssize_t i, n = 0
    for i in range(of.size):
        if of.flags[i] & LISTED and may_move(of, i):
            if of.pixels[n] != i:
                of.flags[i] = LISTED | CHANGED | NEW_STATE
                of.pixels[n] = <int32_t>i
            n += 1
    return n


def kalman_rest(int64_t now, int64_t epoch, bint every,
                const tuning_t[::1] tuning not None,
                const track_t[:, ::1] tracks not None,
                const state_t[:, ::1] states not None,
                const gap_t[:, ::1] gaps not None, listing not None,
                float[:, :, ::1] planes not None):
    """List the pixels that are not at rest from `now` on; return how many.

    listing is (pixels, flags by pixel).  The listed pixels are examined, or all of them
    if `every` is set; those that are not at rest are written to the beginning of
    pixels, in order, and marked as changed unless they keep their place, and with it
    their lane.  planes (4, h, w) receives the parameters of the
    others, from which `kalman_show` reads them; epoch is the time that their variances
    refer to, at or after every sample.  Where the tuning has needs_sample set, pixels
    without a sample count as at rest, whatever their events, until `every` is set
    again.  tracks must chain the events that are not counted in it yet.  gaps is the
    result of `smooth_gap`, which knows all pixels, and planes then has shape
    (6, h, w); it is (0, 0) if later samples are not used.
    """
    cdef int32_t[::1] pixels
    cdef uint8_t[:, ::1] flags
    cdef Py_ssize_t h = tracks.shape[0], w = tracks.shape[1], n
    cdef bint smooth = gaps.shape[0] > 0
    cdef listing_t of
    cdef known_t* k = &of.known
    check_given(listing)
    pixels, flags = listing
    if (states.shape[0] != h or states.shape[1] != w or flags.shape[0] != h
            or flags.shape[1] != w or planes.shape[1] != h or planes.shape[2] != w
            or planes.shape[0] != (SMOOTH_PLANES if smooth else PLANES)
            or pixels.shape[0] != h * w
            or smooth and (gaps.shape[0] != h or gaps.shape[1] != w)):
        raise ValueError("kalman_rest: all images must have one shape")
    if tuning.shape[0] != 1:
        raise ValueError("kalman_rest: tuning must be one record")
    if h * w == 0:
        return 0
    k.tracks, k.states, k.tuning = &tracks[0, 0], &states[0, 0], &tuning[0]
    k.gaps, k.epoch = NULL, epoch
    if smooth:
        k.gaps = &gaps[0, 0]
    of.now, of.smooth, of.size = now, smooth, h * w
    of.pixels, of.flags, of.planes = &pixels[0], &flags[0, 0], &planes[0, 0, 0]
    with nogil:
        n = list_all(&of) if every else list_again(&of)
    return n
