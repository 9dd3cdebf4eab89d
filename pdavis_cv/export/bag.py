"""Images in a ROS 2 bag."""
from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdavis_cv._types import Image
from pdavis_cv.export.embedded import to_json
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import chosen
from pdavis_cv.recording.bag_writer import Bag


class BagFile(Bag):
    """Write images to a ROS 2 bag as ``sensor_msgs/Image`` and ``CameraInfo``.

    Topics are ``/pdavis/NAME`` of each quantity (``32FC1``, NaN = not valid),
    ``/pdavis/picture`` (``bgr8``), ``/pdavis/camera_info`` and ``/pdavis/provenance``
    (JSON); times are those of the recording.

    Parameters
    ----------
    path : path
        ``.mcap``, ``.db3``, or a new folder.
    quantities : sequence of str
        Names from `pdavis_cv.QUANTITIES`, or ``"quad"`` and ``"stokes"``.
    shape : (int, int)
        (height, width) of the images.
    facts : mapping of str to object
        Provenance; see `provenance`.

    Raises
    ------
    ImportError
        If rosbags (extra ``[ros]``) is not installed.
    OSError
        If it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], quantities: Sequence[str],
                 shape: tuple[int, int], facts: Mapping[str, Any]) -> None:
        self._chosen, self._facts = chosen(quantities), facts
        super().__init__(path, shape)
        self.count = 0

    def add(self, frame: PolarFrame, picture: Image | None = None) -> None:
        """Append an image, and a colour picture of it, uint8 (H, W, 3), BGR."""
        if frame.t_us is None:
            raise ValueError("frame must have a time")
        if not self.count:
            self.text("provenance", frame.t_us, to_json(self._facts))
        self.camera_info(frame.t_us)
        for one in self._chosen:
            self.image(one.name, frame.t_us, np.where(
                frame.valid, one.of(frame), np.nan).astype(np.float32))
        if picture is not None:
            self.image("picture", frame.t_us, picture)
        self.count += 1
