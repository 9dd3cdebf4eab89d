"""``usb:`` addresses: a DAVIS346-based camera, whose words are decoded here."""
from __future__ import annotations

import time
from collections.abc import Iterator

from pdavis_cv.errors import DeviceError
from pdavis_cv.live.address import number
from pdavis_cv.live.base import HEARTBEAT_S, Address, LiveSource
from pdavis_cv.live.camera import SETTINGS, Davis346
from pdavis_cv.live.replay import pieces
from pdavis_cv.recording.base import Packet
from pdavis_cv.recording.davis import DavisDecoder

SILENCE_S = 3.0
"""A camera that sends nothing for this long is taken to hang, s; it reports its time
every 33 ms."""


class UsbSource(LiveSource):
    """Decodes the words of a camera as they arrive; the camera is closed with it.

    The camera's `settings` can be changed while it runs.
    """

    def __init__(self, device: Davis346, name: str) -> None:
        super().__init__(device.info, name)
        self.device = device

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
            elif time.monotonic() - heard > SILENCE_S:
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


def open_usb(address: Address, **values: str) -> UsbSource:
    """Open ``usb:SERIAL``, the first camera if none is given, with these `SETTINGS`."""
    settings = {name: number(name, values.pop(name), int)
                for name in SETTINGS if name in values}
    if values:
        raise ValueError(f"there is no {next(iter(values))!r}; a camera takes "
                         f"{', '.join(SETTINGS)}")
    return UsbSource(Davis346(address.target or None, settings), address.text)
