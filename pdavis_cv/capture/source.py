"""Decide whether this package or cv2.VideoCapture opens a source."""
from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from pdavis_cv._types import Parameters
from pdavis_cv.capture import constants as c
from pdavis_cv.capture.outputs import output_at
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.live import is_address, open_source
from pdavis_cv.live.camera import address_of
from pdavis_cv.reconstruct.methods import METHODS, method_parameters
from pdavis_cv.recording.base import Source
from pdavis_cv.recording.options import SourceOptions, source_part
from pdavis_cv.recording.registry import is_recording
from pdavis_cv.registry import instead

_FUSE = tuple(FusionOptions.facts())
_OPEN = tuple(SourceOptions.facts())
_VIEW = ("output", "gain", "gamma", "log")


def is_ours(source: Any, backend: int, parameters: Parameters) -> bool:
    """Return whether a source is opened here and not by cv2.

    ``CAP_PDAVIS`` as backend says so, 0 leaves it to the source, others mean cv2.  Ours
    are recordings and live sources, their addresses, files with the name of a
    recording, and several files; and, if `parameters` have a layout or a sensor, every
    path, which is then a mosaic video or image sequence.
    """
    mosaic = any(parameters.get(name) is not None for name in (
        "layout", "sensor", "analyser_steps"))
    if (backend == c.CAP_PDAVIS or isinstance(source, Source)
            or (backend == 0 and is_address(source))):
        return True
    if backend != 0 or not isinstance(source, (str, os.PathLike, list, tuple)):
        return False
    return mosaic or isinstance(source, (list, tuple)) or is_recording(source)


def opened(source: Any, parameters: Parameters) -> Source:
    """Open a source with this package."""
    if isinstance(source, Source):
        return source
    if isinstance(source, int) and not isinstance(source, bool):
        source = address_of(source)
    paths = source if isinstance(source, (list, tuple)) else [source]
    if not paths or not all(isinstance(path, (str, os.PathLike)) for path in paths):
        raise OSError(f"a recording is opened by its path, got {source!r}")
    return open_source(source, **source_part(parameters))


def checked_parameters(parameters: Parameters) -> None:
    """Raise TypeError if no method of `fuse` has one of the parameters."""
    others = [name for name in parameters if name not in _FUSE and name not in _OPEN]
    # The method may be changed later, but to none of another package unnamed.
    methods = [*METHODS.known, parameters.get("method")] if others else []
    of_methods = {
        name for method in methods if method for name in method_parameters(method)}
    for name in others:
        if name not in of_methods:
            raise TypeError(
                f"VideoCapture has no parameter {name!r}"
                f"{instead(name, (*_FUSE, *_OPEN, *of_methods, *_VIEW))}")


# ---- parameters as numbers ---------------------------------------------------


def parameters_of(params: Sequence[float]) -> dict[str, Any] | None:
    """Return the keyword arguments for cv2's property, value, property, value, ...

    None if a property or a value is unknown.
    """
    values = list(params)
    if len(values) % 2:
        return None
    found: dict[str, Any] = {}
    for prop, value in zip(values[::2], values[1::2], strict=True):
        name = NAME_OF_PROPERTY.get(int(prop))
        if name is None:
            return None
        decoded = decoded_value(name, value)
        if decoded is None:
            return None
        found[name] = decoded
    return found


NAME_OF_PROPERTY = {
    c.CAP_PROP_PDAVIS_OUTPUT: "output",
    c.CAP_PROP_PDAVIS_FPS: "fps",
    c.CAP_PROP_PDAVIS_GAIN: "gain",
    c.CAP_PROP_PDAVIS_GAMMA: "gamma",
    c.CAP_PROP_PDAVIS_LOG: "log",
    c.CAP_PROP_OPEN_TIMEOUT_MSEC: "open_timeout_ms",
    c.CAP_PROP_READ_TIMEOUT_MSEC: "read_timeout_ms",
}
"""Properties that can be set, by the name of the keyword of the same meaning."""


def decoded_value(name: str, value: float) -> Any:
    """Return the keyword argument for a property's value, None if it is invalid."""
    if value != value:
        return None
    if name == "log":
        return bool(value)
    if name != "output":
        return float(value) if value > 0 else None
    try:
        return int(value) if value == int(value) and output_at(int(value)) else None
    except (LookupError, OverflowError):    # also infinity
        return None
