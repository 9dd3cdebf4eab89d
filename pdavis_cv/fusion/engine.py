"""fuse(): polarization images at any time; the one place that orders time."""
from __future__ import annotations

import warnings
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdavis_cv
from pdavis_cv import _kernels
from pdavis_cv._feed import Feed, first_time
from pdavis_cv.analyser import Analyser
from pdavis_cv.calibration.corrected import corrected
from pdavis_cv.calibration.insitu import learned
from pdavis_cv.calibration.past import Past
from pdavis_cv.calibration.thresholds import resolve_thresholds
from pdavis_cv.errors import ExposureWarning
from pdavis_cv.fusion.camera import (
    analyser_of,
    check_calibration_fits,
    check_layout_fits,
    chosen_layout,
    gain_of,
    mismatch_of,
    resolved_extinction_ratio,
    response_of,
)
from pdavis_cv.fusion.options import FusionOptions, takes_options
from pdavis_cv.fusion.window import checked_roi, events_of, part_of, window_of
from pdavis_cv.mosaic import HALF_SIZE, demosaic_valid, demosaic_variance
from pdavis_cv.mosaic import demosaic as demosaic_mosaic
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import Reconstructor, Snapshot
from pdavis_cv.reconstruct.lamp import LampTracker, Wave
from pdavis_cv.reconstruct.methods import (
    default_method,
    factory_of,
    make_reconstructor,
)
from pdavis_cv.recording.base import ApsFrame, Recording, Source

__all__ = ["Fusion", "FusionSnapshot", "fuse"]

# With causal: how long after its mid-exposure a frame may arrive and still act.
_LONGEST_DELAY_US = 2_000_000
_BEFORE, _AFTER = -(2**62), 2**62


