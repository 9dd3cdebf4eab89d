"""FusionOptions: the one list of what `fuse` can be asked for.

`fuse`, `VideoCapture` and the options of every command are made from its fields: a
field that is added here appears in all of them.
"""
from __future__ import annotations

import dataclasses
import inspect
import math
import operator
import textwrap
from collections.abc import Callable, Iterator, Mapping
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
_MOST_OFFSET_US = 1_000_000     # beyond, frames and events are not of one camera


@dataclass(frozen=True)
class OptionFacts:
    """What is known of an option besides its name and default.

    Parameters
    ----------
    type : str
        Type and unit, as a docstring gives them.
    help : str
        One or more sentences.
    word : str or None
        How a command line reads it: ``"text"``, ``"number"``, ``"seconds"`` (after the
        start of the recording), ``"flag"``, ``"region"``, ``"layout"``,
        ``"calibration"`` (a file), ``"ratio"``, ``"offset"``, ``"thresholds"``,
        ``"pair"``; None = not at all.
    brief : str
        Help on the command line; default: the first sentence of `help`.
    choices : tuple of str
        The only texts that are possible; none = any.
    """

    type: str
    help: str
    word: str | None
    brief: str = ""
    choices: tuple[str, ...] = ()


def _option(
    default: Any, type: str, help: str, word: str | None, brief: str = "",
    choices: tuple[str, ...] = (),
) -> Any:
    return dataclasses.field(default=default, metadata={"facts": OptionFacts(
        type, help, word, brief, choices)})


