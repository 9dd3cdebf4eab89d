"""An open recording or live source: its position, properties and pictures."""
from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Image, Parameters
from pdavis_cv.capture import constants as c, picture
from pdavis_cv.capture.manners import type_code
from pdavis_cv.capture.outputs import output_at
from pdavis_cv.capture.seeking import Bookmark, Cursor
from pdavis_cv.capture.source import NAME_OF_PROPERTY, decoded_value, opened
from pdavis_cv.capture.stream import LiveCursor
from pdavis_cv.errors import PdavisError
from pdavis_cv.fusion import Fusion
from pdavis_cv.fusion.options import FusionOptions, fusion_part
from pdavis_cv.fusion.turning import TurningFusion
from pdavis_cv.live import Session as LiveSession
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.base import Recording, Source
from pdavis_cv.render import ToneCurve

FAILURES = (OSError, PdavisError, ValueError, ImportError)
"""Errors that reading may raise: damage, invalid values, a missing package."""

# OpenCV's own numbers, the same in every version.
_POS_MSEC, _POS_FRAMES, _POS_AVI_RATIO, _WIDTH, _HEIGHT, _FPS = 0, 1, 2, 3, 4, 5
_FRAME_COUNT, _FORMAT, _CONVERT_RGB, _BACKEND = 7, 8, 16, 42


@dataclass(frozen=True)
class View:
    """Settings of how images are shown, which can be changed at any time.

    `output` is that of ``read()``, ``CAP_PDAVIS_*``; without `convert` it is float
    planes instead of pictures (``CAP_PROP_CONVERT_RGB`` = 0); for gain, gamma and log
    see `picture.tone`.  The timeouts are those for the first sample and for an image of
    a live source; the defaults are those of cv2.
    """

    output: int = c.CAP_PDAVIS_BGR
    convert: bool = True
    gain: float = 1.0
    gamma: float = 1.0
    log: bool = False
    open_timeout_ms: float = 30_000.0
    read_timeout_ms: float = 30_000.0


