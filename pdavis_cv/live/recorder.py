"""Recorder: writes arriving packets to a file, in a thread of its own."""
from __future__ import annotations

import os
import shutil
import tempfile
import threading
from collections import deque
from itertools import islice
from pathlib import Path

from pdavis_cv.errors import DeviceError
from pdavis_cv.live.inbox import fitting, size_of, together
from pdavis_cv.recording.aedat4.reader import Aedat4Recording
from pdavis_cv.recording.aedat4.writer import UNKNOWN, Aedat4Writer, full_scale_of
from pdavis_cv.recording.base import Packet, Recording, RecordingInfo, Source
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.options import SourceOptions

MOST_BYTES = 256 * 2**20
"""Most bytes that may wait for the disk: 2 s of 10 million events per second."""


class Recorder:
    """Writes packets as AEDAT-4, independently of the images made from them.

    Data are flushed to the system every 10 ms of stream time.  If the process is
    killed, ``.NAME.part<pid>.aedat4`` beside the file can be read up to there.  A full
    or slow disk is a problem that is counted in the log, not an error.  If the recorder
    is `lossy`, `add` never waits; packets that the disk cannot take are counted.  The
    file appears when the recorder is closed; that it cannot be made is an OSError.
    """

    def __init__(
        self, path: str | os.PathLike[str], info: RecordingInfo, lossy: bool,
        log: ProblemLog,
    ) -> None:
        self._writer = Aedat4Writer(
            path, sensor_size=info.sensor_size, layout=info.layout,
            camera=info.camera or UNKNOWN, full_scale_dn=full_scale_of(info),
            source=info)
        self.path = self._writer.path
        self._lossy, self._log = lossy, log
        self._waiting: deque[Packet] = deque()
        self._bytes = 0
        self._change = threading.Condition()
        self._ended = False
        self.events = self.dropped_events = 0
        self.error: str | None = None
        self._thread = threading.Thread(
            target=self._write, name="pdavis recorder", daemon=True)
        self._thread.start()

    def add(self, packet: Packet) -> None:
        """Queue a packet for writing."""
        if packet.start_us is None:
            return
        size = size_of(packet)
        with self._change:
            while (not self._lossy and self.error is None and not self._ended
                   and self._bytes and self._bytes + size > MOST_BYTES):
                self._change.wait()
            if self._ended:
                return
            if self.error is not None or (
                    self._lossy and self._bytes + size > MOST_BYTES):
                self.dropped_events += len(packet.events)
                self._log.add(
                    "not recorded", None, "events could not be recorded: "
                    f"{self.error or 'the disk is too slow'}", count=len(packet.events),
                    start_us=packet.start_us, stop_us=packet.stop_us)
                return
            self._waiting.append(packet)
            self._bytes += size
            self._change.notify_all()

    def close(self) -> None:
        """Write the waiting packets, and finish the file."""
        with self._change:
            self._ended = True
            self._change.notify_all()
        self._thread.join()

    def _write(self) -> None:
        try:
            while (packet := self._next()) is not None:
                self._writer.add(packet)
                self._writer.flush()
                self.events += len(packet.events)
            self._writer.close()
        except (OSError, ValueError) as error:
            with self._change:
                self.error = str(error)
                lost = sum(len(packet.events) for packet in self._waiting)
                self._waiting.clear()
                self._bytes = 0
                self._change.notify_all()
            self.dropped_events += lost
            self._log.add("not recorded", None, "events could not be recorded: "
                          f"{self.error}", count=lost)
            self._writer.leave()

    def _next(self) -> Packet | None:
        """Return the waiting packets of up to 10 ms as one; None at the end."""
        with self._change:
            while True:
                n = fitting(self._waiting[0], islice(self._waiting, 1, None)) if (
                    self._waiting) else -1
                if 0 <= n < len(self._waiting) - 1 or self._ended:
                    break
                self._change.wait()
            if n < 0:
                return None
            parts = [self._waiting.popleft() for _ in range(n + 1)]
            self._bytes -= sum(map(size_of, parts))
            self._change.notify_all()
        return together(parts)


class _Temporary(Aedat4Recording):
    """A recording whose folder is removed when it is closed."""

    def close(self) -> None:
        """Release the file, and remove it."""
        super().close()
        shutil.rmtree(self.path.parent, ignore_errors=True)


def recorded(source: Source) -> Recording:
    """Read a source to its end into a temporary file, and open that as a recording.

    If the device is unplugged, or on an interrupt, the recording ends there, provided
    that something had arrived.

    Parameters
    ----------
    source : Source
        Source to read; closed afterwards.

    Returns
    -------
    Recording
        Its file is removed when it is closed.

    Raises
    ------
    DeviceError
        If the device is gone and nothing had arrived.
    OSError
        If the disk is full.
    """
    folder = Path(tempfile.mkdtemp(prefix="pdavis-"))
    info, log = source.info, ProblemLog("recording")
    try:
        recorder = Recorder(folder / "arrived.aedat4", info, False, log)
        any_packet = False
        try:
            for packet in source.packets():
                recorder.add(packet)
                any_packet = any_packet or packet.start_us is not None
        except (DeviceError, KeyboardInterrupt):
            if not any_packet:
                raise
        finally:
            source.close()
            recorder.close()
        if recorder.error is not None:
            raise OSError(recorder.error)
        return _Temporary(recorder.path, SourceOptions(layout=info.layout))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
