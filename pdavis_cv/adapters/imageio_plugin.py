"""Plugin for imageio: ``imiter("run.aedat4", plugin="pdavis", fps=100)``."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from imageio.config import (
    FileExtension,
    PluginConfig,
    extension_list,
    known_extensions,
    known_plugins,
)
from imageio.core.request import InitializationError, IOMode, Request
from imageio.core.v3_plugin_api import ImageProperties, PluginV3
from numpy.typing import NDArray

from pdavis_cv._types import Image
from pdavis_cv.capture import VideoCapture
from pdavis_cv.capture.constants import CAP_PDAVIS_BGR, CAP_PROP_PDAVIS_POS_US
from pdavis_cv.recording.open import open_recording
from pdavis_cv.recording.options import source_part
from pdavis_cv.recording.registry import suffixes

_POS_FRAMES, _FPS, _FRAME_COUNT = 1, 5, 7


class PdavisPlugin(PluginV3):
    """Read the images of a recording; pictures are RGB, as usual in imageio.

    Parameters may also be passed to the reading functions.  They remain in effect until
    a call passes others, because ``imageio.v2`` passes them to the first call only.

    Parameters
    ----------
    request : imageio.core.Request
    output : int
        ``CAP_PDAVIS_*``; default: the grey picture.
    **parameters
        Parameters of `VideoCapture`, e.g. ``fps``.

    Raises
    ------
    InitializationError
        If the file is not a recording, a package for it is missing, or it is opened
        for writing.
    """

    def __init__(
        self, request: Request, *, output: int = CAP_PDAVIS_BGR, **parameters: Any
    ) -> None:
        super().__init__(request)
        self._capture: VideoCapture | None = None
        self._given = {"output": output, **parameters}
        self._used: dict[str, Any] = {}
        self._last: int | None = None  # number of the last image that was read
        if request.mode.io_mode == IOMode.write:
            raise InitializationError("recordings are not written through imageio")
        self._path = request.get_local_filename()
        try:
            open_recording(self._path, **source_part(parameters)).close()
        except (OSError, ImportError) as error:
            raise InitializationError(str(error)) from error

    def read(self, *, index: Any = 0, **parameters: Any) -> Image:
        """Return image number index, or all of them with ``index=...``.

        Raises
        ------
        IndexError
            If there is no such image.
        """
        if index is None or index is Ellipsis:
            images = list(self.iter(**parameters))
            if not images:
                raise IndexError("the recording holds no image")
            return np.stack(images)
        capture, wanted = self._opened(parameters), index
        if index < 0:
            index += int(capture.get(_FRAME_COUNT))
        if index >= 0 and capture.get(_POS_FRAMES) != index:
            capture.set(_POS_FRAMES, index)
        image = _next(capture) if index >= 0 else None
        self._last = None if image is None else index
        if image is None:
            raise IndexError(f"the recording holds no image {wanted}")
        return image

    def iter(self, **parameters: Any) -> Iterator[Image]:
        """Yield all images in order."""
        capture = self._opened(parameters)
        capture.set(_POS_FRAMES, 0)
        self._last = None
        while (image := _next(capture)) is not None:
            self._last = int(capture.get(_POS_FRAMES)) - 1
            yield image

    def write(self, ndimage: Any, **keywords: Any) -> None:
        """Raise NotImplementedError: imageio cannot write recordings."""
        raise NotImplementedError("recordings are not written through imageio")

    def properties(self, index: Any = 0, **parameters: Any) -> ImageProperties:
        """Return shape and dtype of an image, or of all with ``index=...``."""
        every = index is Ellipsis or index is None
        image = self.read(index=0 if every else index, **parameters)
        if not every:
            return ImageProperties(shape=image.shape, dtype=image.dtype)
        n = int(self._opened(parameters).get(_FRAME_COUNT))
        return ImageProperties(
            shape=(n, *image.shape), dtype=image.dtype, n_images=n, is_batch=True)

    def metadata(
        self, index: Any = 0, exclude_applied: bool = True, **parameters: Any
    ) -> dict[str, Any]:
        """Return ``fps`` and, for one image, its time ``t_us``.

        The last image that was read is not read again.
        """
        capture = self._opened(parameters)
        found: dict[str, Any] = {"fps": capture.get(_FPS)}
        if index is not Ellipsis and index is not None:
            if index != self._last:
                self.read(index=index, **parameters)
            found["t_us"] = int(capture.get(CAP_PROP_PDAVIS_POS_US))
        return found

    def close(self) -> None:
        """Close the recording."""
        if self._capture is not None:
            self._capture.release()
        super().close()

    def _opened(self, parameters: dict[str, Any]) -> VideoCapture:
        """Return the capture, opened again if the parameters have changed."""
        used = {**self._given, **parameters}
        if self._capture is None or (parameters and used != self._used):
            if self._capture is not None:
                self._capture.release()
            self._capture, self._used = VideoCapture(self._path, **used), used
            self._last = None
        return self._capture


def _next(capture: VideoCapture) -> NDArray[Any] | None:
    ok, image = capture.read()
    if not ok or image is None:
        return None
    rgb = image.dtype == np.uint8 and image.ndim == 3
    return np.ascontiguousarray(image[..., ::-1]) if rgb else image


def register() -> None:
    """Register the suffixes of recordings with imageio; needed once."""
    if "pdavis" in known_plugins:
        return
    known_plugins["pdavis"] = PluginConfig(
        name="pdavis", class_name="PdavisPlugin",
        module_name="pdavis_cv.adapters.imageio_plugin", install_name="pdavis-cv")
    for suffix in suffixes():
        extension = FileExtension(
            extension=suffix, priority=["pdavis"],
            name="Recording of an event camera")
        extension_list.append(extension)
        known_extensions.setdefault(suffix, []).insert(0, extension)
