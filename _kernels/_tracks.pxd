"""What a pixel's last events say of its intensity between them.  Inline only.

A stamp is an event's time times two, plus its polarity.
"""
from libc.stdint cimport int32_t, int64_t

from _kernels._lamp cimport lamp_t, ripple
from _kernels._math cimport exp_f
from _kernels._types cimport event_t

cdef packed struct track_t:
    int64_t prev            # stamp of the last but one committed event
    int64_t last            # stamp of the last one
    int32_t n_off           # committed since the reference
    int32_t n_on

cdef packed struct node_t:
    # A frame as it measured one pixel: base + h_on theta_on + h_off theta_off at the
    # last event before its middle, up to noise (a variance; 0 or less: no sample).
    float level
    float h_on
    float h_off
    float noise
    float drift             # variance since the sample before
    int32_t n_on            # all events up to the middle
    int32_t n_off

cdef enum:
    # What the lamp did at an event so long ago is not remembered.
    STALE_US = 10000000

cdef struct walk_t:
    # A place in a pixel's events: the last two passed, the next index, counts passed.
    int64_t t_prev
    int p_prev
    int64_t t
    int p
    int32_t next
    int n_on
    int n_off

cdef struct part_t:
    # What has been crossed of a threshold since the last event: fraction * theta[p],
    # down if p is 0, and its change per second; variances in theta^2, of both.  fall:
    # thresholds per second that the intensity last fell by, 0 if it rose.  ripple: what
    # the lamp adds to the part, in log intensity, and its change per second.
    int p
    double fraction
    double rate
    double var
    double rate_var
    double fall
    double ripple
    double ripple_rate


cdef inline bint never(int64_t t) noexcept nogil:
    """Tell that a time stands for no event; differences stay far from 2**63."""
    return t <= -4611686018427387904LL


cdef inline void step(walk_t* walk, const event_t* store,
                      const int32_t* link) noexcept nogil:
    walk.t_prev = walk.t
    walk.p_prev = walk.p
    walk.t = store[walk.next].t
    walk.p = store[walk.next].p
    if walk.p:
        walk.n_on += 1
    else:
        walk.n_off += 1
    walk.next = link[walk.next]


cdef inline void start(walk_t* walk, int64_t prev, int64_t last,
                       int32_t first) noexcept nogil:
    """Begin after the events with these two stamps."""
    walk.t_prev = prev >> 1
    walk.p_prev = prev & 1
    walk.t = last >> 1
    walk.p = last & 1
    walk.next = first
    walk.n_on = 0
    walk.n_off = 0


cdef inline part_t nothing(int p) noexcept nogil:
    """Return the part of a pixel of which too little is known."""
    cdef part_t part
    part.p = p
    part.fraction = 0.0
    part.rate = 0.0
    part.var = 0.3
    part.rate_var = 0.0
    part.fall = 0.0
    part.ripple = 0.0
    part.ripple_rate = 0.0
    return part


cdef inline double drift(int64_t dt, double n, const double* tuning) noexcept nogil:
    """Variance in theta^2 that dt microseconds and n events add."""
    return tuning[0] * 1e-6 * <double>dt + tuning[1] * n


cdef inline double corner(double hz, double hz_per_level,
                          double level) noexcept nogil:
    """Corner frequency of a pixel that shows level."""
    return hz if hz_per_level <= 0.0 else hz + hz_per_level * exp_f(<float>level)


