"""Log intensity of all pixels at one time: from planes at rest, from lanes in motion.

A pixel's parameters change only with its events and with frames.  In between they are
cached: of a pixel at rest in planes (see rest_of in _estimate.pxd), of one that may be
moving in a lane (see _lanes.h).
"""
from libc.stdint cimport int32_t, int64_t, uint8_t
from libc.string cimport memchr, memcpy

from _kernels._estimate cimport LEAST_VARIANCE, read_pixel, walk_to
from _kernels._hot cimport is_hot
from _kernels._known cimport LATER, PLANES, SMOOTH_PLANES, known_t, show_planes
from _kernels._lamp cimport lamp_of
from _kernels._lanes cimport (
    LANES, enter_events, enter_state, lanes_t, reader_of, reader_t, show_lanes, shown_t)
from _kernels._listing cimport CHANGED, LISTED, NEW_STATE, RESTS
from _kernels._model cimport (
    check_given, state_t, stored_t, track_t, tuning_t, wave_t)
from _kernels._smoothed cimport (
    enter_smoothed, gap_t, read_smoothed, resting_of, resting_t, show_resting)
from _kernels._tracks cimport REST_US, at_rest, walk_t

cdef extern from "_prefetch.h" nogil:
    void prefetch "PDAVIS_PREFETCH"(const void*)
    void prefetch_all "PDAVIS_PREFETCH_ALL"(const void*, Py_ssize_t)

cdef extern from "_rest.h" nogil:
    void rest_row(const float*, const float*, const float*, float, float, float,
                  Py_ssize_t, float*, unsigned char*)
    void smooth_row(const float*, const float*, const float*, const float*,
                    const float*, const float*, float, float, float, Py_ssize_t, float*,
                    float*, unsigned char*)

cdef enum:
    SOON = 8        # how many changed pixels ahead a next event is asked for

cdef enum:
    # Flag of a pixel at rest whose state has changed; an event would have listed it.
    AT_REST = CHANGED | NEW_STATE

cdef struct images_t:
    # The images to write; variance and valid may be NULL.
    float* log
    float* variance
    uint8_t* valid


cdef inline void show_one(const known_t* k, Py_ssize_t at,
                          const images_t* out) noexcept nogil:
    """Write log intensity, variance and validity of one pixel."""
    cdef float variance
    cdef uint8_t valid
    cdef float* var = &variance
    cdef uint8_t* good = &valid
    cdef walk_t walk
    cdef resting_t rest
    if out.variance != NULL:
        var = &out.variance[at]
        good = &out.valid[at]
    if k.gaps == NULL:
        read_pixel(k.t, k.known, k.epoch, k.store, k.tuning, &k.lamp, &k.tracks[at],
                   &k.states[at], &out.log[at], var, good)
        return
    walk_to(&walk, k.t, k.store, &k.tracks[at], k.tuning.refractory_us)
    if at_rest(walk.t, k.t) and not is_hot(&k.states[at]) and (
            walk.next < 0 or k.store[walk.next].t > k.known):
        rest = resting_of(&k.gaps[at], &walk, &k.states[at], k.epoch, k.tuning)
        show_resting(&rest, <float>(1e-6 * <double>(k.t - k.epoch)),
                     <float>k.tuning.valid_variance, &out.log[at], var, good)
        return
    read_smoothed(k.t, k.known, k.store, k.tuning, &k.lamp, &k.tracks[at], &k.gaps[at],
                  &k.states[at], &out.log[at], var, good)


