"""Base of the writers of recordings: the file appears when it is complete."""
from __future__ import annotations

import contextlib
import errno
import logging
import os
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import Unfinished
from pdavis_cv._checks import typed
from pdavis_cv._types import Closing
from pdavis_cv.events import check_inside
from pdavis_cv.recording.base import Packet, RecordingInfo, Source, check_size
from pdavis_cv.recording.facts import text_of
from pdavis_cv.recording.prophesee import FALLING, RISING

_LOG = logging.getLogger(__name__)


class RecordingWriter(Closing):
    """Write packets to a file.

    The file gets its name when the writer is closed.  After an exception inside the
    ``with`` block, or after `discard`, no file remains.

    Parameters
    ----------
    path : path
    sensor_size : (int, int)
        (height, width).
    """

    def __init__(
        self, path: str | os.PathLike[str], sensor_size: tuple[int, int]
    ) -> None:
        self.path = Path(path)
        height, width = sensor_size
        self.sensor_size = int(height), int(width)
        self._lost: Counter[str] = Counter()
        self._last_us: int | None = None
        self._unfinished = Unfinished(path)
        with self._unfinished.named():
            self._file = self._unfinished.part.open("w+b")

    @property
    def losses(self) -> Mapping[str, int]:
        """Number of occurrences of what the format could not hold, by description."""
        return MappingProxyType({what: n for what, n in self._lost.items() if n})

    @property
    def closed(self) -> bool:
        """Whether the file is finished or discarded."""
        return self._file.closed

    def add(self, packet: Packet) -> None:
        """Write a packet.

        Parameters
        ----------
        packet : Packet
            Must not begin before the end of the last one.

        Raises
        ------
        ValueError
            If the writer is closed, time runs backward, or a sample lies outside
            the sensor.
        """
        if self.closed:
            raise ValueError(f"{self.path.name}: writer is closed")
        start, stop = packet.start_us, packet.stop_us
        if start is None or stop is None:
            return
        if self._last_us is not None and start < self._last_us:
            raise ValueError(
                f"packets must be in time order, but one at {start} us comes after "
                f"{self._last_us} us")
        check_inside(packet.events, self.sensor_size)
        for frame in packet.frames:
            check_size(frame, self.sensor_size)
        with self._unfinished.named():
            try:
                self._write(packet)
            except OSError as error:
                if error.errno == errno.EBADF:  # closed, and soon another file's
                    self.discard()
                raise
        self._last_us = stop - 1

    @abstractmethod
    def _write(self, packet: Packet) -> None:
        """Write a checked packet."""

    @abstractmethod
    def _finish(self) -> None:
        """Write the end of the file."""

    def close(self) -> None:
        """Finish the file and give it its name."""
        if self.closed:
            return
        try:
            with self._unfinished.named():
                self._finish()
                self._file.close()
            self._unfinished.finish()
        except BaseException:
            self.discard()
            raise
        for what, count in self.losses.items():
            _LOG.warning("%s: %d %s", self.path, count, what)

    def flush(self) -> None:
        """Pass buffered data to the system, to survive a crash of the process."""
        self._file.flush()

    def leave(self) -> None:
        """Stop writing and keep the unfinished file, under its temporary name.

        Readers treat it as a truncated file.
        """
        with contextlib.suppress(OSError):
            self._file.close()

    def discard(self) -> None:
        """Delete the unfinished file."""
        with contextlib.suppress(OSError):
            self._file.raw.close()      # what is buffered is not written
        self._unfinished.discard()

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.close() if kind is None else self.discard()


def info_of(recording: Source) -> RecordingInfo:
    """Return the facts of what is to be written; raise TypeError if it is no Source."""
    typed("recording", recording, Source, "one that open_recording returns")
    return recording.info


def source_text(info: RecordingInfo) -> str:
    """Return what is known of a recording, as the header of a copy holds it."""
    return text_of(info.facts, info.demosaic, info.biases)


def edges_of(triggers: NDArray[Any], lost: Counter[str]) -> NDArray[Any]:
    """Return the rising and falling edges among triggers; count the others as lost."""
    edges = triggers[np.isin(triggers["type"], (RISING, FALLING))]
    lost["triggers that are not external edges"] += len(triggers) - len(edges)
    return edges
