"""Recordings in AEDAT-4."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from pdavis_cv.errors import PdavisWarning, RecordingError
from pdavis_cv.recording.aedat4 import samples
from pdavis_cv.recording.aedat4.container import Aedat4File, Entry, Stream
from pdavis_cv.recording.aedat4.cursor import Cursor
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError
from pdavis_cv.recording.base import Packet, RecordingInfo
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.files import FileRecording
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import (
    END_OF_TIME,
    Batch,
    between,
    cell_start,
    packetise,
)
from pdavis_cv.recording.timeline import NEVER, Marks, Timeline
from pdavis_cv.sensor import Layout, Sensor

__all__ = ["Aedat4Recording"]

KINDS = ("EVTS", "FRME", "IMUS", "TRIG")
FRAMES_UNDER_WAY = 3
MARK_PULLS = 64
"""The index gives a frame's timestamp; its readout ends within this time of it."""
EPOCH_US = 10**15
"""Times beyond this (the year 2001) are Unix times; smaller ones have another zero."""


class Aedat4Recording(FileRecording):
    """A recording in AEDAT-4; see `open_recording`.

    Parameters
    ----------
    path : path
    options : SourceOptions
        Its ``camera`` is the name of the source, or a part of it.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._file = Aedat4File(self._bytes(), self._log, self._budget)
        self._streams = self._choose(options.camera)
        self._marks = Marks(MARK_PULLS)
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
                raw = samples.raw_frame(*self._file.table(entry))
            except PayloadError:
                continue
            return samples.scale_of(raw.pixels)
        return None

    def _make_info(self, options: SourceOptions) -> RecordingInfo:
        streams = self._streams
        counts: dict[str, int | None] = {}
        for kind in KINDS:
            entries = streams[kind].entries if kind in streams else []
            counts[kind] = sum(e.count or 0 for e in entries) if (
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
                got = self._cursor(kind, Timeline()).pull()
                if got is not None and len(got):
                    starts.append(int(got["t"][0]))
        return min(starts, default=None), max(stops) + 1 if stops else None

    def _frame_time(self, entry: Entry) -> int | None:
        try:
            raw = samples.raw_frame(*self._file.table(entry))
        except PayloadError:
            return entry.start_us
        return samples.exposure_times(raw.times, jaer=self._jaer)[2]

    # Reading -------------------------------------------------------------------

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        return packetise(
            self._batches(start_us), start_us, stop_us, self._budget)

    def events(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> NDArray[Any]:
        """Return the events of start_us <= time < stop_us as one array."""
        if "EVTS" in self._streams and (start_us is None or self._ordered()):
            cursor = self._cursor("EVTS", Timeline(), *self._seek("EVTS", start_us))
            end = END_OF_TIME if stop_us is None else stop_us
            events = cursor.all_events(end)
            if events is not None:
                first = -END_OF_TIME if start_us is None else start_us
                return between(events, first, end)
        return super().events(start_us, stop_us)

    def _batches(self, start_us: int | None) -> Iterator[Batch]:
        """Read from the stream with the earliest position, until all have ended."""
        cursors, pulls, newest = self._begin(start_us)
        marked = not self._file.indexed or not self._ordered()
        while cursors:
            if marked:
                # Later readings can resume here if there is no index.
                newest = max(newest, *(cursor.clock.last for cursor in cursors))
                self._marks.note(
                    pulls, newest, (pulls, newest, [cursor.mark for cursor in cursors]))
                pulls += 1
            cursor = min(cursors, key=lambda c: c.clock.last)
            got = cursor.pull()
            if got is None:
                cursors.remove(cursor)
                batch = Batch()
            else:
                batch = Batch(**{_FIELDS[cursor.kind]: got})
            if cursors:
                batch.complete_us = min(c.clock.last for c in cursors)
            yield batch

    def _begin(self, start_us: int | None) -> tuple[list[Cursor], int, int]:
        """Return cursors from which every sample of the cell of start_us on is read.

        Also returned are the number of packets read before them, and the latest time
        of their samples.
        """
        if start_us is not None and not self._ordered():
            found = self._marks.before(cell_start(start_us))
            if found is not None:
                pulls, newest, marks = found
                cursors = [self._cursor(mark[0], Timeline()) for mark in marks]
                for cursor, mark in zip(cursors, marks, strict=True):
                    cursor.go_to(mark)
                return cursors, pulls, newest
        timeline = Timeline()
        return [self._cursor(kind, timeline, *self._seek(kind, start_us))
                for kind in KINDS if kind in self._streams], 0, NEVER

    def _cursor(self, kind: str, timeline: Timeline, first: int = 0,
                last_us: int = NEVER) -> Cursor:
        return Cursor(
            self._file, kind, self._streams[kind].entries, timeline, size=self._size,
            scale=self._scale, jaer=self._jaer, strict=self._strict, first=first,
            last_us=last_us)

    def _seek(self, kind: str, start_us: int | None) -> tuple[int, int]:
        """Return the index of the first packet to read, and the last time before it.

        If the index shows that time runs backward, the file is read from its beginning
        or a mark, as the samples to drop depend on everything before.
        """
        if start_us is None or not self._ordered():
            return 0, NEVER
        begin = cell_start(start_us)
        entries = self._streams[kind].entries
        lo, hi = 0, len(entries)
        while lo < hi:
            middle = (lo + hi) // 2
            if (entries[middle].stop_us or 0) < begin:
                lo = middle + 1
            else:
                hi = middle
        lo = max(lo - 1, 0)
        if kind == "FRME":
            # The index has the start of frames: some that began before start_us may
            # end after it, but no more than a camera can have in work at a time.
            return max(lo - FRAMES_UNDER_WAY, 0), NEVER
        if lo == 0:
            return lo, NEVER
        last = entries[lo - 1].stop_us
        return lo, NEVER if last is None else last

    def _ordered(self) -> bool:
        if not hasattr(self, "_in_order"):
            if not self._file.indexed:
                self._make_index()
            self._in_order = all(
                e.start_us is not None and e.stop_us is not None
                and e.start_us <= e.stop_us
                and (i == 0 or e.start_us >= (stream.entries[i - 1].stop_us or 0))
                for stream in self._streams.values()
                for i, e in enumerate(stream.entries))
        return self._in_order

    def _make_index(self) -> None:
        """Find the times of every packet of a file without an index."""
        for kind, stream in self._streams.items():
            for entry in stream.entries:
                try:
                    times = samples.span(kind, *self._file.table(entry))
                except PayloadError:
                    times = None  # reported when it is read
                if times:
                    entry.start_us, entry.stop_us = times
        for stream in self._streams.values():
            # A packet without times gets the end of its predecessor.
            last = NEVER
            for entry in stream.entries:
                if entry.start_us is None or entry.stop_us is None:
                    entry.start_us = entry.stop_us = last
                last = entry.stop_us


_FIELDS = {"EVTS": "events", "FRME": "frames", "IMUS": "imu", "TRIG": "triggers"}