@takes_options
def fuse(
    recording: Source, options: FusionOptions | None = None, **changes: Any
) -> Iterator[PolarFrame]:
    """Fuse a recording's frames and events into polarization images.

    Without `fps` and `times_us` there is one image per frame, at its mid-exposure
    (100 per second if there are no frames).  Whatever the interval, the recording is
    followed from its beginning, so an image at t is the same whichever images were
    asked for before it.

    Parameters
    ----------
    recording : Recording
        From `open_recording` or `recording_from_arrays`.
    options : FusionOptions, optional
        What to begin with; the keywords below change it.
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
    return Fusion(recording, options, **changes)


@dataclass(frozen=True, eq=False)
class FusionSnapshot:
    """State of a `Fusion` between two images; picklable.

    Parameters
    ----------
    index : int
        Number of the next image.
    fed_us : int or None
        Time up to which, inclusive, the state has been fed; None = not at all.
    t_us : int or None
        Time of the last image.
    state : Snapshot
        Of the Reconstructor; with ``causal`` as of the last frame's mid-exposure.
    frames : tuple of (int, int)
        Mid-exposure and arrival of the latest frames fed.
    reached_us : int
        Time of the last sample read, which may lie before `fed_us`.
    lamp : mapping of str to object, or None
        State of the `LampTracker`, which has seen all events up to the last image.
    """

    index: int
    fed_us: int | None
    t_us: int | None
    state: Snapshot
    frames: tuple[tuple[int, int], ...]
    reached_us: int
    lamp: Mapping[str, Any] | None


class Fusion:
    """Iterator over the fused images of a recording, with exact repositioning.

    Parameters are those of `fuse`.  `VideoCapture` builds on it.

    Attributes
    ----------
    method : str
        The method in use.
    needs : Needs
        What the method has to be given.
    layout : Layout
        Layout of the whole sensor.
    shape : (int, int)
        (height, width) of the images.
    provenance : mapping of str to object
        What produces the images, also in every PolarFrame; with ``causal`` the
        parameters are those learned so far.
    """

    def __init__(
        self,
        recording: Source, options: FusionOptions | None = None, **changes: Any,
    ) -> None:
        if not isinstance(recording, Recording):
            raise TypeError(
                "recording must be a Recording (see open_recording), got "
                f"{type(recording).__name__}")
        options = (options or FusionOptions()).replace(**changes)
        info = recording.info
        self.recording, self.options = recording, options
        self._calibration = calibration = options.calibration
        check_calibration_fits(calibration, recording)
        self._factory = factory_of(options.method or default_method(info))
        self.layout = chosen_layout(options.layout, calibration, recording)
        self._demosaic, self._causal = demosaic, causal = (
            options.demosaic, options.causal)
        self.extinction_ratio = resolved_extinction_ratio(
            options.extinction_ratio, info.sensor)
        method_parameters = dict(options.parameters)
        self._roi = checked_roi(options.roi, info.sensor_size, demosaic)
        self._denoise = None if options.denoise is False else (
            {} if options.denoise is True else options.denoise)
        everything = (slice(0, info.sensor_size[0]), slice(0, info.sensor_size[1]))
        response = response_of(self.layout, self._calibration, *everything)

        def made(parameters: Mapping[str, Any]) -> Reconstructor:
            return make_reconstructor(
                self._factory, info.sensor_size, on, off, parameters, response,
                self._denoise)

        on, off = resolve_thresholds(
            recording, options.thresholds, options.nominal_thresholds, calibration)
        given = {name: value for name, value in method_parameters.items()
                 if not _is_in_situ(value)}
        whole = made(given)
        if causal and whole.lookahead_us != 0:
            # What the caller says goes before what would make the method causal.
            method_parameters = {**whole.causal_parameters, **method_parameters}
            whole = made({**whole.causal_parameters, **given})
        if causal and whole.lookahead_us != 0:
            raise ValueError(
                f"causal=True needs a method that does not look ahead, but "
                f"{whole.method} needs {whole.lookahead_us} us")
        self.method, self.needs = whole.method, whole.needs
        check_layout_fits(whole, self.layout)
        late = whole.lookahead_us == 0
        on, off, method_parameters = learned(
            recording, options.thresholds, (on, off), calibration, method_parameters,
            whole.needs, causal=self._causal, late=late)
        self._past: Past | None = None
        if whole.needs.learned and late:
            self._past = Past(
                recording, (on, off), self._calibration, method_parameters)
            method_parameters = self._past.parameters_at(_BEFORE)
        whole = made(method_parameters)
        self._window = window_of(self._roi, info.sensor_size, demosaic, whole.margin)
        rows, columns = self._window
        self._lookahead_us = whole.lookahead_us
        self._thresholds = (part_of(on, rows, columns), part_of(off, rows, columns))
        self._typical = float(np.mean(on)), float(np.mean(off))
        self._method_parameters = method_parameters
        self._window_layout = self.layout.crop(columns.start, rows.start)
        self._response = response_of(
            self._window_layout, self._calibration, rows, columns)
        self._crop = self._crop_of_window()
        self._analyser = analyser_of(
            self._calibration, self._window, self._window_layout, demosaic, self._crop)
        self._gain = gain_of(self._calibration, self._window, demosaic)
        self._mismatch = mismatch_of(info.sensor)
        null = (self._analyser or Analyser.ideal()).null()
        self._null = np.ascontiguousarray(null.reshape(4, *null.shape[1:] or (1, 1)))
        x, y, width, height = self._roi
        self.shape = ((height // 2, width // 2) if demosaic in HALF_SIZE
                      else (height, width))

        self._fps, self._times = options.rate, options.times
        self._start_us, self._stop_us = options.start_us, options.stop_us
        self._facts: dict[str, Any] = {
            "pdavis_cv": pdavis_cv.__version__, "method": self.method,
            "parameters": dict(whole.parameters), "causal": self._causal,
            "layout": str(self.layout), "extinction_ratio": self.extinction_ratio,
            "demosaic": demosaic, "roi": (x, y, width, height),
            "calibration": None if calibration is None else calibration.identity,
            "source": str(recording.path) if recording.path else info.format}
        self.provenance: Mapping[str, Any] = MappingProxyType(self._facts)
        self._index = 0
        self._t: int | None = None
        self._fed_us: int | None = None
        self._grid_start: int | None = None
        self._begin()

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
        if self._learn(t):
            # What has been learned holds for the past too: the images go on as if it
            # had been known from the beginning.
            self._start_over()
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
        if self._t is None:
            raise ValueError("image must follow a successful advance")
        estimate = self._current.read(self._t)
        intensity = self._current.intensity(estimate.log_intensity)
        if self._gain is not None:
            intensity /= self._gain
        quad = demosaic_mosaic(intensity, self._window_layout, self._demosaic,
                               valid=estimate.valid)
        valid = demosaic_valid(estimate.valid, self._window_layout, self._demosaic)
        variance = None if estimate.variance is None else demosaic_variance(
            estimate.variance, self._window_layout, self._demosaic,
            valid=estimate.valid)
        quality = self._current.quality
        if quality is not None and self._demosaic in HALF_SIZE:
            quality = quality[::2, ::2].copy()
        if self._crop is not None:
            rows, columns = self._crop
            quad = np.ascontiguousarray(quad[:, rows, columns])
            valid = np.ascontiguousarray(valid[rows, columns])
            variance = None if variance is None else np.ascontiguousarray(
                variance[:, rows, columns])
            quality = None if quality is None else quality[rows, columns].copy()
        if variance is not None:
            if self._analyser is None:
                _kernels.mismatch(quad, *self._mismatch, variance)
            # The four channels measure three numbers: weighted least squares.
            _kernels.reconcile(quad, variance, self._null)
        # The arrays are new and nobody else's: the image takes them over.
        return PolarFrame.adopt(
            quad, valid=valid, t_us=self._t, frame_us=self._frame_us(self._t),
            extinction_ratio=(
                self.extinction_ratio if self._analyser is None else None),
            analyser=self._analyser, variance=variance, provenance=self.provenance,
            quality=quality, reconciled=variance is not None)

    # ---- repositioning -------------------------------------------------------

    def rewind(self) -> None:
        """Go back to before the first image."""
        self._begin()

    def snapshot(self) -> FusionSnapshot:
        """Return the state between two images."""
        state = (self._lagged or self._current).snapshot()
        return FusionSnapshot(
            self._index, self._fed_us, self._t, state, tuple(self._frames),
            self._feed.reached_us, None if self._lamp is None else self._lamp.state())

    def restore(self, snapshot: FusionSnapshot) -> None:
        """Go back to a snapshot of an equal Fusion.

        Raises
        ------
        ValueError
            If the snapshot is of another method, shape or parameters.
        """
        self._begin(snapshot.t_us)
        self._current.restore(snapshot.state)
        if self._lagged is not None:
            self._lagged.restore(snapshot.state)
        if self._lamp is not None and snapshot.lamp is not None:
            self._lamp.restore(snapshot.lamp)
        self._frames.extend(snapshot.frames)
        self._index, self._fed_us = snapshot.index, snapshot.fed_us
        self._feed = Feed(
            self.recording, snapshot.fed_us,
            max((mid for mid, _ in snapshot.frames), default=None),
            by_arrival=self._causal, reached_us=snapshot.reached_us)
        self._t = snapshot.t_us
        if snapshot.t_us is not None:
            self._advance_to(snapshot.t_us)

    # ---- times ---------------------------------------------------------------

    @property
    def fps(self) -> Fraction | None:
        """Images per second of the grid, None for one image per frame or times."""
        return self._fps

    @property
    def start_us(self) -> int | None:
        """Time of the first image, None if there is none."""
        if self._grid_start is None:
            self._grid_start = first_time(self.recording)
        return self._grid_start

    @property
    def stop_us(self) -> int | None:
        """Images lie before this time, None = to the end of the recording."""
        return self._stop_us

    @property
    def times_us(self) -> NDArray[np.int64] | None:
        """Times that were asked for, None for a grid."""
        return self._times

    def _next_time(self) -> int | None:
        if self._times is not None:
            return (int(self._times[self._index]) if self._index < len(self._times)
                    else None)
        if self._fps is not None:
            start = self.start_us
            t = None if start is None else start + round(
                Fraction(self._index * 1_000_000) / self._fps)
        else:
            t = self._next_frame_mid()
        if t is None or (self._stop_us is not None and t >= self._stop_us):
            return None
        return t if self._feed.reaches(t) else None

    def _next_frame_mid(self) -> int | None:
        if self._t is not None:
            after = self._t
        else:
            after = _BEFORE if self._start_us is None else self._start_us - 1
        # Frames that the look-ahead has already fed come first.
        fed = next((mid for mid, _ in self._frames if mid > after), None)
        return self._feed.next_frame_mid(after) if fed is None else fed

    # ---- feeding -------------------------------------------------------------

    def _begin(self, t_us: int | None = None) -> None:
        """Go back to before everything, with what is known at t_us."""
        self._learn(_BEFORE if t_us is None else t_us)
        self._index, self._t = 0, None
        self._start_over()
        self._grid_start = self._start_us
        if self._fps is None and self._times is None and not self._feed.has_frames:
            self._fps = Fraction(100)

    def _start_over(self) -> None:
        """Forget what was fed; the number and time of the last image stay."""
        self._current = self._make()
        # With causal, a second state stays behind at the last frame's mid-exposure:
        # when a frame arrives, it is advanced, and what followed is replayed.
        self._lagged = (
            self._make() if self._causal and self.needs.frames else None)
        # Over the whole sensor, so that an image of a region is the crop.
        self._lamp = LampTracker(
            self.recording.info.sensor_size, *self._typical,
            self._method_parameters.get("bandwidth"),
        ) if self.needs.lamp else None
        self._backlog: deque[NDArray[Any]] = deque()
        self._frames: deque[tuple[int, int]] = deque()
        self._fed_us = None
        self._feed = Feed(self.recording, by_arrival=self._causal)

    def _learn(self, t_us: int) -> bool:
        """Take over what the past of t_us tells; False if nothing is new."""
        if self._past is None:
            return False
        parameters = self._past.parameters_at(t_us)
        if parameters is self._method_parameters:
            return False
        self._method_parameters = parameters
        told = {key: parameters[key] for key in ("bandwidth", "noise")
                if key in parameters}
        self.provenance = MappingProxyType({
            **self._facts, "parameters": {**self._facts["parameters"], **told}})
        return True

    def _make(self) -> Reconstructor:
        rows, columns = self._window
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        return make_reconstructor(
            self._factory, shape, *self._thresholds, self._method_parameters,
            self._response, self._denoise)

    def _advance_to(self, t: int) -> None:
        ahead = self._lookahead_us
        target = None if ahead is None else t + ahead
        for item in self._feed.until(target):
            if isinstance(item, ApsFrame):
                self._add_frame(item)
            else:
                self._add_events(item)
        if self._lamp is not None and target is not None:
            for wave in self._lamp.advance(target):
                self._add_wave(wave)
        if self._lagged is None:
            self._fed_us = _AFTER if target is None else target
        while len(self._frames) > 1 and self._frames[1][1] <= t:
            self._frames.popleft()

    def _add_events(self, events: NDArray[Any]) -> None:
        if not self.needs.events:
            return
        for wave in self._lamp.push(events) if self._lamp is not None else ():
            self._add_wave(wave)
        events = events_of(events, self._window, self.recording.info.sensor_size)
        if not len(events):
            return
        self._current.add_events(events)
        if self._lagged is not None:
            self._backlog.append(events)
            self._advance_lagged(int(events["t"][-1]) - _LONGEST_DELAY_US)

    def _add_wave(self, wave: Wave) -> None:
        self._current.add_wave(wave)
        if self._lagged is not None:
            self._lagged.add_wave(wave)

    def _add_frame(self, frame: ApsFrame) -> None:
        self._frames.append((frame.mid_us, frame.available_us))
        if not self.needs.frames:
            return
        frame = corrected(frame, self._calibration)
        if self._lamp is not None:
            self._lamp.add_frame(frame)
        frame = frame.cropped(*self._window)
        if self._lagged is None:
            self._current.add_frame(frame)
            return
        mid = frame.mid_us
        if self._fed_us is not None and mid <= self._fed_us:
            warnings.warn(
                f"the frame exposed at {mid} us arrived more than "
                f"{_LONGEST_DELAY_US} us later: left out", ExposureWarning,
                stacklevel=2)
            return
        self._advance_lagged(mid)
        self._fed_us = mid - 1
        self._lagged.add_frame(frame)
        self._current.restore(self._lagged.snapshot())
        for events in self._backlog:
            self._current.add_events(events)

    def _advance_lagged(self, before_us: int) -> None:
        """Feed the backlog before before_us to the state that lags behind."""
        assert self._lagged is not None
        while self._backlog and self._backlog[0]["t"][0] < before_us:
            events = self._backlog.popleft()
            n = bisect_left(events["t"], before_us)
            self._lagged.add_events(events[:n])
            self._fed_us = before_us - 1
            if n < len(events):
                self._backlog.appendleft(events[n:])

    def _frame_us(self, t: int) -> int | None:
        arrived = self._causal or self._current.shows_at_readout
        return next((mid for mid, available in reversed(self._frames)
                     if (available if arrived else mid) <= t), None)

    # ---- the window that is computed, and the calibration of it ----------------

    def _crop_of_window(self) -> tuple[slice, slice] | None:
        """Return the part of the window that the region is; None = all of it."""
        (rows, columns), (x, y, width, height) = self._window, self._roi
        if (x, y, x + width, y + height) == (
                columns.start, rows.start, columns.stop, rows.stop):
            return None
        scale = 2 if self._demosaic in HALF_SIZE else 1
        top, left = (y - rows.start) // scale, (x - columns.start) // scale
        return (slice(top, top + height // scale),
                slice(left, left + width // scale))


def _is_in_situ(value: Any) -> bool:
    return isinstance(value, str) and value == "in-situ"
