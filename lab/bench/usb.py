"""What `python -m lab.bench` times of a camera's words."""
from __future__ import annotations

import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import ApsFrame, Packet, joined
from pdavis_cv.recording.davis import DavisDecoder, Orientation
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.memory import recording_from_arrays

from .cases import EVENTS, PACKET, SHAPE, Comparison, case, event_input
from .floor import compiled_floor

_TRANSFER = 1 << 17
"""Bytes of a USB transfer, neuromorphic-drivers' default."""


def _words(events: NDArray[Any], frames: list[ApsFrame]) -> bytes:
    recording = recording_from_arrays(events, frames, sensor_size=SHAPE)
    encoder = runpy.run_path(str(
        Path(__file__).parents[2] / "tests" / "davis_words.py"))["DavisEncoder"]()
    return np.concatenate([
        words for _, words in encoder.chunks(recording.packets())]).tobytes()


@case("usb", "words of a DAVIS346 to packets, against floor_sum", 0.25)
def _usb() -> Iterator[Comparison]:
    floor_sum = compiled_floor()
    step, plane = np.array([-0.2, 0.2], np.float32), np.zeros(SHAPE, np.float32)
    reads = np.random.default_rng(3).integers(400, 1000, (2, *SHAPE), np.uint16)
    for rate in (1, 10):
        events = event_input("uniform")
        events["t"] //= rate
        stop = int(events["t"][-1])
        frames = [ApsFrame(reads[0].astype(float) - reads[1], t, t + 5_000,
                           available_us=t + 17_000, reset=reads[0], signal=reads[1])
                  for t in range(1_000, stop - 20_000, 40_000)]
        for name, images in (("", []), (", 25 frames/s", frames)):
            data = _words(events, images)
            transfers = [data[i:i + _TRANSFER] for i in range(0, len(data), _TRANSFER)]

            def decoded(transfers: list[bytes] = transfers) -> Iterator[Packet]:
                decoder = DavisDecoder(SHAPE, Orientation(), ProblemLog("bench"))
                for part in transfers:
                    yield from decoder.feed(part)

            def candidate(
                decoded: Callable[[], Iterator[Packet]] = decoded
            ) -> float:
                start = perf_counter()
                for _ in decoded():
                    pass
                return perf_counter() - start

            def floor(events: NDArray[Any] = events) -> float:
                start = perf_counter()
                for i in range(0, EVENTS, PACKET):
                    floor_sum(events[i:i + PACKET], step, plane)
                return perf_counter() - start

            def check(events: NDArray[Any] = events, images: list[ApsFrame] = images,
                      decoded: Callable[[], Iterator[Packet]] = decoded) -> None:
                packets = list(decoded())
                np.testing.assert_array_equal(
                    joined([packet.events for packet in packets]), events)
                found = [frame for packet in packets for frame in packet.frames]
                for one, two in zip(found, images, strict=True):
                    np.testing.assert_array_equal(one.dn, two.dn)

            yield Comparison(
                f"{rate} Mev/s{name}", check, candidate, floor,
                lambda s: EVENTS / s / 1e6, "Mev/s", judged=not images)
