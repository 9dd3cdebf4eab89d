"""Event Stream files (``.es``), of event_stream, faery and command_line_tools.

Written from the specification of the format, version 2.  Its rows are counted from the
bottom of the image.
"""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import SequentialRecording
from pdavis_cv.recording.timeline import Clock

CHUNK = 1 << 18
"""Bytes that are decoded at a time."""
_HEADER = 20
_BYTES = 5
DVS, ATIS = 1, 2
_KINDS = ("generic events", "DVS events", "ATIS events", "display events",
          "colour events", "liquid events")


class EventStreamRecording(SequentialRecording):
    """A recording in Event Stream; see `open_recording`.

    DVS events, and those of ATIS that detect a change of intensity.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._reader = self._bytes()
        head = self._reader.read(0, _HEADER).ljust(_HEADER, b"\0")
        version, kind = head[12:15], head[15]
        if version[0] != 2 or kind not in (DVS, ATIS):
            what = _KINDS[kind] if kind < len(_KINDS) else f"events of type {kind}"
            raise RecordingError(
                f"{self._path}: byte 12: an Event Stream of version "
                f"{'.'.join(map(str, version))} with {what} is not read: version 2 "
                "with DVS or ATIS events is")
        width, height = np.frombuffer(head, "<u2", 2, 16).tolist()
        self._begin, self._end = _HEADER, self._reader.size
        self._atis = kind == ATIS
        return RecordingInfo(
            format=f"Event Stream ({_KINDS[kind].partition(' ')[0]})",
            **stated(options, sensor_size=self._sensor_size((height, width))),
            frame_count=0, imu_count=0, trigger_count=0, header={
                "first_row": "bottom", "version": ".".join(map(str, version))})

    def _first(self) -> NDArray[np.int64]:
        return np.zeros(1, np.int64)

    def _next(self, at: int, clock: Clock, state: NDArray[np.int64], memory: Scratch
              ) -> tuple[NDArray[Any], int]:
        data = memory.read(self._reader, at, CHUNK)
        done = 0

        def decode(out: NDArray[Any]) -> None:
            nonlocal done
            done = _kernels.stream_events(
                data, self._atis, *self._info.sensor_size, state, clock.state, out)

        events = self._taken(decode, len(data) // _BYTES + 1, clock, at, memory)
        if len(data) and not done:
            self._log.damage(at, f"byte {at}: the file ends inside an event", offset=at)
        return events, at + done