cdef inline part_t between(const walk_t* walk, int64_t t1, int p1, double on,
                           double off, const lamp_t* lamp, double hz,
                           double t) noexcept nogil:
    """Part crossed at t, between walk and its next event, of polarity p1 at t1.

    Linear where the signs agree.  Else a parabola through both and the event before,
    which crossed the same way as the last; on and off are the thresholds.  It
    cannot turn before the last event nor a threshold beyond it; without an event
    before, half a threshold.  The variances are those of turning polarizers and plates.
    Under a lamp that flickers this holds for the light less its ripple, as a pixel of
    hz passes it on.
    """
    cdef part_t part = nothing(p1)
    cdef double gap = <double>(t1 - walk.t), s, q, turn = 0.366, last = 0.0, next = 0.0
    cdef double here = 0.0, now, change = 0.0, _
    cdef bint same = walk.p == p1
    cdef bint flickers = lamp.blocks > 0 and t1 - walk.t < STALE_US
    if never(walk.t):
        return part
    if gap < 100.0:
        gap = 100.0
    s = (t - <double>walk.t) / gap
    part.var = 0.0005
    part.rate_var = 0.0008
    if flickers:
        last = on if walk.p else -off
        next = on if p1 else -off
        here = ripple(lamp, hz, <double>walk.t, &_)
        change = ripple(lamp, hz, <double>t1, &_) - here
        next -= change
        if walk.t - walk.t_prev < STALE_US:
            last -= here - ripple(lamp, hz, <double>walk.t_prev, &_)
        same = last * next >= 0.0
    if same:
        part.fraction = s
        part.rate = 1e6 / gap
        part.fall = 0.0 if p1 else part.rate
    else:
        if never(walk.t_prev) or walk.p_prev != walk.p:
            part.var = 0.05
            part.rate_var = 1.0
        else:
            part.var = 0.003
            part.rate_var = 0.02
            q = <double>(walk.t - walk.t_prev)
            q = q if q > 100.0 else 100.0
            part.fall = 1e6 / q if p1 else 0.0
            q /= gap
            if flickers:
                last = last if last > 0.0 else -last
                next = next if next > 0.0 else -next
            else:
                last = off if p1 else on
                next = on if p1 else off
            turn = (last - q * q * next) / (2.0 * (last + q * next) + 1e-30)
            turn = 0.0 if turn < 0.0 else 0.414 if turn > 0.414 else turn
        q = 1.0 / (1.0 - 2.0 * turn)
        part.fraction = s * (s - 2.0 * turn) * q
        part.rate = (2.0 * s - 2.0 * turn) * q * 1e6 / gap
    part.rate_var *= 1e12 / (gap * gap)
    if flickers:
        now = ripple(lamp, hz, t, &part.ripple_rate)
        part.ripple = now - here - part.fraction * change
        part.ripple_rate -= part.rate * change
    return part


cdef inline part_t quiet(int64_t t0, int p0, double known, const lamp_t* lamp,
                         double hz, double t) noexcept nogil:
    """Part crossed at t when no event follows t0 up to the time known, which is > t.

    A parabola that goes on by half a threshold and is back at the time known: within
    0.1 of the mean over turning and slowing pixels.
    """
    cdef part_t part = nothing(p0)
    cdef double gap = known - <double>t0, s
    if never(t0):
        return part
    part.var = 0.08
    part.rate_var = 0.3e12 / (gap * gap)
    s = (t - <double>t0) / gap
    part.fraction = 2.0 * s * (1.0 - s)
    part.rate = (2.0 - 4.0 * s) * 1e6 / gap
    add_ripple(&part, lamp, hz, t0, t)
    return part


cdef inline void add_ripple(part_t* part, const lamp_t* lamp, double hz, int64_t t0,
                            double t) noexcept nogil:
    """Let what is expected after the last event, at t0, be beside the lamp's ripple."""
    cdef double _
    if lamp.blocks > 0 and t - <double>t0 < STALE_US:
        part.ripple = (ripple(lamp, hz, t, &part.ripple_rate)
                       - ripple(lamp, hz, <double>t0, &_))


