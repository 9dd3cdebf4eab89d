"""What every writer of recordings is: packets in, a file that appears when whole."""
from __future__ import annotations

import contextlib
import logging
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Self

from pdavis_cv._beside import Unfinished
from pdavis_cv.recording.base import Packet

__all__ = ["RecordingWriter"]

_LOG = logging.getLogger(__name__)


class RecordingWriter(ABC):
    """Writes packets to a file.

    The file gets its name when the writer is closed; after an exception inside the
    ``with`` block, or `discard`, nothing is left.

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
        """What the format could not hold, and how often."""
        return MappingProxyType(dict(self._lost))

    @property
    def closed(self) -> bool:
        """True once the file is finished or given up."""
        return self._file.closed

    def add(self, packet: Packet) -> None:
        """Write a packet.

        Parameters
        ----------
        packet : Packet
            Not before any that was written.

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
        height, width = self.sensor_size
        events = packet.events
        if len(events) and (int(events["x"].max()) >= width
                            or int(events["y"].max()) >= height):
            i = int(((events["x"] >= width) | (events["y"] >= height)).argmax())
            raise ValueError(
                f"event {i} at (x={events['x'][i]}, y={events['y'][i]}) lies outside "
                f"the {width}x{height} sensor")
        for frame in packet.frames:
            if frame.shape != self.sensor_size:
                raise ValueError(
                    f"frame is {frame.shape[1]}x{frame.shape[0]}, the sensor "
                    f"{width}x{height}")
        with self._unfinished.named():
            self._write(packet)
        self._last_us = stop - 1

    @abstractmethod
    def _write(self, packet: Packet) -> None:
        """Write a packet that was checked."""

    @abstractmethod
    def _finish(self) -> None:
        """Write what stands at the end of the file."""

    def close(self) -> None:
        """Finish the file; it is there from now on."""
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
        for what, count in self._lost.items():
            _LOG.warning("%s: %d %s", self.path, count, what)

    def flush(self) -> None:
        """Hand what was written to the system: it stays, whatever becomes of us."""
        self._file.flush()

    def leave(self) -> None:
        """Write no more and leave what there is, under the name of its unfinished part.

        Readers take it as a file that was cut off.
        """
        with contextlib.suppress(OSError):
            self._file.close()

    def discard(self) -> None:
        """Give the file up and leave nothing."""
        with contextlib.suppress(OSError):   # what it still holds may not fit
            self._file.close()
        self._unfinished.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()
