"""Session: images of a live source while its data arrive."""
from __future__ import annotations

import atexit
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, Unpack, overload

import numpy as np

from pdavis_cv._options import names_options
from pdavis_cv._types import Closing, Events
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import Fusion
from pdavis_cv.fusion.options import (
    AllKeywords,
    FusionKeywords,
    FusionOptions,
    fusion_part,
)
from pdavis_cv.live.address import open_source
from pdavis_cv.live.base import endless
from pdavis_cv.live.clock import HostClock
from pdavis_cv.live.inbox import Inbox, Waiting
from pdavis_cv.live.recorder import Recorder
from pdavis_cv.live.statistics import Counter, Patience, SessionStats
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import Factory
from pdavis_cv.recording.base import (
    ApsFrame,
    Packet,
    PlainSource,
    Problem,
    RecordingInfo,
    Source,
    joined,
)
from pdavis_cv.recording.files import ProblemLog
from pdavis_cv.recording.options import SourceOptions, source_part

DEFAULT_FPS = 60
MOST_PUSHED = 64
"""Most images that `Session.push` returns; a second of them."""
KEPT_IMAGES = 8
"""Most images that wait for a slow reader; beyond, the oldest is skipped."""
KEPT_EVENTS_US = 200_000
"""Stream time for which events are kept, to draw pictures of them, us."""
LEAST_IMAGES_S = 0.04
"""Host time after the last image from which on the next one is made even if it is late,
s.  Engineering choice."""


class _Arriving(PlainSource):
    """The source that fusing reads: the packets of a session's inbox."""

    def __init__(
        self, info: RecordingInfo, packets: Iterator[Packet], realtime: bool
    ) -> None:
        self._info, self._packets, self.realtime = info, packets, realtime

    def packets(self) -> Iterator[Packet]:
        return self._packets

    def close(self) -> None:
        """Nothing to release."""


