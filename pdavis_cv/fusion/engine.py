"""fuse(): polarization images at any time; the one place that orders time."""
from __future__ import annotations

import functools
import itertools
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdavis_cv
from pdavis_cv._workers import Workers, usable_cores
from pdavis_cv.calibration.corrected import FrameCorrection
from pdavis_cv.fusion.camera import (
    check_calibration_fits,
    check_layout_fits,
    chosen_layout,
    resolved_extinction_ratio,
    response_of,
)
from pdavis_cv.fusion.feed import Feed
from pdavis_cv.fusion.images import ImageMaker, Samples
from pdavis_cv.fusion.learning import Learning, OnlineLearning, Tuning
from pdavis_cv.fusion.options import FusionOptions, takes_options
from pdavis_cv.fusion.snapshot import BEFORE, FusionSnapshot
from pdavis_cv.fusion.states import AsItArrives, InOrder, Script, states_of
from pdavis_cv.fusion.window import Window, checked_roi, window_of
from pdavis_cv.mosaic import REACH
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import Needs, Reconstructor
from pdavis_cv.reconstruct.lamp import LampTracker
from pdavis_cv.reconstruct.methods import (
    default_method,
    factory_of,
    make_reconstructor,
)
from pdavis_cv.recording.base import ApsFrame, Packet, Recording, Source
from pdavis_cv.sensor import Layout

__all__ = ["Fusion", "fuse"]

_AFTER = 2**62


@takes_options
def fuse(
    recording: Source, options: FusionOptions | None = None, *,
    executor: Executor | None = None, tiles: int | None = None, by_time: bool = False,
    **changes: Any,
) -> Iterator[PolarFrame]:
    """Fuse a recording's frames and events into polarization images.

    Returns at once: nothing is read before the first image is asked for.

    Without `fps` and `times_us` there is one image per frame, at its mid-exposure
    (100 per second if there are no frames).  Whatever the interval, the recording is
    followed from its beginning, so an image at t is the same whichever images were
    asked for before it.

    Parameters
    ----------
    recording : Recording or Source
        From `open_recording` or `recording_from_arrays`, or what is read only once,
        such as `source_from_packets` makes: then in one pass and bounded memory.  Not
        `causal`, the first image of a Source may wait for its first 10 s, which tell
        what the method must know of the camera.
    options : FusionOptions, optional
        What to begin with; the keywords below change it.
    executor : concurrent.futures.Executor, optional
        Works on stripes of the sensor, to the same bits; the recording is read here.
        Where pixels depend on all others, as with ``kalman``, one worker has all.
    tiles : int, optional
        How many stripes, or pieces at a time; default one per core.
    by_time : bool
        Divide time instead: states are followed here, and again by the workers.
    {options}
    **method_parameters
        Passed to the method, e.g. ``cutoff_hz`` for ``cf``.

    Returns
    -------
    iterator of PolarFrame

    Raises
    ------
    TypeError
        If an argument has the wrong type or the method has no such parameter.
    ValueError
        If a value is out of range, e.g. a region that leaves the sensor.
    LayoutError, CalibrationError
        If layouts disagree, or the calibration is of another camera.

    Examples
    --------
    >>> import pdavis_cv
    >>> from pdavis_cv.data import example_recording
    >>> options = pdavis_cv.FusionOptions(method="cf", layout=pdavis_cv.Layout.PDAVIS)
    >>> with pdavis_cv.open_recording(example_recording()) as recording:
    ...     image = next(pdavis_cv.fuse(recording, options, roi=(0, 0, 40, 30)))
    >>> image.dolp.shape
    (30, 40)
    """
    if executor is None:
        return Fusion(recording, options, **changes)
    from pdavis_cv.fusion.stripes import fuse_tiles
    return fuse_tiles(recording, (options or FusionOptions()).replace(**changes),
                      executor, tiles or usable_cores(), by_time)


