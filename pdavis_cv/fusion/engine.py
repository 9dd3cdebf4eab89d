"""Fusion: make polarization images of a recording at any time."""
from __future__ import annotations

import itertools
import os
from collections import deque
from collections.abc import Callable, Iterator
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdavis_cv
from pdavis_cv._advice import Advises
from pdavis_cv._checks import typed
from pdavis_cv._options import changed
from pdavis_cv._types import Events, Facts, Parameters
from pdavis_cv._workers import Begun, Workers
from pdavis_cv.calibration.corrected import FrameCorrection
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.colour_mosaic import COLOUR_REACH
from pdavis_cv.fusion.camera import (
    check_calibration_fits,
    check_layout_fits,
    chosen_layout,
    chosen_sensor,
    facts_used,
    resolved_extinction_ratio,
    response_of,
)
from pdavis_cv.fusion.feed import Feed
from pdavis_cv.fusion.grid import grid_count, grid_us
from pdavis_cv.fusion.images import ImageMaker
from pdavis_cv.fusion.learning import Learning, Tuning
from pdavis_cv.fusion.online_learning import OnlineLearning
from pdavis_cv.fusion.options import FusionOptions, check_times_fit
from pdavis_cv.fusion.snapshot import BEFORE, FusionSnapshot
from pdavis_cv.fusion.states import ArrivalState, InOrderState, make_state
from pdavis_cv.fusion.window import checked_roi, window_of
from pdavis_cv.mosaic import REACH, check_method
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import Needs, Reconstructor, parameters_of
from pdavis_cv.reconstruct.lamp import LampTracker
from pdavis_cv.reconstruct.methods import default_method, factory_of, make_reconstructor
from pdavis_cv.recording.base import ApsFrame, Packet, Recording, Source
from pdavis_cv.recording.facts import assumptions
from pdavis_cv.sensor import Layout

_AFTER = 2**62