@names_options(FusionOptions, SourceOptions, rest="method_parameters")
class Session(Closing):
    """Images of a live source, made while its data arrive.

    One thread reads the source and never waits for fusing; another one fuses, with
    ``causal=True``.  If fusing is late, images are skipped; if it is more than 0.5 s
    late, events are dropped, time jumps to now, and `problems` counts the events
    dropped.  A source that is not ``realtime`` (a file, ``speed=0``) waits instead:
    nothing is skipped, and the images equal those of `fuse` with ``causal=True`` bit
    for bit.

    Iterate over it, or call `read`; several threads may also call `latest`.  Use it as
    a context manager, or call `close`, which also ends the recording.

    Parameters
    ----------
    where : path, address, Source or RecordingInfo
        As in `open_source`.  A RecordingInfo describes the packets that will be given
        to `push`; there are no threads then.
    record : path, optional
        AEDAT-4 file to write arriving packets to, independently of the images.
    {options}
    **method_parameters
        As in `fuse`; ``causal`` is always True, and `fps` is 60 by default.  Without
        `method`, the session takes the best one for the source, and changes to a
        cheaper one if that is too slow for long; `stats` names it.

    Raises
    ------
    TypeError, ValueError
        If an option is unknown or invalid.
    OSError
        If the source cannot be opened, or the file to record to cannot be made.

    Examples
    --------
    >>> from pdavis_cv import Layout
    >>> from pdavis_cv.data import example_recording
    >>> where = f"replay:{example_recording()}?speed=0"
    >>> with Session(where, method="cf", layout=Layout.PDAVIS,
    ...              roi=(0, 0, 8, 8)) as session:
    ...     session.read().dolp.shape
    (8, 8)
    """

    @overload
    def __init__(
        self, where: str | os.PathLike[str] | Source | RecordingInfo, *,
        record: str | os.PathLike[str] | None = ...,
        **parameters: Unpack[AllKeywords],
    ) -> None: ...

    @overload
    def __init__(
        self, where: str | os.PathLike[str] | Source | RecordingInfo, *,
        record: str | os.PathLike[str] | None = ..., method: Factory, **parameters: Any,
    ) -> None: ...

    def __init__(
        self, where: str | os.PathLike[str] | Source | RecordingInfo, *,
        record: str | os.PathLike[str] | None = None, **parameters: Any,
    ) -> None:
        options = FusionOptions().replace(**{
            "fps": DEFAULT_FPS, **fusion_part(parameters), "causal": True})
        self._source: Source | None = None
        if isinstance(where, RecordingInfo):
            self.info, name = endless(where), where.format
        else:
            self._source = open_source(where, **source_part(parameters))
            self.info, name = self._source.info, str(where)
        realtime = self._source is not None and self._source.realtime
        self._log = ProblemLog(name)
        self._lossy = realtime
        self._speed = float(getattr(self._source, "speed", 1.0))
        self._inbox = Inbox(realtime, self._log, waits=self._source is not None)
        self._seen: deque[Packet] = deque()
        self._seen_lock = threading.Lock()
        self._chosen = options.method is None
        self._recorder: Recorder | None = None
        self._last_recorder: Recorder | None = None
        self._change = threading.Condition()
        self._images: deque[PolarFrame] = deque()
        self._latest: tuple[int, PolarFrame | None] = (0, None)
        self._state = "waiting"
        self._first_frame: ApsFrame | None = None
        self._error: Exception | None = None
        self._closed = False
        self.clock = HostClock()
        self._clock_lock = threading.Lock()
        self._skipped = 0
        self._patience = Patience()
        self._events, self._made, self._latency = Counter(), Counter(), Counter()
        self._last_image_s = -np.inf
        self._threads: list[threading.Thread] = []
        self._wanted: Fusion | None = None
        self._ready = threading.Event()
        try:
            self._fusion = self._fusion_of(options)
            if record is not None:
                self.record(record)
        except BaseException:
            if self._source is not None and self._source is not where:
                self._source.close()
            raise
        # The recording is finished however the program ends.
        atexit.register(self.close)
        for target in (self._read, self._fuse) if self._source is not None else ():
            thread = threading.Thread(
                target=target, daemon=True, name=f"pdavis {target.__name__}")
            self._threads.append(thread)
            thread.start()

    def _fusion_of(self, options: FusionOptions) -> Fusion:
        return Fusion(_Arriving(
            self.info, map(self._kept, self._inbox), self._lossy), options)

    # ---- reading -----------------------------------------------------------------

    def _read(self) -> None:
        """Take packets from the source; runs in a thread of its own."""
        assert self._source is not None
        error: Exception | None = None
        self._ready.wait()
        try:
            for packet in self._source.packets():
                if self._closed:
                    break
                self._arrived(packet)
        except Exception as found:      # any kind is passed on to the reader of images
            error = found
        self._inbox.end(None if self._closed else error)

    def _arrived(self, packet: Packet) -> None:
        recorder = self._recorder
        if recorder is not None:
            recorder.add(packet)
        self._events.add(len(packet.events))
        if self._first_frame is None and packet.frames:
            self._first_frame = packet.frames[0]
        if packet.stop_us is not None:
            with self._clock_lock:
                self.clock.saw(
                    round((packet.stop_us - 1) / self._speed), time.monotonic())
        self._inbox.put(packet)
        with self._change:
            if self._state == "waiting":
                self._state = "running"
                self._change.notify_all()

    def record(self, path: str | os.PathLike[str] | None) -> None:
        """Start to record arriving packets to a file, or with None stop recording.

        Parameters
        ----------
        path : path or None
            AEDAT-4 file.

        Raises
        ------
        OSError
            If the file cannot be made.
        """
        recorder = None if path is None else Recorder(
            path, self.info, self._lossy, self._log)
        before, self._recorder = self._recorder, recorder
        self._last_recorder = recorder or before
        if before is not None:
            before.close()

    # ---- fusing ------------------------------------------------------------------

    def _fuse(self) -> None:
        """Make images from the packets that have arrived; runs in its own thread."""
        try:
            self._fusion.prepare()
            self._ready.set()
            while not self._closed and self._step():
                pass
        except Exception as error:      # any kind is passed on to the reader of images
            self._ready.set()
            self._finish("failed", error)
            return
        why = self._inbox.error
        self._finish("ended" if why is None else "failed", why)

    def _step(self) -> bool:
        """Advance to the next image, and make it unless late; False at the end."""
        if self._wanted is not None:
            self._fusion, self._wanted = self._wanted, None
        if self._patience.spent(self._inbox.jumps, time.monotonic()):
            self._be_cheaper()
        if not self._fusion.advance():
            return False
        if self._is_late():
            self._skipped += not self._skip()
            return True
        image = self._fusion.image()
        self._last_image_s = time.monotonic()
        self._patience.image_at(self._last_image_s)
        with self._clock_lock:
            shown_s = None if image.t_us is None else self.clock.host_s(
                round(image.t_us / self._speed))
        if shown_s is not None and self._lossy:
            self._latency.add(1e3 * (time.monotonic() - shown_s))
        self._give(image)
        return True

    def _is_late(self) -> bool:
        """Tell whether the image after this one could already be made."""
        t, newest, rate = self._fusion.t_us, self._inbox.newest_us, self._fusion.fps
        if not self._lossy or t is None or newest is None or rate is None:
            return False
        waited = time.monotonic() - self._last_image_s
        return newest - t > 1e6 / float(rate) and waited < LEAST_IMAGES_S

    def _skip(self) -> bool:
        """Skip this image and those after it but the last 64, if there are more.

        After a pause, which may be years if one time is wrong, they are not looked at.
        """
        t, newest, rate = self._fusion.t_us, self._inbox.newest_us, self._fusion.fps
        if t is None or newest is None or rate is None:
            return False
        count = int((newest - t) * float(rate) / 1e6) - MOST_PUSHED + 1
        if count > 0:
            self._skipped += count
            self._fusion.index += count - 1
        return count > 0

    def _be_cheaper(self) -> None:
        """Change to a cheaper method, unless the caller stated the method."""
        method = self._fusion.cheaper
        if not self._chosen or method is None:
            return
        self._log.add("cheaper method", method, f"{self._fusion.method} could not "
                      f"follow: {method} goes on")
        self._fusion = self._fusion_of(
            self._fusion.options.replace(method=method, parameters={}))

    def _give(self, image: PolarFrame) -> None:
        self._made.add(1)
        with self._change:
            while not self._lossy and len(self._images) >= KEPT_IMAGES and (
                    not self._closed):
                self._change.wait()
            if len(self._images) >= KEPT_IMAGES:
                self._images.popleft()
            self._images.append(image)
            self._latest = (self._latest[0] + 1, image)
            self._change.notify_all()

    def _finish(self, state: str, error: Exception | None) -> None:
        self._fusion.close()
        with self._change:
            self._state, self._error = state, error
            self._change.notify_all()

    def change(self, **options: Unpack[FusionKeywords]) -> None:
        """Continue with other options of `fuse`; the method's state is reset.

        Parameters
        ----------
        **options
            As in the constructor.

        Raises
        ------
        TypeError, ValueError
            If an option is unknown or invalid; nothing is changed then.
        """
        before = self._fusion.options
        if "method" in options:             # parameters of the old method are dropped
            before = FusionOptions(**{
                name: getattr(before, name) for name in FusionOptions.facts()})
            self._chosen = options["method"] is None
        wanted = self._fusion_of(before.replace(**{**options, "causal": True}))
        if self._source is None:
            self._fusion = wanted
        else:
            wanted.prepare()
            self._wanted = wanted

    # ---- images ------------------------------------------------------------------

    def push(self, packet: Packet) -> list[PolarFrame]:
        """Feed a packet and return the images that can be made now, at most 64.

        After a pause of the source, earlier ones are skipped, and counted in `stats`.

        This is for a session that was made from a RecordingInfo.

        Parameters
        ----------
        packet : Packet
            Not before any packet fed earlier; the session keeps its arrays.

        Returns
        -------
        list of PolarFrame

        Raises
        ------
        ValueError
            If the session has its own source, or is closed.
        """
        if self._source is not None:
            raise ValueError("push needs a session made of a RecordingInfo, and this "
                             f"one reads {self._log.name}")
        if self._closed:
            raise ValueError("push after close")
        self._arrived(packet)
        return list(self._known())

    def _known(self) -> Iterator[PolarFrame]:
        try:
            while self._fusion.advance():
                if self._skip():
                    continue
                image = self._fusion.image()
                self._made.add(1)
                self._latest = (self._latest[0] + 1, image)
                yield image
        except Waiting:
            return

    def read(self, timeout: float | None = None) -> PolarFrame | None:
        """Wait for the next image.

        Parameters
        ----------
        timeout : float, optional
            Longest wait, s.

        Returns
        -------
        PolarFrame or None
            None at the end of the source, and after `close`.

        Raises
        ------
        TimeoutError
            If no image came in this time.
        DeviceError, RecordingError
            If the source failed, once all images have been read.
        """
        if self._source is None:
            raise ValueError("read needs a source; images come from push")
        with self._change:
            come = self._change.wait_for(lambda: self._images or self.over, timeout)
            if not come:
                raise TimeoutError(f"{self._log.name}: no image for {timeout:g} s")
            if self._images and not self._closed:
                image = self._images.popleft()
                self._change.notify_all()
                return image
            if self._error is not None:
                raise self._error
            return None

    @property
    def over(self) -> bool:
        """Whether no further image will be made."""
        return self._closed or self._state in ("ended", "failed")

    def latest(
        self, after: int = 0, timeout: float | None = 0.0
    ) -> tuple[int, PolarFrame | None]:
        """Return the newest image; any number of threads may call it.

        Parameters
        ----------
        after : int
            Number of the image that the caller has; waits for a newer one.
        timeout : float, optional
            Longest wait, s.

        Returns
        -------
        number : int
            Counts from 1; `after` if none is newer.
        image : PolarFrame or None
        """
        with self._change:
            self._change.wait_for(lambda: self._latest[0] > after or self.over, timeout)
            return self._latest if self._latest[0] > after else (after, None)

    def __iter__(self) -> Iterator[PolarFrame]:
        while (image := self.read()) is not None:
            yield image

    # ---- what is known ---------------------------------------------------------------

    def _kept(self, packet: Packet) -> Packet:
        if not len(packet.events):
            return packet
        with self._seen_lock:
            self._seen.append(packet)
            newest = int(packet.events["t"][-1])
            while newest - int(self._seen[0].events["t"][-1]) > KEPT_EVENTS_US:
                self._seen.popleft()
        return packet

    def events(self, after_us: int, until_us: int) -> Events:
        """Return the events in (after_us, until_us], if within the last 0.2 s fused.

        Parameters
        ----------
        after_us, until_us : int

        Returns
        -------
        ndarray of EVENT_DTYPE, shape (N,)
        """
        with self._seen_lock:
            packets = list(self._seen)
        parts = [np.empty(0, EVENT_DTYPE)]
        for packet in packets:
            times = packet.events["t"]
            low, high = np.searchsorted(times, [after_us, until_us], "right")
            parts.append(packet.events[low:high])
        return joined(parts)

    @property
    def problems(self) -> Sequence[Problem]:
        """Problems so far: each kind once, with its count."""
        own = () if self._source is None else self._source.problems
        return (*own, *self._log.problems)

    @property
    def options(self) -> FusionOptions:
        """The options of `fuse` in use."""
        return self._fusion.options

    @property
    def fusion(self) -> Fusion:
        """The object that makes the images; it must not be advanced."""
        return self._fusion

    @property
    def first_frame(self) -> ApsFrame | None:
        """The first frame that arrived; None if there was none yet."""
        return self._first_frame

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the first packet has arrived.

        Parameters
        ----------
        timeout : float, optional
            Longest wait, s.

        Raises
        ------
        TimeoutError
            If nothing has arrived in this time.
        DeviceError, RecordingError
            If the source failed before anything arrived.
        """
        with self._change:
            if not self._change.wait_for(
                    lambda: self._state != "waiting" or self._closed, timeout):
                raise TimeoutError(
                    f"{self._log.name}: nothing arrived for {timeout:g} s")
            if self._state == "failed" and self._inbox.newest_us is None:
                assert self._error is not None
                raise self._error

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the images."""
        return self._fusion.shape

    @property
    def stats(self) -> SessionStats:
        """Statistics of the session."""
        packets, lag_us = self._inbox.waiting
        recorder = self._last_recorder
        with self._clock_lock:
            drift = self.clock.drift_ppm
        return SessionStats(
            state="ended" if self._closed else self._state,
            error=None if self._error is None else str(self._error),
            method=self._fusion.method, chosen=self._chosen,
            events_per_s=self._events.rate(), images_per_s=self._made.rate(),
            latency_ms=self._latency.quantile(0.5),
            latency_p95_ms=self._latency.quantile(0.95),
            queued_packets=packets, queued_ms=lag_us / 1000,
            dropped_events=self._inbox.dropped_events, jumps=self._inbox.jumps,
            skipped_images=self._skipped, drift_ppm=drift,
            recorded_events=0 if recorder is None else recorder.events,
            unrecorded_events=0 if recorder is None else recorder.dropped_events,
            recording=None if self._recorder is None else str(self._recorder.path),
            recording_error=None if recorder is None else recorder.error)

    # ---- the end -------------------------------------------------------------------

    def close(self) -> None:
        """Stop reading and finish the recording; may be called repeatedly."""
        with self._change:
            self._closed = True
            self._change.notify_all()
        if self._source is not None:
            self._source.close()
        self._inbox.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self.record(None)
        atexit.unregister(self.close)
