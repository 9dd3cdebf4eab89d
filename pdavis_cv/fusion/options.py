"""FusionOptions: the one list of the options of `fuse`.

The signatures of `fuse` and `VideoCapture` and the options of every command are made
from its fields: a field that is added here appears in all of them.
"""
from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import checked_rate, plain, real_number, typed
from pdavis_cv._options import Options, documented, option
from pdavis_cv._types import Parameters
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import checked_choice
from pdavis_cv.events import checked_time
from pdavis_cv.mosaic import DEMOSAIC_METHODS
from pdavis_cv.reconstruct.base import Factory
from pdavis_cv.reconstruct.methods import METHODS, MethodKeywords, factory_of
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.options import SourceKeywords, SourceOptions
from pdavis_cv.sensor import NOMINAL_THRESHOLDS, Layout
from pdavis_cv.turning import TurningAnalyser

_MOST_OFFSET_US = 1_000_000     # a larger offset means different cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class FusionOptions(Options):
    """Options of `fuse`, checked once; picklable.

    Parameters
    ----------
    parameters : mapping of str to object
        Parameters of the method, e.g. ``{"cutoff_hz": 1.6}`` for ``cf``.
    {options}

    Raises
    ------
    TypeError
        If a value has the wrong type.
    ValueError
        If a value is out of range.

    Examples
    --------
    >>> options = FusionOptions(fps=100, causal=True)
    >>> options.replace(method="cf", cutoff_hz=2.0).parameters["cutoff_hz"]
    2.0
    """

    method: str | Factory | None = option(
        None, "str or callable, optional",
        "One of ``METHODS``, or a callable that makes a `Reconstructor` of your own: "
        "its class, or a function ``(shape, *, theta_on, theta_off, **parameters)``.  "
        "It is also called with a small shape, to see what the method needs.  Default: "
        "``frames`` for a recording without events, ``events`` for one without frames, "
        "else ``DEFAULT_METHOD``.", "text",
        "how to fuse; default: what fits the file", METHODS)
    fps: float | None = option(
        None, "float, optional",
        "Images per second of recording time, at most 1,000,000: "
        "t_k = start + round(k * 1e6 / fps) while t_k < stop.  Default: one image per "
        "frame, at its mid-exposure; 100 per second if there are no frames.",
        "number", "images per second of recording time; default: one per frame, or "
        "100 per second if there are no frames")
    times_us: ArrayLike | None = option(
        None, "array_like of int, optional",
        "Times of the images in us, increasing; excludes `fps`, `start_us`, `stop_us`.",
        None)
    start_us: int | None = option(
        None, "int, optional",
        "Time of the first image, us; default: the mid-exposure of the first frame "
        "(the first event if no frame comes within 2 s).",
        "seconds", "time of the first image, seconds after the start of the recording")
    stop_us: int | None = option(
        None, "int, optional",
        "All images lie before this time, us; default: one past the last sample of any "
        "stream.", "seconds", "end of the images, exclusive, in the same seconds")
    layout: Layout | str | None = option(
        None, "Layout or str, optional",
        'Polarizer layout, or its name ("pdavis", "sony", "sony-rggb" with colours); '
        "default: that of the "
        "calibration, else of the recording, else PDAVIS with a LayoutWarning.",
        "layout",
        "polarizers of the 2x2 cell: pdavis, sony or four angles by row, "
        "e.g. 135,90,0,45, with colours as sony-rggb")
    analyser: TurningAnalyser | None = option(
        None, "TurningAnalyser, optional",
        "A polarizer that turns before an event camera without polarizers of its own; "
        "parameters are then those of `TurningRegression`.  Excludes `method`, "
        "`layout`, `calibration` and `denoise`.", None)
    calibration: Calibration | None = option(
        None, "Calibration, optional",
        "Calibration of this camera: dark frame, gain, thresholds, analyser matrix, "
        "bandwidth.",
        "calibration", "calibration of this camera, as written by pdavis calibrate")
    extinction_ratio: float | str | None = option(
        "nominal", 'float, "nominal" or None',
        "Extinction ratio of the polarizers, above 1, that S1 and S2 are corrected "
        'for; "nominal" takes that of the sensor, None makes no correction.  Unused if '
        "the calibration has an analyser matrix.", "ratio",
        "extinction ratio of the polarizers that S1 and S2 are corrected for: a "
        "number, nominal or none")
    demosaic: str = option(
        "bilinear", '{"bilinear", "superpixel", "binned", "guided"}',
        "How the four channels are interpolated, in linear intensity.",
        "text", choices=DEMOSAIC_METHODS)
    roi: tuple[int, int, int, int] | None = option(
        None, "(int, int, int, int), optional",
        "Region of interest, (x, y, width, height) in sensor pixels; the images are "
        "crops of those of the whole sensor.",
        "region", "region of interest, in sensor pixels")
    causal: bool = option(
        False, "bool",
        "Make each image only from data that had arrived by its time: a frame is used "
        "from the end of its readout on, otherwise from its mid-exposure on.  "
        "Parameters of the camera are then estimated while the stream passes, 0.12, "
        "0.24, 0.48 ... s after the first frame, and used from there on.", "flag",
        "make each image only from data that had arrived by its time")
    thresholds: str | tuple[ArrayLike, ArrayLike] | None = option(
        None, "str or (on, off), optional",
        '"calibration", "bias", "in-situ", "nominal", or contrast thresholds in '
        "natural-log units, scalars or (H, W); default: the first available of "
        "calibration, bias, nominal.  A method that learns, such as kalman, starts "
        "from these, or, where nobody states any, from 1.25 times the nominal ones, as "
        'sensors were measured.  "in-situ" lets other methods learn each pixel\'s '
        "thresholds from the first 10 s, before the first image; with `causal` only "
        "their common scale is learned, while the stream passes.", "thresholds",
        "calibration, bias, in-situ, nominal, or ON,OFF in natural-log units")
    nominal_thresholds: tuple[ArrayLike, ArrayLike] = option(
        NOMINAL_THRESHOLDS, "(on, off)",
        'Thresholds in natural-log units for "nominal", and if no others are known.',
        "pair", "thresholds ON,OFF to use if no others are known")
    clock_offset_us: float | str | None = option(
        "learned", 'float, "learned" or None',
        "Offset added to the frames' exposure times to bring them to the clock of the "
        "events, us; positive if events trail frames, as in a DAVIS346 by some ms.  "
        '"learned" takes that of the calibration; without one, a method that learns, '
        "such as kalman, learns it from the beginning of the recording (with `causal`, "
        "while the stream passes), and applies it if the data clearly ask for one.  "
        "None leaves the time stamps unchanged.  The times of images are on the clock "
        "of the events.", "offset",
        "microseconds to add to the frames' time stamps, learned, or none")
    denoise: bool | Parameters = option(
        False, "bool or mapping",
        "Leave out events that no neighbour behind the same polarizer supports, and "
        "those of hot pixels; parameters of `EventDenoiser`, or True for its defaults.",
        "flag", "leave out events that no neighbour behind the same polarizer "
        "supports, and those of hot pixels")
    threads: int = option(
        1, "int",
        "Number of threads that share the work of each image; it does not change the "
        "images.  With more than one, a recording is read ahead if its images "
        "have 65536 pixels or more; smaller ones gain little.  1 leaves the other "
        "cores to the program's own threads.", "count",
        "threads that share the work of an image; default: one per core from 65536 "
        "pixels on, else 1")

    def __post_init__(self) -> None:
        super().__post_init__()
        put = self._put
        if self.method is not None:
            factory_of(self.method)
        put("times_us", _checked_times(self))
        put("fps", checked_rate("fps", self.fps))
        for name in ("start_us", "stop_us"):
            put(name, plain(getattr(self, name)))
        if self.layout is not None:
            put("layout", Layout.of(self.layout))
        typed("analyser", self.analyser, TurningAnalyser | None,
              "a TurningAnalyser (of images: analyser_steps of open_recording)")
        typed("calibration", self.calibration, Calibration | None,
              "a Calibration, as Calibration.load(path) gives")
        ratio = self.extinction_ratio
        if isinstance(ratio, str):
            if ratio != "nominal":
                raise ValueError("extinction_ratio must be 'nominal', a number or "
                                 f"None, got {ratio!r}")
        elif ratio is not None and not 1 < real_number(ratio) < math.inf:
            raise ValueError(f"extinction_ratio must exceed 1, got {ratio!r}")
        if self.demosaic not in DEMOSAIC_METHODS:
            raise ValueError(
                f"demosaic must be one of {', '.join(DEMOSAIC_METHODS)}, got "
                f"{self.demosaic!r}")
        if self.roi is not None:
            try:
                x, y, width, height = (operator.index(value) for value in self.roi)
            except (TypeError, ValueError):
                raise TypeError("roi must be four integers (x, y, width, height), got "
                                f"{self.roi!r}") from None
            put("roi", (x, y, width, height))
        put("causal", bool(self.causal))
        if not isinstance(self.threads, (int, np.integer)) or self.threads < 1:
            raise ValueError(
                f"threads must be a whole number from 1, got {self.threads!r}")
        put("threads", int(self.threads))
        checked_choice(self.thresholds)
        put("clock_offset_us", _checked_offset(self.clock_offset_us))
        if isinstance(self.denoise, Mapping):
            put("denoise", dict(self.denoise))
        else:
            typed("denoise", self.denoise, bool | np.bool_,
                  "a bool or a mapping of parameters of EventDenoiser")
            put("denoise", bool(self.denoise))


