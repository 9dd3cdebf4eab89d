"""Import OpenCV when it is needed."""
from __future__ import annotations

import importlib
from typing import Any

__all__ = ["native_capture", "opencv"]


def opencv() -> Any:
    """Return the module cv2, or raise an error that says how to install it.

    Returns
    -------
    module
        OpenCV, any of its four wheels.

    Raises
    ------
    ImportError
        If no OpenCV is installed.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise ImportError(
            "this needs OpenCV, which comes as an extra because its four wheels "
            "exclude each other: pip install opencv-contrib-python-headless, or any "
            "OpenCV wheel that you already use") from error


def native_capture() -> Any:
    """Return the real class cv2.VideoCapture, also while it is patched."""
    found = opencv().VideoCapture
    return getattr(found, "replaces", found)
