"""Records of the filter of log intensity, and its model in _increments.h."""
from libc.stdint cimport int8_t, int32_t, int64_t, uint8_t


cdef extern from "_increments.h" nogil:
    enum:
        CLASSES "GAP_CLASSES"
        CONTEXTS
        RATIOS
    const int LAGS
    const double FIRST_RATIO
    const double LEAST_GAP
    const double LEAST_SILENCE
    const int64_t NEVER "PD_NEVER"
    const int64_t CHANGED "PD_CHANGED"
    const int64_t QUIET "PD_QUIET"
    const double GATE "PD_GATE"
    const double CLAIM "PD_CLAIM"
    const double SHOWN "PD_SHOWN"
    const double PRIOR_ODDS "PD_PRIOR_ODDS"
    const double MORE "PD_MORE"
    const double LESS "PD_LESS"
    const double HOT_MEMORY "PD_HOT_MEMORY"
    const double UNKNOWN "PD_UNKNOWN"
    const double SMOOTH_FROM "PD_SMOOTH_FROM"
    const double KNOT "PD_KNOT"
    const double RESTS
    const double DOUBTFUL "PD_DOUBTFUL"
    ctypedef struct camera_t:
        double rest, dead, turn, hz, hz_per_light, black, alpha, beta, gamma, spread2
        double[2] theta
        double[3] theta_cov
        double[2][5] by_class
        double[5] lag
        double[5][2] own, cell, near
        double[2] own_now, cell_now, near_now
    ctypedef struct around_t:
        double since, gap, silent, before, next_weight, drift
        int sign, next_sign, context, flickers
    double weight_of(double gap, double before, int same, int run_before,
                     const camera_t* c)
    double step_of(double before, int on, const camera_t* c)
    int class_of(double gap, double* share)
    int ratio_node "node_of"(double ratio, double* share)
    int context_of(int run, double before, double before2)
    double lead_of(double slope, double light, const camera_t* c)
    void course_of(const around_t* a, const camera_t* c, double* rise, double* bend)
    void part_of(const around_t* a, const camera_t* c, double* part, double* rate)
    ctypedef struct silence_t:
        double rise, bend
    silence_t silence_of(const around_t* a, const camera_t* c)
    double silent_variance(const silence_t* of_, double x)
    double goes_on(double gap, const camera_t* c)
    double drift_of(const around_t* a, const camera_t* c, double* rate)
    void at_rest(double t, float ahead, float p_ahead, float behind, float p_behind,
                 double common, double extra, double m0, double m1, double alpha,
                 double* log, double* variance)
    void rest_planes(float ahead, float p_ahead, float behind, float p_behind,
                     double common, double extra, double m0, double m1, double epoch,
                     double alpha, float* level, float* slope, float* variance,
                     float* grows, float* bends)
    void rest_row(const double* m0, const double* m1, double epoch, double alpha,
                  Py_ssize_t n, float* level, float* slope, float* variance,
                  float* grows, float* bends)
    void pass_row(const float* z, const float* variance, const float* said,
                  const double* noise, Py_ssize_t n, float* log, float* p0, float* p1,
                  float* p2, float* motion)
    void back_row(const float* z, const float* variance, const float* said,
                  const double* noise, Py_ssize_t n, double* b, double* v)
    void show_row(const float* level, const float* slope, const float* variance,
                  const float* grows, const float* bends, float since,
                  float ripple, float most, Py_ssize_t n, float* log, float* out,
                  uint8_t* valid)
    void mean_row(const float* own, const float* cell, const float* other,
                  const float* near, const float* up, const float* down, Py_ssize_t n,
                  float* out)


cdef inline void mean_at(const float* planes, Py_ssize_t y, Py_ssize_t h, Py_ssize_t w,
                         float* out) noexcept nogil:
    """A row of the pixel's plane, plus the mean of its macropixel's, and that of the
    four nearest pixels with its polarizer (the edge is repeated)."""
    cdef const float* cell = planes + h * w
    cdef const float* near = cell + h * w
    mean_row(planes + y * w, cell + y * w, cell + min(y ^ 1, h - 1) * w,
             near + y * w, near + max(y - 2, 0) * w, near + min(y + 2, h - 1) * w, w,
             out)


# An event in the store.  Sums include it.
cdef struct stored_t:
    int64_t t
    double[2] light         # ln: changes by OFF and ON events of the pixel so far
    double[2] count         # thresholds: the same, not weighed by class
    float before            # s since the event before, or since the first of all
    float before2           # the same of the event before
    int32_t prev, next      # the pixel's events before and after it, -1: not stored
    int32_t pixel
    int8_t sign, context    # as in around_t
    int8_t run              # events of its sign up to it, at most 3
    int8_t run_before       # the same of the event before, 0: there was none

# The events of a pixel.
cdef struct pixel_t:
    stored_t at             # the last one committed, and its index in the store
    stored_t newest         # the last one fed, and its index
    int64_t quiet_t         # see increments_rest; NEVER: none
    int32_t at_index, newest_index
    int32_t next            # index of the first one after `at`, -1: none

