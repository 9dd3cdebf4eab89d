"""Images of a camera behind a turning analyser: without a mosaic, from events alone."""
from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdavis_cv
from pdavis_cv._advice import Advises
from pdavis_cv._types import Facts, Parameters
from pdavis_cv.calibration.thresholds import resolve_thresholds
from pdavis_cv.fusion.feed import Feed
from pdavis_cv.fusion.grid import grid_count, grid_us
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.fusion.snapshot import FusionSnapshot
from pdavis_cv.fusion.turning_speed import found_segments
from pdavis_cv.fusion.window import Window, checked_roi
from pdavis_cv.polarimetry import PolarFrame, adopted
from pdavis_cv.reconstruct.base import Needs
from pdavis_cv.reconstruct.turning import TurningRegression
from pdavis_cv.recording.base import ApsFrame, Packet, Recording, Source
from pdavis_cv.turning import PulseClock, TurningAnalyser

_EXCLUDED = "method", "layout", "calibration", "denoise"
_PULSES = 1, 3      # types of triggers: rising edges, pulses
_NOMINAL_SIGMA, _STATED_SIGMA = 0.5, 0.05
"""Relative error of thresholds of a data sheet, and of those that the caller states."""
_LEARN_EVENTS = 4_000_000
"""Most from which thresholds are learned: those from the middle of a recording on, as a
motor may start at its beginning; else, if they do not tell them, from its beginning."""
_SHORT = 16
"""Half turns from the middle on that are too few: their first estimate errs by .08."""


