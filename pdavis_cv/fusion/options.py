"""FusionOptions: the one list of the options of `fuse`.

The signatures of `fuse` and `VideoCapture` and the options of every command are made
from its fields: a field that is added here appears in all of them.
"""
from __future__ import annotations

import dataclasses
import inspect
import math
import operator
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType
from typing import (
    Any,
    Concatenate,
    ParamSpec,
    Protocol,
    TypedDict,
    TypeVar,
    cast,
    overload,
)

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import plain
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.thresholds import checked_choice
from pdavis_cv.events import checked_time
from pdavis_cv.mosaic import DEMOSAIC_METHODS
from pdavis_cv.reconstruct.base import Factory
from pdavis_cv.reconstruct.methods import METHODS, factory_of
from pdavis_cv.sensor import NOMINAL_THRESHOLDS, Layout

__all__ = ["FusionKeywords", "FusionOptions", "OptionFacts", "names_options",
           "takes_options"]

_MOST_FPS = 1_000_000
_MOST_OFFSET_US = 1_000_000     # a larger offset means different cameras


@dataclass(frozen=True)
class OptionFacts:
    """Type, help text and command-line form of an option.

    Parameters
    ----------
    type : str
        Type and unit, as they appear in a docstring.
    help : str
        One or more sentences.
    word : str or None
        How the command line parses it: ``"text"``, ``"number"``, ``"seconds"`` (after
        the start of the recording), ``"flag"``, ``"region"``, ``"layout"``,
        ``"calibration"`` (a file), ``"ratio"``, ``"offset"``, ``"thresholds"``,
        ``"pair"``; None = the command line does not offer it.
    brief : str
        Help text on the command line; default: the first sentence of `help`.
    choices : collection of str
        The allowed texts; empty = any.
    """

    type: str
    help: str
    word: str | None
    brief: str = ""
    choices: Collection[str] = ()


def _option(
    default: Any, type: str, help: str, word: str | None, brief: str = "",
    choices: Collection[str] = (),
) -> Any:
    return dataclasses.field(default=default, metadata={"facts": OptionFacts(
        type, help, word, brief, choices)})


