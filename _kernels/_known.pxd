"""What is known of all pixels at a time; the planes of those at rest.  Inline only."""
from libc.stdint cimport int64_t

from _kernels._estimate cimport rest_of, rest_t
from _kernels._lamp cimport lamp_t
from _kernels._model cimport state_t, stored_t, track_t, tuning_t
from _kernels._smoothed cimport gap_t, resting_of, resting_t
from _kernels._tracks cimport start, walk_t

cdef enum:
    # Number of planes of pixels at rest, without and with later samples.
    PLANES = 4
    SMOOTH_PLANES = 6
    LATER = PLANES      # the first plane that comes from later samples

cdef struct known_t:
    # Data and parameters of all pixels, and the time to read.
    const stored_t* store
    const track_t* tracks
    const state_t* states
    const gap_t* gaps       # NULL: later samples are not used
    const tuning_t* tuning
    lamp_t lamp
    int64_t t
    int64_t known
    int64_t epoch


cdef inline void show_planes(const known_t* k, Py_ssize_t at, float* planes,
                             Py_ssize_t size) noexcept nogil:
    """Write the parameters of a pixel at rest to the planes."""
    cdef walk_t walk
    cdef rest_t rest
    cdef resting_t smoothed
    start(&walk, &k.tracks[at])
    walk.n_on = k.tracks[at].n_on
    walk.n_off = k.tracks[at].n_off
    if k.gaps == NULL:
        rest = rest_of(&k.states[at], &walk, k.epoch, k.tuning)
        planes[at] = rest.level
        planes[size + at] = rest.variance
        planes[2 * size + at] = rest.per_s
        planes[3 * size + at] = rest.offset
        return
    smoothed = resting_of(&k.gaps[at], &walk, &k.states[at], k.epoch, k.tuning)
    planes[at] = smoothed.level
    planes[size + at] = smoothed.v0
    planes[2 * size + at] = smoothed.v1
    planes[3 * size + at] = smoothed.offset
    planes[4 * size + at] = smoothed.slope
    planes[5 * size + at] = smoothed.v2