# A pixel at the middle of a frame's exposure.
cdef struct node_t:
    double mean             # ln of the mean of exp of all changes so far, with the lead
    double[2] light         # means of the changes by OFF and ON events
    # The event of the silence that is open at its end, NEVER: none, 0: the pixel's
    # quiet_t.
    int64_t open_t
    int64_t around_t        # the same at the longest lag after its middle
    float open_variance     # thresholds^2, in the middle
    float middle            # ln of the light in the middle, less `mean`

# A pixel's estimate at the last frame that it has passed.
cdef struct anchor_t:
    float log               # ln(I + black) in the mean over the exposure
    float[2] gain           # relative deviation of the thresholds, OFF, ON
    float[6] p              # covariance of the three, upper triangle by rows
    float hot               # log odds that events of this pixel say nothing
    float motion            # of a hot pixel: mean squared change between frames
    float sampled           # 1: there has been a sample

# What a read needs of a pixel until its events or frames change.
cdef struct shown_t:
    int64_t last, next      # times of the events around, next: 2^62 if there is none
    float ahead, behind     # ln(I + black) at the last event, from frames before, after
    float p_behind          # variance of the frame after, < 0: none
    float[3] p              # of the level before, and its covariances with both gains
    float[3] gains          # covariance of the thresholds' relative errors
    float[2] since, until   # ln: OFF and ON, from the frame before and to the one after
    float[2] theta          # OFF, ON
    float corner            # Hz
    float before, next_weight, drift, opened
    int8_t sign, next_sign, context, state

# What a pixel's counts at other times, and now, say of it, of its macropixel and of its
# neighbours, until one of these times comes to another event: a parabola in the time
# since `origin` (s), and moments of the weights of the times in the open silence.
cdef struct course_t:
    int64_t until, origin   # us
    int64_t last            # us: the event of the open silence
    double[3] level
    float[3] rise, bend
    float[3][3] open
    float before
    int8_t sign, context    # of the open silence, sign 0: none


cdef enum:
    MOST_SAMPLES = 9            # times per exposure
    BEFORE = 1                  # flags of shown_t.state: a sample before, one after,
    AFTER = 2                   # and a pixel whose events say nothing
    HOT = 4
    FLICKERS = 8
    LEVEL = 0                   # planes, as show_row takes them
    SLOPE = 1
    VARIANCE = 2
    GROWS = 3
    BENDS = 4

cdef struct look_t:
    around_t around
    double[2] light
    double[2] count
    int64_t last, next      # next: NEVER where it is not known,
    int64_t unknown         # but stored: its time, else NEVER


cdef inline const camera_t* camera_of(const double[::1] numbers) except NULL:
    if numbers.shape[0] * sizeof(double) != sizeof(camera_t):
        raise ValueError("numbers must be those of a PixelModel")
    return <const camera_t*>&numbers[0]


cdef inline double weight(const stored_t* e, const camera_t* c) noexcept nogil:
    return weight_of(e.before, e.before2, e.run > 1, e.run_before, c)


cdef inline void before_it(const stored_t* e, const camera_t* c, double* light,
                           double* count) noexcept nogil:
    """Sums before an event."""
    cdef int on = e.sign > 0
    cdef double passed = e.sign * weight(e, c)
    light[0], light[1] = e.light[0], e.light[1]
    count[0], count[1] = e.count[0], e.count[1]
    light[on] -= passed * step_of(e.before, on, c)
    count[on] -= passed


cdef inline void look(const pixel_t* p, const stored_t* store, int64_t t, int64_t known,
                      const camera_t* c, look_t* out) noexcept nogil:
    """Find the events around t, of those up to `known`, and the sums at the last one.
    """
    cdef const stored_t* at = &p.at if p.at.run > 0 else NULL
    cdef const stored_t* after = &store[p.next] if p.next >= 0 else NULL
    if at != NULL and at.t > t:
        while at != NULL and at.t > t:
            after = at
            at = &store[at.prev] if at.prev >= 0 else NULL
    else:
        while after != NULL and after.t <= t:
            at = after
            after = &store[at.next] if at.next >= 0 else NULL
    out.around.sign = out.around.flickers = 0
    out.around.gap = out.around.drift = 0.0
    out.last = -NEVER
    if at != NULL:
        out.last = at.t
        out.light[0], out.light[1] = at.light[0], at.light[1]
        out.count[0], out.count[1] = at.count[0], at.count[1]
        out.around.sign = at.sign
        out.around.context = at.context
        out.around.before = at.before
    elif after != NULL:
        before_it(after, c, out.light, out.count)
        if after.run_before > 0:
            # It is not stored any more; the next one tells of it.
            out.last = after.t - <int64_t>(1e6 * after.before + 0.5)
            out.around.sign = after.sign if after.run > 1 else -after.sign
            out.around.context = context_of(after.run_before, 1.0, 0.0)
            out.around.before = after.before2
            if out.last > t:
                out.around.sign = 0
    else:
        out.light[0] = out.light[1] = out.count[0] = out.count[1] = 0.0
    out.around.since = 1e-6 * <double>(t - out.last)
    out.around.silent = 1e-6 * <double>(known - out.last)
    out.next = out.unknown = NEVER
    if after != NULL and after.t > known:
        out.unknown = after.t
    elif after != NULL:
        out.next = after.t
        out.around.gap = 1e-6 * <double>max(after.t - out.last, 1)
        out.around.next_sign = after.sign
        out.around.next_weight = weight(after, c)