class TurningFusion(Advises, Iterator[PolarFrame]):
    """Iterate over the images that `fuse` makes with ``analyser=TurningAnalyser()``.

    Parameters are those of `TurningRegression`; `provenance` has software, options and
    parameters that make the images.  `index` is the number of the next image, `t_us`
    the time of the last one.
    """

    index: int
    t_us: int | None
    _frame_us: int | None
    _steps: Iterator[int]

    def __init__(self, recording: Source, options: FusionOptions) -> None:
        default = FusionOptions()
        for name in _EXCLUDED:
            if getattr(options, name) not in (None, getattr(default, name)):
                raise ValueError(f"analyser excludes {name}")
        assert options.analyser is not None
        if recording.info.event_count == 0:
            raise ValueError("recording has no events; of images it is analyser_steps")
        if options.analyser.triggers and recording.info.trigger_count == 0:
            raise ValueError("recording has no trigger pulses; state rpm, or neither")
        self.recording, self._options = recording, options
        self.needs = Needs(frames=recording.info.frame_count != 0)
        self._analyser: TurningAnalyser = options.analyser
        self._passes = options.causal or not isinstance(recording, Recording)
        if self._analyser.found and self._passes:
            raise ValueError(
                "analyser must state rpm or triggers where a stream passes once or "
                "causal is set: its speed is found from all events")
        size = recording.info.sensor_size
        x, y, w, h = checked_roi(options.roi, size, "bilinear")
        self._window = Window(slice(y, y + h), slice(x, x + w), size)
        self.shape = h, w
        times, self.stop_us = options.times_us, options.stop_us
        self.times_us = None if times is None else np.asarray(times, np.int64)
        self.fps = Fraction(options.fps or 100) if times is None else None
        ratio = options.extinction_ratio
        self._ratio = None if isinstance(ratio, str) or ratio is None else float(ratio)
        assumed = []
        if self._analyser.found:
            assumed.append("speed of the analyser: found from events; the zero of its "
                           "angle and its direction are unknown")
        if not recording.info.frame_count:
            assumed.append(
                "S0 is relative to its recent mean, as events tell changes only")
        self.provenance: Facts = MappingProxyType({
            "pdavis_cv": pdavis_cv.__version__, "method": "turning",
            "parameters": dict(options.parameters), "causal": options.causal,
            "analyser": repr(self._analyser), "extinction_ratio": self._ratio,
            "roi": (x, y, w, h),
            "source": str(recording.path) if recording.path else recording.info.format,
            "assumed": assumed})
        self._thresholds: tuple[Any, ...] | None = None
        self.rewind()

    def __next__(self) -> PolarFrame:
        if not self.advance():
            raise StopIteration
        return self.image()

    def __len__(self) -> int:
        """Return the number of all images, if options and the file's header tell it."""
        if self.times_us is not None:
            return len(self.times_us)
        start, stop = self._options.start_us, self.recording.info.stop_us
        start = self.recording.info.start_us if start is None else start
        if start is None or stop is None:
            raise TypeError("TurningFusion has no length")
        stop = stop if self.stop_us is None else min(stop, self.stop_us)
        assert self.fps is not None
        return grid_count(stop - start, self.fps)

    def close(self) -> None:
        """Do nothing: no thread has to end."""

    # ---- as a Fusion, for a position among the images --------------------------

    @functools.cached_property
    def start_us(self) -> int | None:
        """Time of the first image, None if there is none."""
        return next(self._times(self._opened(self.recording.packets())), None)

    def advance(self) -> bool:
        """Take what the next image needs, which `image` makes; False at the end."""
        t = next(self._steps, None)
        if t is not None:
            self.index, self.t_us = self.index + 1, t
        return t is not None

    def image(self) -> PolarFrame:
        """Return the image that `advance` has passed."""
        assert self.t_us is not None
        found = self._method.polarization(self.t_us)
        return adopted(
            found.quad, valid=found.valid, t_us=self.t_us, frame_us=self._frame_us,
            extinction_ratio=self._ratio, sigmas=found.sigmas,
            provenance=self.provenance)

    def rewind(self) -> None:
        """Return to the position before the first image."""
        self.index, self.t_us, self._frame_us, self._steps = 0, None, None, self._fed()

    def snapshot(self) -> FusionSnapshot:
        """Return the position."""
        return FusionSnapshot(self.index, t_us=self.t_us)

    def restore(self, snapshot: FusionSnapshot) -> None:
        """Move to a position, to go back by reading everything before it again."""
        if snapshot.index < self.index:
            self.rewind()
        while self.index < snapshot.index and self.advance():
            pass

    def _fed(self) -> Iterator[int]:
        """Yield the time of each image when the method has what it needs."""
        self._method, feed = self._begun()
        stop = math.inf if self.stop_us is None else self.stop_us
        for t in self._times(feed):
            if t >= stop or not feed.reaches(t):
                return
            for item in feed.until(t + self._method.lookahead_us):
                if not isinstance(item, ApsFrame):
                    self._method.add_events(self._window.events(item))
                elif not self._options.causal:  # there it follows events after it
                    self._frame_us = item.mid_us
                    self._method.add_frame(self._window.frame(item))
            yield t

    def _times(self, feed: Feed) -> Iterator[int]:
        if self.times_us is not None:
            yield from self.times_us.tolist()
            return
        first, start = feed.first_us(), self._options.start_us
        start = first if start is None else start
        if start is not None and self.fps is not None:
            yield from (start + grid_us(k, self.fps) for k in itertools.count())

    def _begun(self) -> tuple[TurningRegression, Feed]:
        """Find the angle, learn the thresholds, and open the stream."""
        source, options = self.recording, self._options
        packets = source.packets()
        segments: NDArray[np.float64] | PulseClock
        if self._analyser.found:
            segments = self._found
        elif self._analyser.triggers is None:
            segments = self._analyser.segments()
        elif self._passes:
            segments = PulseClock(self._analyser)
            packets = _noting(packets, segments)
        else:
            segments = self._analyser.segments(
                [t for packet in source.packets() for t in _pulses(packet).tolist()])
        on, off = resolve_thresholds(
            source, options.thresholds, options.nominal_thresholds, None)
        known: dict[str, Any] = {
            "segments": segments, "threshold_sigma": _NOMINAL_SIGMA
            if options.thresholds is None or isinstance(options.thresholds, str)
            else _STATED_SIGMA, "centred": not self._passes, **options.parameters}
        if not self._passes and known.get("learn", True):
            self._thresholds = self._thresholds or self._learned(on, off, known)
            on, off, known["threshold_sigma"], known["own_sigma"] = self._thresholds
            known["learn"] = False
        return TurningRegression(self.shape, **self._window.planes(
            {"theta_on": on, "theta_off": off, **known})), self._opened(packets)

    @functools.cached_property
    def _found(self) -> NDArray[np.float64]:
        assert isinstance(self.recording, Recording)
        return found_segments(self.recording, self._analyser.phase)

    def _opened(self, packets: Iterator[Packet]) -> Feed:
        info = self.recording.info
        return Feed(packets, by_arrival=self._options.causal,
                    has_frames=info.frame_count != 0, stop_us=info.stop_us)

    def _learned(self, on: Any, off: Any, known: Parameters) -> tuple[Any, ...]:
        """Return the thresholds that a part shows, their common and own errors."""
        assert isinstance(self.recording, Recording)
        info = self.recording.info
        for start in ((info.start_us or 0) + (info.stop_us or 0)) // 2, info.start_us:
            method, count = TurningRegression(
                info.sensor_size, theta_on=on, theta_off=off, **known), 0
            for packet in self.recording.packets(start):
                method.add_events(packet.events)
                count += len(packet.events)
                if count > _LEARN_EVENTS:
                    break
            if method.common_sigma < known["threshold_sigma"] and (
                    (info.stop_us or 0) - (start or 0) > _SHORT * method.half_us):
                break
        return *method.thresholds, method.common_sigma, method.own_sigma


def _pulses(packet: Packet) -> NDArray[np.int64]:
    """Return the times of the external trigger's pulses."""
    kinds = packet.triggers["type"]
    return np.asarray(packet.triggers["t"][np.isin(kinds, _PULSES)], np.int64)


def _noting(packets: Iterator[Packet], clock: PulseClock) -> Iterator[Packet]:
    """Yield packets; their pulses are added to the clock before."""
    for packet in packets:
        clock.add(_pulses(packet))
        yield packet
