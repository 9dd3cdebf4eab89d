"""The reconstruction methods by name, and how one is made.

A method is a class derived from `Reconstructor`, which stands in this table or is
another package's entry point.
"""
from __future__ import annotations

import inspect
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._types import Parameters
from pdavis_cv.reconstruct.base import Factory, Reconstructor
from pdavis_cv.reconstruct.denoise import MARGIN, EventDenoiser
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.registry import Registry, instead

if TYPE_CHECKING:
    from pdavis_cv.pixel.model import PixelModel
    from pdavis_cv.reconstruct.weights import Weights

METHODS: Registry[Factory] = Registry("method", {
    "frames": "pdavis_cv.reconstruct.frames:FrameHold",
    "events": "pdavis_cv.reconstruct.events:from_events",
    "cf": "pdavis_cv.reconstruct.cf:ComplementaryFilter",
    "kalman": "pdavis_cv.reconstruct.kalman:KalmanFilter",
    "firenet": "pdavis_cv.reconstruct.firenet:FireNet",
    "joint": "pdavis_cv.reconstruct.firenet:Joint",
}, Reconstructor, attribute="method")
"""The methods that ``fuse(method=...)`` takes, by name."""

DEFAULT_METHOD = "kalman"
"""Method of ``fuse(method=None)`` for a recording with both events and frames."""


class MethodKeywords(TypedDict, total=False):
    """The parameters of the library's methods, for type checkers and editors."""

    adaptive_gain: bool
    backend: str
    bandwidth: tuple[float, float] | None
    cutoff_hz: float
    hold: str | bool | None
    lookahead_us: int | None
    mode: str
    model: PixelModel | None
    offsets: str
    radius: int | None
    ratio_sigma: float | None
    rule: str
    scaling: str | None
    table: ArrayLike | None
    weights: str | Path | Weights | None
    window_us: int


# Parameters of a method that are not its user's: the caller of the factory has them.
_GIVEN = ("theta_on", "theta_off", "response")


def default_method(info: RecordingInfo) -> str:
    """Return the default method for a recording's kinds of data."""
    if info.event_count == 0:
        return "frames"
    return "events" if info.frame_count == 0 else DEFAULT_METHOD


def factory_of(method: str | Factory) -> Factory:
    """Return the factory of a method's Reconstructor.

    ValueError if there is no method of this name; ImportError if it is another
    package's and cannot be used; TypeError if it is neither a name nor callable.
    """
    if isinstance(method, str):
        return METHODS[method]
    if not callable(method):
        raise TypeError("method must be a name or make a Reconstructor, got "
                        f"{type(method).__name__}")
    return method


def make_reconstructor(
    method: str | Factory, shape: tuple[int, int],
    theta_on: NDArray[np.float32] | float, theta_off: NDArray[np.float32] | float,
    parameters: Parameters, response: NDArray[np.float64] | None = None,
    denoise: Parameters | None = None, options: Collection[str] = (),
) -> Reconstructor:
    """Make the Reconstructor of a method, given by its name or as a `Factory`.

    The shape is (height, width).  Contrast thresholds are in natural-log units, float
    or (H, W), for methods that take them, and so is the response of the pixels to S0,
    S1, S2, (2, 2, 3) of the cell or (H, W, 3).  `parameters` are further ones of the
    method; `denoise` are those of an `EventDenoiser` that the events pass first.
    `options` are what the caller takes besides, only named where a parameter is
    unknown.

    A parameter that the method does not have is a TypeError, whose message lists those
    it has, as is what a Factory makes that is no Reconstructor.
    """
    maker = factory_of(method)
    known = inspect.signature(maker).parameters
    free = any(one.kind is inspect.Parameter.VAR_KEYWORD for one in known.values())
    for key in parameters:
        if key not in method_parameters(method) and not free:
            raise TypeError(
                f"method {_name(method)!r} has no parameter {key!r}; it takes "
                f"{', '.join(method_parameters(method)) or 'none'}"
                f"{instead(key, (*options, *method_parameters(method)))}")
    offered = {"theta_on": theta_on, "theta_off": theta_off, "response": response}
    given = {key: value for key, value in offered.items()
             if key in known and value is not None}
    made = maker(shape, **given, **parameters)
    if not isinstance(made, Reconstructor):
        raise TypeError(
            f"method {_name(method)!r} must make a Reconstructor, got "
            f"{type(made).__name__}")
    if denoise is not None:
        made.denoiser = EventDenoiser(made.shape, **denoise)
        made.margin += MARGIN
    return made


def method_parameters(method: str | Factory) -> tuple[str, ...]:
    """Return the names of a method's further parameters."""
    named = list(inspect.signature(factory_of(method)).parameters.values())[1:]
    return tuple(one.name for one in named if one.name not in _GIVEN
                 and one.kind is not inspect.Parameter.VAR_KEYWORD)


def _name(method: str | Factory) -> str:
    return method if isinstance(method, str) else getattr(
        method, "__name__", type(method).__name__)
