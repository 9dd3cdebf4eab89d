"""Events: their dtype, checks, and conversions to images and bins."""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, positive, sensor_shape, typed, whole_number
from pdavis_cv._types import Events

EVENT_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""Time in microseconds, column, row (0 at the top), polarity (1 = ON); 13 bytes."""

FAR = 1 << 61
"""Times lie within this of 0, us (73,000 years): sums and differences of two stay in
64 bits."""

MOST_BINS = 65_536
"""A choice: the bins of `voxel_grid` are held in memory, each an image."""

_ALIASES = {
    "t": ("t", "timestamp", "ts"),
    "x": ("x",),
    "y": ("y",),
    "p": ("p", "on", "polarity"),
}


def as_events(events: Any) -> Events:
    """Return events as a C-contiguous EVENT_DTYPE array, a view where possible.

    Parameters
    ----------
    events : ndarray, structured, shape (N,), or mapping of columns
        Fields ``t`` (or ``timestamp``, ``ts``), ``x``, ``y`` and ``p`` (or ``on``,
        ``polarity``), integers or bool.  The memory layout of EVENT_DTYPE under
        other names, or with an unsigned ``t`` or a bool ``p``, gives a view;
        other layouts and columns give a copy.

    Returns
    -------
    ndarray of EVENT_DTYPE, shape (N,)

    Raises
    ------
    TypeError
        If a field is missing or does not hold integers; the message names it.
    ValueError
        If the array is not one-dimensional, columns differ in length, or a value
        does not fit (a polarity other than 0 and 1, a negative coordinate).
    """
    if isinstance(events, np.ndarray) and events.dtype == EVENT_DTYPE:
        return np.ascontiguousarray(_one_dimensional(events))
    if isinstance(events, Mapping):
        columns = {str(name): np.asarray(column) for name, column in events.items()}
        found = _find_fields(tuple(columns))
        return _copy({name: columns[field] for name, field in found.items()}, found)
    typed("events", events, np.ndarray, "a structured array or a mapping of columns")
    dtype = events.dtype
    if dtype.fields is None or dtype.names is None:
        raise TypeError(
            "events must be a structured array with the fields t, x, y, p, or a "
            f"mapping of columns, such as {{'t': a[:, 0], ...}}, got {dtype} of shape "
            f"{events.shape}")
    found = _find_fields(dtype.names)
    for field in found.values():
        _require_integers(field, dtype[field])
    _one_dimensional(events)
    if _same_memory(dtype, found):
        return np.ascontiguousarray(events).view(EVENT_DTYPE)
    return _copy({name: events[field] for name, field in found.items()}, found)


def timed_events(events: Any) -> Events:
    """Return `as_events(events)` after checking that times can be computed with.

    An error names the first event whose time lies further than `FAR` from 0.
    """
    checked: Events = as_events(events)
    i = _kernels.check_times(checked)
    if i < len(checked):
        raise ValueError(
            f"times must lie within 2**61 us of 0, but event {i} is at "
            f"t={checked['t'][i]}")
    return checked


def checked_time(name: str, t_us: int) -> int:
    """Return a time as an int, which is no further than `FAR` from 0."""
    try:
        t = int(t_us)
    except TypeError:
        raise TypeError(
            f"{name} must be a time in us, got {type(t_us).__name__}") from None
    except (ValueError, OverflowError):     # NaN and infinities
        t = FAR + 1
    if not -FAR <= t <= FAR:
        raise ValueError(f"{name} must lie within 2**61 us of 0, got {t_us!r}")
    return t


def check_order(events: Events, name: str = "events") -> None:
    """Raise ValueError naming the first event whose time is before the last one's."""
    t = events["t"]
    back = np.flatnonzero(t[1:] < t[:-1])
    if back.size:
        i = int(back[0]) + 1
        raise ValueError(
            f"{name} must be time-ordered, but event {i} at t={t[i]} comes after "
            f"t={t[i - 1]}")


class EventSlice(NamedTuple):
    """Events of one bin; see `slices`.

    Parameters
    ----------
    start_us, stop_us : int
        Half-open interval [start_us, stop_us) that holds the events.
    events : ndarray of EVENT_DTYPE, shape (N,)
        A view of the original array.
    """

    start_us: int
    stop_us: int
    events: Events


def accumulate(
    events: Any, shape: Sequence[int], *, start_us: int | None = None,
    stop_us: int | None = None, out: NDArray[np.int32] | None = None,
) -> NDArray[np.int32]:
    """Count events per pixel and polarity.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        In any order; or what `as_events` accepts.
    shape : (int, int)
        Sensor (height, width), e.g. ``(260, 346)``.
    start_us, stop_us : int, optional
        Half-open interval [start_us, stop_us); default all.
    out : ndarray of int32, shape (2, H, W), optional
        Receives the result; overwritten.

    Returns
    -------
    ndarray of int32, shape (2, H, W)
        Counts; plane 0 is OFF, plane 1 is ON.

    Raises
    ------
    ValueError
        If an event lies outside ``shape``, inside the interval or not; the message
        names the first one.  If ``out`` is unfit.
    TypeError
        If ``out`` has another dtype.
    """
    events, size = as_events(events), sensor_shape(shape)
    bounds = np.iinfo(np.int64)
    start = int(bounds.min) if start_us is None else checked_time("start_us", start_us)
    stop = int(bounds.max) if stop_us is None else checked_time("stop_us", stop_us)
    counts = output(out, (2, *size), np.int32, events)
    counts.fill(0)
    _all_taken(events, _kernels.count(events, start, stop, counts), size)
    return counts