class Session:
    """A recording, or a live source, that is being read image by image.

    It is opened with parameters of `fuse` and of `open_recording`.  OSError if it
    cannot be opened or has another format, TypeError or ValueError if a parameter is
    invalid.
    """

    def __init__(
        self, source: str | os.PathLike[str] | Source,
        parameters: Parameters, view: View,
    ) -> None:
        self.parameters, self.view = dict(parameters), view
        self._owned = not isinstance(source, Source)
        self.recording = opened(source, parameters)
        self.cursor: Cursor | LiveCursor
        self._live: LiveSession | None = None
        try:
            if isinstance(self.recording, Recording):
                self.cursor = Cursor(self._fusion(parameters))
                self._first = picture.first_frame(self.recording)
            else:
                self._live = LiveSession(self.recording, **fusion_part(parameters))
                self._live.wait(view.open_timeout_ms / 1000)
                self.cursor = LiveCursor(self._live, view.read_timeout_ms / 1000)
                self._first = self._live.first_frame
            self._tone = self._made_tone(view)
        except BaseException:
            self.close()
            raise
        self.grabbed = False
        self._frame: PolarFrame | None = None
        self._broken: Exception | None = None
        self._capture_fps: float | None = None

    def close(self) -> None:
        """Close what this session opened."""
        if self._live is not None:
            self._live.close()
        if self._owned:
            self.recording.close()

    def _fusion(self, parameters: Parameters) -> Fusion | TurningFusion:
        options = FusionOptions().replace(**fusion_part(parameters))
        return (Fusion if options.analyser is None else TurningFusion)(
            self.recording, options)

    def _made_tone(self, view: View) -> ToneCurve:
        white = picture.white_level(self.cursor.fusion.needs.frames, self._first)
        return picture.tone(white, view.gain, view.gamma, view.log)

    # ---- images ----------------------------------------------------------------

    def grab(self) -> bool:
        """Move to the next image; it is computed when it is retrieved.

        If the recording cannot be read, or a package for it is missing, the OSError,
        ValueError or ImportError is raised again by each call until the position is
        changed.
        """
        self._frame = None
        self.grabbed = False
        if self._broken is not None:
            raise self._broken
        try:
            self.grabbed = self.cursor.advance()
        except TimeoutError:
            raise
        except FAILURES as error:
            self._broken = error
            raise
        if self._first is None and isinstance(self.cursor, LiveCursor):
            self._first = self.cursor.session.first_frame
            self._tone = self._made_tone(self.view)
        return self.grabbed

    def retrieve(self, output: int) -> Image:
        """Return an output of the image that was grabbed last.

        LookupError if nothing was grabbed or there is no such output, ValueError if the
        method does not provide it.
        """
        if not self.grabbed:
            raise LookupError("no image was grabbed")
        wanted = output_at(output)
        if wanted.quantity.of_events:
            counts = self._event_counts()
            return picture.events_bgr(counts) if self.view.convert else counts
        if self._frame is None:
            self._frame = self.cursor.image()
        if wanted.picture and self.view.convert:
            return picture.colour(self._frame, wanted, self._tone)
        return picture.plane(self._frame, wanted)

    def _event_counts(self) -> NDArray[np.float32]:
        fusion = self.cursor.fusion
        assert self.cursor.t_us is not None
        until, after = self.cursor.t_us, self.cursor.previous_us
        if after is None:
            after = until - round(1e6 / (self.cursor.fps or 100.0))
        step = 2 if fusion.provenance.get("demosaic") in HALF_SIZE else 1
        parts = ([self.cursor.session.events(after, until)]
                 if isinstance(self.cursor, LiveCursor) else
                 (packet.events for packet in self._readable().packets(
                     after + 1, until + 1)))
        return picture.event_counts(parts, fusion.provenance["roi"], step)

    def _readable(self) -> Recording:
        """Return the recording; raise ValueError if it can be read only once."""
        if not isinstance(self.recording, Recording):
            raise ValueError("a live source is read once")
        return self.recording

    # ---- position ----------------------------------------------------------------

    def seek(self, index: float) -> None:
        """Move so that the next image is number index, clamped to the grid."""
        self._frame = None
        self.grabbed = False
        if self._broken is not None:
            self.cursor.rewind()
            self._broken = None
        self.cursor.seek(int(index))
        self.grabbed = self.cursor.index > 0

    def state(self) -> tuple[Bookmark, bool]:
        """Return the position, to be restored in an equal Session."""
        return self.cursor.bookmark(), self.grabbed

    def restore(self, state: tuple[Bookmark, bool]) -> None:
        """Move to the position that `state` returned."""
        mark, grabbed = state
        self._frame = None
        self.cursor.restore(mark)
        self.grabbed = grabbed

    # ---- properties --------------------------------------------------------------

    def get(self, prop: int) -> float | None:
        """Return the value of a property, None if the number is unknown."""
        getter = _GETTERS.get(prop)
        return None if getter is None else getter(self)

    def set(self, prop: int, value: float) -> bool:
        """Change a property; return False if it does not exist or cannot be changed.

        TypeError or ValueError if the value is invalid.
        """
        if prop in (_POS_FRAMES, _POS_MSEC, _POS_AVI_RATIO):
            self.seek(self._wanted(prop, value))
            return True
        if prop == _CONVERT_RGB:
            self.view = replace(self.view, convert=bool(value))
            return True
        name = NAME_OF_PROPERTY.get(prop)
        if name is None:
            return False
        decoded = decoded_value(name, value)
        if decoded is None:
            raise ValueError(f"{name} cannot be {value}")
        if name in View.__dataclass_fields__:
            view = replace(self.view, **{name: decoded})
            self._tone, self.view = self._made_tone(view), view
            if isinstance(self.cursor, LiveCursor):
                self.cursor.timeout_s = view.read_timeout_ms / 1000
        else:
            self._change_fps(decoded)
        return True

    def _wanted(self, prop: int, value: float) -> float:
        if value != value:
            return 0
        # Far beyond any recording, and far within the range of an int64.
        value = min(max(value, -1e15), 1e15)
        if prop == _POS_FRAMES:
            return value
        if prop == _POS_AVI_RATIO:
            return round(value * self.cursor.count)
        return self.cursor.index_at((self._start_us() or 0) + value * 1000)

    def _start_us(self) -> int | None:
        """Return the time of the first image, None if not known yet."""
        if isinstance(self.cursor, LiveCursor):
            return self.cursor.start_us
        return self.cursor.fusion.start_us

    def _change_fps(self, fps: float) -> None:
        """Change the rate of the images and keep the time."""
        if isinstance(self.cursor, LiveCursor):
            self.cursor.session.change(fps=fps)
            return
        parameters = {**self.parameters, "fps": fps}
        old, new = self.cursor, Cursor(self._fusion(parameters))
        index = old.index if old.t_us is None else new.index_at(old.t_us) + 1
        grabbed = self.grabbed
        self.cursor, self.parameters = new, parameters
        self.seek(index)
        self.grabbed = self.grabbed and grabbed

    def _pos_msec(self) -> float:
        t, start = self.cursor.t_us, self._start_us()
        return 0.0 if t is None or start is None else (t - start) / 1000

    def _format(self) -> float:
        output = output_at(self.view.output)
        if output.picture and self.view.convert:
            return type_code("CV_8UC3")
        depth = "8U" if output.quantity.dtype == np.uint8 else "32F"
        return type_code(f"CV_{depth}C{len(output.quantities)}")

    def _rate_of_frames(self) -> float:
        if isinstance(self.cursor, LiveCursor):
            return 0.0
        if self._capture_fps is None:
            times = [frame.mid_us for packet in self._readable().packets()
                     for frame in packet.frames]
            self._capture_fps = 0.0 if len(times) < 2 else (
                (len(times) - 1) * 1e6 / (times[-1] - times[0]))
        return self._capture_fps