class Fusion(Advises):
    """Iterate over the fused images of a source; return to any earlier position.

    The parameters are those of `fuse`.  `VideoCapture` is built on it.  Nothing is read
    before the first image, or a time, is asked for.

    Attributes
    ----------
    method : str
        The method in use.
    needs : Needs
        What the method requires.
    layout : Layout
        Layout of the whole sensor.
    roi : (int, int, int, int)
        (x, y, width, height) of the images on the sensor.
    window : Window
        The part of the sensor that is computed for them.
    shape : (int, int)
        (height, width) of the images.
    provenance : mapping of str to object
        Software, options and parameters that produce the images, as in every
        PolarFrame; the method's parameters are those in use at the last image.
    index : int
        Number of the next image; a larger one leaves out those before.
    """

    index: int
    method: str
    needs: Needs
    layout: Layout
    shape: tuple[int, int]
    _t: int | None

    def __init__(
        self, recording: Source, options: FusionOptions | None = None, **changes: Any
    ) -> None:
        if not isinstance(recording, Source):
            how = ("; open it first: with pdavis_cv.open_recording(path) as recording, "
                   "or pdavis_cv.open_source(address)"
                   if isinstance(recording, (str, os.PathLike)) else
                   "; pdavis_cv.recording_from_arrays makes one of arrays")
            raise TypeError(
                "recording must be a Recording (see open_recording) or a Source, got "
                f"{type(recording).__name__}{how}")
        options = changed(FusionOptions, options, changes)
        if options.analyser is not None:
            raise ValueError("analyser is an option of fuse(), of VideoCapture with a "
                             "recording, and of pdavis export")
        info = recording.info
        check_times_fit(options, info)
        if info.demosaic:
            options = options.replace(demosaic=info.demosaic)
        self.recording, self.options = recording, options
        check_calibration_fits(options.calibration, recording)
        self.layout = chosen_layout(options.layout, options.calibration, recording)
        sensor = chosen_sensor(options.layout, recording)
        ratio = resolved_extinction_ratio(options.extinction_ratio, sensor)
        self.roi = checked_roi(options.roi, info.sensor_size, options.demosaic)
        self._factory = factory_of(options.method or default_method(info))
        self._denoise = None if options.denoise is False else (
            {} if options.denoise is True else options.denoise)
        probe, parameters = self._probe_method()
        self._lookahead_us = probe.lookahead_us
        self._learning = Learning(
            recording, options, parameters, self.needs, probe.lookahead_us)
        self._workers = Workers(options.threads)
        self._clock_us = self._learning.prior.clock_us
        reach = REACH[options.demosaic]
        if self.layout.colours:
            check_method(options.demosaic, info.sensor_size, self.layout)
            reach += COLOUR_REACH[options.demosaic]
        self.window = window_of(self.roi, info.sensor_size, probe.margin + reach)
        self._images = ImageMaker(
            self.window, self.roi, self.layout, options.demosaic, ratio,
            options.calibration, sensor, self._workers)
        self.shape = self._images.shape
        self._fps = None if options.fps is None else Fraction(options.fps)
        self._times = None if options.times_us is None else np.asarray(options.times_us)
        if self._fps is None and self._times is None and info.frame_count == 0:
            self._fps = Fraction(100)
        self._grid_start = options.start_us
        self._packets: Iterator[Packet] | None = None
        self._closed = False
        self._tuning: Tuning | None = None
        self.provenance: Facts = MappingProxyType({
            "pdavis_cv": pdavis_cv.__version__, "method": self.method,
            "parameters": {name: value for name, value in parameters_of(probe).items()
                           if np.ndim(value) < 2},
            "clock_offset_us": self._clock_us,
            "causal": options.causal, "layout": str(self.layout),
            "extinction_ratio": ratio, "demosaic": options.demosaic, "roi": self.roi,
            "calibration": (known := options.calibration) and (
                known.serial, known.chip, known.sensor_size),
            "source": str(recording.path) if recording.path else info.format,
            "assumed": assumptions(facts_used(
                recording, options, self.layout, sensor, self._learning.thresholds
                if "theta_on" in probe.parameters else None))})
        self._reset()

    def _probe_method(self) -> tuple[Reconstructor, dict[str, Any]]:
        """Make a small method to check its parameters; return it and all parameters."""
        given = dict(self.options.parameters)
        size = self.recording.info.sensor_size
        # Parameters that are maps of the sensor need a method of the sensor's size.
        if all(np.ndim(value) < 2 for value in given.values()):
            size = min(size, (2, 2))
        response = response_of(
            self.layout, self.options.calibration, slice(0, size[0]), slice(0, size[1]))

        def made(parameters: Parameters) -> Reconstructor:
            return make_reconstructor(
                self._factory, size, 0.2, 0.2, parameters, response, self._denoise,
                FusionOptions.facts())

        probe = made(given)
        if self.options.causal and probe.lookahead_us != 0:
            # The caller's parameters override those that make the method causal.
            probe, given = (made({**probe.causal_parameters, **given}),
                            {**probe.causal_parameters, **given})
        if self.options.causal and probe.lookahead_us != 0:
            raise ValueError(
                "causal=True needs a method that does not look ahead, but "
                f"{probe.method} needs {probe.lookahead_us} us")
        if probe.lookahead_us is None and not isinstance(self.recording, Recording):
            raise ValueError(
                f"method {probe.method!r} needs the whole recording before its first "
                "image, got a Source that is read once")
        check_layout_fits(probe, self.layout)
        self.method, self.needs = probe.method, probe.needs
        self.cheaper = probe.cheaper
        return probe, given

    # ---- iteration -----------------------------------------------------------

    def __iter__(self) -> Iterator[PolarFrame]:
        return self

    def __next__(self) -> PolarFrame:
        if not self.advance():
            raise StopIteration
        return self.image()

    def __len__(self) -> int:
        """Return the number of all images, if options and the file's header tell it."""
        if self._times is not None:
            return len(self._times)
        end, start = self.recording.info.stop_us, self.start_us
        if end is None or self.fps is None:
            raise TypeError(f"Fusion has no length{self._advice('len')}")
        stop = end if self.options.stop_us is None else min(end, self.options.stop_us)
        return 0 if start is None else grid_count(stop - start, self.fps)

    @property
    def t_us(self) -> int | None:
        """Time of the last image, None before the first."""
        return self._t

    def prepare(self) -> None:
        """Do before the first `advance` what needs no data if ``causal`` is True."""
        if self._state is None:
            self._make_state()

    def advance(self) -> bool:
        """Process data up to the next image's time; return False at the end."""
        t = None if self._closed else self._next_time()
        if t is None:
            return False
        self._advance_to(t)
        self.index += 1
        self._t = t
        return True

    def image(self) -> PolarFrame:
        """Return the image at the time that `advance` reached.

        Raises
        ------
        ValueError
            If `advance` has not been called yet.
        """
        image = self._begun_image()
        return image if isinstance(image, PolarFrame) else image()

    def begin_image(self) -> Begun[PolarFrame] | PolarFrame:
        """Let another of at least two threads make `image`, with angle and degree."""
        image = self._begun_image()
        if isinstance(image, PolarFrame):
            return image
        make = image

        def made() -> PolarFrame:
            image = make()
            image.aop  # noqa: B018
            return image

        return self._workers.begin(made)

    def _begun_image(self) -> PolarFrame | Callable[[], PolarFrame]:
        if self._t is None or self._state is None:
            raise ValueError("image must follow a successful advance")
        method = self._state.method
        return self._images.begin(
            method, self._t, self._last_frame(method, self._t), self.provenance)

    # ---- repositioning -------------------------------------------------------

    def close(self) -> None:
        """End the threads that share the work of images; there is no further image."""
        self._closed = True
        self._workers.end()

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
        self._reset()

    def snapshot(self) -> FusionSnapshot:
        """Return the state between two images."""
        if self._state is None or self._feed is None:
            return FusionSnapshot(start_us=self._grid_start)
        return FusionSnapshot(
            self.index, self._grid_start, self._state.committed_us, self._t,
            self._state.snapshot(), tuple(self._frames), self._feed.reached_us,
            None if self._lamp is None else self._lamp.state(),
            None if self._online is None else self._online.state(),
            self._corrected.clipping, self._state.fed_us)

    def restore(self, snapshot: FusionSnapshot) -> None:
        """Go back to a snapshot of an equal Fusion.

        Raises
        ------
        ValueError
            If the snapshot belongs to another method, shape or parameters, or the
            source can be read only once.
        """
        typed("snapshot", snapshot, FusionSnapshot, "a FusionSnapshot")
        self.rewind()
        self._grid_start = snapshot.start_us
        if snapshot.state is None or snapshot.t_us is None:
            return
        self._make_state()
        assert self._state is not None
        if self._online is not None and snapshot.learning is not None:
            before = self._online.tuning
            self._online.restore(snapshot.learning)
            self._apply_changes(_AFTER, self._online.tuning.changes(before))
        self._state.restore(snapshot.state, snapshot.state_us, snapshot.fed_us)
        if self._lamp is not None and snapshot.lamp is not None:
            self._lamp.restore(snapshot.lamp)
        if snapshot.clipping is not None:
            self._corrected.clipping = snapshot.clipping
        self._frames.extend(snapshot.frames)
        self.index = snapshot.index
        self._open_feed(snapshot.fed_us, max((mid for mid, *_ in snapshot.frames),
                                             default=None), snapshot.reached_us)
        self._t, self._start_found = snapshot.t_us, True
        self._advance_to(snapshot.t_us)

    # ---- times ---------------------------------------------------------------

    @property
    def fps(self) -> Fraction | None:
        """Images per second of the grid, None for one image per frame or times."""
        if self._fps is None and self._times is None and self._grid_start is None:
            self._find_start()
        return self._fps

    @property
    def clock_offset_us(self) -> int:
        """Offset added to the frames' exposure times, us (`camera`)."""
        return self._known.clock_us

    @property
    def camera(self) -> Calibration:
        """The calibration of the options with what was learned, to start another from.

        With `causal` as at the last image, else as the recording's beginning tells.
        """
        return self._learning.camera(self._known)

    @property
    def _known(self) -> Tuning:
        return self._initial_tuning() if self._online is None else self._online.tuning

    @property
    def start_us(self) -> int | None:
        """Time of the first image, None if there is none."""
        if self._grid_start is None:
            self._find_start()
        return self._grid_start

    @property
    def stop_us(self) -> int | None:
        """Time that all images lie before, None = the end of the recording."""
        return self.options.stop_us

    @property
    def times_us(self) -> NDArray[np.int64] | None:
        """Times of the images that were asked for, None for a grid."""
        return self._times

    def _find_start(self) -> None:
        """Find the beginning of the stream; the feed yields nothing yet."""
        if self._feed is None:
            self._open_feed()
        assert self._feed is not None
        start = self._feed.first_us()
        if self._fps is None and self._times is None and not self._feed.has_frames:
            self._fps = Fraction(100)
        if self._grid_start is None:
            self._grid_start = start
        self._start_found = True

    def _next_time(self) -> int | None:
        if self._times is not None:
            return (int(self._times[self.index]) if self.index < len(self._times)
                    else None)
        if not self._start_found:
            self._find_start()
        assert self._feed is not None
        if self._fps is not None:
            start = self._grid_start
            t = None if start is None else start + grid_us(self.index, self._fps)
        else:
            t = self._next_frame_mid(self._feed)
        stop = self.options.stop_us
        if t is None or (stop is not None and t >= stop):
            return None
        return t if self._reaches(t) else None

    def _reaches(self, t: int) -> bool:
        """Return whether the source has a sample at or after t.

        In real time, frames are fed while that sample is waited for.  To use a frame
        takes several times as long as to make an image: used at t only, it would delay
        the image at t by that.
        """
        assert self._feed is not None
        if not (self.recording.realtime and self.options.causal):
            return self._feed.reaches(t)
        for due in self._feed.reaching(t):
            if due is None:
                return False
            self._feed_to(due)
        return True

    def _next_frame_mid(self, feed: Feed) -> int | None:
        if self._t is not None:
            after = self._t
        else:
            start = self.options.start_us
            after = BEFORE if start is None else start - 1
        # Because of the look-ahead, the next frame may have been fed already.
        fed: int | None = next((mid for mid, *_ in self._frames if mid > after), None)
        while fed is None and (fed := feed.frame_mid(after)) is None:
            settled = feed.read_on()
            if settled is None:
                return None
            # Feed while waiting, so that memory is bounded where no frame comes.
            self._feed_to(settled)
        return fed

    # ---- feeding -------------------------------------------------------------

    def _reset(self) -> None:
        """Return to the position before the first image; nothing is read."""
        self.index, self._t = 0, None
        self._frames: deque[tuple[int, int, float]] = deque()
        self._feed: Feed | None = None
        self._start_found = False       # whether `_find_start` was called
        self._state: InOrderState | ArrivalState | None = None
        self._online: OnlineLearning | None = None
        self._lamp: LampTracker | None = None
        self._corrected: FrameCorrection = FrameCorrection(self.options.calibration)

    def _open_feed(
        self, after_us: int | None = None, frames_after_us: int | None = None,
        reached_us: int | None = None,
    ) -> None:
        """Begin to read the source after what has been fed."""
        clock_us = self._known.clock_us
        source = self.recording
        if isinstance(source, Recording):
            # A frame that the offset moves to a later time has an earlier time stamp.
            self._packets = source.packets(
                None if after_us is None else after_us + 1 - max(clock_us, 0))
        elif self._packets is None:
            self._packets = source.packets()
        self._feed = Feed(
            self._packets, by_arrival=self.options.causal,
            has_frames=source.info.frame_count != 0, stop_us=source.info.stop_us,
            after_us=after_us, frames_after_us=frames_after_us, reached_us=reached_us,
            clock_us=clock_us)

    def _initial_tuning(self) -> Tuning:
        """Return the parameters for the first image, which may read the beginning."""
        if self._tuning is None:
            self._tuning = self._learning.prior
            if self._learning.wanted and not self.options.causal:
                source = self.recording
                if isinstance(source, Recording):
                    ahead = source.packets()
                else:
                    # The packets that are looked at are kept until they are fed.
                    self._packets, ahead = itertools.tee(source.packets())
                self._tuning = self._learning.beginning(source, ahead)
        return self._tuning

    def _make_state(self) -> None:
        """Make the state with the parameters for the first image."""
        tuning = self._initial_tuning()
        if self._learning.wanted and self.options.causal:
            self._online = OnlineLearning(
                self._learning, waits=not self.recording.realtime)
        self._state = make_state(
            self._method_factory(), self.window,
            None if self._online is None else self._online.sample,
            causal=self.options.causal)
        self._set_clock(tuning.clock_us)
        if self.needs.lamp:
            # Of the whole sensor, so that an image of a region equals the crop.
            self._lamp = LampTracker(
                self.recording.info.sensor_size, *tuning.photoreceptors)
        self._update_provenance(parameters_of(self._state.method))

    def _method_factory(self) -> Callable[[], Reconstructor]:
        """Return a function that makes the method for the window."""
        tuning, plane = self._initial_tuning(), self.window.plane
        response = response_of(
            self.window.layout(self.layout), self.options.calibration,
            self.window.rows, self.window.columns)

        def made() -> Reconstructor:
            method = make_reconstructor(
                self._factory, self.window.shape, plane(tuning.theta_on),
                plane(tuning.theta_off), self.window.planes(tuning.parameters),
                response, self._denoise)
            method.workers = self._workers
            return method

        return made

    def _update_provenance(self, parameters: Parameters) -> None:
        """Write the current parameters to the provenance of the images to come."""
        self.provenance = MappingProxyType(
            {**self.provenance, "parameters": dict(parameters),
             "clock_offset_us": self._clock_us})

    def _set_clock(self, clock_us: int) -> None:
        """Set what is added to the exposure times of the frames to come."""
        self._clock_us = clock_us
        if self._state is not None:
            self._state.set_clock(clock_us)
        if self._feed is not None:
            self._feed.clock_us = clock_us

    def _advance_to(self, t: int) -> None:
        ahead = self._lookahead_us
        target = _AFTER if ahead is None else t + ahead
        self._feed_to(target)
        if ahead is not None and self._state is not None:
            self._add_waves_until(target)
            self._state.settle(target)
        while len(self._frames) > 1 and self._frames[1][1] <= t:
            self._frames.popleft()

    def _add_waves_until(self, t_us: int) -> None:
        """Add the lamp's flicker up to t_us, all events until then having been fed."""
        assert self._state is not None
        for wave in () if self._lamp is None else self._lamp.advance(t_us):
            self._state.add_wave(wave)

    def _feed_to(self, target: int) -> None:
        """Feed everything up to target, inclusive; learn at the scheduled times."""
        self.prepare()
        if self._feed is None:
            self._open_feed()
        assert self._feed is not None
        assert self._state is not None
        online = self._online
        if online is not None and not self._learning.uses_frames:
            start = self._feed.first_us()
            if start is not None:
                online.begin(start, start)
        while True:
            look: int | None = None if online is None else online.next_us
            stop = target if look is None else min(look, target)
            for item in self._feed.until(stop):
                self._feed_item(item)
                if online is not None and online.next_us != look:
                    break           # the first frame has set the first time to learn
            else:
                self._state.mark_fed(stop)
                if online is None or look is None or look > target:
                    return
                self._apply_changes(look, online.look())

    def _feed_item(self, item: ApsFrame | Events) -> None:
        assert self._state is not None
        if isinstance(item, ApsFrame):
            self._frames.append((item.mid_us, item.available_us, item.exposure_ms or 1))
            if self.needs.frames:
                frame = self._corrected(item)
                if self.options.causal:     # it acts at its arrival
                    self._add_waves_until(frame.moved(self._clock_us).available_us)
                if self._lamp is not None:
                    self._lamp.add_frame(frame)
                self._state.add_frame(frame)
            if self._online is not None and self._learning.uses_frames:
                self._online.begin(item.mid_us, item.available_us)
        elif self.needs.events:
            for wave in self._lamp.push(item) if self._lamp is not None else ():
                self._state.add_wave(wave)
            self._state.add_events(item)

    def _apply_changes(self, t_us: int, changed: dict[str, Any]) -> None:
        """Change parameters from t_us on; the state before stays as it is."""
        assert self._state is not None
        assert self._online is not None
        moved_us = self._online.tuning.clock_us - self._clock_us
        if moved_us:
            self._set_clock(self._online.tuning.clock_us)
            if self.needs.frames:
                changed = {**changed, "frames_moved_us": moved_us}
        if changed:
            self._state.retune(t_us, changed)
        if self._lamp is not None and changed:
            self._lamp.retune(*self._online.tuning.photoreceptors)
        self._update_provenance(parameters_of(self._state.method))

    def _last_frame(
        self, method: Reconstructor, t: int) -> tuple[int, int, float] | None:
        arrived = self.options.causal or method.shows_at_readout
        return next((frame for frame in reversed(self._frames)
                     if frame[arrived] <= t), None)
