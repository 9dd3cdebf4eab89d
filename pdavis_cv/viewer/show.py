"""Source of the viewer's images: a playing recording or a live session."""
from __future__ import annotations

import dataclasses
import datetime
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pdavis_cv._types import Events
from pdavis_cv.capture.picture import first_frame, white_level
from pdavis_cv.capture.seeking import Cursor
from pdavis_cv.errors import PdavisError
from pdavis_cv.fusion import Fusion, FusionOptions
from pdavis_cv.live import Session, open_source
from pdavis_cv.live.session import DEFAULT_FPS, KEPT_EVENTS_US
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.methods import METHODS
from pdavis_cv.recording.base import Problem, Recording, Source

_SPEEDS = (1e-4, 1e3)
_FAILURES = (OSError, PdavisError, ValueError, ImportError)


class Show(ABC):
    """Provides images to several clients, and takes their commands.

    `name` is that of the recording's file, else the source's format; `white` the value
    of S0 / 2 at full scale of the converter, white in streams.
    """

    live: bool
    name: str
    white: float

    @property
    @abstractmethod
    def fusion(self) -> Fusion:
        """What makes the images."""

    @abstractmethod
    def latest(self, after: int, timeout: float) -> tuple[int, PolarFrame | None]:
        """Return the newest image and its number, waiting for one after a number."""

    @property
    @abstractmethod
    def over(self) -> bool:
        """Whether no new image will come, so that `latest` does not wait."""

    @property
    @abstractmethod
    def period_us(self) -> int:
        """Interval of an image in the source's time."""

    @abstractmethod
    def events(self, until_us: int) -> Events:
        """Return the events of the interval of an image that ends at until_us."""

    @abstractmethod
    def change(self, **options: Any) -> None:
        """Continue with other options of `fuse`."""

    @abstractmethod
    def close(self) -> None:
        """Stop."""

    @abstractmethod
    def _own_status(self) -> dict[str, Any]:
        """Return the status that is specific to this kind of source."""

    def status(self) -> dict[str, Any]:
        """Return the status that the page shows besides pictures, as JSON values."""
        fusion = self.fusion
        height, width = fusion.shape
        fps = fusion.options.fps
        provenance = fusion.provenance
        return {"live": self.live, "name": self.name, "method": fusion.method,
                "methods": list(METHODS), "width": width, "height": height,
                "roi": provenance["roi"],
                "step": 2 if provenance["demosaic"] in HALF_SIZE else 1,
                "fps": None if fps is None else float(fps), **self._own_status()}

    def command(self, name: str, value: Any) -> None:
        """Execute a page's command, one of `commands`, with a value from JSON.

        ValueError or TypeError if the command is unknown, or its value is invalid.
        """
        known = self.commands()
        if name not in known:
            raise ValueError(f"do must be one of {', '.join(known)}, got {name!r}")
        known[name](value)

    def commands(self) -> dict[str, Callable[[Any], None]]:
        """Return what may be commanded, by name."""
        return {"method": lambda value: self.change(method=_text(value)),
                "fps": lambda value: self.change(fps=_number("fps", value))}


def show_of(
    where: Any, record_to: str | os.PathLike[str], options: dict[str, Any]
) -> Show:
    """Open a source for the viewer, with options of `fuse`.

    What the page records goes into the folder `record_to`.
    """
    if isinstance(where, Session):
        return LiveShow(where, False, record_to)
    source = open_source(where, layout=options.get("layout"))
    owned = not isinstance(where, Source)
    if isinstance(source, Recording):
        return FileShow(source, owned, options)
    return LiveShow(Session(source, **options), True, record_to)