def kalman_read(int64_t t, int64_t known, int64_t epoch, chain not None,
                model not None, const state_t[:, ::1] states not None, rows not None,
                shown not None):
    """Write log intensity and its variance at t, using the events up to known >= t.

    The rows (first, last) are written to shown (log intensity, variance, valid).
    chain is (store, tracks that chain the events not counted there yet), model
    (tuning, waves); epoch is as in `kalman_rest`.  Before the first frame used, the
    variance is 0 and log intensity is relative to 0.  valid is 1 where the variance,
    without that of the lag and of the offset, is small enough.  variance and valid are
    not written if they have shape (0, 0).  If the tuning has needs_sample set, pixels
    without a sample are not computed: all three are 0.
    """
    cdef const stored_t[::1] store
    cdef const track_t[:, ::1] tracks
    cdef const tuning_t[::1] tuning
    cdef const wave_t[::1] waves
    cdef float[:, ::1] log, variance
    cdef uint8_t[:, ::1] valid
    cdef Py_ssize_t h = states.shape[0], w = states.shape[1], i, first, last
    cdef bint bare
    cdef known_t k
    cdef images_t out
    first, last = rows
    check_given((*chain, *model, *shown))
    store, tracks = chain
    tuning, waves = model
    log, variance, valid = shown
    bare = variance.shape[0] == 0
    if (tracks.shape[0] != h or tracks.shape[1] != w or log.shape[0] != h
            or log.shape[1] != w or valid.shape[0] != variance.shape[0]
            or valid.shape[1] != variance.shape[1]
            or not bare and (variance.shape[0] != h or variance.shape[1] != w)):
        raise ValueError("kalman_read: all images must have one shape")
    if tuning.shape[0] != 1 or store.shape[0] == 0:
        raise ValueError("kalman_read: tuning or store has a wrong length")
    if first < 0 or last > h:
        raise ValueError("kalman_read: rows must lie in the image")
    if h * w == 0:
        return
    k.store, k.tracks, k.states = &store[0], &tracks[0, 0], &states[0, 0]
    k.gaps, k.tuning, k.lamp = NULL, &tuning[0], lamp_of(waves)
    k.t, k.known, k.epoch = t, known, epoch
    out.log = &log[0, 0]
    out.variance = NULL
    out.valid = NULL
    if not bare:
        out.variance = &variance[0, 0]
        out.valid = &valid[0, 0]
    with nogil:
        for i in range(first * w, last * w):
            show_one(&k, i, &out)


cdef inline Py_ssize_t found(const int32_t[::1] pixels, Py_ssize_t n,
                             Py_ssize_t at) noexcept nogil:
    """Return how many of the first n pixels, which are sorted, lie before `at`."""
    cdef Py_ssize_t low = 0, middle
    while low < n:
        middle = (low + n) // 2
        if pixels[middle] < at:
            low = middle + 1
        else:
            n = middle
    return low


cdef struct group_t:
    # Listed pixels begin <= i < end that share a group of lanes; how many of them have
    # changed, and which lanes they have; whether states of them have; 1 for lanes that
    # are not to be shown.
    Py_ssize_t begin, end
    Py_ssize_t changed
    bint new_states
    uint8_t[LANES] lane
    uint8_t[LANES] done


cdef inline bint renewed(const known_t* k, Py_ssize_t at, lanes_t* lanes, Py_ssize_t i,
                         uint8_t* flag) noexcept nogil:
    """Write a pixel's lane; return False if a lane cannot represent the pixel."""
    cdef walk_t walk
    cdef const state_t* s = &k.states[at]
    cdef int32_t first = k.tracks[at].first
    cdef bint anew = k.gaps != NULL or flag[0] & NEW_STATE
    if first >= 0 and k.t < k.store[first].t <= k.known:
        return False        # a shortcut for the most frequent of the cases below
    if k.gaps != NULL and is_hot(s):
        return False
    walk_to(&walk, k.t, k.store, &k.tracks[at], k.tuning.refractory_us)
    if ((walk.next >= 0 and k.store[walk.next].t <= k.known)
            or (k.known > k.t and k.tuning.holds_part > 0.0)):
        return False
    if k.gaps != NULL:
        enter_smoothed(lanes, i, &walk, &k.gaps[at], s, k.epoch, k.tuning)
    else:
        if anew:
            enter_state(lanes, i, s, k.epoch, k.tuning)
        enter_events(lanes, i, &walk)
    flag[0] = LISTED if first < 0 else LISTED | CHANGED
    return True