@dataclass(frozen=True, kw_only=True, eq=False)
class FusionOptions:
    """Options of `fuse`, checked once; picklable.

    Parameters
    ----------
    {options}
    parameters : mapping of str to object
        Parameters of the method, e.g. ``{"cutoff_hz": 1.6}`` for ``cf``.

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

    method: str | Factory | None = _option(
        None, "str or callable, optional",
        "One of ``METHODS``, or a callable that makes a `Reconstructor` of your own: "
        "its class, or a function ``(shape, *, theta_on, theta_off, **parameters)``.  "
        "It is also called with a small shape, to see what the method needs.  Default: "
        "``frames`` for a recording without events, ``events`` for one without frames, "
        "else ``DEFAULT_METHOD``.", "text",
        "how to fuse; default: what fits the file", METHODS)
    fps: float | None = _option(
        None, "float, optional",
        "Images per second of recording time, at most 1,000,000: "
        "t_k = start + round(k * 1e6 / fps) while t_k < stop.  Default: one image per "
        "frame, at its mid-exposure; 100 per second if there are no frames.",
        "number", "images per second of recording time; default: one per frame, or "
        "100 per second if there are no frames")
    times_us: ArrayLike | None = _option(
        None, "array_like of int, optional",
        "Times of the images in us, increasing; excludes `fps`, `start_us`, `stop_us`.",
        None)
    start_us: int | None = _option(
        None, "int, optional",
        "Time of the first image, us; default: the mid-exposure of the first frame "
        "(the first event if no frame comes within 2 s).",
        "seconds", "time of the first image, seconds after the start of the recording")
    stop_us: int | None = _option(
        None, "int, optional",
        "All images lie before this time, us; default: one past the last sample of any "
        "stream.", "seconds", "end of the images, exclusive, in the same seconds")
    layout: Layout | str | None = _option(
        None, "Layout or str, optional",
        'Polarizer layout, or its name ("pdavis", "sony"); default: that of the '
        "calibration, else of the recording, else PDAVIS with a LayoutWarning.",
        "layout",
        "polarizers of the 2x2 cell: pdavis, sony or four angles by row, "
        "e.g. 135,90,0,45")
    calibration: Calibration | None = _option(
        None, "Calibration, optional",
        "Calibration of this camera: dark frame, gain, thresholds, analyser matrix, "
        "bandwidth.",
        "calibration", "calibration of this camera, as written by pdavis calibrate")
    extinction_ratio: float | str | None = _option(
        "nominal", 'float, "nominal" or None',
        "Extinction ratio of the polarizers, above 1, that S1 and S2 are corrected "
        'for; "nominal" takes that of the sensor, None makes no correction.  Unused if '
        "the calibration has an analyser matrix.", "ratio",
        "extinction ratio of the polarizers that S1 and S2 are corrected for: a "
        "number, nominal or none")
    demosaic: str = _option(
        "bilinear", '{"bilinear", "superpixel", "binned", "guided"}',
        "How the four channels are interpolated, in linear intensity.",
        "text", choices=DEMOSAIC_METHODS)
    roi: tuple[int, int, int, int] | None = _option(
        None, "(int, int, int, int), optional",
        "Region of interest, (x, y, width, height) in sensor pixels; the images are "
        "crops of those of the whole sensor.",
        "region", "region of interest, in sensor pixels")
    causal: bool = _option(
        False, "bool",
        "Make each image only from data that had arrived by its time: a frame is used "
        "from the end of its readout on, otherwise from its mid-exposure on.  "
        "Parameters of the camera are then estimated while the stream passes, 0.5, 1, "
        "2, 4 s ... after the first frame, and used from there on.", "flag",
        "make each image only from data that had arrived by its time")
    thresholds: str | tuple[ArrayLike, ArrayLike] | None = _option(
        None, "str or (on, off), optional",
        '"calibration", "bias", "in-situ", "nominal", or contrast thresholds in '
        "natural-log units, scalars or (H, W); default: the first available of "
        "calibration, bias, nominal.  By default a method that learns, such as kalman, "
        "corrects the common scale of bias or nominal thresholds if the beginning of "
        'the recording contradicts it.  "in-situ" starts from those and estimates each '
        "pixel's thresholds from the first 10 s, before the first image; with `causal` "
        "only the common scale is estimated, while the stream passes.", "thresholds",
        "calibration, bias, in-situ, nominal, or ON,OFF in natural-log units")
    nominal_thresholds: tuple[ArrayLike, ArrayLike] = _option(
        NOMINAL_THRESHOLDS, "(on, off)",
        'Thresholds in natural-log units for "nominal", and if no others are known.',
        "pair", "thresholds ON,OFF to use if no others are known")
    clock_offset_us: float | str | None = _option(
        "learned", 'float, "learned" or None',
        "Offset added to the frames' exposure times to bring them to the clock of the "
        "events, us; positive if events trail frames, as in a DAVIS346 by some ms.  "
        '"learned" takes that of the calibration; without one, a method that learns, '
        "such as kalman, estimates it from the beginning of the recording (with "
        "`causal`, while the stream passes), and applies it if it exceeds both three "
        "standard errors and 1 ms.  None leaves the time stamps unchanged.  The times "
        "of images are on the clock of the events.", "offset",
        "microseconds to add to the frames' time stamps, learned, or none")
    denoise: bool | Mapping[str, Any] = _option(
        False, "bool or mapping",
        "Leave out events that no neighbour behind the same polarizer supports, and "
        "those of hot pixels; parameters of `EventDenoiser`, or True for its defaults.",
        "flag", "leave out events that no neighbour behind the same polarizer "
        "supports, and those of hot pixels")
    threads: int = _option(
        1, "int",
        "Number of threads that share the work of each image; it does not change the "
        "images.  With more than one, a recording is read one image ahead.  They "
        "are faster from about 64,000 pixels on; 1 leaves the other cores to the "
        "program's own threads.", "count",
        "threads that share the work of an image; default: one per core above 65536 "
        "pixels, else 1")
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if self.method is not None:
            factory_of(self.method)
        put("times_us", _checked_times(self))
        _check_rate(self.fps)
        for name in ("fps", "start_us", "stop_us"):
            put(name, plain(getattr(self, name)))
        if self.layout is not None:
            put("layout", Layout.of(self.layout))
        if not isinstance(self.calibration, Calibration | None):
            raise TypeError("calibration must be a Calibration, got "
                            f"{type(self.calibration).__name__}")
        _check_extinction_ratio(self.extinction_ratio)
        if self.demosaic not in DEMOSAIC_METHODS:
            raise ValueError(
                f"demosaic must be one of {', '.join(DEMOSAIC_METHODS)}, got "
                f"{self.demosaic!r}")
        put("roi", _checked_roi(self.roi))
        put("causal", bool(self.causal))
        if not isinstance(self.threads, (int, np.integer)) or self.threads < 1:
            raise ValueError(
                f"threads must be a whole number from 1, got {self.threads!r}")
        put("threads", int(self.threads))
        checked_choice(self.thresholds)
        put("clock_offset_us", _checked_offset(self.clock_offset_us))
        put("denoise", _checked_denoise(self.denoise))
        put("parameters", MappingProxyType(dict(self.parameters)))

    def replace(self, **changes: Any) -> FusionOptions:
        """Return these options with some changed.

        Parameters
        ----------
        **changes
            Options by name; any other name is taken as a parameter of the method.
        """
        known = {name: value for name, value in changes.items() if name in _NAMES}
        parameters = {**self.parameters, **changes.pop("parameters", {})}
        parameters |= {name: value for name, value in changes.items()
                       if name not in _NAMES}
        return dataclasses.replace(self, **known, parameters=parameters)

    @classmethod
    def facts(cls) -> Mapping[str, OptionFacts]:
        """Return the `OptionFacts` of each option, by name."""
        return {one.name: one.metadata["facts"] for one in dataclasses.fields(cls)
                if "facts" in one.metadata}

    @property
    def times(self) -> NDArray[np.int64] | None:
        """Times of the images in us, None for a grid."""
        return None if self.times_us is None else np.asarray(self.times_us, np.int64)

    @property
    def rate(self) -> Fraction | None:
        """Images per second as an exact fraction, None if not given."""
        return None if self.fps is None else Fraction(self.fps)

    def __reduce__(self) -> tuple[Any, ...]:
        values = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        return _restored, ({**values, "parameters": dict(self.parameters)},)


class FusionKeywords(TypedDict, total=False):
    """The fields of FusionOptions as keywords, for type checkers and editors.

    A class that takes the options unpacks it in an overload of its ``__init__``, as
    type checkers do not see the signature that `names_options` writes.
    """

    method: str | Factory | None
    fps: float | None
    times_us: ArrayLike | None
    start_us: int | None
    stop_us: int | None
    layout: Layout | str | None
    calibration: Calibration | None
    extinction_ratio: float | str | None
    demosaic: str
    roi: tuple[int, int, int, int] | None
    causal: bool
    thresholds: str | tuple[ArrayLike, ArrayLike] | None
    nominal_thresholds: tuple[ArrayLike, ArrayLike]
    clock_offset_us: float | str | None
    denoise: bool | Mapping[str, Any]
    threads: int


_NAMES = frozenset(FusionOptions.facts())


def _restored(values: dict[str, Any]) -> FusionOptions:
    return FusionOptions(**values)


# ---- checks ----------------------------------------------------------------------


def _checked_times(options: FusionOptions) -> NDArray[np.int64] | None:
    for name in ("start_us", "stop_us"):
        value = getattr(options, name)
        if value is not None and not isinstance(value, (int, np.integer)):
            raise TypeError(
                f"{name} must be integer microseconds, got {type(value).__name__}")
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


def _check_rate(fps: Any) -> None:
    if fps is None:
        return
    try:
        rate = Fraction(fps)
    except (TypeError, ValueError, OverflowError):
        rate = Fraction(0)
    if not 0 < rate <= _MOST_FPS:
        raise ValueError(f"fps must lie in (0, {_MOST_FPS}], got {fps!r}")


def _check_extinction_ratio(value: Any) -> None:
    if value is None or (isinstance(value, str) and value == "nominal"):
        return
    if isinstance(value, str):
        raise ValueError(
            f"extinction_ratio must be 'nominal', a number or None, got {value!r}")
    if not 1 < float(value) < math.inf:
        raise ValueError(f"extinction_ratio must exceed 1, got {value}")


def _checked_roi(roi: Any) -> tuple[int, int, int, int] | None:
    if roi is None:
        return None
    try:
        x, y, width, height = (operator.index(value) for value in roi)
    except (TypeError, ValueError):
        raise TypeError(
            f"roi must be four integers (x, y, width, height), got {roi!r}") from None
    return x, y, width, height


def _checked_offset(value: Any) -> float | str | None:
    if value is None or (isinstance(value, str) and value == "learned"):
        return value
    if isinstance(value, str) or not abs(float(value)) <= _MOST_OFFSET_US:
        raise ValueError(
            "clock_offset_us must be 'learned', None or within "
            f"{_MOST_OFFSET_US} of 0, got {value!r}")
    return float(value)


def _checked_denoise(value: Any) -> bool | dict[str, Any]:
    if isinstance(value, Mapping):
        return dict(value)
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(
            "denoise must be a bool or a mapping of parameters of EventDenoiser, got "
            f"{type(value).__name__}")
    return bool(value)


# ---- signatures ------------------------------------------------------------------

_P = ParamSpec("_P")
_Source = TypeVar("_Source", contravariant=True)
_Made = TypeVar("_Made", covariant=True)


class _TakesOptions(Protocol[_Source, _P, _Made]):
    """A function of a source and options, as type checkers and editors see it."""

    @overload
    def __call__(
        self, recording: _Source, /, *_: _P.args, **options: _P.kwargs
    ) -> _Made: ...

    @overload
    def __call__(
        self, recording: _Source, options: FusionOptions | None = None, **changes: Any
    ) -> _Made: ...


def _takes(
    options: Callable[_P, FusionOptions]
) -> Callable[[Callable[Concatenate[_Source, ...], _Made]],
              _TakesOptions[_Source, _P, _Made]]:
    def decorate(
        function: Callable[Concatenate[_Source, ...], _Made]
    ) -> _TakesOptions[_Source, _P, _Made]:
        return cast("_TakesOptions[_Source, _P, _Made]", names_options(function))
    return decorate


takes_options = _takes(FusionOptions)
"""Decorate a function ``(source, options=None, **changes)`` so that its signature and
docstring, and type checkers, name the options."""

_F = TypeVar("_F", bound=Callable[..., Any])


def names_options(function: _F) -> _F:
    """Write the options into the signature and docstring of a function or class.

    Parameters
    ----------
    function : callable
        A function, or a class with an ``__init__``, that receives the options in its
        last parameter, ``**changes`` or another name.  A line ``{options}`` of its
        docstring is replaced by their description.

    Returns
    -------
    callable
        The same function or class.
    """
    called = vars(function)["__init__"] if inspect.isclass(function) else function
    found = inspect.signature(called)
    *own, rest = found.parameters.values()
    defaults = {one.name: one.default for one in dataclasses.fields(FusionOptions)}
    types = {one.name: one.type for one in dataclasses.fields(FusionOptions)}
    named = [inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name],
        annotation=types[name]) for name in FusionOptions.facts()]
    rest = rest.replace(name="method_parameters")
    vars(called)["__signature__"] = found.replace(parameters=[*own, *named, rest])
    if function.__doc__ is not None:
        function.__doc__ = "\n".join(_documented(function.__doc__))
    return function


def _documented(text: str) -> Iterator[str]:
    for line in text.splitlines():
        if line.strip() != "{options}":
            yield line
            continue
        indent = line[:len(line) - len(line.lstrip())]
        for name, facts in FusionOptions.facts().items():
            yield f"{indent}{name} : {facts.type}"
            for part in textwrap.wrap(facts.help, 84 - len(indent)):
                yield f"{indent}    {part}"


FusionOptions.__doc__ = "\n".join(_documented(FusionOptions.__doc__ or ""))
