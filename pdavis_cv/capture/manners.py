"""Errors and default values that imitate cv2."""
from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar, cast

from pdavis_cv.errors import PdavisError

Method = TypeVar("Method", bound=Callable[..., Any])

StsError, StsBadArg = -2, -5

# Type codes of OpenCV 5, used if OpenCV is not installed.
_CODES = {"CV_8UC1": 0, "CV_8UC3": 64, "CV_32FC1": 5, "CV_32FC3": 69, "CV_32FC4": 101}


@functools.cache
def _cv2() -> Any:
    """Return cv2, None if it is not installed."""
    try:
        return importlib.import_module("cv2")
    except ImportError:
        return None


def raise_like_cv2(function: str, message: str, code: int = StsError) -> NoReturn:
    """Raise cv2.error (PdavisError without OpenCV) with cv2's attributes.

    `function` is the method that failed, `code` OpenCV's number for the kind of error.
    """
    kind: Any = PdavisError if _cv2() is None else _cv2().error
    error = kind(f"pdavis_cv: error: ({code}) {message} in function '{function}'")
    error.code, error.err, error.func = code, message, function
    error.msg, error.file, error.line = str(error), "", -1
    raise error


def overloads(method: Method) -> Method:
    """Make a method reject unknown arguments with the error that cv2 raises."""
    @functools.wraps(method)
    def call(*args: Any, **keywords: Any) -> Any:
        try:
            return method(*args, **keywords)
        except TypeError:
            try:
                inspect.signature(method).bind(*args, **keywords)
            except TypeError as mismatch:
                refusal = f"Overload resolution failed: {mismatch}"
            else:
                raise
        raise_like_cv2(method.__name__, refusal, StsBadArg)
    return cast(Method, call)


def unknown_property() -> float:
    """Return the value of get() for a property that does not exist.

    It is -1 (``CAP_PROP_UNKNOWN``) in OpenCV 5 and 0 in OpenCV 4.
    """
    cv2 = _cv2()
    return 0.0 if cv2 is not None and int(cv2.__version__.split(".")[0]) < 5 else -1.0


def type_code(name: str) -> float:
    """Return the number of a matrix type, e.g. ``"CV_8UC3"``, in the OpenCV in use."""
    return float(getattr(_cv2(), name, _CODES[name]))