cdef inline void write_group(const shown_t* group, const int32_t* pixels,
                             Py_ssize_t begin, Py_ssize_t end,
                             const images_t* out) noexcept nogil:
    """Copy the results of adjacent pixels, a group's lanes begin <= i < end."""
    cdef Py_ssize_t at = pixels[begin], n = end - begin, lane = begin % LANES
    memcpy(out.log + at, group.log + lane, n * sizeof(float))
    if out.variance != NULL:
        memcpy(out.variance + at, group.variance + lane, n * sizeof(float))
        memcpy(out.valid + at, group.valid + lane, n)


cdef struct showing_t:
    # What `kalman_show` is given.
    const known_t* known
    const reader_t* reader
    Py_ssize_t w, size
    uint8_t* flags
    float* planes
    float dt, most
    bint bare, smooth
    const int32_t* pixels
    Py_ssize_t begin, end       # of the part of the list
    bint mixed
    Py_ssize_t first, last      # pixels to show
    lanes_t* lanes
    images_t out


cdef void look_for_changed(const showing_t* of, group_t* group,
                           Py_ssize_t number) noexcept nogil:
    """Find the pixels of a group, and those of them whose lanes have to be renewed.

    Pixels outside of [first, last) are done: another thread shows them.
    """
    cdef Py_ssize_t i, at, n = 0, base = number * LANES, lane
    cdef uint8_t flag, flags = 0, none = 0
    cdef bint outside
    group.begin = max(base, of.begin)
    group.end = min(base + LANES, of.end)
    for i in range(group.begin, group.end):
        at = of.pixels[i]
        lane = i - base
        outside = at < of.first or at >= of.last
        # Another thread may be writing the flags of the others.
        flag = (&none if outside else &of.flags[at])[0]
        # No branch: which pixels have had an event cannot be predicted.
        group.lane[n] = <uint8_t>lane
        n += (flag & CHANGED) // CHANGED
        flags |= flag
        group.done[lane] = outside
    group.changed = n
    group.new_states = flags & NEW_STATE != 0
    for i in range(n):
        prefetch(&of.known.tracks[of.pixels[base + group.lane[i]]])


cdef void renew_group(const showing_t* of, group_t* group, const group_t* later,
                      Py_ssize_t number) noexcept nogil:
    """Renew the lanes of changed pixels; write those that a lane cannot represent."""
    cdef Py_ssize_t i, at, lane
    cdef int32_t first
    # Where events after t are known, most of them are read one by one.  That takes a
    # next event and a state, which are asked for meanwhile, some at a time; so are
    # states that have changed, as lanes are renewed from them.
    cdef bint ahead = of.known.known > of.known.t
    cdef bint states = ahead or later.new_states
    for i in range(max(group.changed, later.changed if states else 0)):
        if states and i < later.changed:
            at = of.pixels[(number + 1) * LANES + later.lane[i]]
            prefetch_all(&of.known.states[at], sizeof(state_t))
        if i >= group.changed:
            continue
        if ahead and i + SOON < group.changed:
            at = of.pixels[number * LANES + group.lane[i + SOON]]
            first = of.known.tracks[at].first
            if first >= 0:
                prefetch(&of.known.store[first])
        lane = group.lane[i]
        at = of.pixels[number * LANES + lane]
        if not renewed(of.known, at, of.lanes + number, lane, &of.flags[at]):
            show_one(of.known, at, &of.out)
            group.done[lane] = 1


