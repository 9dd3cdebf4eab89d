"""Recordings in AEDAT-4."""
from __future__ import annotations

import contextlib
from bisect import bisect_left
from collections.abc import Iterator
from functools import cached_property
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.errors import PdavisWarning, RecordingError
from pdavis_cv.recording.aedat4 import samples
from pdavis_cv.recording.aedat4.container import Aedat4File, Entry, Stream
from pdavis_cv.recording.aedat4.cursor import FRAMES_UNDER_WAY, Cursor
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError
from pdavis_cv.recording.base import Recording, RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import Batch, cell_start
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import PiecewiseRecording
from pdavis_cv.recording.timeline import NEVER, Marks, SegmentError, Timeline
from pdavis_cv.sensor import Layout, Sensor

KINDS = ("EVTS", "FRME", "IMUS", "TRIG")
MARK_PULLS = 64
"""Packets between two places where reading can resume without an index."""
EPOCH_US = 10**15
"""Times beyond this (the year 2001) are Unix times; smaller ones have another zero."""


class Aedat4Recording(PiecewiseRecording):
    """A recording in AEDAT-4; see `open_recording`.

    A stated ``camera`` is the name of the source, or a part of it.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._file = Aedat4File(self._bytes(), self._log, self._budget)
        self._streams = self._choose(options.camera)
        self._marks = Marks(MARK_PULLS)
        self._frame_times: dict[int, tuple[int, int, int, int, int, int]] = {}
        self._jaer = any(s.attributes.get("originalModuleName") == "jAER"
                         for s in self._streams.values())
        self._size: tuple[int, int] = self._sensor_size(self._stated_size()).value
        self._scale = self._frame_scale()
        return self._make_info(options)

    # Opening -------------------------------------------------------------------

    def _choose(self, camera: str | None) -> dict[str, Stream]:
        """Return the first stream of each kind of the chosen camera."""
        known = [s for s in self._file.streams.values() if s.kind in KINDS]
        for stream in self._file.streams.values():
            if stream.kind not in KINDS:
                self._file.log.add(
                    "unknown stream", stream.number, f"stream {stream.number} of type "
                    f"{stream.kind} is skipped", warning=PdavisWarning)
        names = sorted({s.source for s in known if s.kind in ("EVTS", "FRME")})
        if camera is not None:
            wanted = [name for name in names if camera in name]
        else:
            wanted = names
        if len(wanted) != 1 and known:
            what = "no camera" if not wanted else "several cameras"
            raise RecordingError(
                f"{self.path}: {what} named {camera!r}: it holds {', '.join(names)}"
                if camera is not None else
                f"{self.path}: it holds several cameras, pass camera=: "
                f"{', '.join(names)}" if wanted else
                f"{self.path}: it holds neither events nor frames")
        chosen: dict[str, Stream] = {}
        for stream in sorted(known, key=lambda s: s.number):
            if stream.source in (wanted[0], "") or len(names) == 1:
                chosen.setdefault(stream.kind, stream)
        if not chosen.keys() & {"EVTS", "FRME"}:
            raise RecordingError(f"{self.path}: it holds neither events nor frames")
        return chosen

    def _stated_size(self) -> tuple[int, int] | None:
        for kind in ("EVTS", "FRME"):
            stream = self._streams.get(kind)
            if stream is None:
                continue
            try:
                return (int(stream.attributes["sizeY"]),
                        int(stream.attributes["sizeX"]))
            except (KeyError, ValueError):
                continue
        return None

    def _frame_scale(self) -> samples.FrameScale | None:
        """Return the scale of frames from the first one; it is that of the file."""
        stream = self._streams.get("FRME")
        stated = "" if stream is None else stream.attributes.get("fullScaleDN", "")
        if stated.isdecimal() and len(stated) < 10 and int(stated) > 0:
            scale = int(stated)
            return samples.FrameScale(1.0, scale, scale)
        if self._jaer:
            return samples.TEN_BIT
        for entry in stream.entries[:8] if stream else ():
            try:
                raw = samples.raw_frame(self._file.table(entry))
            except PayloadError:
                continue
            return samples.scale_of(raw.pixels)
        return None

    def _make_info(self, options: SourceOptions) -> RecordingInfo:
        streams = self._streams
        counts: dict[str, int | None] = {}
        for kind in KINDS:
            entries = streams[kind].entries if kind in streams else []
            counts[kind] = sum(e.samples or 0 for e in entries) if (
                self._file.indexed or not entries) else None
        source = next(iter(streams.values())).source
        start, stop = self._span()
        serial = source.partition("_")[2]
        writer = next(iter(streams.values())).attributes.get("originalModuleName")
        return RecordingInfo(
            format="AEDAT-4", writer=writer, camera=source or None,
            serial=serial or None, **stated(
                options, next((text for one in streams.values() if (
                    text := one.attributes.get("sourceFacts")) is not None), None),
                sensor_size=self._size, layout=self._layout(),
                sensor=Sensor.of_chip(source),
                full_scale_dn=self._scale and self._scale.full_scale_dn,
                frame_times="time stamps" if "FRME" in streams else None),
            start_us=start, stop_us=stop if self._file.indexed else None,
            event_count=counts["EVTS"], frame_count=counts["FRME"],
            imu_count=counts["IMUS"], trigger_count=counts["TRIG"],
            wall_clock_us=0 if start is not None and start > EPOCH_US else None,
            header={"compression": self._file.compression,
                    "first_row": "bottom" if self._jaer else "top",
                    "imu_axes": "jAER" if self._jaer else "iniVation",
                    "streams": {str(s.number): {"type": s.kind, **s.attributes}
                                for s in self._file.streams.values()}})

    def _layout(self) -> Layout | None:
        """Return the layout in the header."""
        found = {s.attributes["polarizerLayout"]: s.attributes.get("polarizerSensor")
                 for s in self._streams.values() if "polarizerLayout" in s.attributes}
        if not found:
            return None
        try:
            [(text, owner)] = found.items()
            return Layout.stored(text, owner)
        except ValueError:
            raise RecordingError(
                f"{self.path}: polarizerLayout must be four angles, got "
                f"{', '.join(sorted(found))}") from None

    def _span(self) -> tuple[int | None, int | None]:
        """Return the half-open interval of all samples, from the index if there is one.

        The index has only the timestamps of frames, so the first and last are read.
        """
        starts: list[int] = []
        stops: list[int] = []
        for kind, stream in self._streams.items():
            if not stream.entries:
                continue
            ends = [stream.entries[0], stream.entries[-1]]
            if kind == "FRME":
                times = [t for t in map(self._frame_time, ends) if t is not None]
                starts += times[:1]
                stops += times[-1:]
            elif self._file.indexed:
                starts += [t for t in (ends[0].start_us,) if t is not None]
                stops += [t for t in (ends[1].stop_us,) if t is not None]
            else:
                cursor = self._cursor(kind, Timeline(), Scratch())
                while (got := cursor.pull()) is not None and not len(got):
                    pass
                starts += [] if got is None else [int(got["t"][0])]
        return min(starts, default=None), max(stops) + 1 if stops else None

    def _frame_time(self, entry: Entry) -> int | None:
        try:
            raw = samples.raw_frame(self._file.table(entry))
        except PayloadError:
            return entry.start_us
        return samples.exposure_times(raw.times, jaer=self._jaer)[2]

    # Reading -------------------------------------------------------------------

    def events(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> NDArray[Any]:
        """Return the events of start_us <= time < stop_us as one array."""
        with contextlib.suppress(SegmentError):
            return super().events(start_us, stop_us)
        return Recording.events(self, start_us, stop_us)

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Read from the stream with the earliest position, until all have ended.

        SegmentError if only events are needed, and the shift of a segment depends on
        all streams.
        """
        cursors, pulls, newest = self._begin(start_us, memory, frames)
        if not frames:
            if start_us is None:
                # A damaged index may hold any count; the size of a packet limits it.
                memory.reserve(sum(min(e.samples or 0, 16 * e.size) for c in cursors
                                   for e in self._streams[c.kind].entries))
            for cursor in cursors:
                while (got := cursor.pull()) is not None:
                    yield Batch(got), 0.0
            return
        cursor = min(cursors, key=lambda c: c.last)
        while cursors:
            if not self._trusted:
                # Later readings can resume here.
                newest = max(newest, *(cursor.last for cursor in cursors))
                self._marks.note(
                    pulls, newest, (pulls, newest, [cursor.mark for cursor in cursors]))
                pulls += 1
            got = cursor.pull()
            if got is None:
                cursors.remove(cursor)
                batch = Batch()
            else:
                batch = Batch(**{_FIELDS[cursor.kind]: got})
            if cursors:
                cursor = min(cursors, key=lambda c: c.last)
                batch.complete_us = cursor.last
            yield batch, 0.0

    def _begin(self, start_us: int | None, memory: Scratch, frames: bool
               ) -> tuple[list[Cursor], int, int]:
        """Return cursors from which every sample of the cell of start_us on is read.

        Also returned are the number of packets read before them, and the latest time
        of their samples.
        """
        kinds = [kind for kind in KINDS if kind in self._streams and (
            frames or kind == "EVTS")]
        timeline = None if self._trusted else Timeline(alone=not frames and len(
            self._streams) > 1)
        cursors = [self._cursor(kind, timeline, memory) for kind in kinds]
        if start_us is None:
            return cursors, 0, NEVER
        begin = cell_start(start_us)
        if self._trusted:
            for cursor in cursors:
                cursor.next = self._seek(cursor, begin)
            return cursors, 0, NEVER
        pulls, newest, marks = self._marks.before(begin) or (0, NEVER, None)
        if marks is not None:
            places = {mark[0]: mark for mark in marks}
            cursors = [cursor for cursor in cursors if cursor.kind in places]
            for cursor in cursors:
                cursor.go_to(places[cursor.kind])
        return cursors, pulls, newest

    def _cursor(self, kind: str, timeline: Timeline | None, memory: Scratch) -> Cursor:
        return Cursor(
            self._file, kind, self._streams[kind].entries, timeline, size=self._size,
            scale=self._scale, jaer=self._jaer, strict=self._strict, memory=memory,
            known=self._frame_times)

    def _seek(self, cursor: Cursor, begin: int) -> int:
        """Return the first packet to read for the samples from a time on.

        So many samples that agree with the index lie between that the rest depends on
        nothing before it.
        """
        entries = self._streams[cursor.kind].entries
        at = bisect_left(entries, begin, key=lambda entry: entry.stop_us or 0)
        if cursor.kind == "FRME":
            at = cursor.begins = max(at - FRAMES_UNDER_WAY, 0)
        clean = 0
        while at > 0 and clean < cursor.needed:
            at -= 1
            count = cursor.clean(at)
            clean = clean + count if count else 0
        return at

    @cached_property
    def _trusted(self) -> bool:
        """Whether the index has the times of all packets, in order."""
        return self._file.indexed and all(
            stream.number in self._file.index for stream in self._streams.values())


_FIELDS = {"EVTS": "events", "FRME": "frames", "IMUS": "imu", "TRIG": "triggers"}
