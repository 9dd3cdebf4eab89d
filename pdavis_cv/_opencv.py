"""Import OpenCV when it is needed."""
from __future__ import annotations

import importlib
import importlib.util
import os
from typing import Any


def opencv() -> Any:
    """Return cv2, 4.6 or later, or raise an ImportError that says how to install it.

    Wheels before 4.10, and Debian's 4.6, are compiled for NumPy 1: the error says so.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        if importlib.util.find_spec("cv2") is not None:
            raise ImportError(
                "the OpenCV that is installed cannot be imported; wheels before 4.10, "
                "and Debian's 4.6, are compiled for NumPy 1: install NumPy 1.26, or "
                f"OpenCV 4.10 or later ({error})") from error
        raise ImportError(
            "this needs OpenCV, which comes as an extra because its four wheels "
            "exclude each other: pip install opencv-contrib-python-headless, or any "
            "OpenCV wheel that you already use") from error


def opencv_name(path: str | os.PathLike[str]) -> str:
    """Return a path as a text; OSError if it is no UTF-8, at which OpenCV crashes."""
    name = os.fspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        raise OSError(f"{name}: OpenCV opens only names in UTF-8") from None
    return name


def native_capture() -> Any:
    """Return the real class cv2.VideoCapture, also while it is patched."""
    found = opencv().VideoCapture
    return getattr(found, "replaces", found)


def set_log_level(level: int) -> int:
    """Set how much OpenCV prints, 0 = nothing, and return what was set before."""
    cv2 = opencv()
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # from 4.13 on
    return int(logging.setLogLevel(level))