cdef void show_group(const showing_t* of, const group_t* group,
                     Py_ssize_t number) noexcept nogil:
    """Write the images at the pixels of a group, whose lanes have been renewed."""
    cdef shown_t shown
    cdef const images_t* out = &of.out
    cdef const int32_t* pixels = of.pixels
    cdef Py_ssize_t begin = group.begin, end = group.end, i, at, lane
    cdef Py_ssize_t base = number * LANES
    cdef const lanes_t* lanes = of.lanes + number
    cdef const lanes_t* later = of.lanes + min(number + 2, (of.end - 1) // LANES)
    cdef bint whole = (
        not of.mixed and pixels[end - 1] - pixels[begin] == end - begin - 1)
    if not of.mixed:
        show_lanes(lanes, &shown, of.reader, later, begin - base, end - base)
    i = begin
    while of.mixed and i < end:
        at = i
        while i < end and not group.done[i - base]:
            i += 1
        if i > at:
            show_lanes(lanes, &shown, of.reader, later, at - base, i - base)
        i += 1
    if whole:
        for lane in range(begin - base, end - base):
            whole &= shown.since[lane] < REST_US and not group.done[lane]
    if whole:
        write_group(&shown, pixels, begin, end, out)
        return
    for i in range(begin, end):
        at = pixels[i]
        lane = i - base
        if group.done[lane]:
            continue
        if shown.since[lane] >= REST_US:
            # It came to rest after the list was made.  With RESTS set, its planes are
            # filled and it has been written from them.
            if not of.flags[at] & RESTS:
                show_one(of.known, at, out)
                if of.flags[at] == LISTED:
                    show_planes(of.known, at, of.planes, of.size)
                    of.flags[at] = LISTED | RESTS
            continue
        out.log[at] = shown.log[lane]
        if out.variance != NULL:
            out.variance[at] = shown.variance[lane]
            out.valid[at] = shown.valid[lane]


cdef void show_rows(const showing_t* of, Py_ssize_t first,
                    Py_ssize_t last) noexcept nogil:
    """Show rows from the planes, after those of changed pixels have been renewed."""
    cdef Py_ssize_t w = of.w, n = of.size, y, at, i
    cdef const uint8_t* changed
    cdef const float* p
    cdef uint8_t least
    for y in range(first, last):
        at = y * w
        least = LISTED
        for i in range(at, at + w):     # without an early exit: vectorized
            least &= of.flags[i] & LISTED & ~(of.flags[i] // RESTS)
        if least:
            continue        # the lanes show all of them
        changed = <const uint8_t*>memchr(of.flags + at, AT_REST, w)
        while changed != NULL:
            i = changed - of.flags
            of.flags[i] = 0
            show_planes(of.known, i, of.planes, n)
            changed = <const uint8_t*>memchr(of.flags + i, AT_REST, at + w - i)
        if of.smooth:
            p = of.planes + at
            smooth_row(
                p, p + LATER * n, p + n, p + 2 * n, p + (LATER + 1) * n, p + 3 * n,
                of.dt, <float>LEAST_VARIANCE, of.most, w, of.out.log + at,
                of.out.variance + at, <unsigned char*>(of.out.valid + at))
            continue
        memcpy(of.out.log + at, of.planes + at, w * sizeof(float))
        if not of.bare:
            rest_row(
                of.planes + n + at, of.planes + 2 * n + at, of.planes + 3 * n + at,
                of.dt, <float>LEAST_VARIANCE, of.most, w, of.out.variance + at,
                <unsigned char*>(of.out.valid + at))


cdef void show_groups(const showing_t* of) noexcept nogil:
    """Show the listed pixels of a part of the list."""
    cdef group_t[3] groups
    cdef Py_ssize_t i, first = of.begin // LANES, last = (of.end + LANES - 1) // LANES
    if of.begin == of.end:
        return
    # Three groups at a time: memory that is asked for has come when the next group's
    # turn is over, and single values written then can be read in long words.
    for i in range(first, last + 2):
        groups[i % 3].changed = groups[i % 3].new_states = 0
        if i < last:
            look_for_changed(of, &groups[i % 3], i)
        if first < i <= last:
            renew_group(of, &groups[(i - 1) % 3], &groups[i % 3], i - 1)
        if i > first + 1:
            show_group(of, &groups[(i - 2) % 3], i - 2)


def kalman_show(int64_t t, int64_t known, int64_t epoch, chain not None,
                const tuning_t[::1] tuning not None,
                const state_t[:, ::1] states not None,
                const gap_t[:, ::1] gaps not None, listing not None,
                float[:, :, ::1] planes not None, rows not None, shown not None):
    """Do as `kalman_read` without a lamp, from the cache of `kalman_rest`.

    listing is (listed pixels, how many of them are sorted, flags by pixel, lanes
    (n, 20, 64) of the listed pixels, aligned as float64 is); the cache is updated for
    pixels that are flagged as changed.  With gaps it does as `smooth_read` with
    t < known.
    """
    cdef const stored_t[::1] store
    cdef const track_t[:, ::1] tracks
    cdef const int32_t[::1] pixels
    cdef uint8_t[:, ::1] flags
    cdef float[:, :, ::1] lanes
    cdef float[:, ::1] log, variance
    cdef uint8_t[:, ::1] valid
    cdef Py_ssize_t h = states.shape[0], w = states.shape[1], i, first, last
    cdef Py_ssize_t ordered, n
    cdef bint bare, outside = False, smooth = gaps.shape[0] > 0
    cdef known_t k
    cdef reader_t reader
    cdef showing_t showing
    first, last = rows
    check_given((*chain, *listing, *shown))
    store, tracks = chain
    pixels, ordered, flags, lanes = listing
    log, variance, valid = shown
    bare = variance.shape[0] == 0
    n = pixels.shape[0]
    if (tracks.shape[0] != h or tracks.shape[1] != w or log.shape[0] != h
            or log.shape[1] != w or flags.shape[0] != h or flags.shape[1] != w
            or planes.shape[0] != (SMOOTH_PLANES if smooth else PLANES)
            or planes.shape[1] != h or planes.shape[2] != w
            or smooth and (gaps.shape[0] != h or gaps.shape[1] != w or t >= known)
            or smooth and bare or valid.shape[0] != variance.shape[0]
            or valid.shape[1] != variance.shape[1]
            or not bare and (variance.shape[0] != h or variance.shape[1] != w)):
        raise ValueError("kalman_show: all images must have one shape")
    if tuning.shape[0] != 1 or store.shape[0] == 0 or ordered < 0 or ordered > n:
        raise ValueError("kalman_show: an array has a wrong length")
    if (lanes.shape[1] != sizeof(lanes_t) // (LANES * sizeof(float))
            or lanes.shape[2] != LANES or lanes.shape[0] * LANES < n
            or n > 0 and <size_t>&lanes[0, 0, 0] % sizeof(double) != 0):
        raise ValueError("kalman_show: lanes must have room for the pixels")
    if first < 0 or last > h:
        raise ValueError("kalman_show: rows must lie in the image")
    for i in range(n):      # without an early exit, so that it can be vectorized
        outside |= (pixels[i] < 0) | (pixels[i] >= h * w)
    if outside:
        raise ValueError("kalman_show: pixels must lie in the image")
    if h * w == 0:
        return
    k.store, k.tracks, k.states = &store[0], &tracks[0, 0], &states[0, 0]
    k.tuning, k.lamp.waves, k.lamp.blocks, k.gaps = &tuning[0], NULL, 0, NULL
    if smooth:
        k.gaps = &gaps[0, 0]
    k.t, k.known, k.epoch = t, known, epoch
    reader = reader_of(&tuning[0], t, known, epoch, bare, smooth)
    showing.known, showing.reader = &k, &reader
    showing.w, showing.size, showing.bare, showing.smooth = w, h * w, bare, smooth
    showing.flags, showing.planes = &flags[0, 0], &planes[0, 0, 0]
    showing.dt = <float>(1e-6 * <double>(t - epoch))
    showing.most = <float>tuning[0].valid_variance
    showing.first, showing.last = first * w, last * w
    showing.pixels, showing.lanes = NULL, NULL
    if n > 0:
        showing.pixels, showing.lanes = &pixels[0], <lanes_t*>&lanes[0, 0, 0]
    showing.out.log = &log[0, 0]
    showing.out.variance, showing.out.valid = NULL, NULL
    if not bare:
        showing.out.variance, showing.out.valid = &variance[0, 0], &valid[0, 0]
    with nogil:
        show_rows(&showing, first, last)
        showing.mixed = False
        showing.begin = found(pixels, ordered, showing.first)
        showing.end = found(pixels, ordered, showing.last)
        show_groups(&showing)
        showing.mixed, showing.begin, showing.end = True, ordered, n
        show_groups(&showing)
