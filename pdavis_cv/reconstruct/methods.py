"""The methods by name."""
from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.base import Reconstructor
from pdavis_cv.reconstruct.denoise import Denoised

__all__ = ["EVENT_METHODS", "METHODS", "make_reconstructor", "method_parameters"]

# Method -> (module, what makes it, whether it takes thresholds).
_CLASSES = {
    "frames": ("frames", "FrameHold", False),
    "events": ("from_events", "from_events", True),
    "cf": ("cf", "ComplementaryFilter", True),
    "kalman": ("kalman", "KalmanFilter", True),
    "firenet": ("firenet", "FireNet", True),
    "joint": ("firenet", "Joint", True),
}
METHODS = tuple(_CLASSES)
"""Names that ``fuse(method=...)`` takes."""

EVENT_METHODS = ("events", "firenet", "joint")
"""Those that use no frames: their scale of intensity is their own."""


def make_reconstructor(
    method: str,
    shape: tuple[int, int],
    theta_on: NDArray[np.float32] | float,
    theta_off: NDArray[np.float32] | float,
    parameters: Mapping[str, Any],
    response: NDArray[np.float64] | None = None,
    denoise: Mapping[str, Any] | None = None,
) -> Reconstructor:
    """Make the Reconstructor of a method.

    Parameters
    ----------
    method : str
        One of ``METHODS``.
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float or ndarray of float32, shape (H, W)
        Contrast thresholds in natural-log units.
    parameters : mapping of str to object
        Further parameters of the method.
    response : ndarray of float64, shape (2, 2, 3) or (H, W, 3), optional
        Response of the pixels (of the cell) to S0, S1, S2, for methods that ask.
    denoise : mapping of str to object, optional
        Parameters of an `EventDenoiser` to put before it.

    Raises
    ------
    TypeError
        If the method has no such parameter; the message lists those it has.
    """
    given: dict[str, Any] = {}
    if _CLASSES[method][2]:
        given = {"theta_on": theta_on, "theta_off": theta_off}
    known = method_parameters(method)
    for key in parameters:
        if key not in known:
            raise TypeError(
                f"method {method!r} has no parameter {key!r}; it takes "
                f"{', '.join(known) or 'none'}")
    maker = _class_of(method)
    if response is not None and "response" in inspect.signature(maker).parameters:
        given["response"] = response
    made: Reconstructor = maker(shape, **given, **parameters)
    return made if denoise is None else Denoised(made, **denoise)


def method_parameters(method: str) -> tuple[str, ...]:
    """Return the names of a method's further parameters."""
    return tuple(key for key in inspect.signature(_class_of(method)).parameters
                 if key not in ("shape", "theta_on", "theta_off", "response"))


def _class_of(method: str) -> Any:
    module, name, _ = _CLASSES[method]
    return getattr(importlib.import_module(f"pdavis_cv.reconstruct.{module}"), name)