class LiveShow(Show):
    """The images of a session, which is closed at the end if it is owned.

    Names of recordings are made here, for the folder `record_to`.
    """

    live = True

    def __init__(
        self, session: Session, owned: bool, record_to: str | os.PathLike[str]
    ) -> None:
        self._session, self._owned, self._folder = session, owned, Path(record_to)
        self.name = session.info.format

    @property
    def white(self) -> float:  # type: ignore[override]
        """Full scale of the converter at the first frame's exposure."""
        return white_level(self.fusion.needs.frames, self._session.first_frame)

    @property
    def fusion(self) -> Fusion:
        """What makes the images."""
        return self._session.fusion

    def latest(self, after: int, timeout: float) -> tuple[int, PolarFrame | None]:
        """Return the newest image."""
        return self._session.latest(after, timeout)

    @property
    def over(self) -> bool:
        """Whether no image will come."""
        return self._session.over

    @property
    def period_us(self) -> int:
        """Interval of an image, of which events are still kept."""
        return min(round(1e6 / float(self.fusion.options.fps or DEFAULT_FPS)),
                   KEPT_EVENTS_US)

    def events(self, until_us: int) -> Events:
        """Return the events since the image before."""
        return self._session.events(until_us - self.period_us, until_us)

    def change(self, **options: Any) -> None:
        """Go on with other options."""
        self._session.change(**options)

    def commands(self) -> dict[str, Callable[[Any], None]]:
        """Return what may be commanded, by name."""
        return {**super().commands(), "record": self._record}

    def _record(self, value: Any) -> None:
        """Start or stop a recording; its name is chosen here, never by a page."""
        if not isinstance(value, bool):
            raise TypeError(f"value must be true or false, got {value!r}")
        if not value:
            self._session.record(None)
            return
        now = datetime.datetime.now()
        self._session.record(self._folder / f"pdavis-{now:%Y%m%d-%H%M%S}.aedat4")

    def _own_status(self) -> dict[str, Any]:
        stats = dataclasses.asdict(self._session.stats)
        if stats["recording"] is not None:
            stats["recording"] = Path(stats["recording"]).name
        return {"stats": stats, "problems": _told(self._session.problems)}

    def close(self) -> None:
        """Stop, and close the session if it is owned."""
        if self._owned:
            self._session.close()