class Fusion:
    """Iterator over the fused images of a source, with exact repositioning.

    Parameters are those of `fuse`.  `VideoCapture` builds on it.  Nothing is read
    before the first image, or a time, is asked for.

    Attributes
    ----------
    method : str
        The method in use.
    needs : Needs
        What the method has to be given.
    layout : Layout
        Layout of the whole sensor.
    roi : (int, int, int, int)
        (x, y, width, height) of the images on the sensor.
    window : Window
        What is computed for them.
    margin : int
        Of the method: how many pixels around a pixel its result depends on.
    shape : (int, int)
        (height, width) of the images.
    provenance : mapping of str to object
        What produces the images, also in every PolarFrame; the parameters of the
        method are those in force at the last image.
    """

    method: str
    needs: Needs
    layout: Layout
    shape: tuple[int, int]
    _t: int | None
    _corrected: FrameCorrection

    def __init__(
        self, recording: Source, options: FusionOptions | None = None, **changes: Any
    ) -> None:
        if not isinstance(recording, Source):
            raise TypeError(
                "recording must be a Recording (see open_recording) or a Source, got "
                f"{type(recording).__name__}")
        options = (options or FusionOptions()).replace(**changes)
        info = recording.info
        self.recording, self.options = recording, options
        check_calibration_fits(options.calibration, recording)
        self.layout = chosen_layout(options.layout, options.calibration, recording)
        ratio = resolved_extinction_ratio(options.extinction_ratio, info.sensor)
        roi = checked_roi(options.roi, info.sensor_size, options.demosaic)
        self._factory = factory_of(options.method or default_method(info))
        self._denoise = None if options.denoise is False else (
            {} if options.denoise is True else options.denoise)
        asked, parameters = self._asked()
        self._lookahead_us = asked.lookahead_us
        self._learning = Learning(recording, options, parameters, self.needs)
        self._workers = Workers(options.threads)
        self._clock_us = self._learning.prior.clock_us
        self.roi, self.margin = roi, asked.margin
        self.window = window_of(
            roi, info.sensor_size, asked.margin + REACH[options.demosaic])
        self._images = ImageMaker(
            self.window, roi, self.layout, options.demosaic, ratio,
            options.calibration, info.sensor, self._workers)
        self.shape = self._images.shape
        self._fps, self._times = options.rate, options.times
        if self._fps is None and self._times is None and info.frame_count == 0:
            self._fps = Fraction(100)
        self._grid_start = options.start_us
        self._packets: Iterator[Packet] | None = None
        self._tuning: Tuning | None = None
        self.provenance: Mapping[str, Any] = MappingProxyType({
            "pdavis_cv": pdavis_cv.__version__, "method": self.method,
            "parameters": {name: value for name, value in asked.parameters.items()
                           if np.ndim(value) < 2},
            "clock_offset_us": self._clock_us,
            "causal": options.causal, "layout": str(self.layout),
            "extinction_ratio": ratio, "demosaic": options.demosaic, "roi": roi,
            "calibration": options.calibration and options.calibration.identity,
            "source": str(recording.path) if recording.path else info.format})
        self._begin()

    def _asked(self) -> tuple[Reconstructor, dict[str, Any]]:
        """Make the method small, to check its parameters and see what it needs."""
        given = dict(self.options.parameters)
        numbers = {name: value for name, value in given.items()
                   if not isinstance(value, str) or value != "in-situ"}
        size = self.recording.info.sensor_size
        # A small one will do, but for parameters that are maps of the sensor.
        if all(np.ndim(value) < 2 for value in numbers.values()):
            size = min(size, (2, 2))
        response = response_of(
            self.layout, self.options.calibration, slice(0, size[0]), slice(0, size[1]))

        def made(parameters: Mapping[str, Any]) -> Reconstructor:
            return make_reconstructor(
                self._factory, size, 0.2, 0.2, parameters, response, self._denoise)

        asked = made(numbers)
        if self.options.causal and asked.lookahead_us != 0:
            # What the caller says goes before what would make the method causal.
            asked, given = (made({**asked.causal_parameters, **numbers}),
                            {**asked.causal_parameters, **given})
        if self.options.causal and asked.lookahead_us != 0:
            raise ValueError(
                "causal=True needs a method that does not look ahead, but "
                f"{asked.method} needs {asked.lookahead_us} us")
        if asked.lookahead_us is None and not isinstance(self.recording, Recording):
            raise ValueError(
                f"method {asked.method!r} needs the whole recording before its first "
                "image, got a Source that is read once")
        check_layout_fits(asked, self.layout)
        self.method, self.needs = asked.method, asked.needs
        return asked, given

    # ---- iteration -----------------------------------------------------------

    def __iter__(self) -> Iterator[PolarFrame]:
        return self

    def __next__(self) -> PolarFrame:
        if not self.advance():
            raise StopIteration
        return self.image()

    @property
    def index(self) -> int:
        """Number of the image that comes next."""
        return self._index

    @property
    def t_us(self) -> int | None:
        """Time of the last image, None before the first."""
        return self._t

    def advance(self) -> bool:
        """Feed up to the next image's time; False at the end."""
        t = self._next_time()
        if t is None:
            return False
        self._advance_to(t)
        self._index += 1
        self._t = t
        return True

    def image(self) -> PolarFrame:
        """Return the image at the time that `advance` reached.

        Raises
        ------
        ValueError
            If nothing was advanced to yet.
        """
        if self._t is None or self._states is None:
            raise ValueError("image must follow a successful advance")
        method = self._states.method
        return self._images.image(
            method, self._t, self._frame_us(method, self._t), self.provenance)

    def made(
        self, samples: Samples, t_us: int, frame_us: int | None,
        provenance: Mapping[str, Any],
    ) -> PolarFrame:
        """Return the image of samples of the whole `window`."""
        return self._images.made(samples, t_us, frame_us, provenance)

    def frame_us(self) -> int | None:
        """Return the mid-exposure of the last frame that an image here would use."""
        assert self._t is not None and self._states is not None  # noqa: PT018
        return self._frame_us(self._states.method, self._t)

    # ---- repositioning -------------------------------------------------------

    def rewind(self) -> None:
        """Go back to before the first image.

        Raises
        ------
        ValueError
            If the source can be read only once and has been read.
        """
        if self._packets is not None and not isinstance(self.recording, Recording):
            raise ValueError(
                "a position needs a Recording, got a Source that is read once")
        self._begin()

    def snapshot(self) -> FusionSnapshot:
        """Return the state between two images."""
        if self._states is None or self._feed is None:
            return FusionSnapshot(start_us=self._grid_start)
        return FusionSnapshot(
            self._index, self._grid_start, self._states.behind_us, self._t,
            self._states.snapshot(), tuple(self._frames), self._feed.reached_us,
            None if self._lamp is None else self._lamp.state(),
            None if self._online is None else self._online.state(),
            self._corrected.clipping, self._states.fed_us)

    def restore(self, snapshot: FusionSnapshot) -> None:
        """Go back to a snapshot of an equal Fusion.

        Raises
        ------
        ValueError
            If the snapshot is of another method, shape or parameters, or the source
            can be read only once.
        """
        self.rewind()
        self._grid_start = snapshot.start_us
        if snapshot.state is None or snapshot.t_us is None:
            return
        self._start()
        assert self._states is not None
        if self._online is not None and snapshot.learning is not None:
            before = self._online.tuning
            self._online.restore(snapshot.learning)
            self._go_on_with(_AFTER, self._online.tuning.changes(before))
        self._states.restore(snapshot.state, snapshot.state_us, snapshot.fed_us)
        if self._lamp is not None and snapshot.lamp is not None:
            self._lamp.restore(snapshot.lamp)
        if snapshot.clipping is not None:
            self._corrected.clipping = snapshot.clipping
        self._frames.extend(snapshot.frames)
        self._index = snapshot.index
        self._open(snapshot.fed_us, max((mid for mid, _ in snapshot.frames),
                                        default=None), snapshot.reached_us)
        self._t, self._peeked = snapshot.t_us, True
        self._advance_to(snapshot.t_us)

    # ---- times ---------------------------------------------------------------

    @property
    def fps(self) -> Fraction | None:
        """Images per second of the grid, None for one image per frame or times."""
        if self._fps is None and self._times is None and self._grid_start is None:
            self._peek()
        return self._fps

    @property
    def clock_offset_us(self) -> int:
        """What is added to the frames' exposure times, us.

        Not `causal`, the beginning of the recording is read for it where it is to be
        learned; with `causal` it is what has been learned up to the last image.
        """
        if not self.options.causal:
            self._clock_us = self._learned().clock_us
        return self._clock_us

    @property
    def start_us(self) -> int | None:
        """Time of the first image, None if there is none."""
        if self._grid_start is None:
            self._peek()
        return self._grid_start

    @property
    def stop_us(self) -> int | None:
        """Images lie before this time, None = to the end of the recording."""
        return self.options.stop_us

    @property
    def times_us(self) -> NDArray[np.int64] | None:
        """Times that were asked for, None for a grid."""
        return self._times

    def _peek(self) -> None:
        """Find the beginning of the stream; nothing is handed out yet."""
        if self._feed is None:
            self._open()
        assert self._feed is not None
        start = self._feed.first_us()
        if self._fps is None and self._times is None and not self._feed.has_frames:
            self._fps = Fraction(100)
        if self._grid_start is None:
            self._grid_start = start
        self._peeked = True

    def _next_time(self) -> int | None:
        if self._times is not None:
            return (int(self._times[self._index]) if self._index < len(self._times)
                    else None)
        if not self._peeked:
            self._peek()
        assert self._feed is not None
        if self._fps is not None:
            start = self._grid_start
            t = None if start is None else start + round(
                Fraction(self._index * 1_000_000) / self._fps)
        else:
            t = self._next_frame_mid(self._feed)
        stop = self.options.stop_us
        if t is None or (stop is not None and t >= stop):
            return None
        return t if self._feed.reaches(t) else None

    def _next_frame_mid(self, feed: Feed) -> int | None:
        if self._t is not None:
            after = self._t
        else:
            start = self.options.start_us
            after = BEFORE if start is None else start - 1
        # Frames that the look-ahead has already fed come first.
        fed: int | None = next((mid for mid, _ in self._frames if mid > after), None)
        while fed is None and (fed := feed.frame_mid(after)) is None:
            settled = feed.read_on()
            if settled is None:
                return None
            # Flat in memory also where frames stay away.
            self._feed_to(settled)
        return fed

    # ---- feeding -------------------------------------------------------------

    def _begin(self) -> None:
        """Go back to before everything; nothing is read yet."""
        self._index, self._t = 0, None
        self._frames: deque[tuple[int, int]] = deque()
        self._feed: Feed | None = None
        self._peeked = False        # the beginning of the stream was found
        self._states: InOrder | AsItArrives | Script | None = None
        self._online: OnlineLearning | None = None
        self._lamp: LampTracker | None = None
        self._corrected: FrameCorrection = FrameCorrection(self.options.calibration)

    def _open(
        self, after_us: int | None = None, frames_after_us: int | None = None,
        reached_us: int | None = None,
    ) -> None:
        """Begin to read, after what has been fed."""
        clock_us = self._learned().clock_us
        if self._online is not None:
            clock_us = self._online.tuning.clock_us
        source = self.recording
        if isinstance(source, Recording):
            # A frame that is moved on may have been stamped before what has been fed.
            self._packets = source.packets(
                None if after_us is None else after_us + 1 - max(clock_us, 0))
        elif self._packets is None:
            self._packets = source.packets()
        self._feed = Feed(
            self._packets, by_arrival=self.options.causal,
            has_frames=source.info.frame_count != 0, stop_us=source.info.stop_us,
            after_us=after_us, frames_after_us=frames_after_us, reached_us=reached_us,
            clock_us=clock_us)

    @property
    def _learns_first(self) -> bool:
        return bool(self._learning.wanted) and not self.options.causal

    def _learned(self) -> Tuning:
        """Return what is known before the first image: not causal, by a beginning."""
        if self._tuning is None:
            self._tuning = self._learning.prior
            if self._learns_first:
                source = self.recording
                if isinstance(source, Recording):
                    ahead = source.packets()
                else:
                    # What is looked at is kept until it is fed.
                    self._packets, ahead = itertools.tee(source.packets())
                self._tuning = self._learning.beginning(source, ahead)
        return self._tuning

    def _start(self) -> None:
        """Make the states, with what is known before the first image."""
        tuning = self._learned()
        if self._learning.wanted and self.options.causal:
            self._online = OnlineLearning(self._learning)
        self._states = states_of(
            self.maker(self.window, self._workers), self.window,
            None if self._online is None else self._online.camera,
            causal=self.options.causal)
        self._set_clock(tuning.clock_us)
        if self.needs.lamp:
            # Over the whole sensor, so that an image of a region is the crop.
            self._lamp = LampTracker(
                self.recording.info.sensor_size, tuning.theta_on, tuning.theta_off,
                tuning.parameters.get("bandwidth"))
        self._say(self._states.method.parameters)

    def maker(
        self, window: Window, workers: Workers
    ) -> Callable[[], Reconstructor]:
        """Return what makes the method for a window, with what is known beforehand."""
        tuning, plane = self._learned(), window.plane
        response = response_of(window.layout(self.layout), self.options.calibration,
                               window.rows, window.columns)
        return functools.partial(
            _made, workers, self._factory, window.shape, plane(tuning.theta_on),
            plane(tuning.theta_off),
            window.planes(tuning.parameters), response, self._denoise)

    def _say(self, parameters: Mapping[str, Any]) -> None:
        """Put the parameters in force into the provenance of the images to come."""
        self.provenance = MappingProxyType(
            {**self.provenance, "parameters": dict(parameters),
             "clock_offset_us": self._clock_us})

    def _set_clock(self, clock_us: int) -> None:
        """Add this to the exposure times of the frames to come."""
        self._clock_us = clock_us
        if self._states is not None:
            self._states.set_clock(clock_us)
        if self._feed is not None:
            self._feed.clock_us = clock_us

    def _advance_to(self, t: int) -> None:
        ahead = self._lookahead_us
        target = _AFTER if ahead is None else t + ahead
        self._feed_to(target)
        if ahead is not None and self._states is not None:
            self._light_until(target)
            self._states.settle(target)
        while len(self._frames) > 1 and self._frames[1][1] <= t:
            self._frames.popleft()

    def _light_until(self, t_us: int) -> None:
        """Tell the states how the lamp flickers up to t_us; all events were there."""
        assert self._states is not None
        for wave in () if self._lamp is None else self._lamp.advance(t_us):
            self._states.add_wave(wave)

    def _feed_to(self, target: int) -> None:
        """Feed everything up to target, inclusive; learn at the times for it."""
        if self._states is None:
            self._start()
        if self._feed is None:
            self._open()
        assert self._feed is not None
        assert self._states is not None
        online = self._online
        while True:
            look: int | None = None if online is None else online.next_us
            stop = target if look is None else min(look, target)
            for item in self._feed.until(stop):
                self._take(item)
                if online is not None and online.next_us != look:
                    break           # the first frame: now there is a time to learn at
            else:
                self._states.passed(stop)
                if online is None or look is None or look > target:
                    return
                self._go_on_with(look, online.look())

    def _take(self, item: ApsFrame | NDArray[Any]) -> None:
        assert self._states is not None
        if isinstance(item, ApsFrame):
            self._frames.append((item.mid_us, item.available_us))
            if self.needs.frames:
                frame = self._corrected(item)
                if self.options.causal:         # it acts as soon as it is there
                    self._light_until(frame.moved(self._clock_us).available_us)
                if self._lamp is not None:
                    self._lamp.add_frame(frame)
                self._states.add_frame(frame)
            if self._online is not None:
                self._online.saw_frame(item.mid_us, item.available_us)
        elif self.needs.events:
            for wave in self._lamp.push(item) if self._lamp is not None else ():
                self._states.add_wave(wave)
            self._states.add_events(item)

    def _go_on_with(self, t_us: int, changed: dict[str, Any]) -> None:
        """Go on with other parameters; the state goes on, the past stays as it was."""
        assert self._states is not None
        assert self._online is not None
        moved_us = self._online.tuning.clock_us - self._clock_us
        if moved_us:
            self._set_clock(self._online.tuning.clock_us)
            if self.needs.frames:
                changed = {**changed, "frames_moved_us": moved_us}
        if changed:
            self._states.retune(t_us, changed)
        if self._lamp is not None and "bandwidth" in changed:
            self._lamp.retune(changed["bandwidth"])
        self._say(self._states.method.parameters)

    def _frame_us(self, method: Reconstructor, t: int) -> int | None:
        arrived = self.options.causal or method.shows_at_readout
        return next((mid for mid, available in reversed(self._frames)
                     if (available if arrived else mid) <= t), None)


def _made(workers: Workers, *described: Any) -> Reconstructor:
    """Return what `make_reconstructor` makes, with threads to share its rows."""
    made = make_reconstructor(*described)
    made.workers = workers
    return made