def _time(value: int | None) -> float | None:
    return None if value is None else float(value)


_GETTERS: dict[int, Callable[[Session], float | None]] = {
    _POS_MSEC: Session._pos_msec,
    _POS_FRAMES: lambda s: float(s.cursor.index),
    _POS_AVI_RATIO: lambda s: s.cursor.index / max(s.cursor.count, 1),
    _WIDTH: lambda s: float(s.cursor.fusion.shape[1]),
    _HEIGHT: lambda s: float(s.cursor.fusion.shape[0]),
    _FPS: lambda s: s.cursor.fps,
    _FRAME_COUNT: lambda s: float(s.cursor.count),
    _FORMAT: Session._format,
    _CONVERT_RGB: lambda s: float(s.view.convert),
    _BACKEND: lambda s: float(c.CAP_PDAVIS),
    c.CAP_PROP_OPEN_TIMEOUT_MSEC: lambda s: s.view.open_timeout_ms,
    c.CAP_PROP_READ_TIMEOUT_MSEC: lambda s: s.view.read_timeout_ms,
    c.CAP_PROP_PDAVIS_OUTPUT: lambda s: float(s.view.output),
    c.CAP_PROP_PDAVIS_FPS: lambda s: s.cursor.fps,
    c.CAP_PROP_PDAVIS_CAPTURE_FPS: Session._rate_of_frames,
    c.CAP_PROP_PDAVIS_EXPOSURE_US: lambda s: (
        None if s._first is None else s._first.exposure_ms * 1000 or None),
    c.CAP_PROP_PDAVIS_START_US: lambda s: _time(s._start_us()),
    c.CAP_PROP_PDAVIS_POS_US: lambda s: _time(s.cursor.t_us),
    c.CAP_PROP_PDAVIS_GAIN: lambda s: s.view.gain,
    c.CAP_PROP_PDAVIS_GAMMA: lambda s: s.view.gamma,
    c.CAP_PROP_PDAVIS_LOG: lambda s: float(s.view.log),
    c.CAP_PROP_PDAVIS_WHITE: lambda s: s._tone.white,
}
