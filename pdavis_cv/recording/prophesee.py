"""Prophesee's RAW (EVT2, EVT2.1, EVT3) and DAT files: events and external triggers.

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
from pdavis_cv.recording.base import TRIGGER_DTYPE, RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import SequentialRecording
from pdavis_cv.recording.timeline import FILLED, OFFSET, Clock

MAX_HEADER = 1 << 16
CHUNK = 1 << 18
"""Bytes that are decoded at a time."""
_CHIPS = (("320", (320, 320)), ("imx636", (720, 1280)), ("gen4", (720, 1280)),
          ("gen3", (480, 640)))
"""(height, width) by a substring of the name of plugin or generation."""
_DAT_FIELDS = {1: (9, 17), 2: (14, 28)}
"""Bits of an event's word before y and before p, by the version of DAT; x is first."""
DAT, EVT2, EVT21, EVT3 = 0, 2, 21, 3
_NAMES = {DAT: "DAT", EVT2: "RAW (EVT2)", EVT21: "RAW (EVT2.1)", EVT3: "RAW (EVT3)"}
_WORD_BYTES = {DAT: 8, EVT2: 4, EVT21: 8, EVT3: 2}

# Indices into the kernels' state.
HIGH, UNTIMED, TRIGGERS, WORD_STATE = 0, 6, 7, 8
_TRIGGER_ROOM = 256
RISING, FALLING = 1, 2


def is_prophesee(start: bytes) -> bool:
    """Return whether a file begins with a header of Prophesee."""
    lines = [line for line in start.split(b"\n") if line.startswith(b"%")]
    return bool(lines) and re.search(
        rb"%\s*(evt \d|format EVT|geometry|Data file containing|plugin_name"
        rb"|system_ID|camera_integrator_name|integrator_name"
        rb"|(Version|Width|Height) \d)", b"\n".join(lines)) is not None


OTHER_TRIGGERS = ("triggers of other channels than {} were left out; "
                  "trigger_channel= states which one is read")


def ordered_triggers(t: NDArray[np.int64], rising: NDArray[Any], after_us: int
                     ) -> tuple[NDArray[Any], int]:
    """Return external triggers in time order, and how many were left out.

    `t` are their times, us, and `rising` tells which are rising edges, (N,).  Those
    before `after_us`, or before an earlier one, are left out.
    """
    keep = t >= np.maximum(np.maximum.accumulate(t), after_us)
    out = np.empty(int(keep.sum()), TRIGGER_DTYPE)
    out["t"] = t[keep]
    out["type"] = np.where(rising[keep], RISING, FALLING)
    return out, len(t) - len(out)


class WordStream:
    """Decode words of EVT2, EVT2.1 (version 21) or EVT3; the state is kept.

    Of EVT2.1, `high_first` tells whether the upper half of a word comes first.
    `triggers`, int64 (N, 2), are the external triggers of the last call on `channel`:
    time in the file in us, 1 for a rising edge; `other_triggers` counts the others.
    """

    def __init__(self, version: int, size: tuple[int, int], *, high_first: bool = True,
                 channel: int = 0) -> None:
        self.version, self.size, self._high_first = version, size, high_first
        self.dtype = np.dtype("<u2" if version == EVT3 else "<u4")
        self._stream = np.zeros(WORD_STATE, np.int64)
        self._stream[HIGH] = -1
        self._room = np.empty((_TRIGGER_ROOM, 2), np.int64)
        self.triggers, self._channel, self.other_triggers = self._room[:0], channel, 0

    def untimed(self) -> tuple[str, int, str]:
        """Return kind, number and message of words skipped since the last call."""
        skipped, self._stream[UNTIMED] = int(self._stream[UNTIMED]), 0
        return "untimed", skipped, (
            "events were skipped whose time is not known, or damaged")

    def room(self, words: NDArray[np.unsignedinteger]) -> int:
        """Return the largest number of events of words, and what the kernel needs."""
        return {EVT2: len(words), EVT21: 16 * len(words)}.get(
            self.version, 12 * len(words) + 12)

    def decode(self, words: NDArray[np.unsignedinteger], state: NDArray[np.int64],
               out: NDArray[Any]) -> None:
        """Append the events of words that lie on the sensor to `out`.

        Words are uint32 (EVT2, EVT2.1: two each) or uint16 (EVT3); the state, int64
        (7,), is that of the events' clock.
        """
        if self.version == EVT21:
            words = _single_events(words.reshape(-1, 2), self._high_first)
        kernel = _kernels.evt3_words if self.version == EVT3 else _kernels.evt2_words
        done, found = 0, []
        while done < len(words):
            done = kernel(words, done, *self.size, self._stream, state, self._room, out)
            if self._stream[TRIGGERS]:
                found.append(self._room[:int(self._stream[TRIGGERS])].copy())
        triggers = np.concatenate(found) if found else self._room[:0]
        self.triggers = triggers[triggers[:, 1] >> 1 == self._channel] & (-1, 1)
        self.other_triggers += len(triggers) - len(self.triggers)


