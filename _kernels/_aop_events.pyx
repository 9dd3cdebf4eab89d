"""Stokes parameters of log intensity, event by event, for the AoP of each.

All sums of the high pass decay at one rate, and an angle does not depend on their
scale.  So the sums are not decayed; events are weighted by exp(rate (t - epoch)).
"""
from libc.math cimport fabs
from libc.stdint cimport int64_t

from _kernels._math cimport exp_f
from _kernels._types cimport event_t

cdef packed struct turn_t:
    double s1           # weighted sums of the changes of log intensity
    double s2
    double swept        # leaky integral of s1 ds2 - s2 ds1 = |s|^2 d(2 AoP)
    double energy       # leaky integral of |s|^2 dt
    double t            # last update, us


cdef inline void move(turn_t* m, double t, double d1, double d2,
                      double weight) noexcept nogil:
    m.energy += (m.s1 * m.s1 + m.s2 * m.s2) * (t - m.t) * weight
    m.swept += (m.s1 * d2 - m.s2 * d1) * weight
    m.s1 += d1
    m.s2 += d2
    m.t = t


cdef void new_epoch(turn_t[:, ::1] turns, float s, float leaky) noexcept nogil:
    """Rescale the sums to a later epoch."""
    cdef Py_ssize_t r, c
    for r in range(turns.shape[0]):
        for c in range(turns.shape[1]):
            turns[r, c].s1 *= s
            turns[r, c].s2 *= s
            turns[r, c].swept *= leaky
            turns[r, c].energy *= leaky


def aop_event_stokes(const event_t[::1] events not None,
                     const float[:, :, :] step not None,
                     const double[:, ::1] axes not None, Py_ssize_t radius,
                     int64_t last, double rate, double span, bint correct,
                     double[::1] epoch not None, turn_t[:, ::1] turns not None,
                     float[:, ::1] out not None):
    """Write S1 and S2, times a common factor, of each event's macropixel after it.

    axes holds the coefficients of place 2 (y % 2) + x % 2 of the cell in S1 and S2.  An
    event acts on the macropixels within radius.  rate is 1 / tau per us; the weights
    refer to epoch[0], which advances in steps of span us.  correct: correct the phase
    lead by the rate of rotation, a mean over 2 tau.  Returns how many events were
    taken: all, or those before the first that is outside or late.
    """
    cdef Py_ssize_t n = events.shape[0], rows = turns.shape[0], columns = turns.shape[1]
    cdef Py_ssize_t i, y, x, p, r, c, a, b, reach, place
    cdef double t, d, d1, d2, u, v, w, k, scale
    cdef float age, weight
    cdef float fall = exp_f(<float>(-rate * span))
    cdef float leaky = exp_f(<float>(-0.5 * rate * span))
    if (out.shape[0] != 2 or out.shape[1] != n or axes.shape[0] != 4
            or axes.shape[1] != 2 or epoch.shape[0] != 1):
        raise ValueError("aop_event_stokes: out, axes or epoch has a wrong shape")
    if (step.shape[0] > 2 * rows or step.shape[1] > 2 * columns or step.shape[2] != 2
            or radius < 0 or not span > 0.0):
        raise ValueError("aop_event_stokes: step, radius or span is impossible")
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if (y >= step.shape[0] or x >= step.shape[1] or p > 1
                    or events[i].t < last):
                break
            last = events[i].t
            t = <double>last
            # In steps of span, so that rounding does not depend on other events.
            while t - epoch[0] > span:
                if t - epoch[0] > 64.0 * span:
                    new_epoch(turns, 0.0, 0.0)
                    epoch[0] += <double>(<int64_t>((t - epoch[0]) / span)) * span
                else:
                    new_epoch(turns, fall, leaky)
                    epoch[0] += span
            age = <float>(rate * (t - epoch[0]))
            weight = exp_f(-1.5 * age)
            d = step[y, x, p] * exp_f(age)
            place = 2 * (y & 1) + (x & 1)
            d1 = d * axes[place, 0]
            d2 = d * axes[place, 1]
            r = y >> 1
            c = x >> 1
            for a in range(-radius if r >= radius else -r,
                           (radius if r + radius < rows else rows - 1 - r) + 1):
                reach = 0
                while (reach + 1) * (reach + 1) + a * a <= radius * radius:
                    reach += 1
                for b in range(-reach if c >= reach else -c,
                               (reach if c + reach < columns else columns - 1 - c) + 1):
                    move(&turns[r + a, c + b], t, d1, d2, weight)
            u = turns[r, c].s1
            v = turns[r, c].s2
            if correct:
                # Rotate by -atan(rate / w), w the signed rate of the doubled angle.
                w = turns[r, c].swept
                k = rate * turns[r, c].energy
                scale = fabs(w) + k
                if scale > 0.0:
                    k = (k if w >= 0.0 else -k) / scale
                    w = fabs(w) / scale
                    d = u * w + v * k
                    v = v * w - u * k
                    u = d
            out[0, i] = <float>u
            out[1, i] = <float>v
        else:
            i = n
    return i