class FusionKeywords(MethodKeywords, total=False):
    """The fields of FusionOptions as keywords, for type checkers and editors.

    What takes the options unpacks it, as type checkers do not see the signature that
    `names_options` writes.  Parameters of other packages' methods are given in
    `parameters`, or beside a `method` that is a class or a function.
    """

    parameters: Parameters
    method: str | Factory | None
    fps: float | None
    times_us: ArrayLike | None
    start_us: int | None
    stop_us: int | None
    layout: Layout | str | None
    analyser: TurningAnalyser | None
    calibration: Calibration | None
    extinction_ratio: float | str | None
    demosaic: str
    roi: tuple[int, int, int, int] | None
    causal: bool
    thresholds: str | tuple[ArrayLike, ArrayLike] | None
    nominal_thresholds: tuple[ArrayLike, ArrayLike]
    clock_offset_us: float | str | None
    denoise: bool | Parameters
    threads: int


class AllKeywords(FusionKeywords, SourceKeywords, total=False):
    """The options of a class that opens a source and fuses it."""


def fusion_part(parameters: Parameters) -> dict[str, Any]:
    """Return those parameters that do not only tell how a source is opened."""
    only = SourceOptions.facts().keys() - FusionOptions.facts().keys()
    return {name: value for name, value in parameters.items() if name not in only}


