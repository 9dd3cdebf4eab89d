"""Prophesee's RAW (EVT2, EVT3) and DAT files, which hold events only.

Written from Prophesee's documentation of the formats.  They are decoded here because
the existing readers have other licences (expelliarmus GPL, faery LGPL).
"""
from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.errors import RecordingError
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import SequentialRecording, likely_size
from pdavis_cv.recording.timeline import FILLED, OFFSET, Clock, Timeline
from pdavis_cv.sensor import Layout

__all__ = ["PropheseeRecording", "WordStream", "is_prophesee"]

MAX_HEADER = 1 << 16
MAX_SIDE = 8192
CHUNK = 1 << 18
"""Bytes that are decoded at a time."""
_CHIPS = (("320", (320, 320)), ("imx636", (720, 1280)), ("gen4", (720, 1280)),
          ("gen3", (480, 640)))
"""(height, width) by a substring of the name of plugin or generation."""

# Indices into the kernels' state.
HIGH, TIME, UNTIMED, WORD_STATE = 0, 1, 6, 7


def is_prophesee(start: bytes) -> bool:
    """Return whether a file begins with a header of Prophesee."""
    lines = [line for line in start.split(b"\n") if line.startswith(b"%")]
    return bool(lines) and re.search(
        rb"%\s*(evt \d|format EVT|geometry|Data file containing|plugin_name"
        rb"|system_ID|camera_integrator_name|integrator_name)",
        b"\n".join(lines)) is not None


class WordStream:
    """Decode words of EVT2 or EVT3 to events; the state is kept between calls.

    Parameters
    ----------
    version : {2, 3}
    size : (int, int)
        Sensor (height, width).
    """

    def __init__(self, version: int, size: tuple[int, int]) -> None:
        self.version, self.size = version, size
        self.dtype = np.dtype("<u4" if version == 2 else "<u2")
        self._stream = np.zeros(WORD_STATE, np.int64)
        self._stream[HIGH] = -1
        self.jumps = 0

    @property
    def untimed(self) -> int:
        """Number of event words that were skipped because their time is unknown."""
        return int(self._stream[UNTIMED])

    def events(self, words: NDArray[np.unsignedinteger], clock: Clock,
               memory: Scratch | None = None) -> NDArray[Any]:
        """Return the events that lie on the sensor and in time order.

        Parameters
        ----------
        words : ndarray of uint32 (EVT2) or uint16 (EVT3), shape (N,)
        clock : Clock
            Its state counts dropped events.
        memory : Scratch, optional
            Provides memory for the result.

        Returns
        -------
        ndarray of EVENT_DTYPE, shape (M,)
        """
        two = self.version == 2
        kernel = _kernels.evt2_words if two else _kernels.evt3_words
        # Pages that are never written take no memory.
        out = (memory or Scratch()).room(len(words) if two else 12 * len(words) + 12)
        clock.begin()
        done, self.jumps = 0, 0
        while done < len(words):
            done, jump = kernel(
                words, done, *self.size, self._stream, clock.state, out)
            if jump:
                clock.jump(int(self._stream[TIME] + clock.state[OFFSET]))
                self.jumps += 1
        return out[:int(clock.state[FILLED])]


