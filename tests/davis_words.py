"""Encoder of a recording as the words that a DAVIS346 sends, and a camera of these."""
from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Events
from pdavis_cv.live.base import endless
from pdavis_cv.live.usb import UsbSource
from pdavis_cv.recording.base import ApsFrame, Packet
from pdavis_cv.recording.davis import WRAP_US, Orientation
from pdavis_cv.recording.davis_trace import TraceWriter, Transfer

_RESET_LEVEL_DN = 1023
_MOST_WRAPS = 0xFFF
_LONGEST_READOUT_US = 500_000
"""Longest time from the begin of an exposure to the end of its readout, us; a DAVIS346
usually exposes for at most 0.1 s and is read out in 12 ms."""


class DavisEncoder:
    """Encodes packets as words of a camera whose chip has the images' orientation.

    Frames are rounded and clipped to ten bits, unless they have both reads.  The
    camera's time is that of the packets, which must not be negative.

    Attributes
    ----------
    time_us : int
        Time that the words so far have reported.
    """

    def __init__(self) -> None:
        self.time_us = 0
        self._row = -1

    def until(self, time_us: int) -> NDArray[np.uint16]:
        """Return the words that advance the camera's time; none if it is not later."""
        words: list[int] = []
        if time_us > self.time_us:
            wraps = time_us // WRAP_US - self.time_us // WRAP_US
            while wraps > 0:
                words.append(0x7000 | min(wraps, _MOST_WRAPS))
                wraps -= _MOST_WRAPS
            words.append(0x8000 | time_us % WRAP_US)
            self.time_us = time_us
        return np.array(words, np.uint16)

    def events(self, events: Events) -> Iterator[NDArray[np.uint16]]:
        """Yield the words of events, none of which is earlier than `time_us`.

        Parameters
        ----------
        events : ndarray of EVENT_DTYPE, shape (N,)

        Yields
        ------
        ndarray of uint16, shape (M,)
        """
        # Each wrap of the 15 bits of time is reported by a word of its own.
        turns = np.flatnonzero(np.diff(events["t"] // WRAP_US)) + 1
        for part in np.split(events, turns):
            if len(part):
                yield self.until(int(part["t"][0]))
                yield self._of_one_turn(part)

    def _of_one_turn(self, events: Events) -> NDArray[np.uint16]:
        times = events["t"]
        new_time = np.diff(times, prepend=self.time_us) > 0
        new_row = np.diff(events["y"].astype(np.int64), prepend=self._row) != 0
        new_row |= new_time
        at = np.cumsum(1 + new_time + new_row) - 1
        words = np.empty(int(at[-1]) + 1, np.uint16)
        words[at] = 0x2000 | events["p"].astype(np.uint16) << 12 | events["x"]
        words[at[new_row] - 1] = 0x1000 | events["y"][new_row]
        words[at[new_time] - 2] = 0x8000 | (times[new_time] % WRAP_US)
        self.time_us, self._row = int(times[-1]), int(events["y"][-1])
        return words

    def chunks(
        self, packets: Iterator[Packet]
    ) -> Iterator[tuple[int, NDArray[np.uint16]]]:
        """Yield the time reached and the words up to it, packet by packet.

        Parameters
        ----------
        packets : iterator of Packet
            In time order.  The reads of a frame are sent from the begin of its exposure
            on, so packets are held until those that arrive 0.5 s later are known.

        Yields
        ------
        time_us : int
        words : ndarray of uint16, shape (M,)
        """
        waiting: deque[Packet] = deque()
        readout: list[tuple[int, NDArray[np.uint16]]] = []
        read_until = 0
        for packet in packets:
            waiting.append(packet)
            for frame in packet.frames:
                for time, words in frame_words(frame):
                    # Frames are read one after the other.
                    read_until = max(read_until, time)
                    readout.append((read_until, words))
            while _end_us(packet) - _end_us(waiting[0]) > _LONGEST_READOUT_US:
                yield self._chunk(waiting.popleft(), readout)
        for packet in waiting:
            yield self._chunk(packet, readout)

    def _chunk(
        self, packet: Packet, readout: list[tuple[int, NDArray[np.uint16]]]
    ) -> tuple[int, NDArray[np.uint16]]:
        end, events, parts = _end_us(packet), packet.events, []
        while readout and readout[0][0] <= end:
            time, words = readout.pop(0)
            n = bisect_left(events["t"], time)
            parts += [*self.events(events[:n]), self.until(time), words]
            events = events[n:]
        parts += [*self.events(events), self.until(end)]
        return end, np.concatenate(parts)


def _end_us(packet: Packet) -> int:
    if packet.stop_us is not None:
        return packet.stop_us - 1
    return packet.until_us or 0


def frame_words(frame: ApsFrame) -> list[tuple[int, NDArray[np.uint16]]]:
    """Return (time, words) of a frame: reset read, exposure, signal read, end."""
    if frame.reset is not None and frame.signal is not None:
        reset, signal = frame.reset, frame.signal
    else:
        dn = np.rint(np.clip(np.nan_to_num(frame.dn), 0, _RESET_LEVEL_DN))
        reset = np.full(frame.shape, _RESET_LEVEL_DN, np.uint16)
        signal = (_RESET_LEVEL_DN - dn).astype(np.uint16)
    start, end = frame.exposure_start_us, frame.exposure_end_us
    if isinstance(start, int) and isinstance(end, int):
        columns = [np.concatenate([_column(read, 11 + k, x)
                                   for x in range(frame.shape[1])])
                   for k, read in enumerate((reset, signal))]
        return [(start, np.concatenate([_special(8), columns[0], _special(14)])),
                (end, np.concatenate([_special(15), columns[1]])),
                (frame.available_us, _special(10))]
    blocks = [(int(t), k, _column(read, 11 + k, x))
              for k, (read, times) in enumerate(((reset, start), (signal, end)))
              for x, t in enumerate(np.broadcast_to(times, frame.shape[1:]))]
    blocks.sort(key=lambda block: block[:2])
    return [(blocks[0][0], _special(9)), *((t, words) for t, _, words in blocks),
            (frame.available_us, _special(10))]


def _special(code: int) -> NDArray[np.uint16]:
    return np.array([code], np.uint16)


def _column(read: NDArray[np.uint16], code: int, x: int) -> NDArray[np.uint16]:
    return np.concatenate([
        _special(code), 0x4000 | np.minimum(read[:, x], _RESET_LEVEL_DN), _special(13)])


class SimulatedDavis346:
    """Stands in for a Davis346: its words are those of a recording, at once."""

    def __init__(self, recording):
        self.settings = {}
        self.info, self.orientation = endless(recording.info), Orientation()
        self._chunks = DavisEncoder().chunks(recording.packets())

    def read(self, timeout_s):
        found = next(self._chunks, None)
        if found is None:
            return None
        time_us, words = found
        return [Transfer(words.tobytes(), time_us * 1e-6)]

    def close(self):
        pass


def unpaced(device):
    """Return the source of a device that waits for its reader."""
    source = UsbSource(device, "usb:")
    source.realtime = False
    return source


def write_trace(path, recording):
    """Write the words of a recording with a TraceWriter."""
    device = SimulatedDavis346(recording)
    with TraceWriter(path, device.info, device.orientation) as trace:
        while (transfers := device.read(1)) is not None:
            for one in transfers:
                trace.add(one)
