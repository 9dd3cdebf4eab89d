"""What `python -m lab.bench` times of fuse(): an image of each method, AoP and DoLP."""
from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from pdavis_cv.data import example_recording
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import FusionOptions
from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.polarimetry import PolarFrame, polarization
from pdavis_cv.recording.base import (
    ApsFrame,
    Packet,
    Problem,
    Recording,
    RecordingInfo,
    Source,
)
from pdavis_cv.recording.open import open_recording
from pdavis_cv.recording.stream import source_from_packets
from pdavis_cv.sensor import Layout

from .cases import CASES, SHAPE, Case, Comparison, case, mosaic_input

FRAME_US, EXPOSURE_US, READOUT_US = 40_000, 8_000, 12_000
PACKET_EVENTS = 10_000
"""Events of a packet, of 10 ms at most: a camera's are as small."""

RATES = (33e3, 1e6, 10e6)
"""Events per second: those of a slow scene, of a busy one, and the sensor's most."""

_KNOWN: dict[str, Any] = {
    "model": PixelModel(theta=np.array([0.2, 0.2]), bandwidth=(250.0, 0.0)),
    "ratio_sigma": 0.1, "clock_offset_us": 0.0}
IMAGES: dict[str, tuple[dict[str, Any], float]] = {
    "frames": ({"method": "frames"}, 1.5),
    "cf": ({"method": "cf"}, 3),
    "events": ({"method": "events"}, 3),
    "redundancy": ({"method": "events", "offsets": "redundancy"}, 8),
    "kalman": ({"method": "kalman", **_KNOWN}, 10),
    "causal": ({"method": "kalman", "causal": True, **_KNOWN}, 10),
    "offline": ({"method": "kalman", "mode": "offline", **_KNOWN}, 20),
}
"""Options of each method, whose learning is left out; how often an image of it may
cost what the chain from mosaic to AoP and DoLP does, at 33 kev/s and 1000 images/s."""


def endless(rate: float, shape: tuple[int, int] = SHAPE) -> Source:
    """Return a stream of events, uniform over the sensor, and of 25 frames/s.

    Parameters
    ----------
    rate : float
        Events per second.
    shape : (int, int)
        (height, width), both even.
    """
    return source_from_packets(_info(shape), _packets(rate, shape))