def slices(
    events: Any, *, duration_us: int | None = None, count: int | None = None,
    start_us: int | None = None, stop_us: int | None = None,
) -> Iterator[EventSlice]:
    """Cut events into bins of equal duration or of equal number.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Time-ordered; or what `as_events` accepts.
    duration_us : int, optional
        Bin k is [start_us + k * duration_us, start_us + (k + 1) * duration_us), empty
        ones included; the last one ends at ``stop_us``, if that is given.
    count : int, optional
        Events per bin instead; the last bin may hold fewer.  A bin goes from its
        first event to one past its last: events of one time may be divided between
        two bins, which then overlap by that microsecond.
    start_us, stop_us : int, optional
        Half-open interval [start_us, stop_us) to be cut; default: from the first
        event to the last one.

    Returns
    -------
    iterator of EventSlice
        In order of time; the events are views.

    Raises
    ------
    ValueError
        If not exactly one of ``duration_us`` and ``count`` is given, it is not
        positive, or time runs backward; the message names the first such event.
    """
    if (duration_us is None) == (count is None):
        raise ValueError(
            "slices needs either duration_us or count, got "
            f"duration_us={duration_us}, count={count}")
    if duration_us is not None:
        duration_us = whole_number("duration_us", duration_us, 1, FAR)
    if count is not None:
        count = whole_number("count", count, 1, FAR)
    if start_us is not None:
        start_us = checked_time("start_us", start_us)
    if stop_us is not None:
        stop_us = checked_time("stop_us", stop_us)
    events = as_events(events)
    check_order(events)
    t = events["t"]
    first = 0 if start_us is None else bisect_left(t, start_us)
    end = len(t) if stop_us is None else bisect_left(t, stop_us)
    events = events[first:end]
    if count is not None:
        parts = (events[i:i + count] for i in range(0, len(events), count))
        return (EventSlice(int(part["t"][0]), int(part["t"][-1]) + 1, part)
                for part in parts)
    assert duration_us is not None
    if start_us is None and len(events):
        start_us = int(events["t"][0])
    if stop_us is None and len(events) and start_us is not None:
        whole = (int(events["t"][-1]) - start_us) // duration_us + 1
        stop_us = start_us + whole * duration_us
    if start_us is None or stop_us is None:
        return iter(())
    t = events["t"]
    return (EventSlice(start, min(start + duration_us, stop_us), events[
                bisect_left(t, start):bisect_left(t, start + duration_us)])
            for start in range(start_us, stop_us, duration_us))


