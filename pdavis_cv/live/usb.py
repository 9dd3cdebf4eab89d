"""``usb:`` addresses: a DAVIS346-based camera, or a simulation of its USB words."""
from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from typing import Protocol

from pdavis_cv.errors import DeviceError
from pdavis_cv.live.address import number, options_of
from pdavis_cv.live.base import HEARTBEAT_S, Address, LiveSource
from pdavis_cv.live.camera import SETTINGS, Davis346
from pdavis_cv.live.clock import moved
from pdavis_cv.live.davis_words import DavisEncoder
from pdavis_cv.live.openers import simulated
from pdavis_cv.live.replay import ReplaySource, pieces
from pdavis_cv.recording.base import Packet, Recording, RecordingInfo
from pdavis_cv.recording.davis import DavisDecoder, Orientation
from pdavis_cv.recording.davis_trace import Transfer
from pdavis_cv.simulation import DEFAULT_CAMERA

__all__ = ["Device", "SimulatedDavis346", "UsbSource", "open_usb"]

SILENCE_S = 3.0
"""A camera that sends nothing for this long is taken to hang, s; it reports its time
every 33 ms."""
_COUNTER_US = 1 << 32
"""A recording that begins later than this has Unix time, not a camera's clock, us."""


class Device(Protocol):
    """A device that sends the words of a DAVIS346: a camera or a simulation.

    Attributes
    ----------
    info : RecordingInfo
        Information on the stream, of the format "DAVIS346 over USB".
    orientation : Orientation
        How its chips are mounted.
    realtime : bool
        False: the device waits for its reader.
    speed : float
        Stream time per real time.
    """

    info: RecordingInfo
    orientation: Orientation
    realtime: bool
    speed: float

    def read(self, timeout_s: float) -> list[Transfer] | None:
        """Wait for the next transfers; [] after `timeout_s`, None at the end.

        Raises
        ------
        DeviceError
            If the device is gone.
        """

    @property
    def settings(self) -> Mapping[str, int]:
        """Exposure, interval of frames and biases in use."""

    def set(self, **settings: int) -> None:
        """Change settings.

        Raises
        ------
        ValueError
            If there is no such setting, or its value is out of range.
        """

    def close(self) -> None:
        """Release the device."""


class UsbSource(LiveSource):
    """Decodes the words of a camera as they arrive.

    Parameters
    ----------
    device : Device
        Closed with the source.
    name : str
        Name for messages.

    Attributes
    ----------
    device : Device
        The device, whose `settings` can be changed while it runs.
    """

    def __init__(self, device: Device, name: str) -> None:
        super().__init__(device.info, name)
        self.device, self.realtime, self.speed = device, device.realtime, device.speed

    def _arrivals(self) -> Iterator[Packet]:
        decoder = DavisDecoder(
            self.info.sensor_size, self.device.orientation, self._log)
        heard = time.monotonic()
        while not self._closed.is_set():
            transfers = self.device.read(HEARTBEAT_S)
            if transfers is None:
                return
            if transfers:
                heard = time.monotonic()
            elif time.monotonic() - heard > SILENCE_S / self.speed:
                raise DeviceError(
                    f"{self.name}: the camera has sent nothing for {SILENCE_S:g} s: "
                    "unplug it, plug it in and open it again")
            for one in transfers:
                for packet in decoder.feed(one.data, one.host_s, lost=one.lost):
                    yield from pieces(packet)
                yield Packet(until_us=decoder.time_us)

    def close(self) -> None:
        """Stop, and release the camera."""
        super().close()
        self.device.close()


class SimulatedDavis346:
    """Sends a recording as a DAVIS346 would: the same words, at its own pace.

    Its clock is that of the recording, or begins at 0 if the recording has Unix time.

    Parameters
    ----------
    recording : Recording
        Closed with the device.
    speed : float
        Stream time per real time; 0 = as fast as it is read.
    loop : bool
        Begin again at the end.
    seconds : float
        End after this stream time.
    """

    def __init__(
        self, recording: Recording, *, speed: float = 1.0, loop: bool = False,
        seconds: float = math.inf,
    ) -> None:
        if not 0 <= speed < math.inf:
            raise ValueError(f"speed must not be negative, got {speed:g}")
        self._replay = ReplaySource(
            recording, "simulated", speed=0, loop=loop, seconds=seconds)
        start = recording.info.start_us or 0
        origin = 0 if 0 <= start < _COUNTER_US else start
        self.info, self.orientation = self._replay.info, Orientation()
        self.realtime, self.speed = speed > 0, speed or 1.0
        self._chunks = DavisEncoder().chunks(
            moved(packet, -origin) for packet in self._replay.packets())
        self._next: tuple[int, bytes] | None = None
        self._first: tuple[int, float] | None = None
        self._closed = False

    def read(self, timeout_s: float) -> list[Transfer] | None:
        """Return the transfer that is due within this time, s; [] if there is none."""
        if self._closed:
            return None
        if self._next is None:
            found = next(self._chunks, None)
            if found is None:
                return None
            self._next = found[0], found[1].tobytes()
        time_us, data = self._next
        if self.realtime:
            now = time.monotonic()
            if self._first is None:
                self._first = time_us, now
            wait = (time_us - self._first[0]) * 1e-6 / self.speed - (
                now - self._first[1])
            if wait > timeout_s:
                time.sleep(timeout_s)
                return []
            time.sleep(max(wait, 0.0))
        self._next = None
        return [Transfer(data, time_us * 1e-6)]

    @property
    def settings(self) -> Mapping[str, int]:
        """No settings, as a recording cannot be changed."""
        return {}

    def set(self, **settings: int) -> None:
        """Refuse all settings."""
        raise ValueError(
            f"a simulated camera has no settings, got {', '.join(settings)}")

    def close(self) -> None:
        """Close the recording."""
        self._closed = True
        self._replay.close()


def open_usb(address: Address, **values: str) -> UsbSource:
    """Open ``usb:SERIAL``, the first camera if none is given, or ``usb:simulated``.

    Parameters
    ----------
    address : Address
    **values
        Settings of a camera; of the simulated one those of `open_simulated`.
    """
    if address.target == "simulated":
        return open_simulated(address, **options_of(open_simulated, values))
    settings = {name: number(name, values.pop(name), int)
                for name in SETTINGS if name in values}
    if values:
        raise ValueError(f"there is no {next(iter(values))!r}; a camera takes "
                         f"{', '.join(SETTINGS)}")
    return UsbSource(Davis346(address.target or None, settings), address.text)


def open_simulated(
    address: Address, *, replay: str = "", scene: str = "fan",
    camera: str = DEFAULT_CAMERA, size: str = "48x48", rpm: float = 200.0,
    hz: float = 1.0, seed: int = 0, speed: float = 1.0, loop: bool = True,
    seconds: float = math.inf,
) -> UsbSource:
    """Open ``usb:simulated``: the words of a file, or of a scene as in `simulated`."""
    recording = (address.open_recording(replay) if replay
                 else simulated(scene, camera, size, rpm, hz, seed))
    return UsbSource(SimulatedDavis346(
        recording, speed=speed, loop=loop, seconds=seconds), address.text)
