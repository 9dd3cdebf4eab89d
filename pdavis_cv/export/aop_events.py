"""AoP events as AEDAT-4: events, their angles and pictures of them, in one file."""
from __future__ import annotations

import contextlib
import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import real_number
from pdavis_cv._types import Events
from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.aop_events import AOP_EVENT_DTYPE
from pdavis_cv.recording.aedat4.container import Aedat4File, Stream
from pdavis_cv.recording.aedat4.cursor import Cursor
from pdavis_cv.recording.aedat4.writer import (
    ANGLE_STEPS,
    ANGLES,
    EVENTS,
    FRAMES,
    Aedat4Writer,
)
from pdavis_cv.recording.base import ApsFrame, Packet
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.timeline import Timeline
from pdavis_cv.sensor import Layout

__all__ = ["AopEventsFile", "read_aop_events"]

_PER_PACKET = 1 << 16
_LEAST_FPS, _MOST_FPS = 1e-12, 1e6


class AopEventsFile(Aedat4Writer):
    """Writes AoP events as a triple of streams that DV, dv-processing and aedat read.

    ``events`` has the events as they were; ``aop`` has one more event for each of them,
    with the same time, row and polarity, whose x is the angle in steps of .01 degrees
    (0 to 17,999); ``frames`` has, for each interval, the last angle of each pixel in
    these steps, and 18,000, which counts as saturated, where there was no event.

    Parameters
    ----------
    path : path
        The file appears under this name when the writer is closed.
    sensor_size : (int, int)
        (height, width).
    layout : Layout, optional
        Kept in the header.
    fps : float
        Frames per second.

    Attributes
    ----------
    frames : int
        How many were written.

    Raises
    ------
    ValueError
        If fps lies outside 1e-12 to 1e6: the clock counts microseconds up to 2**61.
    """

    _numbers = (EVENTS, FRAMES, ANGLES)

    def __init__(
        self, path: str | os.PathLike[str], *, sensor_size: tuple[int, int],
        layout: Layout | None = None, fps: float = 100.0,
    ) -> None:
        if not _LEAST_FPS <= real_number(fps) <= _MOST_FPS:
            raise ValueError(
                f"fps must lie in {_LEAST_FPS:g}..{_MOST_FPS:g}, got {fps!r}")
        super().__init__(path, sensor_size=sensor_size, layout=layout, frame_bits=16,
                         full_scale_dn=ANGLE_STEPS)
        self._interval_us = round(1e6 / real_number(fps))
        self.frames = 0
        self._begin_us: int | None = None
        self._last = np.full(self.sensor_size, ANGLE_STEPS, np.float32)

    def add_angles(self, events: Events, angles: NDArray[Any]) -> None:
        """Write events and what `AopEvents` made of them.

        Parameters
        ----------
        events : ndarray of EVENT_DTYPE, shape (N,)
            Not before any that was written.
        angles : ndarray of AOP_EVENT_DTYPE, shape (N,)

        Raises
        ------
        ValueError
            If the two do not belong to each other, or as for `add`.
        """
        if len(events) != len(angles) or any(
                not np.array_equal(events[name], angles[name]) for name in "txy"):
            raise ValueError(
                f"angles must be those of the events, got {len(angles)} for "
                f"{len(events)}, or other times or places")
        for first in range(0, len(events), _PER_PACKET):
            some = np.s_[first:first + _PER_PACKET]
            self.add(Packet(events=events[some]))
            turns = angles["aop"][some].astype(np.float64) / math.pi
            steps = np.rint(turns * ANGLE_STEPS).astype(np.int64) % ANGLE_STEPS
            beside = np.array(events[some], EVENT_DTYPE)
            beside["x"] = steps
            with self._unfinished.named():
                self._put_events(ANGLES, beside)
                self._show(events[some], steps)

    def _show(self, events: Events, steps: NDArray[np.int64]) -> None:
        """Keep each pixel's last angle; write those of intervals that have ended."""
        t = events["t"]
        if self._begin_us is None:
            self._begin_us = int(t[0])
        while len(t):
            cut = int(np.searchsorted(t, self._begin_us + self._interval_us))
            self._last[events["y"][:cut], events["x"][:cut]] = steps[:cut]
            if cut == len(t):
                break
            self._finish_frame()
            events, steps, t = events[cut:], steps[cut:], t[cut:]
            # Intervals without an event have no frame.
            self._begin_us += (int(t[0]) - self._begin_us) // self._interval_us * (
                self._interval_us)

    def _finish_frame(self) -> None:
        begin = self._begin_us
        if begin is not None and (self._last < ANGLE_STEPS).any():
            self._put_frame(ApsFrame(
                self._last, begin, begin + self._interval_us,
                full_scale_dn=ANGLE_STEPS, valid=self._last < ANGLE_STEPS))
            self.frames += 1
        self._last = np.full(self.sensor_size, ANGLE_STEPS, np.float32)

    def _finish(self) -> None:
        self._finish_frame()
        super()._finish()


def read_aop_events(path: str | os.PathLike[str]) -> Events:
    """Read the AoP events that `AopEventsFile` wrote.

    Parameters
    ----------
    path : path

    Returns
    -------
    ndarray of AOP_EVENT_DTYPE, shape (N,)
        Angles to .005 degrees.

    Raises
    ------
    RecordingError
        If it is no AEDAT-4 file with a stream of angles beside its events, or if what
        is left of a damaged one does not match.
    """
    with contextlib.closing(FileReader(path)) as reader:
        file = Aedat4File(reader, ProblemLog(str(path)))
        found = {name: _stream(file, name) for name in ("events", "aop")}
        if found["events"] is None or found["aop"] is None:
            raise RecordingError(f"{path}: it holds no stream of angles beside events")
        events, beside = (_read(file, stream, path)
                          for stream in found.values() if stream is not None)
    if len(events) != len(beside) or any(
            not np.array_equal(events[name], beside[name]) for name in "typ"):
        raise RecordingError(
            f"{path}: angles and events do not match: {len(beside)} and {len(events)}")
    out = np.empty(len(events), AOP_EVENT_DTYPE)
    for name in "txy":
        out[name] = events[name]
    out["aop"] = beside["x"] * (math.pi / ANGLE_STEPS)
    return out


def _stream(file: Aedat4File, name: str) -> Stream | None:
    return next((stream for stream in file.streams.values() if stream.kind == "EVTS"
                 and stream.attributes.get("originalOutputName") == name), None)


def _read(file: Aedat4File, stream: Stream, path: Any) -> NDArray[Any]:
    try:
        size = (int(stream.attributes["sizeY"]), int(stream.attributes["sizeX"]))
    except (KeyError, ValueError):
        raise RecordingError(f"{path}: the header does not give its size") from None
    cursor = Cursor(file, "EVTS", stream.entries, Timeline(), size=size)
    pieces = [np.empty(0, EVENT_DTYPE)]
    while (piece := cursor.pull()) is not None:
        pieces.append(piece)
    return np.concatenate(pieces)
