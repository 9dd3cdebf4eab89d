"""Events to the input planes of the recurrent networks."""
from libc.stdint cimport int64_t, uint8_t

from _kernels._types cimport event_t


def voxel_planes(const event_t[::1] events not None, int64_t last, int64_t start,
                 int64_t stop, const float[:, :, :] steps not None,
                 Py_ssize_t height, Py_ssize_t width,
                 float[:, :, :, ::1] out not None, uint8_t[:, ::1] seen not None):
    """Divide each event's step between two bins of its place; return how many it took.

    steps is (height, width, 2): the steps of OFF and ON events.  out is (place, bin,
    y, x) with places anticlockwise from the bottom left of the cell.
    Stops at the first event outside the sensor, before last, or not before stop.
    """
    cdef Py_ssize_t n = events.shape[0], bins = out.shape[1]
    cdef Py_ssize_t h = out.shape[2], w = out.shape[3], i, y, x, p, k, place
    cdef double per_us, at
    cdef float step, late
    if (out.shape[0] != 4 or bins < 2 or stop <= start
            or 2 * h != height + height % 2 or 2 * w != width + width % 2
            or seen.shape[0] != h or seen.shape[1] != w or steps.shape[2] != 2):
        raise ValueError("voxel_planes: sizes do not fit")
    if steps.shape[0] != height or steps.shape[1] != width:
        raise ValueError("voxel_planes: steps do not fit")
    per_us = (bins - 1) / <double>(stop - start)
    with nogil:
        for i in range(n):
            y = events[i].y
            x = events[i].x
            p = events[i].p
            if (y >= height or x >= width or p > 1 or events[i].t < last
                    or events[i].t < start or events[i].t >= stop):
                break
            last = events[i].t
            at = <double>(last - start) * per_us
            k = <Py_ssize_t>at
            if k > bins - 2:              # only if the division rounds up
                k = bins - 2
            late = <float>(at - k)
            step = steps[y, x, p]
            # (1, 0), (1, 1), (0, 1), (0, 0) are places 0, 1, 2, 3.
            place = x % 2 if y % 2 else 3 - x % 2
            y = y // 2
            x = x // 2
            out[place, k, y, x] += step - step * late
            out[place, k + 1, y, x] += step * late
            seen[y, x] = 1
        else:
            i = n
    return i