cdef inline part_t ahead(const walk_t* walk, double on, double off,
                         const lamp_t* lamp, double hz, double t) noexcept nogil:
    """Part crossed at t from the last two events alone, nothing known beyond t.

    Means and variances of the part and of its slope, as functions of the time since
    the last event over the last interval, for turning polarizers of any degree seen by
    a low-pass pixel: on at nearly the same rate, then more and more likely to have
    turned.  After a turn it goes on fast, unless one of the events was noise.  Under a
    lamp that flickers this holds for the light less its ripple.
    """
    cdef part_t part = nothing(walk.p)
    cdef double gap = <double>(walk.t - walk.t_prev), u, change, room = 1.0, _
    cdef bint same = walk.p_prev == walk.p
    if never(walk.t_prev):
        return part
    if lamp.blocks > 0 and t - <double>walk.t_prev < STALE_US:
        # In how long the light alone crosses a threshold, and which way.
        change = (ripple(lamp, hz, <double>walk.t, &_)
                  - ripple(lamp, hz, <double>walk.t_prev, &_))
        if change != 0.0:
            change = (on if walk.p else -off) - change
            part.p = change > 0.0
            change = change / on if change > 0.0 else -change / off
            # Less than half a threshold is no turn.
            same = walk.p_prev == part.p or change < 0.5
            gap /= change if change > 0.1 else 0.1
        # How much of it the light may have crossed without an event.
        room = ripple(lamp, hz, t, &_) - ripple(lamp, hz, <double>walk.t, &_)
        room = 1.0 - room / on if part.p else 1.0 + room / off
        room = 0.3 if room < 0.3 else 2.0 if room > 2.0 else room
    if gap < 200.0:
        gap = 200.0
    u = (t - <double>walk.t) / (gap * room)
    if same:
        part.fall = 0.0 if part.p else 1e6 / gap
        part.var = 0.1 * u * u + 0.005 if u < 1.5 else 0.23
        part.rate_var = 0.04 + 0.25 * u if u < 1.0 else 0.29
        if u < 0.8:
            part.fraction = 0.86 * u
            part.rate = 0.93 - 0.18 * u
        elif u < 1.2:
            part.fraction = 0.688 if u < 1.1 else 0.688 - 0.57 * (u - 1.1)
            part.rate = 0.786 - 1.59 * (u - 0.8)
        elif u < 5.0:
            part.fraction = (0.688 - 0.57 * (u - 1.1) if u < 1.45
                             else 0.488 - 0.26 * (u - 1.45))
            part.rate = 0.15 - 0.7 * (u - 1.2) if u < 2.25 else -0.585
        else:
            part.fraction = -0.435
    else:
        part.var = 0.05
        part.rate_var = 1.7
        if u < 0.15:
            part.fraction = 4.5 * u
            part.rate = 4.7
        elif u < 0.3:
            part.fraction = 0.675 + 1.1 * (u - 0.15)
            part.rate = 4.7 - 8.8 * (u - 0.15)
        elif u < 0.6:
            part.fraction = 0.84 - 0.97 * (u - 0.3)
            part.rate = 3.38 - 11.27 * (u - 0.3)
        elif u < 2.0:
            part.fraction = 0.549 - 0.178 * (u - 0.6)
        else:
            part.fraction = 0.3
    part.fraction *= room
    part.rate *= 1e6 / gap
    part.rate_var *= 1e12 / (gap * gap)
    add_ripple(&part, lamp, hz, walk.t, t)
    return part


cdef inline double lead_variance(double u, double rate_var, double fall,
                                 double shown, const double* tuning) noexcept nogil:
    """Variance of lead's result u.

    From that of the slope, per second squared, and the relative error of the corner
    frequency, by the derivatives of the equation that lead solves.  A pixel that is as
    fast as its light is bright shows no fall faster than 1/e of its corner frequency
    (times 2 pi), and what it falls to beyond is lost: fall is per second.  tuning as in
    kalman_frame.
    """
    cdef double hz = tuning[2], e = 0.0, d, v, lost = 0.0
    if hz <= 0.0 and tuning[3] <= 0.0:
        return 0.0
    if tuning[3] > 0.0:
        e = tuning[3] * exp_f(<float>shown)
        lost = fall * 0.15915494309189535 * e / ((hz + e) * (hz + e))
        # Measured on turning polarizers from 200 to 1000 RPM.
        lost = 2.0 * (lost - 0.2) if lost > 0.2 else 0.0
        lost = lost if lost < 0.6 else 0.6
        e = tuning[3] * exp_f(<float>(shown + u))
    d = hz + e * (1.0 + u)
    if d < 0.05 * (hz + e):
        d = 0.05 * (hz + e)
    v = tuning[4] * u * (hz + e)
    v = (0.02533 * rate_var + v * v) / (d * d) + lost * lost
    return v if v < 1.0 else 1.0


cdef inline double lead(double slope, double shown, double hz,
                        double hz_per_level) noexcept nogil:
    """Log intensity minus what a low-pass pixel shows of it.

    slope is that of the log intensity shown, per second.  The pixel follows
    y' = 2 pi (hz + hz_per_level I) (ln I - y): solved for ln I - y.  Where I is far
    below what is shown, its size is lost; -0.85 is the limit that can be told.
    """
    cdef double c, u, e, f, g, level
    cdef int _
    if hz_per_level <= 0.0:
        if hz <= 0.0:
            return 0.0
        u = slope * 0.15915494309189535 / hz
        return 3.0 if u > 3.0 else -3.0 if u < -3.0 else u
    c = slope * 0.15915494309189535
    level = exp_f(<float>shown)
    f = hz + hz_per_level * level
    u = c / f
    if u < 0.02 and u > -0.02:
        return u * (1.0 - u * hz_per_level * level / f)
    u = 0.0
    for _ in range(8):
        e = hz_per_level * level * exp_f(<float>u)
        g = u * (hz + e) - c
        f = hz + e * (1.0 + u)
        if f < 0.05 * (hz + e):
            f = 0.05 * (hz + e)
        g /= f
        u -= g
        u = 2.0 if u > 2.0 else -0.85 if u < -0.85 else u
        if g < 1e-4 and g > -1e-4:
            break
    return u
