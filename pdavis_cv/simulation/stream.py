"""A simulation as a recording: computed while it is read, in constant memory."""
from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events
from pdavis_cv.recording.base import (
    MAX_PACKET_EVENTS,
    ApsFrame,
    Packet,
    PlainSource,
    Recording,
)
from pdavis_cv.recording.packetise import cut
from pdavis_cv.simulation.aps import FrameClock, make_frame, node_slopes
from pdavis_cv.simulation.bus import BusState
from pdavis_cv.simulation.checks import affordable
from pdavis_cv.simulation.dvs import PixelArray, in_time_order
from pdavis_cv.simulation.faults import EventFaults
from pdavis_cv.simulation.scenes import FloatArray, Scene, Stokes
from pdavis_cv.simulation.specimen import Specimen
from pdavis_cv.simulation.truth import Truth

PIECE_US = 10_000
_ROWS = 16      # rows, and intervals, per evaluation of a scene that is not uniform
_INTERVALS = 16
_WEIGHTS = 4    # float64 arrays of (intervals, columns) that are held at once


@dataclass(slots=True)
class Piece:
    """Output of the camera in 10 ms, up to `stop_us`.

    Frames are those that became available in it; `bus_load` is the fraction of the time
    in which the read-out bus was busy, `bus_lost` the number of events that it lost.
    """

    stop_us: int
    events: Events
    frames: list[ApsFrame] = field(default_factory=list)
    bus_load: float = 0.0
    bus_lost: int = 0