class Repeatable(Recording):
    """The same stream as a recording, of which `fuse` may read images ahead.

    Parameters
    ----------
    rate, shape
        As for `endless`.
    """

    def __init__(self, rate: float, shape: tuple[int, int] = SHAPE) -> None:
        self._rate, self._shape = rate, shape

    @property
    def info(self) -> RecordingInfo:
        """What is known before reading."""
        return _info(self._shape)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """None."""
        return ()

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the packets, from the beginning only."""
        assert start_us is None, "only the whole stream is read"
        return _packets(self._rate, self._shape)

    def close(self) -> None:
        """Do nothing, as no file is open."""


def _info(shape: tuple[int, int]) -> RecordingInfo:
    return RecordingInfo(format="bench", sensor_size=shape, layout=Layout.PDAVIS)


def _packets(rate: float, shape: tuple[int, int]) -> Iterator[Packet]:
    rng = np.random.default_rng(1)
    span = int(min(10_000, PACKET_EVENTS / rate * 1e6))
    n = round(rate * span / 1e6)
    # A hundred different packets go round.
    packets = np.zeros((100, n), EVENT_DTYPE)
    packets["t"] = np.sort(rng.integers(0, span, packets.shape), axis=1)
    for field, side in (("y", shape[0]), ("x", shape[1]), ("p", 2)):
        packets[field] = rng.integers(0, side, packets.shape)
    dn = mosaic_input(shape, Layout.PDAVIS, 0.7, 0.4)
    begin = 0
    for k in count():
        # Copied as bytes, as NumPy copies packed structures field by field.
        events = packets[k % len(packets)].view(np.uint8).copy().view(EVENT_DTYPE)
        events["t"] += k * span
        frames: tuple[ApsFrame, ...] = ()
        if (k + 1) * span > begin + READOUT_US:
            frames = (ApsFrame(dn, begin, begin + EXPOSURE_US,
                               available_us=begin + READOUT_US),)
            begin += FRAME_US
        yield Packet(events, frames)


def _fusion(rate: float, fps: float, options: dict[str, Any], **more: Any) -> Fusion:
    return Fusion(endless(rate), FusionOptions(
        fps=fps, thresholds=(0.2, 0.2), **more), **options)


def shown(image: PolarFrame) -> PolarFrame:
    """Return the image, after what is timed of it has been computed."""
    assert image.aop.shape == image.dolp.shape
    return image


def chain(shape: tuple[int, int] = SHAPE) -> Callable[[], float]:
    """Return what times the chain from mosaic to AoP and DoLP, s."""
    mosaic = mosaic_input(shape, Layout.PDAVIS, 0.7, 0.6).astype(np.float32)

    def floor() -> float:
        start = thread_time()
        for _ in range(10):
            shown(polarization(mosaic, Layout.PDAVIS))
        return (thread_time() - start) / 10
    return floor


def per_image(fusion: Fusion, n: int = 40) -> float:
    """Return the processor time of an image, s: a mean of n, 40 ms at 1000 images/s."""
    start = thread_time()
    for _ in range(n):
        shown(next(fusion))
    return (thread_time() - start) / n


def check_same(make: Callable[[], Fusion]) -> None:
    """Check that two equal Fusions make the same images."""
    one, two = make(), make()
    for _ in range(2):
        np.testing.assert_array_equal(shown(next(one)).aop, shown(next(two)).aop)
    for fusion in (one, two):
        fusion.recording.close()


def _images(name: str) -> Iterator[Comparison]:
    options, _ = IMAGES[name]
    floor = chain()

    def check() -> None:
        one, two = (_fusion(33e3, 100.0, options, threads=n) for n in (1, 2))
        for _ in range(3):
            np.testing.assert_array_equal(shown(next(one)).aop, next(two).aop)

    for rate in RATES:
        for fps in (1000.0, 50.0):
            fusion = _fusion(rate, fps, options)

            def candidate(fusion: Fusion = fusion, fps: float = fps) -> float:
                if fusion.t_us is None:     # not at the beginning, which allocates
                    while fusion.index < 0.2 * fps:
                        fusion.advance()
                return per_image(fusion, 40 if fps > 100 else 2)    # a frame's period

            yield Comparison(
                f"{rate / 1e6:g} Mev/s, {fps:g} images/s", check, candidate, floor,
                lambda s: 1e3 * s, "ms", judged=rate == RATES[0] and fps == 1000,
                at=(f"events per second, {fps:g} images/s", rate))


for _name, (_, _goal) in IMAGES.items():
    CASES[f"image-{_name}"] = Case(
        f"image-{_name}", f"an image of {_name}, CPU, against mosaic to AoP and DoLP",
        _goal, partial(_images, _name), by_time=True)


@case("image-recording",
      "an image of a recording at 1000 images/s, CPU, against mosaic to AoP and DoLP",
      10, by_time=True)
def _recording() -> Iterator[Comparison]:
    folder = os.environ.get("PDAVIS_TEST_DATA")
    path = Path(folder, "davis346.aedat4") if folder else example_recording("fan")
    for name, (options, _) in IMAGES.items():
        learning = {key: value for key, value in options.items() if key not in _KNOWN}

        def make(learning: dict[str, Any] = learning) -> Fusion:
            recording = open_recording(path, layout=Layout.PDAVIS)
            return Fusion(recording, FusionOptions(fps=1000.0), **learning)

        fusion = make()
        while fusion.index < 300:   # the beginning, where most is learned
            fusion.advance()

        yield Comparison(
            f"{path.stem}, {name}", partial(check_same, make),
            partial(per_image, fusion), chain(fusion.shape), lambda s: 1e3 * s, "ms",
            judged=bool(folder) and name in ("kalman", "causal"))
        fusion.recording.close()
