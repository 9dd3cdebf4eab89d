"""The methods by name."""
from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.base import Reconstructor

__all__ = ["METHODS", "make_reconstructor", "method_parameters"]

# Method -> (module, class, whether it takes thresholds).
_CLASSES = {
    "frames": ("frames", "FrameHold", False),
    "events": ("events", "EventHighPass", True),
    "cf": ("cf", "ComplementaryFilter", True),
    "kalman": ("kalman", "KalmanFilter", True),
}
METHODS = tuple(_CLASSES)
"""Names that ``fuse(method=...)`` takes."""


def make_reconstructor(
    method: str,
    shape: tuple[int, int],
    theta_on: NDArray[np.float32] | float,
    theta_off: NDArray[np.float32] | float,
    parameters: Mapping[str, Any],
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

    Raises
    ------
    TypeError
        If the method has no such parameter; the message lists those it has.
    """
    given = ({"theta_on": theta_on, "theta_off": theta_off}
             if _CLASSES[method][2] else {})
    known = method_parameters(method)
    for key in parameters:
        if key not in known:
            raise TypeError(
                f"method {method!r} has no parameter {key!r}; it takes "
                f"{', '.join(known) or 'none'}")
    made: Reconstructor = _class_of(method)(shape, **given, **parameters)
    return made


def method_parameters(method: str) -> tuple[str, ...]:
    """Return the names of a method's further parameters."""
    return tuple(key for key in inspect.signature(_class_of(method)).parameters
                 if key not in ("shape", "theta_on", "theta_off"))


def _class_of(method: str) -> Any:
    module, name, _ = _CLASSES[method]
    return getattr(importlib.import_module(f"pdavis_cv.reconstruct.{module}"), name)
