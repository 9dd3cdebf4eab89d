"""Recordings in memory."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import sensor_shape, typed
from pdavis_cv.events import EVENT_DTYPE, check_inside, check_order, timed_events
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    TRIGGER_DTYPE,
    ApsFrame,
    Packet,
    PlainSource,
    Recording,
    RecordingInfo,
    check_size,
)
from pdavis_cv.recording.facts import CALLER
from pdavis_cv.recording.packetise import Batch, packetise
from pdavis_cv.sensor import Layout


class MemoryRecording(PlainSource, Recording):
    """A recording whose samples are arrays, which `recording_from_arrays` checks."""

    def __init__(
        self, info: RecordingInfo, events: NDArray[Any],
        frames: tuple[ApsFrame, ...], imu: NDArray[Any], triggers: NDArray[Any],
    ) -> None:
        self._info = info
        self._events, self._frames = events, frames
        self._imu, self._triggers = imu, triggers

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        whole = Batch(self._events, list(self._frames), self._imu, self._triggers)
        yield from packetise([whole], start_us, stop_us)

    def close(self) -> None:
        """Do nothing: there is no file."""


def recording_from_arrays(
    events: Any, frames: Iterable[ApsFrame] = (), *, sensor_size: tuple[int, int],
    layout: Layout | str | None = None, imu: NDArray[Any] | None = None,
    triggers: NDArray[Any] | None = None,
) -> Recording:
    """Make a recording from arrays.

    Parameters
    ----------
    events : ndarray or mapping of columns, shape (N,)
        Time-ordered events, as accepted by `as_events`; None for no events.
    frames : iterable of ApsFrame
        Frames in the order of ``available_us`` and of ``mid_us``.
    sensor_size : (int, int)
        (height, width).
    layout : Layout or str, optional
        Polarizer layout, or its name; see `Layout.of`.
    imu : ndarray of IMU_DTYPE, optional
    triggers : ndarray of TRIGGER_DTYPE, optional

    Returns
    -------
    Recording
        It refers to the arrays without copying; do not change them afterwards.

    Raises
    ------
    TypeError
        If an array has the wrong dtype.
    ValueError
        If time runs backward, or an event or a frame lies outside the sensor.
    """
    events = np.empty(0, EVENT_DTYPE) if events is None else timed_events(events)
    frames = tuple(frames)
    layout = None if layout is None else Layout.of(layout)
    height, width = sensor_shape(sensor_size, "sensor_size")
    check_order(events)
    check_inside(events, (height, width))
    for i, frame in enumerate(frames):
        typed(f"frames must be ApsFrames: frame {i}", frame, ApsFrame, "one")
        check_size(frame, (height, width), f"frame {i}")
        if i and (frame.available_us <= frames[i - 1].available_us
                  or frame.mid_us <= frames[i - 1].mid_us):
            raise ValueError(
                f"frames must be in time order, but frame {i} at {frame.mid_us} us "
                f"comes after {frames[i - 1].mid_us} us")
    imu = _checked_samples("imu", imu, IMU_DTYPE)
    triggers = _checked_samples("triggers", triggers, TRIGGER_DTYPE)
    whole = Packet(events, frames, imu, triggers)
    info = RecordingInfo(
        format="memory", sensor_size=(height, width), layout=layout,
        sensor=None if layout is None else layout.sensor,
        full_scale_dn=frames[0].full_scale_dn if frames else None,
        origins=dict.fromkeys(
            ("sensor_size", "layout", "sensor", "full_scale_dn"), CALLER),
        start_us=whole.start_us, stop_us=whole.stop_us,
        event_count=len(events), frame_count=len(frames), imu_count=len(imu),
        trigger_count=len(triggers))
    return MemoryRecording(info, events, frames, imu, triggers)


def _checked_samples(name: str, samples: NDArray[Any] | None, dtype: np.dtype[Any]
                     ) -> NDArray[Any]:
    if samples is None:
        return np.empty(0, dtype)
    if samples.dtype != dtype or samples.ndim != 1:
        raise TypeError(
            f"{name} must be one-dimensional {dtype.names}, got {samples.dtype}")
    check_order(samples, name)
    return samples
