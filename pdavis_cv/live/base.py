"""The base class of live sources: sources that send data by themselves."""
from __future__ import annotations

import dataclasses
import itertools
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pdavis_cv.errors import RecordingError
from pdavis_cv.live.clock import in_order
from pdavis_cv.recording.base import Packet, Problem, Recording, RecordingInfo, Source
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.options import SourceOptions

HEARTBEAT_S = 0.01
"""Longest interval at which a source reports its time, s.  It is shorter than the
interval of images, so that these are not delayed if no events come in the dark."""


@dataclass(frozen=True)
class Address:
    """An address of a live source, ``SCHEME:TARGET?name=value&...``.

    Parameters
    ----------
    text : str
        The whole address.
    target : str
        What follows the scheme.
    open_recording : callable
        Opens a file by its path, as `pdavis_cv.open_recording` does, with the options
        that the caller of `open_source` gave.
    """

    text: str
    target: str
    open_recording: Callable[[str], Recording]


def endless(info: RecordingInfo) -> RecordingInfo:
    """Return the information on a stream that sends a recording's kinds of data.

    It states whether there will be frames or events, but not how many.
    """
    counts: dict[str, Any] = {
        f"{kind}_count": 0 if getattr(info, f"{kind}_count") == 0 else None
        for kind in ("event", "frame", "imu", "trigger")}
    return dataclasses.replace(info, start_us=None, stop_us=None, **counts)


def restated(info: RecordingInfo, options: SourceOptions) -> RecordingInfo:
    """Return the info with what a caller states in place of what is known."""
    known = {name: fact for name, fact in info.facts.items()
             if name != "extinction_ratio"}
    return dataclasses.replace(info, **stated(options, None, **known))


class LiveSource(Source):
    """A source that can be read once, while its data arrive.

    A device implements `_arrivals`.  Its packets come in time order; if there is
    nothing to send for `HEARTBEAT_S`, an empty packet with ``until_us`` reports the
    time.  If the device is gone, it raises DeviceError.

    A class that is an entry point in the group ``pdavis_cv.sources`` is made from an
    `Address`, ``Kind(address, *, hz=10.0, ...)``.  Its keyword arguments are the names
    that may follow the question mark, and their defaults tell the types.

    Parameters
    ----------
    info : RecordingInfo
        What is known before the first packet.
    name : str
        Name for messages, such as the address.

    Attributes
    ----------
    speed : float
        Stream time per real time; 1 for every camera.
    """

    realtime = True
    speed = 1.0

    def __init__(self, info: RecordingInfo, name: str) -> None:
        self._info = info
        self._log = ProblemLog(name)
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._begun = False

    @property
    def name(self) -> str:
        """Address or name of the device."""
        return self._log.name

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first packet."""
        return self._info

    def state(self, options: SourceOptions) -> None:
        """Note what the caller states about the source."""
        self._info = restated(self._info, options)

    @property
    def problems(self) -> Sequence[Problem]:
        """Problems found so far: clock resets and samples that arrived late."""
        return self._log.problems

    def packets(self) -> Iterator[Packet]:
        """Iterate over all packets, once; ends when the source is closed.

        Yields
        ------
        Packet

        Raises
        ------
        RecordingError
            If the packets were requested before.
        ValueError
            If the source is closed.
        DeviceError
            While iterating, if the device is gone.
        """
        with self._lock:
            if self._closed.is_set():
                raise ValueError(f"{self.name}: source is closed")
            if self._begun:
                raise RecordingError(
                    f"{self.name}: packets() of a Source can be called once, and it "
                    "was called before; a Recording can be read again")
            self._begun = True
        return in_order(itertools.takewhile(
            lambda _: not self._closed.is_set(), self._arrivals()), self._log)

    @abstractmethod
    def _arrivals(self) -> Iterator[Packet]:
        """Yield packets as they arrive; the arrays belong to the receiver."""

    def close(self) -> None:
        """Stop; a reader that waits for a packet gets none."""
        self._closed.set()