class SimulatedRecording(PlainSource, Recording):
    """A recording of a scene that is simulated while it is read (`Camera.stream`).

    Each reading simulates it from its start, so memory does not grow with its length.
    The same camera, scene and run give the same bits.  Its info has no counts, since
    they are unknown before the simulation.
    """

    def __init__(
        self, camera: Specimen, scene: Scene, stop_us: int, run: int = 0,
        threads: int = 1, step_us: float | None = None,
    ) -> None:
        self.camera, self.scene, self.stop_us = camera, scene, stop_us
        self.run, self.threads = run, threads
        step = scene.step_us if step_us is None else step_us
        dvs = camera.dvs
        if dvs is not None:
            step = min(step, dvs.step_us)
        if dvs is not None and dvs.burst_chance and camera.aps is not None:
            # At most one burst per interval.
            gap = min(camera.aps.exposure_us,
                      1e6 / camera.aps.fps - camera.aps.exposure_us)
            step = min(step, max(gap - dvs.burst_us, 100.0))
        intervals = max(1, PIECE_US / step)
        # Weights of the frames' integrals, by interval and column; some arrays at once.
        affordable("10 ms of the light's course",
                   8 * _WEIGHTS * intervals * camera.size[1], step_us=step)
        self._intervals = math.ceil(intervals - 1e-9)
        self._info = camera.info(stop_us)
        self._bus: list[tuple[int, float, int]] = []

    def close(self) -> None:
        """Nothing to release."""

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Simulate from 0 and give the samples with start_us <= time < stop_us."""
        start = 0 if start_us is None else int(start_us)
        stop = self.stop_us if stop_us is None else min(int(stop_us), self.stop_us)
        for piece in self.pieces():
            if piece.stop_us - PIECE_US >= stop:
                return
            for packet in _packets(piece):
                kept = cut(packet, start, stop)
                if kept.start_us is not None:
                    yield kept

    def truth(self) -> Truth:
        """Return the light in front of the camera.

        With a bus, its load and losses are those of the last complete reading.
        """
        truth = Truth(self.scene, self.camera.size, self.camera.origin, self.stop_us)
        if self._bus:
            stop, load, lost = zip(*self._bus, strict=True)
            truth.bus_t_us = np.array(stop, np.int64)
            truth.bus_load = np.array(load)
            truth.bus_lost = np.array(lost, np.int64)
        return truth

    def pieces(self) -> Iterator[Piece]:
        """Simulate, 10 ms at a time.

        Yields
        ------
        Piece
            Events and frames before the end of the recording.
        """
        camera = self.camera
        clock = None if camera.aps is None else FrameClock(camera.aps, camera.size[1])
        bus = None if camera.bus is None else BusState(camera.bus, camera.size)
        pixels = None
        if camera.dvs is not None:
            pixels = PixelArray(camera.dvs, camera.maps, camera.noise_seed(self.run),
                                camera.origin)
        faults, wrong, factors = camera.faults, None, (1.0, 1.0)
        if faults.lost or faults.jitter_us:
            wrong = EventFaults(faults, camera.noise_seed(self.run))
        sums: dict[int, FloatArray] = {}
        log: list[tuple[int, float, int]] = []
        with ThreadPoolExecutor(self.threads) as pool:
            for start in range(0, self.stop_us, PIECE_US):
                stop = start + PIECE_US
                if pixels is not None and factors != (
                        now := faults.threshold_factors(start / self.stop_us)):
                    factors = now
                    pixels.scale_thresholds(*now)
                parts = self._simulate(start, pixels, clock, sums, pool)
                events = in_time_order(parts, start, stop)
                piece = Piece(stop, events)
                if bus is not None:
                    lost = bus.lost
                    piece.events = bus.pass_on(events, stop)
                    piece.bus_load, piece.bus_lost = bus.load, bus.lost - lost
                    log.append((stop, piece.bus_load, piece.bus_lost))
                if wrong is not None:
                    piece.events = wrong.pass_on(piece.events, start, stop)
                if clock is not None:
                    piece.frames = self._finish(clock, sums, stop)
                if stop >= self.stop_us:
                    end = np.searchsorted(piece.events["t"], self.stop_us)
                    piece.events = piece.events[:end]
                    piece.frames = [frame for frame in piece.frames
                                    if frame.available_us < self.stop_us]
                yield piece
        self._bus = log

    def _simulate(
        self, start: int, pixels: PixelArray | None, clock: FrameClock | None,
        sums: dict[int, FloatArray], pool: ThreadPoolExecutor,
    ) -> list[NDArray[Any]]:
        """Return the events of 10 ms, and add its light to the exposures ``sums``."""
        height, width = self.camera.size
        rows = [slice(r, min(r + _ROWS, height)) for r in range(0, height, _ROWS)]
        if self.threads == 1 and self.scene.uniform:
            rows = [slice(0, height)]
        step = PIECE_US / self._intervals
        size = self._intervals if self.scene.uniform else _INTERVALS
        # Of nodes that make 10 ms: (start, step, intervals).
        blocks = [(start + first * step, step, min(size, self._intervals - first))
                  for first in range(0, self._intervals, size)]
        weights = {} if clock is None else {
            (frame, block): clock.weights(frame, *block)
            for frame in clock.frames(start, start + PIECE_US) for block in blocks}
        for frame, _ in weights:
            sums.setdefault(frame, np.zeros((height, width)))
        edges, first_edge = np.empty(0), 0
        if clock is not None and pixels is not None and pixels.pixel.burst_chance:
            edges, first_edge = clock.edges(
                start, start + PIECE_US, pixels.pixel.burst_us)

        def band(part: slice) -> list[NDArray[Any]]:
            events: list[Events] = []
            for block in blocks:
                at, step, _ = block
                light, analyser = self._light(block, part)
                nodes = light[2:-2]
                if pixels is not None:
                    if at == 0:
                        pixels.settle(nodes[0] if analyser is None
                                      else analyser @ nodes[0], part)
                    events += pixels.advance(
                        at, step, nodes, node_slopes(light), analyser,
                        rows=part, edges=edges, first_edge=first_edge)
                for (frame, other), weight in weights.items():
                    if other == block and np.any(weight):
                        sums[frame][part] += _integral(
                            weight, light, analyser, (part.stop - part.start, width))
            return events

        found = pool.map(band, rows) if self.threads > 1 else map(band, rows)
        return [events for part in found for events in part]

    def _light(
        self, block: tuple[float, float, int], rows: slice
    ) -> tuple[FloatArray, FloatArray | None]:
        """Light (nodes, pixels) at the nodes of a block, and None.

        For uniform light: S0..S2 (nodes, 3), and the pixels' responses (pixels, 3).
        There are two more nodes at each end, for the slopes.
        """
        start, step, count = block
        t = start + step * np.arange(-2, count + 3)
        camera = self.camera
        analyser = camera.maps["analyser"][rows]
        row, column = camera.origin
        seen: FloatArray | None = None
        if self.scene.uniform:
            light = np.stack(self.scene.stokes(t, column, row), axis=-1)
            seen = np.ascontiguousarray(analyser.reshape(-1, 3))
        else:
            y = np.arange(rows.start, rows.stop)[:, None] + row
            x = np.arange(camera.size[1])[None, :] + column
            light = _analysed(
                analyser, self.scene.stokes(t[:, None, None], x, y), len(t))
        return np.ascontiguousarray(light), seen

    def _finish(
        self, clock: FrameClock, sums: dict[int, FloatArray], stop: int
    ) -> list[ApsFrame]:
        """Frames that have been read out before ``stop``."""
        camera, frames = self.camera, []
        for number in sorted(sums):
            if clock.available_us(number) >= stop:
                break
            digitised = clock.pixel.digitise(
                sums.pop(number), camera.maps, camera.noise_seed(self.run), number,
                camera.origin)
            frames.append(make_frame(
                clock, number, digitised, camera.faults.frame_offset_us))
        return frames


def _analysed(analyser: FloatArray, stokes: Stokes, times: int) -> FloatArray:
    """Return light (times, H * W) on pixels of responses (H, W, 3) to Stokes images."""
    shape = (times, *analyser.shape[:2])
    s0, s1, s2 = (np.broadcast_to(each, shape) for each in stokes)
    if not s0.strides[0]:
        s0 = s0[:1]             # constant: stride 0 in time
    light = np.empty((times, analyser.shape[0] * analyser.shape[1]))
    s0, s1, s2 = (np.ascontiguousarray(each.reshape(len(each), -1))
                  for each in (s0, s1, s2))
    _kernels.analysed(
        np.ascontiguousarray(analyser.reshape(-1, 3).T), s0, s1, s2, light)
    return light


def _integral(
    weight: FloatArray, light: FloatArray, analyser: FloatArray | None,
    shape: tuple[int, int],
) -> FloatArray:
    """Exposure integral per pixel; ``weight`` is (nodes, 1) or (nodes, columns)."""
    if weight.shape[1] == 1:
        total = weight[:, 0] @ light
        return (total if analyser is None else analyser @ total).reshape(shape)
    if analyser is None:
        mosaic = light.reshape(len(light), *shape)
        return np.asarray(np.einsum("kx,kyx->yx", weight, mosaic))
    seen = analyser.reshape(*shape, 3)
    return np.asarray(np.einsum("yxc,xc->yx", seen, weight.T @ light))


def _packets(piece: Piece) -> Iterator[Packet]:
    """Split a piece into packets that end with a frame or at MAX_PACKET_EVENTS."""
    events, at = piece.events, 0
    for frame in [*piece.frames, None]:
        end = len(events) if frame is None else int(
            np.searchsorted(events["t"], frame.available_us, "right"))
        while end - at > MAX_PACKET_EVENTS:
            yield Packet(events[at:at + MAX_PACKET_EVENTS].copy())
            at += MAX_PACKET_EVENTS
        part = events if end - at == len(events) else events[at:end].copy()
        yield Packet(part, () if frame is None else (frame,))
        at = end