def voxel_grid(
    events: Any, shape: Sequence[int], bins: int, *, start_us: int | None = None,
    stop_us: int | None = None, out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Sum polarities in time bins, each event shared between the two nearest.

    Bin k is centred at ``start_us + k * (stop_us - start_us) / (bins - 1)`` and takes
    ``1 - |distance|``, in units of the spacing, of each event; a single bin takes
    everything (Zhu et al., CVPR 2019).

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Time-ordered; or what `as_events` accepts.
    shape : (int, int)
        Sensor (height, width).
    bins : int
        Number of bins.
    start_us, stop_us : int, optional
        Half-open interval [start_us, stop_us) that is spread over the bins; default:
        from the first event to one past the last.
    out : ndarray of float32, shape (bins, H, W), optional
        Receives the result; overwritten.

    Returns
    -------
    ndarray of float32, shape (bins, H, W)
        Sums of +1 (ON) and -1 (OFF).

    Raises
    ------
    ValueError
        If an event lies outside ``shape``; the message names the first one.  If the
        interval is empty, ``bins`` not positive, or ``out`` unfit.
    TypeError
        If ``out`` has another dtype.
    """
    events, size = timed_events(events), sensor_shape(shape)
    bins = whole_number("bins", bins, 1, MOST_BINS)
    grid = output(out, (bins, *size), np.float32, events)
    if not len(events):
        grid.fill(0)
        return grid
    start = int(events["t"][0]) if start_us is None else checked_time(
        "start_us", start_us)
    stop = int(events["t"][-1]) + 1 if stop_us is None else checked_time(
        "stop_us", stop_us)
    if stop <= start:
        raise ValueError(f"stop_us must lie after start_us, got [{start}, {stop})")
    grid.fill(0)
    _all_taken(events, _kernels.voxel(events, start, stop, grid), size)
    return grid


def time_surface(
    events: Any, shape: Sequence[int], *, tau_us: float, t_us: int | None = None,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return exp(-age / tau) of the last event of each pixel and polarity.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE, shape (N,)
        Time-ordered; or what `as_events` accepts.
    shape : (int, int)
        Sensor (height, width).
    tau_us : float
        Time constant in microseconds.
    t_us : int, optional
        Time of the surface; later events are ignored.  Default: the time of the last
        event.
    out : ndarray of float32, shape (2, H, W), optional
        Receives the result; overwritten.

    Returns
    -------
    ndarray of float32, shape (2, H, W)
        1 for an event at ``t_us``, 0 where there was none; plane 0 is OFF, plane 1
        is ON.

    Raises
    ------
    ValueError
        If an event lies outside ``shape`` or time runs backward; the message names
        the first one.  If ``tau_us`` is not positive or ``out`` unfit.
    TypeError
        If ``out`` has another dtype.
    """
    events, size = timed_events(events), sensor_shape(shape)
    rate = 1 / positive("tau_us", tau_us)
    surface = output(out, (2, *size), np.float32, events)
    never = int(np.iinfo(np.int64).min)
    _all_taken(events, _kernels.check_events(events, never, *size), size)
    surface.fill(0)
    if len(events):
        t = int(events["t"][-1]) if t_us is None else checked_time("t_us", t_us)
        _kernels.surface(events[:bisect_right(events["t"], t)], t, rate, surface)
    return surface


def _all_taken(events: Events, taken: int, shape: tuple[int, int]) -> None:
    if taken < len(events):
        raise bad_event(events, taken, shape)


def check_inside(events: Events, shape: tuple[int, int], of: str = "") -> None:
    """Raise ValueError naming the first event that lies outside a sensor."""
    height, width = shape
    outside = (events["x"] >= width) | (events["y"] >= height) | (events["p"] > 1)
    if outside.any():
        raise _outside(events, int(outside.argmax()), shape, of)


def _outside(
    events: Events, i: int, shape: tuple[int, int], of: str = ""
) -> ValueError:
    event, (height, width) = events[i], shape
    return ValueError(
        f"event {i}{of} at (x={event['x']}, y={event['y']}, p={event['p']}) lies "
        f"outside the {width}x{height} sensor")


def bad_event(
    events: Events, i: int, shape: tuple[int, int], last_us: int | None = None
) -> ValueError:
    """Return the ValueError for event i, at which a kernel stopped.

    It says whether the event lies outside the sensor, (height, width), or is late:
    before its predecessor, or `last_us`, the last time seen before ``events``.
    """
    event, (height, width) = events[i], shape
    if event["y"] >= height or event["x"] >= width or event["p"] > 1:
        return _outside(events, i, shape)
    before = int(events["t"][i - 1]) if i else last_us
    return ValueError(
        f"events must be time-ordered, but event {i} at t={event['t']} comes after "
        f"t={before}")


def _find_fields(names: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for name, aliases in _ALIASES.items():
        field = next((alias for alias in aliases if alias in names), None)
        if field is None:
            raise TypeError(f"events have no field {' or '.join(aliases)}: {names}")
        found[name] = field
    return found


def _require_integers(field: str, dtype: np.dtype[Any]) -> None:
    if dtype.kind not in "iub" or dtype.subdtype is not None:
        raise TypeError(f"events field {field} must hold integers, got {dtype}")


def _one_dimensional(events: Events) -> NDArray[Any]:
    if events.ndim != 1:
        raise ValueError(f"events must be one-dimensional, got shape {events.shape}")
    return events


def _same_memory(dtype: np.dtype[Any], found: dict[str, str]) -> bool:
    fields: Mapping[str, Any] = dtype.fields or {}
    wanted: Mapping[str, Any] = EVENT_DTYPE.fields or {}
    return dtype.itemsize == EVENT_DTYPE.itemsize and all(
        fields[field][1] == wanted[name][1]
        and dtype[field].itemsize == EVENT_DTYPE[name].itemsize
        and dtype[field].isnative
        and (name == "p" or dtype[field].kind in ("i" if name == "t" else "") + "u")
        and (name != "p" or dtype[field].kind in "ub")
        for name, field in found.items())


def _copy(columns: dict[str, NDArray[Any]], found: dict[str, str]) -> Events:
    lengths = {found[name]: column.shape for name, column in columns.items()}
    if len(set(lengths.values())) != 1 or columns["t"].ndim != 1:
        raise ValueError(
            f"events columns must be one-dimensional and equally long, got {lengths}")
    out = np.empty(columns["t"].shape, EVENT_DTYPE)
    for name, column in columns.items():
        _require_integers(found[name], column.dtype)
        out[name] = column
        limit = 1 if name == "p" else int(np.iinfo(EVENT_DTYPE[name]).max)
        if column.dtype.kind != "b" and column.size and name != "t":
            bad = np.flatnonzero((column < 0) | (column > limit))
            if bad.size:
                raise ValueError(
                    f"events field {found[name]} must lie in 0..{limit}, but event "
                    f"{bad[0]} has {column[bad[0]]}")
    return out