@dataclass(frozen=True, kw_only=True, eq=False)
class FusionOptions:
    """What `fuse` is asked for, checked once; picklable.

    Parameters
    ----------
    {options}
    parameters : mapping of str to object
        Of the method, e.g. ``{"cutoff_hz": 1.6}`` for ``cf``.

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
        "One of ``METHODS``, or what makes a `Reconstructor` of your own: its class "
        "or a function ``(shape, *, theta_on, theta_off, **parameters)``, also called "
        "with a small shape to see what it makes.  Default: what fits the "
        "recording (``frames`` without events, ``events`` without frames, else "
        "``DEFAULT_METHOD``).", "text",
        f"how to fuse: {', '.join(METHODS)}; default: what fits the file")
    fps: float | None = _option(
        None, "float, optional",
        "Images per second of recording time, at most 1,000,000: "
        "t_k = start + round(k * 1e6 / fps) while t_k < stop.  Default: one image for "
        "each frame, at its mid-exposure; 100 per second without frames.",
        "number", "images per second of the recording; default: one for each frame, "
        "100 per second without frames")
    times_us: ArrayLike | None = _option(
        None, "array_like of int, optional",
        "Times of the images in us, increasing; excludes `fps`, `start_us`, `stop_us`.",
        None)
    start_us: int | None = _option(
        None, "int, optional",
        "First time of an image, us; default: the mid-exposure of the first frame (the "
        "first event if no frame comes within 2 s).",
        "seconds", "first image, seconds after the start of the recording")
    stop_us: int | None = _option(
        None, "int, optional",
        "Images lie before this time, us; default: one past the last sample of any "
        "stream.", "seconds", "end, in the same seconds, exclusive")
    layout: Layout | str | None = _option(
        None, "Layout or str, optional",
        'Polarizer layout, or its name ("pdavis", "sony"); default: that of the '
        "calibration, of the recording, else PDAVIS with a LayoutWarning.", "layout",
        "polarizers of the 2x2 cell: pdavis, sony or four angles by row, "
        "e.g. 135,90,0,45")
    calibration: Calibration | None = _option(
        None, "Calibration, optional",
        "Of this camera: dark, gain, thresholds, analyser matrix, bandwidth.",
        "calibration", "what is known of this camera, as pdavis calibrate wrote it")
    extinction_ratio: float | str | None = _option(
        "nominal", 'float, "nominal" or None',
        "Contrast of the polarizers, above 1, that S1 and S2 are corrected for; "
        '"nominal" takes the sensor\'s, None corrects nothing.  Unused where the '
        "calibration has an analyser matrix.", "ratio",
        "contrast of the polarizers that S1 and S2 are corrected for: a number, "
        "nominal or none")
    demosaic: str = _option(
        "bilinear", '{"bilinear", "superpixel", "binned", "guided"}',
        "How the four channels are brought to one place; linear intensity is used.",
        "text", choices=DEMOSAIC_METHODS)
    roi: tuple[int, int, int, int] | None = _option(
        None, "(int, int, int, int), optional",
        "(x, y, width, height) in sensor pixels; gives the crop of the full result.",
        "region", "part of the sensor, in pixels")
    causal: bool = _option(
        False, "bool",
        "Use only what had arrived at t: a frame changes the state when its readout "
        "ends.  Otherwise it acts from its mid-exposure on.  What a method learns of "
        "the camera it then learns as the stream passes, 0.5, 1, 2, 4 s ... after the "
        "first frame, and goes on with.", "flag",
        "use only what had arrived at each time")
    thresholds: str | tuple[ArrayLike, ArrayLike] | None = _option(
        None, "str or (on, off), optional",
        '"calibration", "bias", "in-situ", "nominal", or contrast thresholds in '
        "natural-log units, scalars or (H, W); default: the first available of "
        "calibration, bias, nominal.  By default a method that learns, as kalman, "
        "corrects the scale of bias or nominal ones that all pixels share where the "
        'beginning of the recording contradicts it.  "in-situ" starts from those and '
        "finds each pixel's from the first 10 s, before the first image; with `causal` "
        "nothing is looked at before its time, and only the scale found.", "thresholds",
        "calibration, bias, in-situ, nominal, or ON,OFF in natural-log units")
    nominal_thresholds: tuple[ArrayLike, ArrayLike] = _option(
        NOMINAL_THRESHOLDS, "(on, off)",
        'Natural-log units; used for "nominal", and where nothing better is known.',
        "pair", "thresholds ON,OFF where nothing better is known")
    clock_offset_us: float | str | None = _option(
        "learned", 'float, "learned" or None',
        "What is added to the frames' exposure times to bring them to the clock of the "
        "events, us; positive where events trail frames, as in a DAVIS346 by some ms.  "
        '"learned" takes the calibration\'s, else a method that learns, as kalman, '
        "finds it from the beginning of the recording (with `causal`, as the stream "
        "passes) and applies what is beyond three standard errors and 1 ms.  None "
        "leaves stamps as they are.  Images are on the clock of the events.", "offset",
        "microseconds to add to the frames' stamps, learned, or none")
    denoise: bool | Mapping[str, Any] = _option(
        False, "bool or mapping",
        "Leave out events without support by neighbours behind the same polarizer, and "
        "those of hot pixels; parameters of `EventDenoiser`, or True for its own.",
        "flag", "leave out events without support by neighbours behind the same "
        "polarizer, and hot pixels")
    threads: int = _option(
        1, "int",
        "Threads that share the rows of each image; the images are the same for any "
        "number.  More than one pays from about 64,000 pixels on; 1 leaves the cores "
        "to the program's own threads.", "count",
        "threads that share the rows of an image; default: a core each above 65536 "
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
            Options by name; any other name is a parameter of the method.
        """
        known = {name: value for name, value in changes.items() if name in _NAMES}
        parameters = {**self.parameters, **changes.pop("parameters", {})}
        parameters |= {name: value for name, value in changes.items()
                       if name not in _NAMES}
        return dataclasses.replace(self, **known, parameters=parameters)

    @classmethod
    def facts(cls) -> Mapping[str, OptionFacts]:
        """Return the facts about each option, by name."""
        return {one.name: one.metadata["facts"] for one in dataclasses.fields(cls)
                if "facts" in one.metadata}

    @property
    def times(self) -> NDArray[np.int64] | None:
        """Times of the images in us, None = on a grid."""
        return None if self.times_us is None else np.asarray(self.times_us, np.int64)

    @property
    def rate(self) -> Fraction | None:
        """Images per second, exactly; None = not stated."""
        return None if self.fps is None else Fraction(self.fps)

    def __reduce__(self) -> tuple[Any, ...]:
        values = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        return _restored, ({**values, "parameters": dict(self.parameters)},)


class FusionKeywords(TypedDict, total=False):
    """The fields of FusionOptions as keywords, for type checkers and editors.

    These follow no decorator: a class that takes the options unpacks it in an overload.
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
    """A function of a source and of options, for type checkers and editors."""

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
"""Gives a function ``(source, options=None, **changes)`` the options by name: in its
signature and docstring, and for type checkers."""

_F = TypeVar("_F", bound=Callable[..., Any])


def names_options(function: _F) -> _F:
    """Write the options into the signature and docstring of a function or class.

    Parameters
    ----------
    function : callable
        It, or its ``__init__``, ends in ``**changes``, or another name, which receive
        the options.  A line ``{options}`` of its docstring is replaced by their
        description.

    Returns
    -------
    callable
        The same.
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