class FileShow(Show):
    """A recording that plays, stops, and goes to any of its images.

    It is closed at the end if it is owned.  Options are those of `fuse`; 60 images per
    second by default.
    """

    live = False

    def __init__(
        self, recording: Recording, owned: bool, options: dict[str, Any]
    ) -> None:
        self._recording, self._owned = recording, owned
        self.name = recording.name
        self._options = FusionOptions().replace(**{"fps": DEFAULT_FPS, **options})
        self._cursor = Cursor(Fusion(recording, self._options))
        self._first = first_frame(recording)
        self.white = white_level(self.fusion.needs.frames, self._first)
        self._count = self._cursor.count
        self._change = threading.Condition()
        self._moving = threading.RLock()        # the cursor belongs to who holds it
        self._latest: tuple[int, PolarFrame | None] = (0, None)
        self._playing, self._speed, self._closed = False, 1.0, False
        self._error: str | None = None
        self._step(0)
        self._thread = threading.Thread(
            target=self._play, name="pdavis player", daemon=True)
        self._thread.start()

    @property
    def fusion(self) -> Fusion:
        """What makes the images."""
        assert isinstance(self._cursor.fusion, Fusion)
        return self._cursor.fusion

    def latest(self, after: int, timeout: float) -> tuple[int, PolarFrame | None]:
        """Return the newest image."""
        with self._change:
            self._change.wait_for(
                lambda: self._latest[0] > after or self._closed, timeout)
            return self._latest if self._latest[0] > after else (after, None)

    @property
    def over(self) -> bool:
        """Whether no image will come."""
        return self._closed

    @property
    def period_us(self) -> int:
        """Interval of an image."""
        return round(1e6 / self._cursor.fps) if self._cursor.fps else 10_000

    def events(self, until_us: int) -> Events:
        """Return the events since the image before."""
        return self._recording.events(until_us - self.period_us + 1, until_us + 1)

    def change(self, **options: Any) -> None:
        """Continue with other options, at the same time of the recording."""
        before = self._options
        if "method" in options:             # what belongs to the old one goes with it
            before = FusionOptions(**{
                name: getattr(before, name) for name in FusionOptions.facts()})
        wanted = before.replace(**options)
        cursor = Cursor(Fusion(self._recording, wanted))
        with self._moving:
            t = self._cursor.t_us
            self._cursor, self._options = cursor, wanted
            self._count = cursor.count
            self.white = white_level(self.fusion.needs.frames, self._first)
            self._go(0 if t is None else cursor.index_at(t))

    def commands(self) -> dict[str, Callable[[Any], None]]:
        """Return what may be commanded, by name."""
        return {**super().commands(), "play": lambda value: self._set(True),
                "pause": lambda value: self._set(False),
                "seek": lambda value: self._go(int(_number("seek", value))),
                "step": lambda value: self._step(int(_number("step", value))),
                "speed": self._set_speed}

    def _set(self, playing: bool) -> None:
        if playing and self._cursor.index >= self._count:
            self._go(0)
        with self._change:
            self._playing = playing
            self._change.notify_all()

    def _set_speed(self, value: Any) -> None:
        speed = _number("speed", value)
        if not _SPEEDS[0] <= speed <= _SPEEDS[1]:
            raise ValueError(f"speed must lie in {_SPEEDS[0]:g}..{_SPEEDS[1]:g}, got "
                             f"{speed:g}")
        with self._change:
            self._speed = speed
            self._change.notify_all()

    def _step(self, by: int) -> None:
        with self._moving:
            self._go(max(self._cursor.index - 1, 0) + by)

    def _go(self, index: int) -> None:
        """Show the image of this number, clamped."""
        with self._moving:
            self._cursor.seek(min(max(index, 0), max(self._count - 1, 0)))
            self._next()

    def _next(self) -> bool:
        """Show the next image; False at the end."""
        with self._moving:
            if not self._cursor.advance():
                return False
            image = self._cursor.image()
        with self._change:
            self._latest = (self._latest[0] + 1, image)
            self._change.notify_all()
        return True

    def _play(self) -> None:
        due = time.monotonic()
        while True:
            with self._change:
                if not self._playing and not self._closed:
                    self._change.wait_for(lambda: self._playing or self._closed)
                    due = time.monotonic()
                if self._closed:
                    return
            self._play_next()
            due = max(due + 1 / ((self._cursor.fps or DEFAULT_FPS) * self._speed),
                      time.monotonic() - 0.1)
            with self._change:
                self._change.wait_for(
                    lambda: self._closed or not self._playing,
                    max(due - time.monotonic(), 0))

    def _play_next(self) -> None:
        """Show the next image if still playing; pause with the last one.

        The cursor is held meanwhile, so that a seek that follows the last image finds
        the player paused, and one that follows a pause is not played on from.
        """
        with self._moving:
            if not self._playing:
                return
            try:
                more = self._next() and self._cursor.index < self._count
            except _FAILURES as error:
                more, self._error = False, str(error)
            if not more:
                with self._change:
                    self._playing = False

    def _own_status(self) -> dict[str, Any]:
        return {"playing": self._playing, "speed": self._speed,
                "index": max(self._cursor.index - 1, 0), "count": self._count,
                "start_us": self.fusion.start_us, "error": self._error,
                "problems": _told(self._recording.problems)}

    def close(self) -> None:
        """Stop, and close the recording if it is owned."""
        with self._change:
            self._closed = True
            self._change.notify_all()
        self._thread.join()
        if self._owned:
            self._recording.close()


def _told(problems: Iterable[Problem]) -> list[str]:
    """Return problems as text, with the count of those that occurred repeatedly."""
    return [f"{problem.count} {problem.message}" if problem.count > 1
            else problem.message for problem in problems]


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name} must be a number, got {value!r}")
    if not abs(value) < 1e15:
        raise ValueError(f"{name} must be finite, got {value!r}")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"method must be a name, got {value!r}")
    return value
