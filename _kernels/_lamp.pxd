"""Ripple that the flicker of a lamp adds to all log intensities.  Inline only.

Time is divided into blocks of BLOCK_US.  The ripple of a block is a sinusoid (`wave_t`)
with its frequency in periods (turns) per microsecond, the amplitudes of its cosine and
sine, and phase 0 at the beginning of the block.  The amplitudes are either those of the
light, to which each pixel's low-pass is applied, or those behind the low-pass, which is
then taken to be the same for all pixels (docs/theory/lamp.md).
"""
from libc.stdint cimport int64_t

from _kernels._model cimport wave_t

# Length of a block, us: as BLOCK_US in reconstruct/lamp.py.
cdef enum:
    BLOCK_US = 100000

cdef struct lamp_t:
    const wave_t* waves     # one per block
    int64_t blocks          # number of blocks
    int64_t start           # beginning of the first block, us


cdef extern from "_lamp.h" nogil:
    const double QUARTER_TURN
    double cos_turns "pd_cos_turns"(double u) noexcept nogil


cdef inline lamp_t lamp_of(const wave_t[::1] waves) noexcept nogil:
    """Return the lamp with these waves, one per block; it points into their memory."""
    cdef lamp_t lamp
    lamp.blocks = waves.shape[0]
    lamp.waves = NULL
    lamp.start = 0
    if lamp.blocks > 0:
        lamp.waves = &waves[0]
        lamp.start = waves[0].start_us
    return lamp


cdef inline const wave_t* wave_at(const lamp_t* lamp, double t) noexcept nogil:
    """Return the wave of the block that contains t, or NULL."""
    cdef double since = t - <double>lamp.start
    cdef int64_t block
    if lamp.blocks == 0 or since < 0.0:
        return NULL
    block = <int64_t>(since / BLOCK_US)
    return lamp.waves + block if block < lamp.blocks else NULL


cdef inline bint lamp_flickers(const lamp_t* lamp, double begin,
                               double end) noexcept nogil:
    """Return whether the lamp flickers in the block of either time."""
    cdef const wave_t* wave = wave_at(lamp, begin)
    if wave != NULL and wave.turns_per_us > 0.0:
        return True
    wave = wave_at(lamp, end)
    return wave != NULL and wave.turns_per_us > 0.0


cdef extern from *:
    """
    #if defined(__GNUC__)
    #define PD_SELDOM __attribute__((noinline, cold, unused))
    #else
    #define PD_SELDOM
    #endif

    /* Ripple, and its derivative (1/s), at a phase of `turns` since the beginning of
       the block.  If of_light, the pixel's low-pass of corner frequency hz is applied
       (hz = 0: no low-pass).  Not inlined, as that would slow down steady lamps. */
    static PD_SELDOM double pd_ripple(double turns_per_us, double cosine, double sine,
                                      int of_light, double turns, double hz,
                                      double *rate) {
        double c = pd_cos_turns(turns), s = pd_cos_turns(turns - QUARTER_TURN);
        if (hz > 0 && of_light) {
            /* A low-pass turns e^(i w t) into e^(i w t) / (1 + i lag), lag = f / hz. */
            double lag = 1e6 * turns_per_us / hz, share = 1 / (1 + lag * lag), passed;
            passed = share * (c + lag * s);
            s = share * (s - lag * c);
            c = passed;
        }
        *rate = TWO_PI_PER_US * turns_per_us * (sine * c - cosine * s);
        return cosine * c + sine * s;
    }
    """
    double ripple_of "pd_ripple"(double turns_per_us, double cosine, double sine,
                                 bint of_light, double turns, double hz,
                                 double* rate) noexcept nogil


cdef inline double ripple(const lamp_t* lamp, double hz, double t,
                          double* rate) noexcept nogil:
    """Return the ripple of log intensity at t; its derivative (1/s) goes into rate.

    hz is the corner frequency of the pixel's low-pass, 0 for none.
    """
    cdef const wave_t* wave = wave_at(lamp, t)
    cdef double since = t - <double>lamp.start
    if wave == NULL or wave.turns_per_us <= 0.0:
        rate[0] = 0.0
        return 0.0
    since -= BLOCK_US * <double>(<int64_t>(since / BLOCK_US))
    return ripple_of(wave.turns_per_us, wave.cosine, wave.sine, wave.of_light > 0.0,
                     wave.turns_per_us * since, hz, rate)