def _single_events(pairs: NDArray[np.unsignedinteger], high_first: bool
                   ) -> NDArray[np.uint32]:
    """Return words of EVT2 for those of EVT2.1, which hold up to 32 pixels of a row.

    The upper half of a word has the fields of EVT2, the lower half a bit per pixel.
    """
    high, pixels = (pairs if high_first else pairs[:, ::-1]).T
    events = high >> 28 <= 1
    row, column = np.nonzero(pixels[events, None] >> np.arange(32, dtype=np.uint32) & 1)
    counts = np.ones(len(high), np.int64)
    counts[events] = np.bincount(row, minlength=np.count_nonzero(events))
    words: NDArray[np.uint32] = np.repeat(high, counts)
    vectors = np.repeat(events, counts)
    x = (words[vectors] >> 11) + column.astype(np.uint32) & 0x7FF
    words[vectors] = words[vectors] & ~np.uint32(0x7FF << 11) | x << 11
    return words


def _upper_first(pairs: NDArray[np.unsignedinteger]) -> bool:
    """Return whether the upper halves of words of EVT2.1 come first.

    Sensors differ in this.  Upper bits of time (kind 8) rise slowly where they are, but
    not in the halves that are pixels.
    """
    def rises(half: NDArray[np.unsignedinteger]) -> int:
        steps = np.diff((half[half >> 28 == 8] & 0xFFFFFFF).astype(np.int64))
        return int(np.count_nonzero((steps >= 0) & (steps < 1 << 14)))

    return rises(pairs[:, 0]) >= rises(pairs[:, 1])


