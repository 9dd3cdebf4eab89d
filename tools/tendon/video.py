"""The video of ``pdavis tendon``: frame, events and DoLP above the traces."""
from __future__ import annotations

import argparse
from collections import deque
from typing import Any

import numpy as np

from pdavis_cv import EVENT_DTYPE, PolarFrame, Recording, render
from pdavis_cv._opencv import opencv
from pdavis_cv.mosaic import HALF_SIZE

from .._images import screen_scale, tone_of
from .findings import Findings

_COLOURS = ((80, 220, 255), (255, 180, 80), (120, 255, 120), (255, 120, 220))


class TendonSheet:
    """Compose the pictures of the video.

    The options of fuse() have ``times_us``.
    """

    def __init__(
        self, args: argparse.Namespace, recording: Recording, found: Findings,
        options: dict[str, Any],
    ) -> None:
        self.args, self.found = args, found
        self.tone = tone_of(recording, options, "S0")
        dolp = found.fused.table["dolp"]
        low, high = float(np.nanmin(dolp)), float(np.nanmax(dolp))
        margin = 0.1 * (high - low) or 0.01
        self.limits = (low - margin, high + margin)
        self.top = float(np.ceil(min(1.0, 1.6 * high) * 20) / 20)
        self._packets = recording.packets()
        self._events: deque[Any] = deque()
        self._source = recording.name
        times = options["times_us"]
        self._window = int(np.median(np.diff(times))) if len(times) > 1 else 10_000
        self._fps = 1e6 / self._window

    def _events_until(self, t_us: int) -> Any:
        while not self._events or self._events[-1]["t"][-1] < t_us:
            packet = next(self._packets, None)
            if packet is None:
                break
            if len(packet.events):
                self._events.append(packet.events)
        while self._events and self._events[0]["t"][-1] < t_us - self._window:
            self._events.popleft()
        if not self._events:
            return np.empty(0, EVENT_DTYPE)
        events = np.concatenate(self._events)
        return events[(events["t"] >= t_us - self._window) & (events["t"] < t_us)]

    def picture(self, frame: PolarFrame, image: PolarFrame) -> render.Picture:
        """Compose one picture."""
        found, t = self.found, int(image.t_us or 0)
        scale = 2 if image.provenance.get("demosaic") in HALF_SIZE else 1
        left, top = (int(v) for v in image.provenance.get("roi", (0, 0))[:2])
        shape = (image.shape[0] * scale, image.shape[1] * scale)
        events = render.events_on(shape, self._events_until(t), origin=(left, top))
        events = events[::scale, ::scale]
        now = (t - found.origin_us) / 1e6
        second = found.seconds(found.fused.t_us)
        span = max(2.5 / found.load_hz, 1.0)
        begin = min(max(second[0], now - 0.7 * span), max(second[0], second[-1] - span))
        lines = []
        for i, table in enumerate(found.fused.table):
            colour = _COLOURS[i % len(_COLOURS)]
            lines.append(render.Line(
                second, table["dolp"], colour, found.fused.rois[i].name,
                table["dolp_se"]))
            if found.frames is not None:
                lines.append(render.Line(
                    found.seconds(found.frames.t_us), found.frames.table["dolp"][i],
                    (150, 150, 150), "frames" if i == 0 else "", dots=True))
        enlarged = self.args.scale or screen_scale(image.shape)
        zoom = render.DARK.sized(image.shape[1] * enlarged).zoom
        wide = 3 * (image.shape[1] * enlarged + 8 * zoom) + 8 * zoom
        below = render.chart(
            lines, (160 * zoom, max(wide, 480)), zoom=zoom,
            span_s=(begin, begin + span), limits=self.limits, now_s=now, title="DoLP")
        title = (f"{self._source}   t = {now:.3f} s   load {found.load_hz:.3g} Hz   "
                 f"{self.args.slow:g} x slower   {self._fps:g} images/s   "
                 f"{enlarged / scale:g} x enlarged")
        return render.tendon_sheet(
            frame, events, image, below, grey=self.tone.seen, top=self.top,
            scale=enlarged, title=title,
            marks=self._mark(left, top, scale, enlarged))

    def _mark(self, left: int, top: int, scale: int, enlarged: int) -> Any:
        def mark(picture: render.Picture) -> render.Picture:
            cv2 = opencv()
            size = enlarged / scale
            picture = np.ascontiguousarray(picture)
            for i, roi in enumerate(self.found.fused.rois):
                rings = [np.rint((ring - (left, top)) * size).astype(np.int32)
                         for ring in roi.rings]
                cv2.polylines(picture, rings, True, _COLOURS[i % len(_COLOURS)], 1)
            if self.args.pixel_um is not None:
                picture = render.scale_bar(picture, self.args.pixel_um * scale,
                                           scale=enlarged)
            return picture
        return mark
