"""Replace cv2.VideoCapture temporarily, so that other programs open recordings."""
from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any, Unpack

from pdavis_cv._opencv import native_capture, opencv
from pdavis_cv.capture import VideoCapture
from pdavis_cv.capture.source import checked_parameters, is_ours
from pdavis_cv.capture.video import CaptureKeywords
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.options import SourceOptions, source_part


@contextlib.contextmanager
def patched_cv2(
    *modules: ModuleType, mosaics: bool = False, **parameters: Unpack[CaptureKeywords]
) -> Iterator[type[VideoCapture]]:
    """Replace ``cv2.VideoCapture`` by `VideoCapture` in a ``with`` block.

    This is for libraries that construct it themselves (imutils, vidgear, supervision,
    ultralytics).  It is replaced in cv2 and in every imported module that holds a copy
    of the name.  Sources that are not recordings are passed to the real class.
    Captures that were made inside the block remain usable after it.

    Parameters
    ----------
    *modules : module
        Further modules whose ``VideoCapture`` is replaced.
    mosaics : bool
        Also read videos and images as those of a polarization camera; needs a
        ``layout`` or ``sensor``.
    **parameters
        Parameters of `VideoCapture` for every recording that is opened, e.g. ``fps``.

    Yields
    ------
    type
        The class that replaces ``cv2.VideoCapture``.

    Raises
    ------
    TypeError
        If a parameter is unknown.
    ValueError
        If `mosaics` is True without a layout.

    Notes
    -----
    The change affects all threads.
    """
    if mosaics and SourceOptions(**source_part(parameters)).known_layout is None:
        raise ValueError("mosaics=True needs layout=, the images do not say it")
    of_fuse = {name: value for name, value in parameters.items()
               if name not in ("output", "gain", "gamma", "log")}
    checked_parameters(of_fuse)
    cv2, real = opencv(), native_capture()
    patched = _patched(dict(parameters), mosaics, real)
    originals = [(module, module.VideoCapture) for module in {cv2, *modules}]
    outer = cv2.VideoCapture
    originals += [(module, outer) for module in _holding(outer)
                  if module not in (cv2, *modules)]
    for module, _ in originals:
        vars(module)["VideoCapture"] = patched
    try:
        yield patched
    finally:
        for module, original in originals:
            vars(module)["VideoCapture"] = original
        # Modules that were imported inside the block hold copies of the replacement.
        for module in _holding(patched):
            vars(module)["VideoCapture"] = outer


def _holding(value: object) -> list[ModuleType]:
    """Return the imported modules whose ``VideoCapture`` is a value."""
    return [module for module in list(sys.modules.values())
            if isinstance(module, ModuleType)
            and vars(module).get("VideoCapture") is value]


def _patched(
    parameters: dict[str, Any], mosaics: bool, real: Any
) -> type[VideoCapture]:
    stated = parameters if mosaics else {}

    class PatchedVideoCapture(VideoCapture):
        """A VideoCapture that applies the parameters to recordings only."""

        replaces = real  # opens sources that are not recordings

        def __init__(
            self,
            filename: str | os.PathLike[str] | int | Recording | None = None,
            apiPreference: int = 0,
            params: Sequence[float] = (),
            *,
            index: int | None = None,
        ) -> None:
            super().__init__(**parameters)
            self._asked = self._parameters
            if filename is not None or index is not None:
                self._open("VideoCapture", filename, apiPreference, params, index)

        def _open(
            self, function: str, filename: Any, backend: Any, params: Any, index: Any
        ) -> bool:
            ours = is_ours(filename, backend, stated)
            self._parameters = self._asked if ours else {}
            return super()._open(function, filename, backend, params, index)

        def __reduce__(self) -> tuple[Any, ...]:
            # Another process cannot import this local class.
            return object.__new__, (VideoCapture,), self.__getstate__()

    PatchedVideoCapture.__name__ = PatchedVideoCapture.__qualname__ = "VideoCapture"
    return PatchedVideoCapture
