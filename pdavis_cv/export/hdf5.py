"""HDF5 stacks with one dataset per quantity."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.export.embedded import to_json
from pdavis_cv.export.stacks import StackFile
from pdavis_cv.recording.hdf5.reader import h5py_module
from pdavis_cv.recording.hdf5.sink import written


class Hdf5File(StackFile):
    """Write an HDF5 file with a dataset (T, H, W) per quantity, and dimension scales.

    The dimension scales are ``t_us`` (T,), ``y`` (H,) and ``x`` (W,), from which
    ``xarray.open_dataset`` labels all axes; ``y`` and ``x`` are in pixels, or in
    micrometres in the object if ``pixel_um`` is given.  Each dataset has an attribute
    ``units``; the file has ``provenance`` (JSON) and ``pixel_um``.

    Raises
    ------
    ImportError
        If h5py (extra ``[export]``) is not installed.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        h5py_module()       # if it is missing, before anything is computed
        super().__init__(*arguments, **options)

    def _finish(self, part: Path, stack: NDArray[np.float32]) -> None:
        height, width = stack.shape[2:]
        with written(part) as file:
            file.attrs["provenance"] = to_json(self.facts)
            if self.pixel_um is not None:
                file.attrs["pixel_um"] = self.pixel_um
            pitch, unit = ((1, "pixel") if self.pixel_um is None
                           else (self.pixel_um, "um"))
            scales = {"t_us": (np.array(self.times_us, np.int64), "us"),
                      "y": (pitch * np.arange(height), unit),
                      "x": (pitch * np.arange(width), unit)}
            for name, (values, unit) in scales.items():
                file[name] = values
                file[name].attrs["units"] = unit
                file[name].make_scale(name)
            for c, name in enumerate(self.quantities):
                data = file.create_dataset(name, (self.count, height, width), "<f4")
                data.attrs["units"] = self.units[name]
                for axis, scale in zip(data.dims, scales, strict=True):
                    axis.attach_scale(file[scale])
                for t in range(self.count):
                    data[t] = stack[t, c]