class PropheseeRecording(SequentialRecording):
    """A recording in Prophesee's RAW or DAT; see `open_recording`.

    Parameters
    ----------
    path : path
    layout : Layout, optional
    bad_events : {"drop", "raise"}
    camera : str, optional
        Must be part of the header's camera or serial number if given.
    """

    def _open(self, layout: Layout | None, camera: str | None) -> RecordingInfo:
        self._reader = self._bytes()
        self._end = self._reader.size
        facts = self._header()
        name = " ".join(facts.get(key, "") for key in (
            "integrator_name", "camera_integrator_name", "plugin_name", "system_ID"
            )).strip() or None
        serial = facts.get("serial_number")
        if camera is not None and camera.lower() not in f"{name} {serial}".lower():
            raise RecordingError(
                f"{self._path}: no camera named {camera!r}: it is {name} {serial}")
        self._version = self._kind(facts)
        size = self._sensor_size(facts)
        if size is None:
            size = self._hull()
            self._log.add("unknown size", None, "the header does not give the sensor's "
                          f"size: {size[1]}x{size[0]} holds the first events")
        return RecordingInfo(
            format="DAT" if self._version == 0 else f"RAW (EVT{self._version})",
            sensor_size=size, writer=facts.get("generator", "Prophesee"), camera=name,
            serial=serial, layout=layout, frame_count=0, imu_count=0, trigger_count=0,
            event_count=(self._reader.size - self._begin) // 8 if (
                self._version == 0) else None,
            header={"first_row": "top", **facts})

    def _header(self) -> dict[str, str]:
        """Return the header's lines by their first word; set where they end."""
        data = self._reader.read(0, MAX_HEADER)
        at = 0
        facts: dict[str, str] = {}
        while data[at:at + 1] == b"%":
            end = data.find(b"\n", at)
            if end < 0:
                break
            line = data[at + 1:end].strip().decode("latin-1")
            at = end + 1
            if line == "end":
                break
            key, _, value = line.partition(" ")
            facts.setdefault(key, value.strip())
        self._begin = at
        return facts

    def _kind(self, facts: dict[str, str]) -> int:
        """Return 2 or 3 for RAW (EVT2, EVT3), 0 for DAT.

        Raises
        ------
        RecordingError
            If the events have another format.
        """
        if facts.get("Data", "").startswith("file containing"):
            kind, size = self._reader.read(self._begin, 2).ljust(2, b"\0")
            if kind not in (0, 12) or size != 8:
                raise RecordingError(
                    f"{self._path}: byte {self._begin}: events of type {kind} and "
                    f"{size} bytes, but those of DAT are of type 0 or 12 and 8 bytes")
            self._begin += 2
            return 0
        stated = facts.get("format", "").partition(";")[0] or facts.get("evt", "2.0")
        version = stated.upper().removeprefix("EVT").strip()
        if version not in ("2", "2.0", "3", "3.0"):
            raise RecordingError(
                f"{self._path}: byte 0: EVT{version} is not read, EVT2 and EVT3 are")
        return int(version[0])

    def _sensor_size(self, facts: dict[str, str]) -> tuple[int, int] | None:
        options = dict(part.split("=", 1) for part in facts.get(
            "format", "").split(";")[1:] if "=" in part)
        width, _, height = facts.get("geometry", "").partition("x")
        for high, wide in ((options.get("height"), options.get("width")),
                           (height, width), (facts.get("Height"), facts.get("Width")),
                           (facts.get("height"), facts.get("width"))):
            sides = [(side or "").strip() for side in (high, wide)]
            if not all(side.isdecimal() and len(side) < 10 for side in sides):
                continue
            size = int(sides[0]), int(sides[1])
            if not (0 < size[0] <= MAX_SIDE and 0 < size[1] <= MAX_SIDE):
                raise RecordingError(
                    f"{self._path}: sensor sides must lie in 1..{MAX_SIDE}, the header "
                    f"says {size[1]}x{size[0]}")
            return size
        names = " ".join(facts.get(key, "") for key in (
            "plugin_name", "sensor_generation", "sensor_name")).lower()
        return next((size for part, size in _CHIPS if part in names), None)

    def _hull(self) -> tuple[int, int]:
        """Return a sensor size that holds the first events."""
        if self._version == 0:
            words = self._words(self._begin, Scratch()).reshape(-1, 2)[:, 1]
            x, y = words & 0x3FFF, words >> 14 & 0x3FFF
        else:
            stream = WordStream(self._version, (2048, 2048))
            events = stream.events(
                self._words(self._begin, Scratch()), Clock(Timeline()))
            x, y = events["x"], events["y"]
        return likely_size(int(x.max(initial=0)), int(y.max(initial=0)))

    def _words(self, at: int, memory: Scratch) -> NDArray[np.unsignedinteger]:
        """Return the complete words of the chunk at a byte."""
        dtype = np.dtype("<u2" if self._version == 3 else "<u4")
        size = 8 if self._version == 0 else dtype.itemsize
        data = memory.read(self._reader, at, CHUNK)
        words: NDArray[np.unsignedinteger] = data[:len(data) // size * size].view(dtype)
        return words

    def _first(self) -> WordStream | None:
        return WordStream(self._version, self._info.sensor_size) if (
            self._version) else None

    def _next(self, at: int, clock: Clock, state: WordStream | None, memory: Scratch
              ) -> tuple[NDArray[Any], int]:
        words = self._words(at, memory)
        if not len(words):
            if at < self._reader.size:
                self._log.damage(
                    at, f"byte {at}: the file ends inside a word", offset=at)
            return np.empty(0, EVENT_DTYPE), at
        after = at + words.nbytes
        if state is None:
            t, word = words.reshape(-1, 2).T
            return self._checked(
                (t.astype(np.int64), word & 0x3FFF, word >> 14 & 0x3FFF, word >> 28),
                clock, at, memory), after
        before = state.untimed
        events = state.events(words, clock, memory)
        self._dropped(clock, at, state.jumps)
        self._count(at, "untimed", state.untimed - before, "events were skipped "
                    "whose time is not known, or damaged")
        return events, after