# ---- checks ----------------------------------------------------------------------


def _checked_times(options: FusionOptions) -> NDArray[np.int64] | None:
    for name in ("start_us", "stop_us"):
        value = getattr(options, name)
        typed(name, value, int | np.integer | None, "integer microseconds")
        if value is not None:
            checked_time(name, int(value))
    if options.times_us is None:
        return None
    if any(value is not None
           for value in (options.fps, options.start_us, options.stop_us)):
        raise TypeError("times_us excludes fps, start_us and stop_us")
    raw = np.asarray(options.times_us)
    if raw.ndim != 1 or (raw.size and raw.dtype.kind not in "iu"):
        raise TypeError(
            "times_us must be one-dimensional integer microseconds, got "
            f"{raw.dtype} {raw.shape}")
    times = raw.astype(np.int64)
    if np.any(times[1:] <= times[:-1]):
        raise ValueError("times_us must increase")
    for t in times[:1], times[-1:]:
        if t.size:
            checked_time("times_us", int(t[0]))
    return times


def check_times_fit(options: FusionOptions, info: RecordingInfo) -> None:
    """Raise ValueError if the images lie further from a recording than it is long.

    So do seconds, or times from its start, in place of its own microseconds.  Some of
    ``times_us`` may, and a ``stop_us`` after the end takes all.  Where the file does
    not tell its end, nothing is checked.
    """
    if info.start_us is None or info.stop_us is None:
        return
    span = info.stop_us - info.start_us
    given = [(name, value, value) for name in ("start_us", "stop_us")
             if (value := getattr(options, name)) is not None]
    if options.times_us is not None and np.size(options.times_us):
        times = np.asarray(options.times_us)
        given.append(("times_us", int(times[0]), int(times[-1])))
    for name, first, last in given:
        late = first > info.stop_us + span and name != "stop_us"
        if last < info.start_us - span or late:
            raise ValueError(
                f"{name} must be microseconds of the recording's clock, which runs "
                f"from {info.start_us} to {info.stop_us}, got {first}")


def _checked_offset(value: Any) -> float | str | None:
    if value is None or (isinstance(value, str) and value == "learned"):
        return value
    if isinstance(value, str) or not abs(float(value)) <= _MOST_OFFSET_US:
        raise ValueError(
            "clock_offset_us must be 'learned', None or within "
            f"{_MOST_OFFSET_US} of 0, got {value!r}")
    return float(value)


FusionOptions.__doc__ = documented(FusionOptions.__doc__, FusionOptions)