class PropheseeRecording(SequentialRecording):
    """A recording in Prophesee's RAW or DAT; see `open_recording`.

    A stated ``camera`` must be part of the header's camera or serial number.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._reader = self._bytes()
        self._end = self._reader.size
        facts = self._header()
        name = " ".join(facts.get(key, "") for key in (
            "integrator_name", "camera_integrator_name", "plugin_name", "system_ID"
            )).strip() or None
        serial = facts.get("serial_number")
        self._check_camera(options.camera, f"{name} {serial}")
        self._channel = options.trigger_channel
        self._version = self._kind(facts)
        origin = facts.get("t0", facts.get("T0", ""))   # of faery
        self._origin = int(origin) if re.fullmatch(r"\d{1,18}", origin) else 0
        self._high_first = self._version == EVT21 and {
            "little": False, "legacy": True}.get(_endianness(facts), _upper_first(
                self._words(self._begin, Scratch()).reshape(-1, 2)))
        size = self._sensor_size(_stated_size(facts, self._log), self._farthest)
        return RecordingInfo(
            format=_NAMES[self._version],
            writer=facts.get("generator", "Prophesee"), camera=name, serial=serial,
            **stated(options, facts.get("source_facts"), sensor_size=size),
            frame_count=0, imu_count=0,
            trigger_count=0 if self._version == DAT else None,
            event_count=(self._reader.size - self._begin) // 8 if (
                self._version == DAT) else None,
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
        """Return the version of the events; for DAT, skip the two bytes before them."""
        stated = facts.get("format", "").partition(";")[0] or facts.get("evt", "")
        if "Data" in facts or ("Version" in facts and not stated):
            kind, size = self._reader.read(self._begin, 2).ljust(2, b"\0")
            dat = facts.get("Version", "2")
            if kind not in (0, 12) or size != 8 or dat not in ("1", "2"):
                raise RecordingError(
                    f"{self._path}: byte {self._begin}: DAT {dat} with events of "
                    f"type {kind} and {size} bytes is not read: versions 1 and 2 are, "
                    "of type 0 or 12 (CD) and 8 bytes")
            self._begin += 2
            self._fields = _DAT_FIELDS[int(dat)]
            return DAT
        name = (stated or "2.0").upper().removeprefix("EVT").strip().replace(".", "")
        version = {"2": EVT2, "20": EVT2, "21": EVT21, "3": EVT3, "30": EVT3}.get(name)
        if version is None:
            raise RecordingError(
                f"{self._path}: byte 0: EVT{stated.upper().removeprefix('EVT')} is not "
                "read, EVT2, EVT2.1 and EVT3 are; Metavision's "
                "metavision_file_to_dat converts it")
        if _endianness(facts) not in ("", "little", "legacy"):
            raise RecordingError(
                f"{self._path}: byte 0: words with endianness {_endianness(facts)} are "
                "not read, little and legacy are")
        return version

    def _farthest(self) -> tuple[int, int]:
        """Return the largest x and y of the first events."""
        words = self._words(self._begin, Scratch())
        if self._version == DAT:
            x, y, _ = self._places(words.reshape(-1, 2)[:, 1])
        else:
            stream = self._stream((2048, 2048))
            events = np.empty(stream.room(words), EVENT_DTYPE)
            state = Clock(None).state
            stream.decode(words, state, events)
            x, y = (events[axis][:int(state[FILLED])] for axis in "xy")
        return int(x.max(initial=0)), int(y.max(initial=0))

    def _places(self, word: NDArray[np.unsignedinteger]
                ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Return x, y, p of the words of DAT."""
        y, p = self._fields
        return word & (1 << y) - 1, word >> y & (1 << p - y) - 1, word >> p & 1

    def _words(self, at: int, memory: Scratch) -> NDArray[np.unsignedinteger]:
        """Return the complete words of the chunk at a byte."""
        size = _WORD_BYTES[self._version]
        data = memory.read(self._reader, at, CHUNK)
        words: NDArray[np.unsignedinteger] = data[:len(data) // size * size].view(
            "<u2" if self._version == EVT3 else "<u4")
        return words

    def _stream(self, size: tuple[int, int]) -> WordStream:
        return WordStream(self._version, size, high_first=self._high_first,
                          channel=self._channel)

    def _first(self) -> WordStream | None:
        return None if self._version == DAT else self._stream(self._info.sensor_size)

    def _next(self, at: int, clock: Clock, state: WordStream | None, memory: Scratch
              ) -> tuple[NDArray[Any], int]:
        if at == self._begin:
            clock.state[OFFSET] = self._origin
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
                (t.astype(np.int64), *self._places(word)), clock, at, memory), after
        others = state.other_triggers
        events = self._taken(lambda out: state.decode(words, clock.state, out),
                             state.room(words), clock, at, memory)
        self._count(at, *state.untimed())
        self._count(at, "other triggers", state.other_triggers - others,
                    OTHER_TRIGGERS.format(self._channel))
        return events, after

    def _triggers(self, at: int, clock: Clock, state: WordStream | None, after_us: int
                  ) -> NDArray[Any] | None:
        if state is None or not len(state.triggers):
            return None
        triggers, late = ordered_triggers(
            clock.moved(state.triggers[:, 0], after_us), state.triggers[:, 1],
            after_us)
        self._count(at, "late triggers", late, "triggers were dropped because time ran "
                    "backward")
        return triggers


def _stated_size(facts: dict[str, str], log: ProblemLog) -> tuple[int, int] | None:
    """Return (height, width) as the header states it, or by its chip."""
    options = dict(part.split("=", 1) for part in facts.get(
        "format", "").split(";")[1:] if "=" in part)
    width, _, height = facts.get("geometry", "").partition("x")
    for high, wide in ((options.get("height"), options.get("width")),
                       (height, width), (facts.get("Height"), facts.get("Width")),
                       (facts.get("height"), facts.get("width"))):
        sides = [(side or "").strip() for side in (high, wide)]
        if all(re.fullmatch(r"[-+]?\d{1,9}", side) for side in sides):
            return int(sides[0]), int(sides[1])
        if all(sides):
            log.add("sensor size", None, "the header's height {!r} and width {!r} are "
                    "no numbers".format(*sides))
    names = " ".join(facts.get(key, "") for key in (
        "plugin_name", "sensor_generation", "sensor_name")).lower()
    return next((size for part, size in _CHIPS if part in names), None)


def _endianness(facts: dict[str, str]) -> str:
    """Return the order of bytes that the header states, "" if none."""
    found = re.search(r"endianness=(\w+)", facts.get("format", ""))
    return (found[1] if found else facts.get("endianness", "")).lower()
